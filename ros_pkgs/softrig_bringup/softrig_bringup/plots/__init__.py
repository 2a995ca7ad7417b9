"""Pictures of runs: curves from signals, marks of what is expected, axes that draw both."""
