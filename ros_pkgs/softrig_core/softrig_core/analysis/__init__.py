"""A rig as a map: its linear view, its operating points, an agent in the place of a law."""
