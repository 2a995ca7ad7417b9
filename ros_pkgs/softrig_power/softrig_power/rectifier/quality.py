"""Power quality over whole grid cycles, summed at the plant's own steps.

`sums` is an array of shape (ROWS, HARMONICS + 1): rows of harmonics (weights times cos and sin of k omega t), and one
row of plain integrals.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from softrig_core import jit

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]
    Three = tuple[float, float, float]

CYCLES = 6  # length of a window
HARMONICS = 50

# rows: cosine and sine sums of the three currents, of the DC voltage, of the grid voltages (order 1 only)
CURRENT_COS, CURRENT_SIN = 0, 3
LINK_COS, LINK_SIN = 6, 7
GRID_COS, GRID_SIN = 8, 11
PLAIN = 14
ROWS = 15
# columns of the plain row
TIME, LINK, LOW, HIGH, POWER = 0, 1, 2, 3, 4
CURRENT_SQUARE, GRID_SQUARE = 5, 8
WINDOWS = 11  # number of complete windows

# name: unit; of currents and PF see `figures`
FIGURES: Mapping[str, str] = {
    "windows": "",
    "thd": "%",
    "thd50": "%",
    "pf": "",
    "dpf": "",
    "current": "A",
    "power": "W",
    "voltage": "V",
    "ripple": "V",
    "voltage_6": "V",
    "voltage_12": "V",
    "current_5": "A",
    "current_7": "A",
}


def empty() -> Array:
    """Create sums without samples."""
    import numpy as np

    sums = np.zeros((ROWS, HARMONICS + 1))
    sums[PLAIN, LOW], sums[PLAIN, HIGH] = math.inf, -math.inf
    return sums


def opened(kept: bytes) -> Array:
    """Create sums of what was kept of them, to be added to."""
    import numpy as np

    return np.frombuffer(kept).reshape(ROWS, HARMONICS + 1).copy()


@jit
def sample(
    sums: Array, t: float, weight: float, state: tuple[float, float, float, float], grid: Three, omega: float
) -> None:
    """Add the signals at t with the weight (s) that a rule of integration gives them."""
    i_a, i_b, i_c, v = state
    g_a, g_b, g_c = grid
    plain = sums[PLAIN]
    plain[TIME] += weight
    plain[LINK] += weight * v
    plain[LOW], plain[HIGH] = min(plain[LOW], v), max(plain[HIGH], v)
    plain[POWER] += weight * (g_a * i_a + g_b * i_b + g_c * i_c)
    plain[CURRENT_SQUARE] += weight * i_a * i_a
    plain[CURRENT_SQUARE + 1] += weight * i_b * i_b
    plain[CURRENT_SQUARE + 2] += weight * i_c * i_c
    plain[GRID_SQUARE] += weight * g_a * g_a
    plain[GRID_SQUARE + 1] += weight * g_b * g_b
    plain[GRID_SQUARE + 2] += weight * g_c * g_c
    c_1, s_1 = math.cos(omega * t), math.sin(omega * t)
    c, s = c_1 * weight, s_1 * weight
    sums[GRID_COS, 1] += c * g_a
    sums[GRID_COS + 1, 1] += c * g_b
    sums[GRID_COS + 2, 1] += c * g_c
    sums[GRID_SIN, 1] += s * g_a
    sums[GRID_SIN + 1, 1] += s * g_b
    sums[GRID_SIN + 2, 1] += s * g_c
    for k in range(1, HARMONICS + 1):
        sums[CURRENT_COS, k] += c * i_a
        sums[CURRENT_COS + 1, k] += c * i_b
        sums[CURRENT_COS + 2, k] += c * i_c
        sums[CURRENT_SIN, k] += s * i_a
        sums[CURRENT_SIN + 1, k] += s * i_b
        sums[CURRENT_SIN + 2, k] += s * i_c
        sums[LINK_COS, k] += c * v
        sums[LINK_SIN, k] += s * v
        c, s = c * c_1 - s * s_1, s * c_1 + c * s_1


@jit
def turn_over(sums: Array, complete: Array) -> None:
    """End a window: its sums become the complete ones, a new window begins."""
    windows = sums[PLAIN, WINDOWS] + 1.0
    for row in range(ROWS):
        for k in range(HARMONICS + 1):
            complete[row, k] = sums[row, k]
            sums[row, k] = 0.0
    complete[PLAIN, WINDOWS] = sums[PLAIN, WINDOWS] = windows
    sums[PLAIN, LOW], sums[PLAIN, HIGH] = math.inf, -math.inf


def figures(sums: Array) -> dict[str, float]:
    """Return the figures of a complete window; all 0 before there is one.

    ::

        THD   = sqrt(sum I_rms^2 - sum I_1rms^2)/sqrt(sum I_1rms^2)        all content, over the three phases
        THD50 = the same with the harmonics 2 to 50 only
        PF    = mean(sum v i)/sum(V_rms I_rms)
        DPF   = the same with the fundamentals only

    Parameters
    ----------
    sums : ndarray
        Those of the last complete window.

    Returns
    -------
    dict of str to float
        As `FIGURES`: ``current``, ``current_5``, ``current_7``: amplitudes (A peak), root mean square over the phases,
        of the fundamental and of harmonics; ``ripple``: largest less smallest DC voltage; ``voltage_6``,
        ``voltage_12``: amplitudes of its harmonics. Shares of a current that is 0 are 0.
    """
    import numpy as np

    plain = sums[PLAIN]
    if not plain[WINDOWS]:
        return dict.fromkeys(FIGURES, 0.0)
    duration = plain[TIME]
    peak = 2.0 / duration * np.hypot(sums[CURRENT_COS : CURRENT_COS + 3], sums[CURRENT_SIN : CURRENT_SIN + 3])
    squares = plain[CURRENT_SQUARE : CURRENT_SQUARE + 3] / duration
    first = (peak[:, 1] ** 2).sum() / 2.0
    rms = np.sqrt(squares * plain[GRID_SQUARE : GRID_SQUARE + 3] / duration)
    products = (
        sums[CURRENT_COS : CURRENT_COS + 3, 1] * sums[GRID_COS : GRID_COS + 3, 1]
        + sums[CURRENT_SIN : CURRENT_SIN + 3, 1] * sums[GRID_SIN : GRID_SIN + 3, 1]
    )
    grid_1 = np.hypot(sums[GRID_COS : GRID_COS + 3, 1], sums[GRID_SIN : GRID_SIN + 3, 1]) * 2.0 / duration
    shares = products * 4.0 / duration**2
    link = 2.0 / duration * np.hypot(sums[LINK_COS], sums[LINK_SIN])
    flows = first > 0.0
    some = np.sqrt((peak**2).mean(axis=0))
    found = {
        "windows": plain[WINDOWS],
        "thd": 100.0 * math.sqrt(max(0.0, squares.sum() - first) / first) if flows else 0.0,
        "thd50": 100.0 * math.sqrt((peak[:, 2:] ** 2).sum() / 2.0 / first) if flows else 0.0,
        "pf": plain[POWER] / duration / rms.sum() if flows else 0.0,
        "dpf": shares.sum() / (peak[:, 1] * grid_1).sum() if flows else 0.0,
        "current": some[1],
        "power": plain[POWER] / duration,
        "voltage": plain[LINK] / duration,
        "ripple": plain[HIGH] - plain[LOW],
        "voltage_6": link[6],
        "voltage_12": link[12],
        "current_5": some[5],
        "current_7": some[7],
    }
    return {name: float(value) for name, value in found.items()}
