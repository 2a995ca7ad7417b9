"""The search for the run that violates a requirement."""
