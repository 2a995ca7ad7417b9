"""What the plant and its observers share: the modules of the string and the conditions they may be in."""

from __future__ import annotations

from typing import Any

from softrig_core import Block, Level, Params, param
from softrig_core.kit.newest import Newest

from .module import ModuleParams
from .string import Characteristic, characteristic

IRRADIANCE = (0.0, 1500.0)  # W/m^2
TEMPERATURE = (-40.0, 100.0)  # deg C


class ArrayParams(Params):
    """The string; pattern 1 of the paper."""

    module: ModuleParams = ModuleParams()
    irradiance: tuple[float, ...] = param(
        (1000.0, 800.0, 600.0, 400.0), "irradiance of each module until pv/environment arrives", "W/m^2", min_length=1
    )
    temperature: tuple[float, ...] = param(
        (25.0, 25.0, 25.0, 25.0), "cell temperature of each module until pv/environment arrives", "degC", min_length=1
    )

    def agreed(self) -> dict[str, Any]:
        """Return the quantities on which a string and the nodes that judge it must agree: modules and initial
        conditions.
        """
        return {"pv/module": self.module.model_dump(), "pv/conditions": self.irradiance + self.temperature}

    def sources(self) -> Newest[tuple[float, ...], Characteristic]:
        """Return the function that computes the characteristic under the values of pv/environment."""
        return Newest(lambda environment: characteristic(self.module, *split(environment)))

    def _check(self) -> None:
        if problem := refuse(self.irradiance, self.temperature):
            raise ValueError(problem)


def refuse(irradiance: tuple[float, ...], temperature: tuple[float, ...]) -> str:
    """Describe why these conditions cannot be; empty when they can."""
    if len(irradiance) != len(temperature):
        return f"irradiance of {len(irradiance)} modules, temperature of {len(temperature)}"
    for name, values, (low, high), unit in (
        ("irradiance", irradiance, IRRADIANCE, "W/m^2"),
        ("temperature", temperature, TEMPERATURE, "deg C"),
    ):
        for k, value in enumerate(values, 1):
            if not low <= value <= high:
                return f"{name} of module {k} is {value:g} {unit}, expected {low:g} to {high:g}"
    return ""


def split(environment: tuple[float, ...]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return irradiance and temperature of the modules out of the values of pv/environment."""
    n = len(environment) // 2
    return environment[:n], environment[n:]


def possible(block: Block, environment: tuple[float, ...]) -> bool:
    """Return whether a block may use these values of pv/environment; if not, the block reports the reason."""
    irradiance, temperature = split(environment)
    bright = all(IRRADIANCE[0] <= value <= IRRADIANCE[1] for value in irradiance)
    if bright and all(TEMPERATURE[0] <= value <= TEMPERATURE[1] for value in temperature):
        return True
    block.report(
        Level.ERROR, "environment", f"pv/environment refused, the last one holds: {refuse(irradiance, temperature)}"
    )
    return False
