"""Sensors of a drive: encoder, resolver or Hall sensors on the shaft, current sensors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal, NamedTuple

from softrig_core import Block, BlockParams, Level, Port, joint_state, param, scalars, vector3

from .ports import CURRENTS, SHAFT, SHAFT_MEAS

SHAFT_OUT = joint_state("measured", "shaft_measured", SHAFT, position="rad", velocity="rad/s")
HALL = scalars("hall", "hall", {"a": "1", "b": "1", "c": "1"})
CURRENTS_OUT = vector3("measured", "currents_measured", "abc", "A")
SIXTH = math.pi / 3.0


class ShaftSensorParams(BlockParams):
    """Parameters of a shaft sensor: its kind, resolution and errors, and the tracking loop behind it."""

    period: float = param(1e-4, "sampling period", "s", gt=0.0, le=0.1)
    kind: Literal["encoder", "resolver", "hall"] = param("encoder", "which sensor")
    lines: int = param(1024, "encoder: lines a revolution; four counts a line", ge=1, le=10_000_000)
    index: bool = param(True, "encoder: an index pulse a revolution makes the angle absolute")
    start: float = param(0.0, "encoder: angle that is assumed at the begin, until the index", "rad", ge=-1e6, le=1e6)
    pole_pairs: int = param(1, "pole pairs of the resolver, or of the machine with Hall sensors", ge=1, le=1000)
    bits: int = param(12, "resolver: resolution of sine and cosine", ge=4, le=24)
    imbalance: float = param(0.0, "resolver: amplitude of the sine above that of the cosine", ge=-0.5, le=0.5)
    offset: float = param(0.0, "resolver: offset of the sine, over its amplitude", ge=-0.5, le=0.5)
    noise: float = param(0.0, "resolver: standard deviation of noise on both, over their amplitude", ge=0.0, le=0.5)
    first_edge: float = param(
        math.pi / 6.0, "Hall: electrical angle at which sensor a rises", "rad", ge=-math.pi, le=math.pi
    )
    bandwidth: float = param(
        600.0, "bandwidth of the loop that tracks the angle and estimates the speed", "rad/s", gt=0.0, live=True
    )

    def _check(self) -> None:
        if self.bandwidth * self.period > 0.5:
            raise ValueError(
                f"bandwidth = {self.bandwidth:g} rad/s: expected at most half of 1/period = {1.0 / self.period:g} 1/s"
            )


class ShaftState(NamedTuple):
    """Angle (rad) and speed (rad/s) as followed; encoder: first count, revolution, whether the index was seen."""

    theta: float = 0.0
    omega: float = 0.0
    begin: float = 0.0
    turn: float = 0.0
    absolute: bool = False
    k: int = 0


class ShaftSensor(Block[ShaftSensorParams]):
    """Angle and speed as measured by an encoder, a resolver or Hall sensors.

    ::

        encoder   count = floor(theta 4 lines/2 pi), angle in the middle of a count; relative until the index pulse
        resolver  atan2((1 + imbalance) sin + offset, cos), both rounded to bits
        Hall      six sectors of the electrical angle
        loop      e = wrapped(angle - theta),  w' = alpha^2 e,  theta' = w + 2 alpha e

    An encoder's angle is its count; those of resolver and Hall sensors are the loop's. The speed is the loop's.
    """

    @classmethod
    def ports(cls, params: ShaftSensorParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Hall sensors publish their three states, too."""
        return (SHAFT_MEAS,), (SHAFT_OUT, HALL) if params.kind == "hall" else (SHAFT_OUT,)

    def setup(self) -> None:
        """Scale the sensor and the loop."""
        p = self.p
        self._kind = p.kind
        self._per_count = math.tau / (4 * p.lines)
        self._levels = float(2 ** (p.bits - 1))
        self._cycle = math.tau / p.pole_pairs if p.kind != "encoder" else math.tau
        self._k_p, self._k_i = 2.0 * p.bandwidth * p.period, p.bandwidth * p.bandwidth * p.period

    def first(self) -> ShaftState:
        """Begin at the angle that is assumed."""
        return ShaftState(self.p.start)

    def update(
        self, x: ShaftState, t: int, *, joint_states: tuple[float, ...]
    ) -> tuple[ShaftState, Mapping[str, tuple[float, ...]]]:
        """Sense the shaft."""
        p = self.p
        true = joint_states[0]
        if self._kind == "encoder":
            return self._counted(x, true)
        electrical = p.pole_pairs * true
        if self._kind == "resolver":
            sine, cosine = math.sin(electrical), math.cos(electrical)
            if p.noise:
                sine, cosine = (
                    sine + p.noise * self.standard_normal(2 * x.k),
                    cosine + p.noise * self.standard_normal(2 * x.k + 1),
                )
            sine = round(((1.0 + p.imbalance) * sine + p.offset) * self._levels)
            cosine = round(cosine * self._levels)
            theta, omega = self._followed(x, math.atan2(sine, cosine) / p.pole_pairs)
            return ShaftState(theta, omega, k=x.k + 1), {"measured": (theta, omega)}
        sector = math.floor((electrical - p.first_edge) / SIXTH)
        theta, omega = self._followed(x, ((sector + 0.5) * SIXTH + p.first_edge) / p.pole_pairs)
        n = sector % 6
        states = (
            1.0 if n < 3 else 0.0,
            1.0 if 2 <= n < 5 else 0.0,
            1.0 if n == 0 or n >= 4 else 0.0,
        )
        return ShaftState(theta, omega, k=x.k + 1), {"measured": (theta, omega), "hall": states}

    def _counted(self, x: ShaftState, true: float) -> tuple[ShaftState, Mapping[str, tuple[float, ...]]]:
        count, turn = math.floor(true / self._per_count), math.floor(true / math.tau)
        begin = x.begin if x.k else float(count)
        absolute = x.absolute or (self.p.index and x.k > 0 and turn != x.turn)
        origin = 0.0 if absolute else self.p.start - begin * self._per_count
        measured = (count + 0.5) * self._per_count + origin
        theta, omega = self._followed(x, measured)
        if absolute and not x.absolute:
            theta = measured  # the index tells the angle: the loop does not take it for motion
        return ShaftState(theta, omega, begin, float(turn), absolute, x.k + 1), {"measured": (measured, omega)}

    def _followed(self, x: ShaftState, angle: float) -> tuple[float, float]:
        theta = x.theta + self.p.period * x.omega
        error = math.remainder(angle - theta, self._cycle)
        return theta + self._k_p * error, x.omega + self._k_i * error


