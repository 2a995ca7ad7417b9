"""What the suite costs, as ratios to baselines of the same run: ``scripts/softrig bench``, from a checkout."""

from softrig_core.bits import pin

pin()  # before a part loads numpy, so that all CPUs use the same kernels
