"""The pages of the packages as one site: collected, completed from docstrings and declarations, built by Sphinx."""

from softrig_core.bits import pin

pin()  # the same kernels on every CPU, before a part loads numpy
