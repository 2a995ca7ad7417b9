"""Random inputs: Python's answers of a block to inputs that do not occur in a run, as further golden rows."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..block.answer import admit
from ..block.block import Block
from ..block.port import Port, Sample
from ..rig.members import Member
from .golden import Call, Changed, answer_of, kept_of, keys_of, methods

# zeros of both signs, the smallest numbers, large ones, and numbers that no port accepts but C may receive
ODD = (0.0, -0.0, 5e-324, -5e-324, 1e-308, 1e-30, 1.0, -1.0, 1e30, -1e300, math.inf, -math.inf, math.nan)
SHARE_ODD = 0.04  # share of drawn numbers that are odd values
SHARE_WIDE = 0.1  # share of drawn numbers that are up to a thousand times those of the run
SHARE_ABSENT = 0.1  # share of drawn values of a held input that are absent
AGAIN = 50  # calls after which a sequence begins again, because an odd value may have ended it


@dataclass(frozen=True)
class Raised:
    """A call to which Python raises an error, whose answer must not leave the block, or that C does not support."""

    method: str
    t: int
    x: Any
    inputs: Mapping[str, Any]


@dataclass(frozen=True)
class Drawn(Call):
    """A call with inputs that did not occur in a run."""


@dataclass(frozen=True)
class Beyond(Drawn):
    """A call with an input that its port rejects: a node never gets it, and C may discard it where Python answers."""


def drawn_calls(
    member: Member, block: Block, golden: Sequence[Call | Changed], count: int, seed: int, *, absent: bool = True
) -> list[list[Call | Raised]]:
    """Return sequences of calls with drawn inputs, each from the first state on.

    Parameters
    ----------
    block : Block
        As at the begin of the run.
    golden : sequence of Call or Changed
        Of a run: the inputs are spread as its inputs are.
    count : int
        Calls in all.
    seed : int
        Of the drawn numbers.
    absent : bool
        Whether held inputs are left out now and then.
    """
    draw = np.random.default_rng(seed)
    may_be_absent = {p.name for p in member.inputs if p.held} if absent else set()
    asked = [c for c in golden if isinstance(c, Call)]
    rows = {name: [c.inputs for c in asked if c.method == name] for name in methods(block)}
    at_hand = next((c.kept for c in asked if c.method == methods(block)[-1]), ())
    result: list[list[Call | Raised]] = []
    while sum(map(len, result)) < count:
        result.append(_sequence(member, block, rows, may_be_absent, draw, at_hand))
    return result


def _sequence(
    member: Member,
    block: Block,
    rows: Mapping[str, Sequence[Any]],
    may_be_absent: set[str],
    draw: np.random.Generator,
    at_hand: tuple[Any, ...],
) -> list[Call | Raised]:
    """Return calls from the first state on; a plant whose state has no outputs ends the run, and so the sequence."""
    x, k, calls = block.first(), 0, list[Call | Raised]()
    while len(calls) < AGAIN:
        t = round(k * member.schedule.period * 10**9)
        for name in methods(block):
            inputs = _inputs(rows[name][int(draw.integers(len(rows[name])))], may_be_absent, draw)
            for cached, key in zip(kept_of(block), at_hand, strict=False):
                if key is not None:
                    cached(key)
            call = _asked(member, block, name, x, t, inputs)
            if isinstance(call, Call) and asks_anew(call, at_hand):
                call = Raised(name, t, x, inputs)
            calls.append(call)
            if isinstance(call, Call):
                x = call.after
            if isinstance(call, Beyond) or (isinstance(call, Raised) and name == "outputs"):
                return calls
        k += 1
    return calls


def asks_anew(call: Call, at_hand: Sequence[Any]) -> bool:
    """Return whether a call needed a cached answer for another value than the one that C stores."""
    return any(asked is not None and asked != known for asked, known in zip(call.kept, at_hand, strict=False))


def _asked(member: Member, block: Block, name: str, x: Any, t: int, inputs: Mapping[str, Any]) -> Call | Raised:
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            result = getattr(block, name)(x, t, **inputs)
        after, outputs = answer_of(name, x, result)
        ports = () if name == "advance" else member.outputs
        kind = Drawn if all(_admitted(p, inputs.get(p.name)) for p in member.inputs) else Beyond
        entries = {p.name: admit(outputs, p, member.name, t) for p in ports}
        return kind(name, t, x, inputs, after, entries, keys_of(block))
    except Exception:  # whatever it raises ends a run
        return Raised(name, t, x, inputs)


def _admitted(port: Port, values: Any) -> bool:
    """Return whether a port accepts these values."""
    row = values.data if isinstance(values, Sample) else values
    return row is None or all(abs(v) <= limit for v, limit in zip(row, port.limits, strict=True))


def _inputs(rows: Mapping[str, Any], may_be_absent: set[str], draw: np.random.Generator) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for name, row in rows.items():
        if name in may_be_absent and draw.random() < SHARE_ABSENT:
            row = None
        data = row.data if isinstance(row, Sample) else row
        numbers = None if data is None else tuple(_number(v, draw) for v in data)
        result[name] = Sample(row.stamp, numbers) if isinstance(row, Sample) and numbers is not None else numbers
    return result


def _number(value: float, draw: np.random.Generator) -> float:
    kind = draw.random()
    if kind < SHARE_ODD:
        return float(ODD[int(draw.integers(len(ODD)))])
    size = max(abs(value), 1e-3) * (1e3 if kind < SHARE_ODD + SHARE_WIDE else 1.0)
    return float(value + size * draw.standard_normal())
