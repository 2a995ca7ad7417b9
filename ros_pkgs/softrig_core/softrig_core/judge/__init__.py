"""How a record is judged: figure functions, formulas, units, expectations, claims; arrays and words, no rig."""