class CurrentSensorParams(BlockParams):
    """Errors of each phase, noise, resolution and range."""

    period: float = param(1e-4, "sampling period", "s", gt=0.0, le=0.1)
    gain: tuple[float, float, float] = param((1.0, 1.0, 1.0), "gain of phases a, b, c", each=(0.0, 10.0), live=True)
    offset: tuple[float, float, float] = param((0.0, 0.0, 0.0), "offset", "A", each=(-1e6, 1e6), live=True)
    noise: float = param(0.0, "standard deviation of the noise", "A", ge=0.0, live=True)
    lsb: float = param(0.0, "resolution; 0: not quantised", "A", ge=0.0)
    limit: float = param(1e6, "range, plus and minus", "A", gt=0.0)


class CurrentState(NamedTuple):
    """Number of the sample."""

    k: int = 0


class CurrentSensor(Block[CurrentSensorParams]):
    """Phase currents as the sensor converts them: y = lsb round((gain i + offset + noise)/lsb), within the range.

    The plant gives currents at a peak of the carrier, so that is when they are sampled.
    """

    INPUTS = (CURRENTS,)
    OUTPUTS = (CURRENTS_OUT,)
    STATE = CurrentState

    def update(
        self, x: CurrentState, t: int, *, currents: tuple[float, ...]
    ) -> tuple[CurrentState, Mapping[str, tuple[float, ...]]]:
        """Convert the currents."""
        i_a, i_b, i_c = currents
        measured = (self._converted(i_a, 0, x.k), self._converted(i_b, 1, x.k), self._converted(i_c, 2, x.k))
        return CurrentState(x.k + 1), {"measured": measured}

    def _converted(self, i: float, phase: int, k: int) -> float:
        p = self.p
        y = p.gain[phase] * i + p.offset[phase]
        if p.noise:
            y += p.noise * self.standard_normal(3 * k + phase)
        if p.lsb:
            y = round(y / p.lsb) * p.lsb
        if abs(y) > p.limit:
            self.report(Level.WARN, "range", f"a current of {y:.3g} A is beyond the sensor's {p.limit:g} A")
            y = math.copysign(p.limit, y)
        return y
