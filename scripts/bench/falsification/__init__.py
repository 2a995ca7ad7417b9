"""Public falsification problems, written from their equations, and what other searches need for them."""
