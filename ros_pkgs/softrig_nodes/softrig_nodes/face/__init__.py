"""What users see of a node, and how they operate it, with the usual ROS tools."""
