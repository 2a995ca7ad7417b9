"""Functional Mock-up Units: plants and laws from other tools as nodes of a rig; see `doc/fmu.md`."""
