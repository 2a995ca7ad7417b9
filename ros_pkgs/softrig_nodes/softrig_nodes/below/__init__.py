"""All uses of non-public interfaces of rclpy, rcl and launch; no other room uses them.

`uses` lists what is used of Python, with a test and the public way; `arrival` and `tf_message` call C, `leave` ends the
process.
"""
