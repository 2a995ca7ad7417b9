"""A rig: the members of a scenario, wired and checked."""
