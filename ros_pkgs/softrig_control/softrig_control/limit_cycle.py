"""Detection of a limit cycle: turning points of the measured signal that do not approach each other."""

from __future__ import annotations

from typing import NamedTuple

from softrig_core.kit.dense import total

SWINGS = 8  # number of swings in a row, each from one turning point to the next
# In a loop that settles the swings decay: the second half of them then has less than this share of the first half.
KEPT = 0.9
# The swings of a limit cycle are alike: the smallest has at least this share of the largest.
ALIKE = 0.5
LONGEST = 3  # multiple of the longest time between turning points after which the signal counts as at rest
BAND = 0.02  # smaller swings, relative to the reference, do not count


NONE, NEVER = (0.0,) * SWINGS, (0,) * SWINGS


class Swinging(NamedTuple):
    """State of the detector, in the unit of the measured signal; times in samples."""

    reference: float = 0.0
    turn: float = 0.0
    """At the newest turning point."""

    far: float = 0.0
    """Farthest from there so far."""

    up: bool = True
    """Whether that is above."""

    since: int = 0
    """Samples since the turning point was found."""

    since_turn: int = 0
    """Swings since the beginning, at most `SWINGS`."""

    swings: tuple[float, ...] = NONE
    """The newest ones, peak to peak; the oldest first."""

    spans: tuple[int, ...] = NEVER
    """How long each took."""

    @property
    def aside(self) -> str:
        """No state of a linear view: the reason."""
        return "only a warning depends on it"


def limit_cycle(x: Swinging, y: float, reference: float) -> tuple[Swinging, float]:
    """Process one sample; return the mean swing (peak to peak), 0 while there is no lasting one.

    In a loop that settles, near its reference or not, the swings decrease; in a limit cycle or a diverging loop they do
    not. The count starts again with each new reference.

    Parameters
    ----------
    y, reference : float
        In the unit of the signal.
    """
    before, turn, far, up, since, result, swings, spans = x
    if reference != before:
        turn, far, up, since, result, swings, spans = y, y, True, 0, 0, NONE, NEVER
    since += 1
    if (y > far) == up and y != far:
        far = y
    elif abs(y - far) > BAND * abs(reference):
        swings, spans, result = (*swings[1:], abs(far - turn)), (*spans[1:], since), min(result + 1, SWINGS)
        turn, far, up, since = far, y, not up, 0
    # Without a new turning point for so long, the signal has come to rest.
    if result and since > LONGEST * max(spans):
        turn, far, up, since, result, swings, spans = y, y, True, 0, 0, NONE, NEVER
    x = Swinging(reference, turn, far, up, since, result, swings, spans)
    if result < SWINGS or min(swings) < ALIKE * max(swings):
        return x, 0.0
    first, second = total(swings[: SWINGS // 2]), total(swings[SWINGS // 2 :])
    return x, second / (SWINGS // 2) if second >= KEPT * first else 0.0
