"""Nodes in real time: ticks follow the wall clock."""
