"""Boards in a rig: frames, wires, and blocks whose ticks a board answers."""
