"""Scenarios: one experiment as validated data, from files or from code."""
