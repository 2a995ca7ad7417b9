"""The pages of the packages as one site: collected, completed by what the code says of itself, built by Sphinx."""

from softrig_core.bits import pin

pin()  # the same kernels on every CPU, before a part loads numpy
