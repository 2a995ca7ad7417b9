"""What the suite costs, as ratios to baselines of the same run: ``scripts/softrig bench``, from a checkout."""

from softrig_core.bits import pin

pin()  # the same kernels on every CPU, before a part loads numpy
