"""A rig: the nodes of a scenario, wired and checked."""
