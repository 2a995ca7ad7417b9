"""Blocks, and what a tick of one is: ports, parameters, schedule, step, loop."""
