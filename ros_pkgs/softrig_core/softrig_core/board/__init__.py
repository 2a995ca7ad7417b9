"""Boards in a rig: frames, wires, and blocks whose ticks run on a board."""

SIMULATORS = ("simavr", "qemu", "program")  # defined here, so that code which reads a port need not import the rest
