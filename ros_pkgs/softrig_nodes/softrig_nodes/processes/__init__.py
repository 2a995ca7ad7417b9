"""A rig as processes: their start, supervision and end."""
