"""Three-phase machines on a two-level inverter, and their field-oriented control."""
