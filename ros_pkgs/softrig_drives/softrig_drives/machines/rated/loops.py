"""What the drives of data sheets have in common: bandwidths, and a step that the torque can follow."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from softrig_control.data_sheet import mapping, plausible, text

START = 0.1  # s to the rated speed with the rated torque, where no inertia is given
SECONDS = 100.0  # s: a longer start means an inertia in another unit


class Drive(NamedTuple):
    """Parameters of plant and controller, a step within the drive's ability, and a description of the assumptions."""

    plant: dict[str, float]
    law: dict[str, float]
    step: dict[str, float]
    assumed: tuple[str, ...]


def inertia(rated: Mapping[str, float], torque: float, w: float, assumed: list[str]) -> float:
    """Return the inertia, kg m^2: of the data sheet, or assumed by the time of a start."""
    if "J" in rated:
        plausible(
            "J", rated["J"], "kg m^2", 1e-6 * torque / w, SECONDS * torque / w,
            "the rated torque would start the rotor in no such time: is it in kg m^2? (1 g cm^2 = 1e-7 kg m^2)"
        )  # fmt: skip
        return rated["J"]
    J = torque * START / w
    assumed.append(f"J = {J:.4g} kg m^2: at rated torque the rotor needs {START:g} s to its rated speed")
    return J


def most(rated: Mapping[str, float], peak: float, scale: float, assumed: list[str]) -> float:
    """Return the largest current as an amplitude, A; `scale` turns that of the data sheet into one."""
    if "i_max" in rated:
        plausible("i_max", scale * rated["i_max"] / peak, "times the rated current", 0.5, 50.0, "it is in A")
        return scale * rated["i_max"]
    assumed.append(f"i_max = {1.5 * peak:.4g} A: 1.5 times the amplitude of the rated current")
    return 1.5 * peak


def loops(
    torque: float, w: float, J: float, period: float, assumed: list[str]
) -> tuple[float, float, dict[str, float]]:
    """Return the bandwidths of current and speed loop (rad/s), and a step that the torque can follow."""
    alpha_c = min(400.0 * math.pi, 0.15 / period)
    alpha_s = min(alpha_c / 40.0, 0.8 * torque / (0.2 * w * J))
    assumed.append(f"bandwidths of {alpha_c:.4g} (current) and {alpha_s:.4g} rad/s (speed): chosen by the period and J")
    speed = min(0.2 * w, 0.8 * torque / (alpha_s * J))
    # a load step T lowers the speed by T/(e J alpha_s): by less than half of its value
    return alpha_c, alpha_s, {"speed": speed, "torque": min(0.5 * torque, 0.4 * math.exp(1.0) * J * alpha_s * speed)}


def written(drive: Drive, names: tuple[str, str], begin: float, more: str = "") -> str:
    """Return the nodes and expectations of a scenario with a step of speed and one of load.

    Parameters
    ----------
    names : (str, str)
        Of the plant's and the controller's node.
    begin : float
        Time of the speed step, s.
    more : str
        Further lines of `expect`.
    """
    alpha, step, (plant, law) = drive.law["speed_bandwidth"], drive.step, names
    settle = 10.0 / alpha
    return f"""duration: {text(begin + 2.0 * settle)}
shared: {{begins: {text(begin)}, loaded: {text(begin + settle)}, target: {text(step["speed"])}}}
nodes:
  {plant}:
    parameters: {mapping(drive.plant)}
  {law}:
    parameters: {mapping(drive.law)}
  speed_source: {{parameters: {{period: ${plant}.period}}}}
  load_source: {{parameters: {{period: ${plant}.period, values: [0.0, {text(step["torque"])}]}}}}
expect:
  rise_time: {text(math.log(9.0) / alpha)} +- 8 %
  speed_end: $speed_source.velocities.1 +- 3 %
{more}"""
