"""Timed shading patterns."""

from __future__ import annotations

from collections.abc import Mapping

from softrig_control.profile import StepProfile
from softrig_core import Block, BlockParams, Port, param
from softrig_core.kit.newest import Newest

from .array import IRRADIANCE, TEMPERATURE, refuse
from .ports import environment


class ShadingSourceParams(BlockParams):
    """Patterns one after the other; pattern 1 of the paper."""

    period: float = param(0.001, "sampling period", "s", gt=0.0, le=100.0)
    modules: int = param(4, "modules of the string", ge=1, le=1000)
    times: tuple[float, ...] = param(
        (0.0,), "times at which a pattern begins, increasing", "s", min_length=1, each=(0.0, 1e9), live=True
    )
    irradiance: tuple[float, ...] = param(
        (1000.0, 800.0, 600.0, 400.0), "irradiance of each module, pattern after pattern", "W/m^2", live=True
    )
    temperature: tuple[float, ...] = param(
        (25.0, 25.0, 25.0, 25.0),
        "cell temperature of each module, one pattern for all times or one for each",
        "degC",
        live=True,
    )
    fluctuation: float = param(
        0.0,
        "all values are multiplied by 1 + fluctuation u, u uniform in [-1, 1], drawn once for each",
        ge=0.0,
        lt=1.0,
        live=True,
    )

    def _check(self) -> None:
        n, count = self.modules, len(self.times)
        if len(self.irradiance) != n * count:
            raise ValueError(f"irradiance has {len(self.irradiance)} values, expected {n} modules x {count} times")
        if len(self.temperature) not in (n, n * count):
            raise ValueError(f"temperature has {len(self.temperature)} values, expected {n} or {n * count}")
        for k in range(count):
            if problem := refuse(*self.pattern(k)):
                raise ValueError(f"pattern {k + 1}: {problem}")
        try:
            StepProfile(self.times, self.times)
        except ValueError as error:
            raise ValueError(f"times: {error}") from None

    def pattern(self, k: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return irradiance and temperature of pattern k, counted from 0."""
        n = self.modules
        first = k * n if len(self.temperature) > n else 0
        return self.irradiance[k * n : (k + 1) * n], self.temperature[first : first + n]


class ShadingSource(Block[ShadingSourceParams]):
    """Irradiance and cell temperature of every module, changing at given times.

    The random numbers of the fluctuation are drawn once for the whole run; changed parameters do not affect them.
    """

    @classmethod
    def ports(cls, params: ShadingSourceParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Declare one irradiance and one temperature per module."""
        return (), (environment(params.modules),)

    def setup(self) -> None:
        """Keep the patterns of a run at hand."""
        self._profile = Newest(self._drawn)

    def first(self) -> tuple[float, ...]:
        """Draw the fluctuation of this run, the state: one number in [-1, 1] a value."""
        return tuple(self.generator().uniform(-1.0, 1.0, 2 * self.p.modules).tolist())

    def _drawn(self, x: tuple[float, ...]) -> StepProfile[tuple[float, ...]]:
        p = self.p
        n, patterns = p.modules, [p.pattern(k) for k in range(len(p.times))]
        factors = [1.0 + p.fluctuation * u for u in x]
        limits = [IRRADIANCE] * n + [TEMPERATURE] * n
        values = [
            tuple(min(max(x * f, low), high) for x, f, (low, high) in zip(g + t, factors, limits, strict=True))
            for g, t in patterns
        ]
        return StepProfile(p.times, values)

    def update(self, x: tuple[float, ...], t: int) -> tuple[tuple[float, ...], Mapping[str, tuple[float, ...]]]:
        """Return the pattern that is valid at t."""
        return x, {"environment": self._profile(x).at(t)}
