"""What people see of a node and do with it by usual ROS tools."""
