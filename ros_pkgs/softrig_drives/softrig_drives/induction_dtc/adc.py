"""Models of a current converter, from ideal rounding to truncation with random one-bit dither."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from math import floor
from typing import TYPE_CHECKING, Literal

from softrig_core import Params, param

if TYPE_CHECKING:
    import numpy as np

_DRAWS = 4096  # dither bits drawn at once; a single draw costs more than the conversion


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
        """Whether there is a converter at all."""
        return self.adc_mode != "none"

    @property
    def offset(self) -> float:
        """Offset delta in LSB; 0 in the modes without."""
        return self.offset_lsb if self.adc_mode in ("offset", "dither") else 0.0

    @property
    def dithered(self) -> bool:
        """Whether a random bit is added."""
        return self.adc_mode == "dither"

    @property
    def lsb(self) -> float:
        """Least significant bit q in A."""
        return self.full_scale / float(2 ** (self.bits - 1))


class Converter:
    """One channel.

    ::

        ideal    y = q floor(x/q + 1/2)
        offset   y = q floor(x/q + 1/2 - delta)             mean error -delta
        dither   y = q (floor(x/q + 1/2 - delta) + d)       d in {0, 1}, P(d = 1) = p_d: mean error p_d - delta

    The mean errors are in LSB; the dither bit is added after clipping.

    Parameters
    ----------
    p : AdcParams

    Attributes
    ----------
    clipped : int
        Samples in a row beyond the range, up to the newest.
    """

    def __init__(self, p: AdcParams) -> None:
        self._quantised = p.quantised
        self._q = p.lsb
        self._shift = 0.5 - p.offset
        self._low, self._high = -(2 ** (p.bits - 1)), 2 ** (p.bits - 1) - 1
        self._p_d = p.dither_p
        self._dithered = p.dithered
        self._bits: Iterator[int] | None = None
        self.clipped = 0

    def start(self, rng: np.random.Generator) -> None:
        """Begin a run; `rng` draws the dither bits, if the mode has some."""
        self.clipped = 0
        self._bits = chain.from_iterable(self._draws(rng)) if self._dithered else None

    def _draws(self, rng: np.random.Generator) -> Iterator[list[int]]:
        while True:
            yield (rng.random(_DRAWS) < self._p_d).astype(int).tolist()

    def __call__(self, x: float) -> float:
        """Convert one sample (A)."""
        if not self._quantised:
            return x
        code = floor(x / self._q + self._shift)
        if self._low <= code <= self._high:
            self.clipped = 0
        else:
            code = self._low if code < 0 else self._high
            self.clipped += 1
        if self._bits is not None:
            code += next(self._bits)
        return code * self._q
