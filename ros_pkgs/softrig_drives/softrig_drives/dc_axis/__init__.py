"""Position axis of a 12 V DC motor with full state feedback over a fieldbus (Love et al., 2024)."""
