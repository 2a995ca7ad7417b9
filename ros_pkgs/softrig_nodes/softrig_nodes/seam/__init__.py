"""What a node's logic knows of the middleware: endpoints, ticks, buttons, health; no ROS in it."""
