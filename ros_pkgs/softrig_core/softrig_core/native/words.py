"""Native replacements for Python functions: the same bits; an error discards the tick.

Each is a function of its own in the compiled text. If one raises, the tick is discarded and Python computes it again,
with its own type and text of the error.
"""

from __future__ import annotations

import builtins
import cmath
import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable
from typing import Any

COMPLEX = ("phase", "rect")  # of `cmath`
WHOLE = "4e18"  # beyond it a float may be no int64, whose largest is 9.2e18

# C returns NaN or infinity where Python's `math` raises. The text raises there as well, so that Python answers the tick
# with its own error.
_BELOW = "def {name}(x):\n    if x {wrong}:\n        raise ValueError\n    return math.{name}(x)\n"
_FINITE = "def {name}(x):\n    if x - x != 0.0 and x == x:\n        raise ValueError\n    return math.{name}(x)\n"
_LARGE = (
    "def {name}(x):\n    y = math.{name}(x)\n    if y - y != 0.0 and x - x == 0.0:\n        raise OverflowError\n"
    "    return y\n"
)
_CUT = (
    "def {name}(x):\n    if not -"
    + WHOLE
    + " < x < "
    + WHOLE
    + ":\n        raise OverflowError\n    return {call}(x)\n"
)

_LARGEST = (1 << 63) - 1

