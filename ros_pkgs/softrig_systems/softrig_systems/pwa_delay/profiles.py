"""How the delay varies: constant, a sine with a given rate, or a random telegraph signal between zero and its
maximum.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from softrig_core import jit

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Kind = Literal["constant", "sine", "telegraph"]
KINDS: dict[str, float] = {"constant": 0.0, "sine": 1.0, "telegraph": 2.0}


class Profile(NamedTuple):
    """A delay over time, as native loops read it; made by `profile`."""

    kind: float
    h: float
    mu: float
    changes: NDArray[np.float64]


def profile(kind: Kind, h: float, mu: float = 0.0, *, seed: int | Sequence[int] = 0, horizon: float = 0.0) -> Profile:
    """Create a profile.

    Parameters
    ----------
    kind : {"constant", "sine", "telegraph"}
        d = h; d = h/2 (1 + sin(2 mu t/h)), whose rate is at most mu; d jumps between 0 and h at random times.
    h : float
        Largest delay, s.
    mu : float
        Bound of the rate of a sine.
    seed : int or sequence of int
        Of the telegraph.
    horizon : float
        Time (s) for which a telegraph has jumps, 4 h apart in the mean.

    Raises
    ------
    ValueError
        h or mu is negative or not finite.
    """
    import numpy as np

    if not (h >= 0.0 and math.isfinite(h) and mu >= 0.0 and math.isfinite(mu)):
        raise ValueError(f"delay h = {h} s, mu = {mu}: expected finite values, not negative")
    changes = np.zeros(1)
    if kind == "telegraph" and h > 0.0:
        count = int(horizon / (4.0 * h) * 1.5) + 20
        changes = np.cumsum(np.random.default_rng(seed).exponential(4.0 * h, count))
    return Profile(KINDS[kind], h, mu, changes)


@dataclass(frozen=True, eq=False)
class Delay:
    """The delay over time, drawn with the seed: it is stored with a block's state but is not one of its numbers."""

    profile: Profile
    constants: Any = None  # values that a native loop reads, including the profile
    longest: float = 0.0  # s, that is remembered: a live change goes no further

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Delay):
            return NotImplemented
        a, b = self.profile, other.profile
        return a[:3] == b[:3] and a.changes.tolist() == b.changes.tolist()


@jit
def delay_at(p: Profile, t: float) -> float:
    """Return the delay (s) at t (s)."""
    if p.kind == 0.0:
        return p.h
    if p.kind == 1.0:
        return 0.5 * p.h * (1.0 + math.sin(2.0 * p.mu * t / p.h)) if p.h > 0.0 else 0.0
    low, high = 0, p.changes.size  # number of changes up to t
    while low < high:
        middle = (low + high) // 2
        if p.changes[middle] <= t:
            low = middle + 1
        else:
            high = middle
    return p.h if low % 2 == 0 else 0.0
