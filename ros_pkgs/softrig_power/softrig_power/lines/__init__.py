"""Transmission lines: constants, exact two-ports, lossy Bergeron sections and modal transforms."""
