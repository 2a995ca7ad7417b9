"""A rig as a map: its linearisation, its operating points, an agent in place of a controller."""
