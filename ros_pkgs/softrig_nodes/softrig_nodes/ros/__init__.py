"""The implementation of the seam by ROS 2."""
