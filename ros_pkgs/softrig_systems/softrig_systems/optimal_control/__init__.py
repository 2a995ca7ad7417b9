"""Optimal control by modified variational iteration, against direct collocation and exact answers."""
