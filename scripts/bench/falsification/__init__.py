"""Public falsification problems, written from their equations, and the runs that other searches need for them."""
