"""Models of a current converter, from ideal rounding to truncation with random one-bit dither."""

from __future__ import annotations

from math import floor
from typing import Literal

from softrig_core import Params, param

ROW = 4096  # samples of one channel whose dither bits stand together in the stream, then those of the other


class AdcParams(Params):
    """Converter of one current; integer codes are clipped to [-2^(bits-1), 2^(bits-1) - 1]."""

    adc_mode: Literal["none", "ideal", "offset", "dither"] = param(
        "dither", "none: not quantised; ideal: rounds; offset: has an offset; dither: offset plus a random bit"
    )
    bits: int = param(10, "resolution n of the converters", ge=2, le=24)
    full_scale: float = param(16.0, "range of the converters, +- this current", "A", gt=0.0)
    offset_lsb: float = param(0.5, "offset delta of the modes offset and dither, in LSB; 0.5 is truncation")
    dither_p: float = param(0.5, "probability p_d of the dither bit being 1", ge=0.0, le=1.0)

    @property
    def quantised(self) -> bool:
        """Return whether there is a converter at all."""
        return self.adc_mode != "none"

    @property
    def offset(self) -> float:
        """Offset delta in LSB; 0 in the modes without."""
        return self.offset_lsb if self.adc_mode in ("offset", "dither") else 0.0

    @property
    def dithered(self) -> bool:
        """Return whether a random bit is added."""
        return self.adc_mode == "dither"

    @property
    def lsb(self) -> float:
        """Least significant bit q in A."""
        return self.full_scale / float(2 ** (self.bits - 1))


class Converter:
    """One channel, without memory.

    ::

        ideal    y = q floor(x/q + 1/2)
        offset   y = q floor(x/q + 1/2 - delta)             mean error -delta
        dither   y = q (floor(x/q + 1/2 - delta) + d)       d in {0, 1}, P(d = 1) = p_d: mean error p_d - delta

    The mean errors are in LSB; the dither bit is added after clipping.
    """

    def __init__(self, p: AdcParams) -> None:
        self._quantised = p.quantised
        self._q = p.lsb
        self._shift = 0.5 - p.offset
        self._low, self._high = -(2.0 ** (p.bits - 1)), 2.0 ** (p.bits - 1) - 1.0
        self._p_d = p.dither_p if p.dithered else 0.0

    def beyond(self, x: float) -> bool:
        """Return whether a sample (A) is beyond the range."""
        return self._quantised and not self._low <= x / self._q + self._shift < self._high + 1.0

    def __call__(self, x: float, uniform: float = 1.0) -> float:
        """Convert one sample (A); `uniform`, a random number in [0, 1), decides on the dither bit."""
        if not self._quantised:
            return x
        code = min(max(float(floor(x / self._q + self._shift)), self._low), self._high) + (uniform < self._p_d)
        return code * self._q


def draw(k: int, channel: int) -> int:
    """Return the place of sample k of a channel, 0 or 1, in the stream of random numbers, which is made in rows."""
    return (2 * (k // ROW) + channel) * ROW + k % ROW
