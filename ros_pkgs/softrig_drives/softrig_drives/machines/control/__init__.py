"""Field orientation, voltage over frequency, six steps, and their common parts."""
