"""Three-phase six-switch rectifier under generalised predictive control."""
