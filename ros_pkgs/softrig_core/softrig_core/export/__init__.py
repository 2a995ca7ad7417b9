"""Blocks as C99: a controller or plant that ran as a node leaves Python with its golden rows."""
