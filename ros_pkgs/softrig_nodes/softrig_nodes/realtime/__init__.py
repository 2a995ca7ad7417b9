"""Nodes against the wall clock."""
