"""Controllers of tank and pendulum, and the delay between a sensor and its controller."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

from softrig_core import Block, BlockParams, History, Level, Port, joint_state, param

from .params import DelayParams, law_of_the_tank
from .ports import INFLOW, LEVEL, SEEN, TORQUE
from .profiles import Delay, delay_at

Answer = tuple[Any, Mapping[str, tuple[float, ...]]]


class TankControllerParams(BlockParams):
    """Gains."""

    period: float = param(0.01, "sampling period", "s", gt=0.0, le=10.0)
    switch: float = param(0.5, "level at which the gain changes", ge=0.0, le=10.0)
    k_low: float = param(0.2, "gain below it", "1/s", ge=0.0, le=10.0)
    k_high: float = param(0.1, "gain above it, taken away", "1/s", ge=0.0, le=10.0)
    A: float = param(10.0, "area of the tank", "m^2", gt=0.0, le=1e4)
    phi: float = param(1000.0, "density", "kg/m^3", gt=0.0, le=1e5)


class TankController(Block[TankControllerParams]):
    """u = k_low A phi x below the switching level, -k_high A phi x from there on, as the paper's law.

    Plant, certificate and monitor must have the same gains: they do not change in a run.
    """

    INPUTS = (LEVEL,)
    OUTPUTS = (INFLOW,)

    @classmethod
    def agreed(cls, params: TankControllerParams) -> Mapping[str, Any]:
        """Return the controller, and the effect of a command."""
        return {
            **law_of_the_tank(params.switch, params.k_low, params.k_high),
            "tank/A phi": params.A * params.phi,
            "tank/hold": params.period,
        }

    def update(self, x: Any, t: int, *, level: tuple[float, ...]) -> Answer:
        """Return the inflow."""
        p, now = self.p, level[0]
        return x, {"inflow": (p.A * p.phi * now * (p.k_low if now < p.switch else -p.k_high),)}

    def refused(self, x: Any, t: int) -> tuple[Any, None]:
        """Hold the last inflow, none before the first level."""
        self.report(Level.ERROR, "bad_level", "no valid level: the last inflow is held")
        return x, None


class PendulumControllerParams(BlockParams):
    """Gains."""

    period: float = param(0.001, "sampling period", "s", gt=0.0, le=1.0)
    k_negative: float = param(1.0, "gain k while theta <= 0", ge=0.0, le=1e3)
    k_positive: float = param(5.0, "gain k while theta > 0", ge=0.0, le=1e3)


class PendulumController(Block[PendulumControllerParams]):
    """u = -k (theta + omega) of the state that it sees, k by the sign of theta.

    The plant's certificate must have the same gains: they do not change in a run.
    """

    INPUTS = (SEEN,)
    OUTPUTS = (TORQUE,)
    AGREED = {"pendulum/k_negative": "k_negative", "pendulum/k_positive": "k_positive"}

    def update(self, x: Any, t: int, *, state: tuple[float, ...]) -> Answer:
        """Return the torque."""
        theta, omega = state
        return x, {"torque": (-(self.p.k_positive if theta > 0.0 else self.p.k_negative) * (theta + omega),)}

    def refused(self, x: Any, t: int) -> tuple[Any, None]:
        """Hold the last torque, none before the first state."""
        self.report(Level.ERROR, "bad_state", "no valid state: the last torque is held")
        return x, None


class DelayLineParams(DelayParams, BlockParams):
    """Parameters of a delay line: the delayed signals, and the delay."""

    period: float = param(0.001, "sampling period", "s", gt=0.0, le=1.0)
    channels: tuple[str, ...] = param(("joint",), "names of the channels", min_length=1)
    fields: tuple[Literal["position", "velocity", "effort"], ...] = param(
        ("position", "velocity"), "fields that are delayed", min_length=1
    )
    unit: str = param("rad", "unit of a position or effort; a velocity is in this per s")


class Line(NamedTuple):
    """The delay over time, and the channels of late; None before the first message."""

    delay: Delay
    past: History | None = None


class DelayLine(Block[DelayLineParams]):
    """Any JointState, a delay d(t) later, linear between its samples; before there is one, the first.

    Its memory is for twice the delay of the start; certificates are for the delay of the start.
    """

    @classmethod
    def ports(cls, params: DelayLineParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """The same channels and fields in and out."""
        units = {f: params.unit + ("/s" if f == "velocity" else "") for f in params.fields}
        return (
            (joint_state("state", "state", params.channels, **units),),  # type: ignore[arg-type]
            (joint_state("delayed", "delayed_state", params.channels, **units),),  # type: ignore[arg-type]
        )

    def first(self) -> Line:
        """Return the state without a past."""
        return Line(Delay(self.p.bounded_profile(self), longest=self.p.reach))

    def go_on(self, x: Line, before: DelayLineParams) -> Line:
        """Keep the samples, which are read at the new delay from now on: at most at twice that of the start."""
        return x._replace(delay=Delay(self.p.bounded_profile(self, x.delay.longest), longest=x.delay.longest))

    def update(self, x: Line, t: int, *, state: tuple[float, ...]) -> Answer:
        """Return the delayed values."""
        past = History(self.p.period, self.p.reach, state) if x.past is None else x.past.put(state)
        return self._out(x.delay, past, t)

    def refused(self, x: Line, t: int) -> tuple[Line, Mapping[str, tuple[float, ...]] | None]:
        """Use the last value again."""
        return (x, None) if x.past is None else self._out(x.delay, x.past.again(), t)

    def _out(self, delay: Delay, past: History, t: int) -> tuple[Line, Mapping[str, tuple[float, ...]]]:
        back = min(delay_at(delay.profile, t / 1e9), delay.longest)
        return Line(delay, past), {"delayed": past.aged(back / self.p.period)}
