"""Check that both ends belong to one line: reversed transformers, exchanged phases, data of another line."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product

import numpy as np
from softrig_core import Array

from ...lines.modal import AERIAL
from ..records.record import GROUPS, Record
from .equations import model, objectives
from .objective import Objective

# A share of the voltage. Ends that agree this well are wired rightly, so no other wiring is tried.
WIRED = 1e-3
# There are many wirings, so each is tried on this fraction of the window first.
SHARE = 4
# On that part the ends must agree this many times better; only then the whole window is evaluated.
LIKELY = 3.0
# The ends must agree this many times better under another wiring. Right wirings with usual errors reach 3 at most.
BETTER = 10.0
FINE = 1e-2  # km
EXCHANGES = {
    "b and c": (0, 2, 1),
    "a and b": (1, 0, 2),
    "a and c": (2, 1, 0),
    "a, b, c in a circle": (1, 2, 0),
    "a, c, b in a circle": (2, 0, 1),
}


def contradiction(work: Objective, limit: float) -> str:
    """Describe how the ends contradict each other by more than `limit` of their voltage; None if they do not.

    At the place of a fault all three modes agree, not only the one that locates it: the measure is the least mean of
    F over the modes. Records with a wiring fault at one end can have a sharp minimum in one mode, at a wrong place.
    """
    curve = work.curves.mean(axis=0)
    # At an end of the line the voltage follows from that end alone, whatever the current of the other end.
    if int(np.argmin(curve)) in (
        0,
        len(curve) - 1,
    ):
        for name, rewired in _otherwise(work.record):
            if np.max(_apart(work, rewired, (work.first, work.count))(work.grid)) < work.p.f_threshold:
                return f"contradictory: with {name} the ends are those of a healthy line: wired so?"
    voltage = max(float(np.sqrt(np.mean(work.record.group(name) ** 2))) for name in ("u_s", "u_r"))
    apart = _least(work, _apart(work, work.record, (work.first, work.count)), curve)
    if apart <= WIRED * voltage:
        return ""
    best, name = min(_likely(work), default=(apart, ""))
    text = f"contradictory: the ends disagree by {apart:.4g} V or more wherever the fault may be"
    if best * BETTER <= apart:
        return f"{text}, by {best:.4g} V with {name}: wired so?"
    if apart > limit * voltage:
        return (
            f"{text}, {100.0 * apart / voltage:.3g} % of their voltage (at most {100.0 * limit:g} % expected), and no "
            "exchange of signs or phases explains it: the data of another line, clocks, ratios?"
        )
    return ""


def _likely(work: Objective) -> Iterator[tuple[float, str]]:
    """Yield the wirings under which the ends agree better, tried on a part of the window first, and how well, V."""
    stretch = (work.first, max(work.count // SHARE, 1))
    known = _least(work, _apart(work, work.record, stretch))
    for name, rewired in _otherwise(work.record):
        if _least(work, _apart(work, rewired, stretch)) * LIKELY <= known:
            yield _least(work, _apart(work, rewired, (work.first, work.count))), name


def _apart(work: Objective, record: Record, stretch: tuple[int, int]) -> Callable[[Array], Array]:
    """Mean of F over the three modes at points in km, V, over a stretch (first sample, number of samples)."""
    line = model(work.section)
    groups = [record.group(name) for name in GROUPS]
    modes = [
        np.array([row[0] * g[:, 0] + row[1] * g[:, 1] + row[2] * g[:, 2] for g in groups]) for row in AERIAL.tolist()
    ]

    def apart(x: Array) -> Array:
        out = np.empty((len(modes), len(x)))
        for f, ends in zip(out, modes, strict=True):
            objectives(line, ends, record.rate, *stretch, x, f)
        return np.asarray(out.mean(axis=0))

    return apart


def _least(work: Objective, apart: Callable[[Array], Array], curve: Array | None = None) -> float:
    """Return the least value along the line: on the locator's grid, then between its points."""
    from scipy.optimize import minimize_scalar

    grid = work.grid
    curve = apart(grid) if curve is None else curve
    k = int(np.argmin(curve))
    near = minimize_scalar(
        lambda x: float(apart(np.array([x]))[0]),
        bounds=(grid[max(k - 1, 0)], grid[min(k + 1, len(grid) - 1)]),
        method="bounded",
        options={"xatol": FINE},
    )
    return min(float(curve[k]), float(near.fun))


def _otherwise(record: Record) -> Iterator[tuple[str, Record]]:
    """Yield the record for each wrong wiring of the ends, with a description."""
    for turned in (("i_s",), ("i_r",), ("i_s", "i_r"), ("u_s",), ("u_r",)):
        yield f"{_named(turned)} reversed", _wired(record, dict.fromkeys(turned, (-1.0, (0, 1, 2))))
    for group, phase in product(("i_s", "i_r"), range(3)):
        again = _wired(record, {})
        again.group(group)[:, phase] *= -1.0
        yield f"phase {'abc'[phase]} of {group} reversed", again
    for groups, (phases, order) in product((("u_r", "i_r"), ("i_s",), ("i_r",), ("u_s",), ("u_r",)), EXCHANGES.items()):
        name = f"phases {phases} of {_named(groups)} exchanged"
        yield name, _wired(record, dict.fromkeys(groups, (1.0, order)))
        if groups[-1][0] == "i":
            yield (
                f"{name} and {groups[-1]} reversed",
                _wired(record, {group: (-1.0 if group == groups[-1] else 1.0, order) for group in groups}),
            )


def _named(groups: tuple[str, ...]) -> str:
    return " and ".join(groups)


def _wired(record: Record, changes: dict[str, tuple[float, tuple[int, ...]]]) -> Record:
    samples = record.samples.copy()
    again = Record(record.start, record.rate, samples)
    for group, (sign, order) in changes.items():
        again.group(group)[:] = sign * record.group(group)[:, list(order)]
    return again