TEXTS: dict[str, str] = {
    **{n: _BELOW.format(name=n, wrong="< 0.0") for n in ("sqrt",)},
    **{n: _BELOW.format(name=n, wrong="<= 0.0") for n in ("log", "log2", "log10")},
    "log1p": _BELOW.format(name="log1p", wrong="<= -1.0"),
    **{n: _BELOW.format(name=n, wrong="< -1.0 or x > 1.0") for n in ("asin", "acos")},
    **{n: _FINITE.format(name=n) for n in ("sin", "cos", "tan")},
    **{n: _LARGE.format(name=n) for n in ("exp", "expm1", "sinh", "cosh")},
    **{n: _CUT.format(name=n, call=f"math.{n}") for n in ("floor", "ceil", "trunc")},
    **{f"{n}_": _CUT.format(name=f"{n}_", call=n) for n in ("int", "round")},
    # `float(floor(x))`, without the two conversions, which are as slow as a division; the sum makes no zero negative.
    "whole_": _CUT.format(name="whole_", call="0.0 + array_floor"),
    "fmod": "def fmod(x, y):\n    if y == 0.0 or (x - x != 0.0 and x == x):\n        raise ValueError\n"
    "    return math.copysign(abs(x) % abs(y), x)\n",
    "power_": "def power_(x, y):\n    if (x < 0.0 and y != math.floor(y)) or (x == 0.0 and y < 0.0):\n"
    "        raise ValueError\n    z = power(x, y)\n"
    "    if z - z != 0.0 and x - x == 0.0 and y - y == 0.0:\n        raise OverflowError\n    return z\n",
    # numba's whole numbers wrap silently, and they become floats by rounding.
    "times_": "def times_(x, y):\n    if not abs(float(x) * float(y)) < 9.2e18:\n"
    "        raise OverflowError\n    return x * y\n",
    **{
        f"{name}_": f"def {name}_(x, y):\n"
        f"    if (y {more} 0 and x > {_LARGEST} {back} y) or (y {less} 0 and x < -{_LARGEST} {back} y):\n"
        f"        raise OverflowError\n    return x {sign} y\n"
        for name, sign, back, more, less in (("plus", "+", "-", ">", "<"), ("minus", "-", "+", "<", ">"))
    },
    # numba takes the width of a shift modulo 64.
    "left_": f"def left_(x, y):\n    if not 0 <= y <= 62 or not -({_LARGEST} >> y) <= x <= {_LARGEST} >> y:\n"
    "        raise OverflowError\n    return x << y\n",
    "right_": "def right_(x, y):\n    if y < 0:\n        raise ValueError\n    return x >> min(y, 63)\n",
    # Python compares a whole number and a float exactly; floats differ as the numbers do unless they are equal.
    "apart_": "def apart_(k, y):\n    d = float(k)\n    if d != y or not abs(y) < 9.2e18:\n        return d - y\n"
    "    return float(k - int(y))\n",
    # Up to 2**53 a whole number is exact as a float.
    "exact_": "def exact_(k):\n    if not -9007199254740992 <= k <= 9007199254740992:\n"
    "        raise OverflowError\n    return k\n",
    "bisect_right": "def bisect_right(a, x):\n    low, high = 0, len(a)\n    while low < high:\n"
    "        middle = (low + high) // 2\n        if x < a[middle]:\n            high = middle\n"
    "        else:\n            low = middle + 1\n    return low\n",
    "bisect_left": "def bisect_left(a, x):\n    low, high = 0, len(a)\n    while low < high:\n"
    "        middle = (low + high) // 2\n        if a[middle] < x:\n            low = middle + 1\n"
    "        else:\n            high = middle\n    return low\n",
    # The row of a place begins with the numbers of `reports.HEAD`.
    "reported_": "def reported_(reports, at, numbers):\n    reports[0] += 1.0\n    if reports[at] == 0.0:\n"
    "        reports[at + 1] = reports[0]\n    reports[at] += 1.0\n    reports[at + 2] = reports[0]\n"
    "    for k in range(len(numbers)):\n        reports[at + 3 + k] = numbers[k]\n",
    "abs_": "def abs_(z):\n    r = abs(z)\n    if r - r != 0.0:\n        raise OverflowError\n    return r\n",
    # An angle that underflows is an error in Python; infinity and NaN are left to Python.
    "phase": "def phase(z):\n    a = math.atan2(z.imag, z.real)\n    if z - z != 0.0 or (a == 0.0 and z.imag != 0.0):\n"
    "        raise ValueError\n    return a\n",
    "rect": "def rect(r, phi):\n    if r - r != 0.0 or phi - phi != 0.0:\n        raise ValueError\n"
    "    return complex(r * math.cos(phi), r * math.sin(phi))\n",
    "remainder": "def remainder(x, y):\n    if x != x or y != y:\n        return x + y\n"
    "    if x - x != 0.0 or y == 0.0:\n        raise ValueError\n    if y - y != 0.0:\n        return x\n"
    "    a, b = abs(x), abs(y)\n    r = a % b\n    c = b - r\n    if r > c:\n        r = -c\n"
    "    elif r == c:\n        r = r - 2.0 * (0.5 * (a - r) % b)\n    if x == 0.0:\n        return x\n"
    "    return -r if x < 0.0 else r\n",
    # A number that is not in the table ends the call; n[1] asks the caller to draw it and to call again.
    "drawn_": "def drawn_(row, n, k):\n    i = k - int(row[0]) + 2\n    if i < 2 or i >= len(row):\n"
    "        n[1] = row[1] = k + 1\n        raise IndexError\n    return float(row[i])\n",
}
# A text that Python runs uses Python's own functions for these, which raise by themselves.
OWN: dict[str, Callable[..., Any]] = {
    **{n: getattr(math, n) for n in TEXTS if hasattr(math, n)},
    **{n: getattr(cmath, n) for n in COMPLEX},
    "abs_": abs,
    "int_": int,
    "round_": round,
    "bisect_right": bisect_right,
    "bisect_left": bisect_left,
}
# Python raises for no float in any of these, so they are called as they are.
PLAIN = {name: f"math.{name}" for name in ("atan", "atan2", "tanh", "copysign", "fabs", "isfinite", "isnan", "isinf",
                                           "radians", "degrees", "asinh")}  # fmt: skip


def word(function: Callable[..., Any]) -> str | None:
    """Return the native name of a function of the standard library; None: it has none."""
    if function in (bisect_right, bisect_left):
        return function.__name__
    name = getattr(function, "__name__", "")
    if name in COMPLEX and function is getattr(cmath, name):
        return name
    if function is getattr(math, name, None):
        return name if name in TEXTS else PLAIN.get(name)
    if function in (builtins.int, builtins.round):
        return f"{name}_"
    return None
