"""Dependence of the last digits on the machine: CPU kernels of numpy and OpenBLAS, functions of the C library.

`pin` fixes the kernels before numpy is loaded, in processes that softrig starts: the command line, nodes, workers. In
any other process the user's choice stays, and a run records the kernels that it used. Code that determines the numbers
of a run uses neither BLAS nor numpy's array functions (doc/bits.md); checks and figures may use them.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, MutableMapping
from functools import cache

CORE, SIMD = "OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES"
PINS = {CORE: "Haswell", SIMD: "X86_V4 AVX512_ICL AVX512_SPR"}
ARGUMENTS = 1000  # arguments of each function in the digest
# functions that decide numbers: of `math`, each with its interval; of `cmath`; of two arguments
FUNCTIONS = {
    "sin": (-40.0, 40.0),
    "cos": (-40.0, 40.0),
    "tan": (-10.0, 10.0),
    "asin": (-1.0, 1.0),
    "acos": (-1.0, 1.0),
    "tanh": (-3.0, 3.0),
    "exp": (-30.0, 30.0),
    "expm1": (-2.0, 2.0),
    "log": (0.0, 3.0),
    "log2": (0.0, 3.0),
    "log10": (0.0, 3.0),
    "log1p": (-0.9, 2.0),
}
COMPLEX = ("exp", "sqrt", "sinh", "cosh", "atanh")
OF_TWO = ("pow", "atan2", "hypot")


def cpu_has_avx512(cpuinfo: str = "/proc/cpuinfo") -> bool:
    """Return whether numpy and OpenBLAS would choose kernels here that a CPU without AVX-512 has not."""
    try:
        with open(cpuinfo) as file:
            return "avx512f" in next((line for line in file if line.startswith("flags")), "").split()
    except OSError:
        return False


def pin(environ: MutableMapping[str, str] = os.environ, *, wider: bool | None = None) -> None:
    """Select the AVX2 kernels if the CPU has wider ones, for this process and those that it starts.

    Variables that are already set stay. If numpy is already loaded, its own choice also stays; `kernels` reports it.

    Parameters
    ----------
    wider : bool, optional
        Whether the CPU has AVX-512; detected by default.
    """
    if not (cpu_has_avx512() if wider is None else wider):
        return
    environ.setdefault(CORE, PINS[CORE])
    if "NPY_ENABLE_CPU_FEATURES" not in environ:  # numpy takes one of the two
        environ.setdefault(SIMD, PINS[SIMD])


def kernels() -> dict[str, str]:
    """Return the kernels in use: ``blas``, those of numpy's OpenBLAS, and ``simd``, the levels of numpy's functions."""
    return {"blas": blas_core(), "simd": simd_level()}


@cache
def blas_core() -> str:
    """Return the kernels that numpy's OpenBLAS has chosen (``Haswell``); empty where numpy has another BLAS."""
    import ctypes

    from numpy.linalg import _umath_linalg

    library = ctypes.CDLL(_umath_linalg.__file__)  # its symbols and those of the BLAS that it is linked with
    for prefix in ("scipy_openblas", "openblas"):
        for suffix in ("64_", ""):
            name = getattr(library, f"{prefix}_get_corename{suffix}", None)
            if name is not None:
                name.restype = ctypes.c_char_p
                return str(name().decode())
    return ""


@cache
def simd_level() -> str:
    """Return which CPU features numpy's array functions may use beyond the baseline (``X86_V3``)."""
    from importlib import import_module

    core = import_module("numpy._core._multiarray_umath")
    baseline, features = core.__cpu_baseline__, core.__cpu_features__
    return " ".join([*baseline[-1:], *(name for name in core.__cpu_dispatch__ if features[name])])


@cache
def math_digest() -> str:
    """Return a digest of the functions that determine numbers: the bits of their results at `ARGUMENTS` arguments each.

    These are the functions that plants, controllers and searches call (`FUNCTIONS`; a test finds them in the sources).
    Products and quotients of complex numbers are included, because a compiler may fuse them. The version of a library
    is not sufficient: Debian changed functions within glibc 2.36, and glibc selects functions by CPU (FMA).
    """
    import cmath
    import hashlib
    import math
    import struct

    # spread over an interval by the golden ratio; multiplication and addition are alike everywhere
    spread = [(k * 0.6180339887498949) % 1.0 for k in range(1, ARGUMENTS + 1)]
    pairs = list(zip(spread, reversed(spread), strict=True))
    plane = [complex(4.0 * u - 2.0, 4.0 * v - 2.0) for u, v in pairs]
    digest = hashlib.sha256()

    def digest_values(values: Iterable[complex]) -> None:
        digest.update(b"".join(struct.pack("<2d", z.real, z.imag) for z in values))

    for name, (low, high) in FUNCTIONS.items():
        function: Callable[..., complex] = getattr(math, name)
        digest_values(function(low + (high - low) * u) for u in spread)
    for name in COMPLEX:
        function = getattr(cmath, name)
        digest_values(function(z) for z in plane)
    digest_values(math.pow(9.0 * u, 8.0 * v - 4.0) for u, v in pairs)
    digest_values(math.atan2(u - 0.5, v - 0.5) for u, v in pairs)
    digest_values(math.hypot(u, v) for u, v in pairs)  # Python's own
    digest_values(abs(z) for z in plane)  # the C library's, as numpy.hypot
    digest_values(z * w for z, w in zip(plane, reversed(plane), strict=True))
    digest_values(z / w for z, w in zip(plane, reversed(plane), strict=True))
    return digest.hexdigest()[:12]
