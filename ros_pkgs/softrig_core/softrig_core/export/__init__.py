"""Blocks as C99: a controller or plant that ran as a node is exported with its golden rows."""
