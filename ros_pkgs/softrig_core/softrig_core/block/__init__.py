"""Blocks and the definition of their tick: ports, parameters, schedule, step, loop."""
