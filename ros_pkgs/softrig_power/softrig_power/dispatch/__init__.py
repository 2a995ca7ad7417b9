"""Economic dispatch of thermal units with valve points, after Sharifzadeh (2020): MILP, NLP and a proof."""
