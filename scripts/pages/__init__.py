"""The tools that make the doc pages and compare them with the code: ``scripts/softrig docs pages``, from a checkout."""

from softrig_core.bits import pin

pin()  # before a part loads numpy, so that all CPUs use the same kernels
