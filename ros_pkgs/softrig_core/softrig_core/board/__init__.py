"""Boards in a rig: frames, wires, and blocks whose ticks run on a board."""

SIMULATORS = ("simavr", "qemu", "program")  # here, as who reads a port need not load all of a board's entry
