"""Boards in a rig: frames, wires, and blocks whose ticks run on a board."""
