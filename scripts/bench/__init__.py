"""What the suite costs, as ratios to baselines of the same run: ``scripts/softrig bench``, from a checkout."""
