"""Generalised predictive control (GPC) of single-input single-output plants, with and without constraints."""
