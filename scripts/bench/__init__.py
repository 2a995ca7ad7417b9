"""What the suite costs, as ratios to baselines of the same run: ``scripts/softrig bench``, from a checkout."""

import softrig_core as softrig_core  # which chooses the kernels of numpy before a part loads it
