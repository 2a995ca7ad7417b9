"""Studies: a scenario over cases, grids, draws, seeds, or a search."""

# The most runs of one study or search, because more would take weeks.
RUNS = 1_000_000
