"""The controller of the queue: any law, on the network's published state alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

from softrig_core import Block, BlockParams, History, Level, Values, param, to_ns

from .laws import LAWS, Gains, LawName, Measured, integral_gain
from .model import Bottleneck, phi, psi
from .ports import COMMAND, HEALTH, REFERENCE, STATE

STALE = 5  # periods after which a state is too old
HOLD = 50  # ticks without a valid state after which nothing is dropped any more


class AqmControllerParams(Gains, Bottleneck, BlockParams):
    """Law, gains, and the controller's own idea of the network."""

    period: float = param(0.001, "control period", "s", gt=0.0, le=1.0)
    law: LawName = param("sspd", "the law")
    set_point: float = param(120.0, "wanted queue q_d until a reference arrives", "packet", gt=0.0, le=1e6)
    phi_form: Literal["corrected", "printed"] = param(
        "corrected", "Phi as derived or as the paper prints it", live=True
    )
    anti_windup: bool = param(
        False, "freeze the integral while the command is clipped in the direction of e; robust always does", live=True
    )
    history: float = param(0.5, "how far back the controller remembers the state", "s", gt=0.0, le=100.0)

    def _check(self) -> None:
        if not self.set_point < self.q_max:
            raise ValueError(f"set_point = {self.set_point:g}: expected less than q_max = {self.q_max:g} packets")
        longest = self.q_max / self.C + self.tau_p
        if self.history < longest:
            raise ValueError(
                f"history = {self.history:g} s is shorter than the longest delay q_max/C + tau_p = {longest:g} s"
            )


@dataclass(frozen=True)
class LastAnswer:
    """The last answer, which a state that cannot be used repeats; no numbers of a linear view."""

    command: tuple[float, ...] = (0.0,)
    health: tuple[float, ...] = (0.0, 0.0, 0.0)

    def values(self) -> Values:
        """Return it by ports."""
        return {"command": self.command, "health": self.health}


SILENCE = LastAnswer()


class State(NamedTuple):
    """Integral of e (packet s), set point q_d and last e (packets), window and round trip of late.

    The last two fields are the number of successive ticks without a valid state, and the last answer.
    """

    integral: float
    q_d: float
    e: float | None = None
    past: History | None = None
    silent: int = 0
    last: LastAnswer = SILENCE


Answer = tuple[State, Values]


class AqmController(Block[AqmControllerParams]):
    """Drop probability from window, queue and round trip time, by one of `laws`, clipped to [0, 1].

    Window and round trip of one round trip ago come from the controller's own record of the state, interpolated
    linearly; before there is one, from the oldest value. The integral is updated with e after the law has used it.

    If the state is refused, negative or older than 5 periods, the last command is repeated. After 50 ticks without a
    valid state the command is 0, so that only a full queue drops packets.

    When gains change, the integral is rescaled so that its part of the command (of the surface) stays the same, if the
    law has an integral before and after. The set point changes only by its topic, because figures read it there; the
    law and its model of the network are fixed at the start.
    """

    INPUTS = (STATE, REFERENCE)
    OUTPUTS = (COMMAND, HEALTH)
    AGREED = {"tcp/set_point": "set_point"}  # the network that it assumes may differ

    def setup(self) -> None:
        """Choose the law."""
        p = self.p
        self._law = LAWS[p.law]
        self._printed = p.phi_form == "printed"
        self._freezes = p.anti_windup or p.law == "robust"
        self._rate = 1.0 / p.period
        self._period = to_ns(p.period)
        self._stale = STALE * self._period

    def first(self) -> State:
        """Return a state without samples and with no drops."""
        return State(0.0, self.p.set_point)

    def go_on(self, x: State, before: AqmControllerParams) -> State:
        """Continue with other gains; the record of the state stays."""
        was, now = integral_gain(self.p.law, before), integral_gain(self.p.law, self.p)
        return x._replace(integral=x.integral * (was / now)) if was != now and now else x

    def update(self, x: State, t: int, *, state: tuple[float, ...], reference: tuple[float, ...] | None) -> Answer:
        """Return the drop probability."""
        integral, q_d, e_before, past, silent, last = x
        age = self.age("state") or 0
        if age > self._stale:
            self.report(Level.WARN, "stale", f"the state is older than {STALE} periods: the last command is held")
            silent = max(silent, age // self._period - 1)
            return self._hold(State(integral, q_d, e_before, past, silent, last))
        w, q, R = state
        if w <= 0.0 or q < 0.0 or R <= 0.0:
            self.report(
                Level.ERROR,
                "bad_state",
                f"state window {w:g}, queue {q:g}, rtt {R:g}: impossible, the last command is held",
            )
            return self._hold(x)
        if reference is not None and reference[0] != q_d:
            q_d, e_before = self._aim(q_d, e_before, reference[0])
        p = self.p
        past = History(p.period, p.history, (w, R)) if past is None else past.put((w, R))
        w_R, R_R = self._one_trip_ago(past, R)
        e = q - q_d
        m = Measured(
            e,
            p.N * w / R - p.C,
            phi(w, R, p.N, p.C, printed=self._printed),
            psi(w, R, w_R, R_R, p.N),
            0.0 if e_before is None else (e - e_before) * self._rate,
            integral,
        )
        u, s = self._law(m, p)
        drop = min(max(u, 0.0), 1.0)
        if not (self._freezes and ((u > 1.0 and e > 0.0) or (u < 0.0 and e < 0.0))):
            integral += e * p.period
        last = LastAnswer((drop,), (s, integral, float(drop != u)))
        return State(integral, q_d, e, past, 0, last), last.values()

    def refused(self, x: State, t: int) -> Answer:
        """Hold the last command; after 50 ticks publish 0."""
        return self._hold(x)

    def _hold(self, x: State) -> Answer:
        integral, q_d, e, past, silent, last = x
        silent += 1
        if past is not None:
            past = past.again()  # the record has one entry for each tick
        if silent >= HOLD:
            self.report(Level.ERROR, "no_state", f"no valid state for {HOLD} ticks: nothing is dropped")
            last = LastAnswer(health=last.health)
        return State(integral, q_d, e, past, silent, last), last.values()

    def _aim(self, q_d: float, e: float | None, wanted: float) -> tuple[float, float | None]:
        """Return set point and last e, so that the derivative gets no kick."""
        if 0.0 < wanted < self.p.q_max:
            return wanted, None if e is None else e + (q_d - wanted)
        self.report(
            Level.ERROR,
            "bad_reference",
            f"reference {wanted:g} packets is not within 0 and q_max = {self.p.q_max:g}; {q_d:g} stays",
        )
        return q_d, e

    def _one_trip_ago(self, past: History, R: float) -> tuple[float, ...]:
        """Return window and round trip time of one round trip ago."""
        back = R
        if back > self.p.history:
            self.report(Level.WARN, "deep", f"round trip {R:g} s is beyond the record of {self.p.history:g} s")
            back = self.p.history
        return past.aged(back * self._rate)
