"""Pictures of runs: `curves` from signals, `marks` of what is expected, `axes` to draw both, `figures` of a run."""
