"""Evaluation of records: figure functions, formulas, units, expectations, claims; arrays and texts, no rig."""
