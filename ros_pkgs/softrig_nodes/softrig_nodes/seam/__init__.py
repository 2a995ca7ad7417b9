"""The middleware as the logic of a node sees it: endpoints, ticks, buttons, health; without ROS."""
