"""The pages of the packages as one site: collected, completed from docstrings and declarations, built by Sphinx."""

from softrig_core.bits import pin

pin()  # before a part loads numpy, so that all CPUs use the same kernels
