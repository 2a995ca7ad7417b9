"""Studies: a scenario over cases, grids, draws, seeds, or a search."""

RUNS = 1_000_000  # of one study or search: more would take weeks
