"""The search for a run that violates a requirement."""
