"""Field orientation, voltage over frequency, six steps, and what they are made of."""
