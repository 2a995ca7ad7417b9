"""The options of a run, and the command that repeats it."""
