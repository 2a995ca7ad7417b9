"""Blocks whose work runs in a process of its own."""
