"""Fuzzy speed controller."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

from softrig_control.fuzzy import And, TakagiSugeno, sum_rules
from softrig_core import Values, param

from .speed_control import SpeedControl, SpeedControlParams

LARGEST = 3
TERMS = 2 * LARGEST + 1
THIRDS = tuple(n / LARGEST for n in range(-LARGEST, LARGEST + 1))
TABLE_II = tuple(index for row in sum_rules(TERMS) for index in row)


class LsrmFuzzyParams(SpeedControlParams):
    """Scaling factors (set P, like the paper; set S is 0.05, 0.005, 2), terms and rules."""

    K_e: float = param(1.0, "error that counts as 1", "m/s", gt=0.0, le=100.0, live=True)
    K_de: float = param(0.01, "change of the error in one period that counts as 1", "m/s", gt=0.0, le=100.0, live=True)
    K_u: float = param(2.0, "change of the force in one period for an output of 1", "N", gt=0.0, le=1e3, live=True)
    peaks: tuple[float, ...] = param(
        THIRDS, "where the terms NB, NM, NS, Z, PS, PM, PB of both inputs are 1", each=(-100.0, 100.0), live=True
    )
    rules: tuple[int, ...] = param(
        TABLE_II, "Table II row by row (a row an error): the output's terms", each=(-LARGEST, LARGEST), live=True
    )
    conjunction: And = param("product", "AND of a rule's two premises", live=True)

    def _check(self) -> None:
        if len(self.rules) != TERMS * TERMS:
            raise ValueError(f"rules has {len(self.rules)} values, expected {TERMS} x {TERMS}")
        if len(self.peaks) != TERMS or any(b <= a for a, b in pairwise(self.peaks)):
            raise ValueError(f"peaks {list(self.peaks)}: expected {TERMS} increasing numbers")


class State(NamedTuple):
    """Force (N) and error (m/s) of the period before."""

    force: float = 0.0
    error: float = 0.0


class LsrmFuzzy(SpeedControl[LsrmFuzzyParams]):
    """Incremental fuzzy controller of 49 rules.

    ::

        e = v_ref - v,  de = e - e_before (0 before the first)
        F* = F*_before + K_u y(e/K_e, de/K_de), within plus and minus F_max

    y is the surface of `softrig_control.fuzzy.TakagiSugeno`. Where the four active rules of Table II are not clipped, y
    is e/K_e + de/K_de exactly: there the law is the PI controller with K_p = K_u/K_de and K_i = K_u/(K_e Ts).

    The state is the force itself, so changed factors, terms and rules cause no jump.
    """

    STATE = State

    def setup(self) -> None:
        """Create the surface."""
        p = self.p
        outputs = [THIRDS[n + LARGEST] for n in p.rules]
        table = [outputs[k : k + TERMS] for k in range(0, len(outputs), TERMS)]
        self._surface = TakagiSugeno((p.peaks, p.peaks), table, p.conjunction)

    def update(
        self, x: State, t: int, *, joint_states: tuple[float, ...], reference: tuple[float, ...]
    ) -> tuple[State, Values]:
        """Return the force command."""
        p = self.p
        error = reference[1] - joint_states[0]
        force = self.clip(x.force + p.K_u * self._surface(error / p.K_e, (error - x.error) / p.K_de))
        return State(force, error), {"force_cmd": (force,)}
