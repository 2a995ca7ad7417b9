"""ROS 2 behind the seam."""
