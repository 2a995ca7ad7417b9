"""Studies: a scenario over cases, grids, draws, seeds, or a search."""
