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
    from softrig_core import Array

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
PENDING = 12  # weight (s) of the newest instant, as long as it is not in the sums

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


def opened(stored: bytes) -> Array:
    """Create sums from stored ones, to add to."""
    import numpy as np

    return np.frombuffer(stored).reshape(ROWS, HARMONICS + 1).copy()


@jit
def sample(
    sums: Array, s_1: float, c_1: float, weight: float, state: tuple[float, float, float, float], grid: Three
) -> None:
    """Add signals with a weight (s) of an integration rule; sine and cosine are those of omega t."""
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
    c, s = c_1 * weight, s_1 * weight
    sums[GRID_COS, 1] += c * g_a
    sums[GRID_COS + 1, 1] += c * g_b
    sums[GRID_COS + 2, 1] += c * g_c
    sums[GRID_SIN, 1] += s * g_a
    sums[GRID_SIN + 1, 1] += s * g_b
    sums[GRID_SIN + 2, 1] += s * g_c
    # Four orders side by side, because each one after the other would wait for the previous result.
    c_2, s_2 = c_1 * c_1 - s_1 * s_1, 2.0 * c_1 * s_1
    c_4, s_4 = c_2 * c_2 - s_2 * s_2, 2.0 * c_2 * s_2
    cb, sb = c * c_1 - s * s_1, s * c_1 + c * s_1
    cc, sc = c * c_2 - s * s_2, s * c_2 + c * s_2
    cd, sd = cb * c_2 - sb * s_2, sb * c_2 + cb * s_2
    for k in range(1, HARMONICS + 1, 4):
        sums[CURRENT_COS, k] += c * i_a
        sums[CURRENT_COS + 1, k] += c * i_b
        sums[CURRENT_SIN, k] += s * i_a
        sums[CURRENT_SIN + 1, k] += s * i_b
        sums[CURRENT_COS, k + 1] += cb * i_a
        sums[CURRENT_COS + 1, k + 1] += cb * i_b
        sums[CURRENT_SIN, k + 1] += sb * i_a
        sums[CURRENT_SIN + 1, k + 1] += sb * i_b
        if k == 5:  # orders 6 and 12 of the link
            sums[LINK_COS, 6] += cb * v
            sums[LINK_SIN, 6] += sb * v
        elif k == 9:
            sums[LINK_COS, 12] += cd * v
            sums[LINK_SIN, 12] += sd * v
        if k + 3 <= HARMONICS:
            sums[CURRENT_COS, k + 2] += cc * i_a
            sums[CURRENT_COS + 1, k + 2] += cc * i_b
            sums[CURRENT_SIN, k + 2] += sc * i_a
            sums[CURRENT_SIN + 1, k + 2] += sc * i_b
            sums[CURRENT_COS, k + 3] += cd * i_a
            sums[CURRENT_COS + 1, k + 3] += cd * i_b
            sums[CURRENT_SIN, k + 3] += sd * i_a
            sums[CURRENT_SIN + 1, k + 3] += sd * i_b
        c, s = c * c_4 - s * s_4, s * c_4 + c * s_4
        cb, sb = cb * c_4 - sb * s_4, sb * c_4 + cb * s_4
        cc, sc = cc * c_4 - sc * s_4, sc * c_4 + cc * s_4
        cd, sd = cd * c_4 - sd * s_4, sd * c_4 + cd * s_4


@jit
def cleared(sums: Array, windows: float) -> None:
    """Begin a window after some others, without samples."""
    for row in range(ROWS):
        for k in range(HARMONICS + 1):
            sums[row, k] = 0.0
    sums[PLAIN, WINDOWS] = windows
    sums[PLAIN, LOW], sums[PLAIN, HIGH] = math.inf, -math.inf


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


@jit
def amplitude(sums: Array, cosine: int, sine: int, k: int) -> float:
    """Return the amplitude of an order, not yet divided by half the time; the third current follows from the others."""
    a, b = sums[cosine, k], sums[sine, k]
    if cosine == CURRENT_COS + 2:
        a, b = -sums[CURRENT_COS, k] - sums[CURRENT_COS + 1, k], -sums[CURRENT_SIN, k] - sums[CURRENT_SIN + 1, k]
    return math.sqrt(a * a + b * b)


@jit
def squares_of(sums: Array, k: int, share: float) -> float:
    """Sum over the phases of the squared amplitudes of an order, A^2."""
    total = 0.0
    for phase in range(3):
        peak = share * amplitude(sums, CURRENT_COS + phase, CURRENT_SIN + phase, k)
        total += peak * peak
    return total


@jit
def measure(sums: Array, values: Array) -> None:
    """Write the figures of a complete window, in the order of `FIGURES`, into an array.

    ::

        THD   = sqrt(sum I_rms^2 - sum I_1rms^2)/sqrt(sum I_1rms^2)        all content, over the three phases
        THD50 = the same with the harmonics 2 to 50 only
        PF    = mean(sum v i)/sum(V_rms I_rms)
        DPF   = the same with the fundamentals only

    ``current``, ``current_5``, ``current_7``: amplitudes (A peak), root mean square over the phases, of the fundamental
    and of harmonics; ``ripple``: largest less smallest DC voltage; ``voltage_6``, ``voltage_12``: amplitudes of its
    harmonics. Shares of a current that is 0 are 0.
    """
    plain = sums[PLAIN]
    duration = plain[TIME]
    share = 2.0 / duration
    first = squares_of(sums, 1, share) / 2.0
    more = 0.0
    for k in range(2, HARMONICS + 1):
        more += squares_of(sums, k, share)
    square = rms = product = peaks = 0.0
    for phase in range(3):
        mean_square = plain[CURRENT_SQUARE + phase] / duration
        square += mean_square
        rms += math.sqrt(mean_square * plain[GRID_SQUARE + phase] / duration)
        a, b = sums[CURRENT_COS + phase, 1], sums[CURRENT_SIN + phase, 1]
        if phase == 2:
            a, b = -sums[CURRENT_COS, 1] - sums[CURRENT_COS + 1, 1], -sums[CURRENT_SIN, 1] - sums[CURRENT_SIN + 1, 1]
        product += (a * sums[GRID_COS + phase, 1] + b * sums[GRID_SIN + phase, 1]) * 4.0 / (duration * duration)
        grid = share * amplitude(sums, GRID_COS + phase, GRID_SIN + phase, 1)
        peaks += share * math.sqrt(a * a + b * b) * grid
    flows = first > 0.0
    values[0] = plain[WINDOWS]
    values[1] = 100.0 * math.sqrt(max(0.0, square - first) / first) if flows else 0.0
    values[2] = 100.0 * math.sqrt(more / 2.0 / first) if flows else 0.0
    values[3] = plain[POWER] / duration / rms if flows else 0.0
    values[4] = product / peaks if flows else 0.0
    values[5] = math.sqrt(2.0 * first / 3.0)
    values[6] = plain[POWER] / duration
    values[7] = plain[LINK] / duration
    values[8] = plain[HIGH] - plain[LOW]
    values[9] = share * amplitude(sums, LINK_COS, LINK_SIN, 6)
    values[10] = share * amplitude(sums, LINK_COS, LINK_SIN, 12)
    values[11] = math.sqrt(squares_of(sums, 5, share) / 3.0)
    values[12] = math.sqrt(squares_of(sums, 7, share) / 3.0)
