"""Piecewise affine systems with delay: proven margins, checked certificates, and plants that confirm them."""
