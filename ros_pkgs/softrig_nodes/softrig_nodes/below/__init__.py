"""All that softrig uses of rclpy, rcl and launch below their public interfaces; nothing else in the packages does.

`uses` lists what is used of Python, with a test and the public way; `arrival` and `tf_message` call C, `leave` ends the
process.
"""
