"""Public falsification problems, written anew from their equations, and what other searches need for them."""
