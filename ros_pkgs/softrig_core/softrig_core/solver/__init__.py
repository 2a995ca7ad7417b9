"""Blocks whose work runs in a separate process."""
