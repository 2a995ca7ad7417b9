"""Bags of a running system: recorder and player."""
