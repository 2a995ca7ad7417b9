"""The controller of the queue: any law, on the network's published state alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, Self

from pydantic import model_validator
from softrig_core import Block, BlockParams, History, Level, executable, param, to_ns

from .laws import INTEGRAL, LAWS, Gains, LawName, Measured
from .model import Bottleneck, phi, psi
from .ports import COMMAND, HEALTH, REFERENCE, STATE

STALE = 5  # periods beyond which a state is too old
HOLD = 50  # ticks without a valid state after which nothing is dropped any more


class AqmControllerParams(Gains, Bottleneck, BlockParams):
    """Law, gains, and the controller's own idea of the network."""

    period: float = param(0.001, "control period", "s", gt=0.0, le=1.0)
    law: LawName = param("sspd", "the law")
    set_point: float = param(120.0, "queue q_d wanted, until a reference comes", "packet", gt=0.0, le=1e6)
    phi_form: Literal["corrected", "printed"] = param(
        "corrected", "Phi as derived or as the paper prints it", live=True
    )
    anti_windup: bool = param(
        False, "freeze the integral while the command is clipped in the direction of e; robust always does", live=True
    )
    history: float = param(0.5, "how far back the controller remembers the state", "s", gt=0.0, le=100.0)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if not self.set_point < self.q_max:
            raise ValueError(f"set_point = {self.set_point:g}: expected less than q_max = {self.q_max:g} packets")
        longest = self.q_max / self.C + self.tau_p
        if self.history < longest:
            raise ValueError(f"history = {self.history:g} s is shorter than the longest delay q_max/C + tau_p = "
                             f"{longest:g} s")  # fmt: skip
        return self


class AqmController(Block[AqmControllerParams]):
    """Drop probability from window, queue and round trip time, by one of `laws`, clipped to [0, 1].

    Window and round trip of one round trip ago come from the controller's own record of the state, interpolated
    linearly; before there is one, from the oldest value. The integral takes e in after the law has used it.

    A state that is refused, negative or older than 5 periods is answered by the last command; after 50
    ticks without a valid one by 0, for then only a full queue may drop.

    Under other gains the integral is rescaled so that its part of the command (of the surface) stays, where the law has
    one after as before. The set point, on which figures agree, changes by its topic; the law and its idea of the
    network are fixed at the start.
    """

    INPUTS = (STATE, REFERENCE)
    OUTPUTS = (COMMAND, HEALTH)

    @classmethod
    def agreed(cls, params: AqmControllerParams) -> Mapping[str, Any]:
        """What is wanted; its idea of the network is its own."""
        return {"tcp/set_point": params.set_point}

    def setup(self) -> None:
        """Choose the law."""
        p = self.p
        self._law = LAWS[p.law]
        self._printed = p.phi_form == "printed"
        self._freezes = p.anti_windup or p.law == "robust"
        self._rate = 1.0 / p.period
        self._period = to_ns(p.period)
        self._stale = STALE * self._period
        self._history = History(p.period, p.history)

    def change(self, params: AqmControllerParams) -> None:
        """Take other gains; the record of the state goes on."""
        history, share = self._history, INTEGRAL[params.law]
        before, after = share(self.p), share(params)
        if before != after and after:
            self.integral *= before / after
        super().change(params)
        self._history = history

    def start(self) -> None:
        """Know nothing, drop nothing."""
        self.integral = 0.0
        self._q_d = self.p.set_point
        self._known = False
        self._e: float | None = None
        self._silent = 0
        self._answer: Mapping[str, tuple[float, ...]] = {"command": (0.0,), "health": (0.0, 0.0, 0.0)}

    def update(
        self, t: int, *, state: tuple[float, ...], reference: tuple[float, ...] | None
    ) -> Mapping[str, tuple[float, ...]]:
        """Give the drop probability."""
        age = self.age("state") or 0
        if age > self._stale:
            self.report(Level.WARN, "stale", f"the state is older than {STALE} periods: the last command is held")
            self._silent = max(self._silent, age // self._period - 1)
            return self._hold()
        w, q, R = state
        if w <= 0.0 or q < 0.0 or R <= 0.0:
            self.report(Level.ERROR, "bad_state", f"state window {w:g}, queue {q:g}, rtt {R:g}: impossible, the last "
                        "command is held")  # fmt: skip
            return self._hold()
        if reference is not None and reference[0] != self._q_d:
            self._aim(reference[0])
        self._silent = 0
        w_R, R_R = self._look_back(w, R)
        p = self.p
        e = q - self._q_d
        m = Measured(
            e,
            p.N * w / R - p.C,
            phi(w, R, p.N, p.C, printed=self._printed),
            psi(w, R, w_R, R_R, p.N),
            0.0 if self._e is None else (e - self._e) * self._rate,
            self.integral,
        )
        self._e = e
        u, s = self._law(m, p)
        drop = min(max(u, 0.0), 1.0)
        if not (self._freezes and ((u > 1.0 and e > 0.0) or (u < 0.0 and e < 0.0))):
            self.integral += e * p.period
        self._answer = {"command": (drop,), "health": (s, self.integral, float(drop != u))}
        return self._answer

    def refused(self, t: int) -> Mapping[str, tuple[float, ...]]:
        """Hold the last command; after 50 ticks give 0."""
        return self._hold()

    def _hold(self) -> Mapping[str, tuple[float, ...]]:
        self._silent += 1
        if self._known:
            self._history.put(self._history.at(0.0))  # the record has one entry a tick
        if self._silent >= HOLD:
            self.report(Level.ERROR, "no_state", f"no valid state for {HOLD} ticks: nothing is dropped")
            self._answer = {**self._answer, "command": (0.0,)}
        return self._answer

    def _aim(self, q_d: float) -> None:
        if not 0.0 < q_d < self.p.q_max:
            self.report(Level.ERROR, "bad_reference", f"reference {q_d:g} packets is not within 0 and q_max = "
                        f"{self.p.q_max:g}; {self._q_d:g} stays")  # fmt: skip
            return
        if self._e is not None:
            self._e += self._q_d - q_d  # no kick of the derivative
        self._q_d = q_d

    def _look_back(self, w: float, R: float) -> tuple[float, ...]:
        """Note the state and give window and round trip time of one round trip ago."""
        line = self._history
        if not self._known:
            line.reset((w, R))
            self._known = True
        back = R
        if back > self.p.history:
            self.report(Level.WARN, "deep", f"round trip {R:g} s is beyond the record of {self.p.history:g} s")
            back = self.p.history
        line.put((w, R))
        return line.aged(back * self._rate)


main = executable(AqmController)
