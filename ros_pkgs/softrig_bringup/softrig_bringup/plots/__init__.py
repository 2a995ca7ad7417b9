"""Pictures of runs: curves of signals, marks of expected values, axes for both."""
