"""Nodes whose ticks end when everything due has been exchanged."""
