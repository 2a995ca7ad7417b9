"""Linear views of the systems against a fault: a step on a link, run by the nodes of the rig, beside the view's
prediction.
"""

import json
import math
from typing import NamedTuple

import numpy as np
import pytest
from softrig_bringup.cli import main
from softrig_core import (
    Block,
    Plant,
    Rig,
    RunError,
    ScenarioError,
    linear_along,
    linear_view,
    load_scenario,
    number,
    simulate,
)

PERIODS = 40
AT_REST = 1e-6

# A command of each system, the step as a part of its largest value, and the largest error of the view.
STEPS = {
    "dc_motor_smc": ("motor/command/armature/effort", 2.0**-12, AT_REST),
    "dc_motor_fsfb": ("axis/command/armature/effort", 2.0**-12, AT_REST),
    "rectifier_mpc": ("v_drop/command/v_drop/effort", 2.0**-12, AT_REST),
    "manipulator_adsmc": ("motor_command/motor2/effort", 2.0**-12, AT_REST),
    "optimal_control_mvim": ("ocp/command/axis_1/effort", 2.0**-12, AT_REST),
    # The friction has a kink where a joint starts to move.
    "rehab_impedance": ("motor_command/hip/effort", 2.0**-16, 1e-5),
    "pv_mppt": ("converter/duty/duty/effort", 2.0**-18, 1e-3),  # the voltage of the string is solved iteratively
}


def stepped(name, link, height, begin, end):
    """Run a scenario with an offset of `height` on a link from `begin` to `end`; return its signals."""
    topic, channel, _ = link.rsplit("/", 2)
    fault = {"link": topic, "kind": "offset", "channels": [channel], "value": [height], "from": begin}
    scenario = load_scenario(name).having(faults={"step": fault}, duration=end, figures={}, expect={}, claims={},
                                          requirements={}, changes=(), plots=())  # fmt: skip
    return simulate(scenario).signals


def apart(name, link, share):
    """Return the largest difference of an output between view and rig, relative to the largest output."""
    view = linear_along(name, PERIODS, at=0.3, inputs=[link])
    end = view.at + (PERIODS + 1) * view.period
    quiet = simulate(name, duration=end).signals
    height = share * max(1e-3, float(np.abs(quiet[link].x).max()))
    up, down = (stepped(name, link, sign * height, view.at, end) for sign in (1.0, -1.0))
    _, outputs = view.answer(np.full((PERIODS, 1), height))
    times = view.at + view.period * np.arange(PERIODS)
    result = {}
    for k, output in enumerate(view.outputs):
        at = np.searchsorted(up[output].t, times - 1e-9)
        seen = 0.5 * (up[output].x[at] - down[output].x[at])
        most = max(np.abs(seen).max(), np.abs(outputs[:, k]).max())
        result[output] = float(np.abs(seen - outputs[:, k]).max() / most) if most else 0.0
    return result


@pytest.mark.long
@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", STEPS)
def test_a_view_along_a_run_agrees_with_the_rig_under_a_step_through_a_fault(name):
    link, share, most = STEPS[name]
    result = apart(name, link, share)
    assert max(result.values()) < most, result


# Rigs of which a linear view along the run is refused, with the reason.
OTHERWISE = {
    # Two travelling waves, which move by one place a step.
    "fault_location": "numbers move, .* of them in line_plant.line",
    "gupfc": "numbers move, .* of them in gupfc_plant.network.ring",  # the moving mean of a cycle of 1024 steps
    "pwa_delay": "numbers move, .* of them in switched_delay_plant.past",
    "tcp_aqm_smc": "numbers move, .* of them in tcp_fluid.past",
    "economic_dispatch": "dispatch/setpoints/2/effort is not published at",  # the solver publishes only now and then
    "induction_dtc": 0.1,  # hysteresis and a table switch at every tick
    "lsrm_fuzzy": 0.1,  # a phase without current is blocked by its diode, so its flux can only rise
}


@pytest.mark.long
@pytest.mark.timeout(900)
@pytest.mark.parametrize(("name", "reason"), OTHERWISE.items())
def test_a_view_along_a_run_that_differs_from_the_rig_is_reported(name, reason):
    if isinstance(reason, str):
        with pytest.raises(RunError, match=reason):
            linear_along(name, PERIODS, at=0.3, inputs=["dispatch/setpoints/2/effort"] if "dispatch" in name else None)
    else:
        assert linear_along(name, PERIODS, at=0.3).state_error > reason


@pytest.mark.long
def test_rotating_grid_currents_have_no_view_at_one_tick():
    steady = {"event_source.times": [0.0, 5.0]}
    view = linear_view("rectifier_mpc", "", at=0.1, overrides=steady)
    assert {f"grid/current/{axis}" for axis in "xyz"} <= view.left_out.keys()
    assert "turns with an angle" in view.left_out["grid/current/x"]
    assert "belongs to other ticks" in view.left_out["power_quality/thd/position"]
    assert max(view.output_errors.values()) < AT_REST
    assert view.C.shape == (len(view.outputs), len(view.states))
    with pytest.raises(RunError, match="grid/current/x is another function of the states at each tick"):
        linear_view("rectifier_mpc", "", at=0.1, overrides=steady, outputs=["grid/current/x"])
    along = linear_along("rectifier_mpc", 12, at=0.1, overrides=steady, outputs=["grid/current/x", "grid/current/y"])
    assert max(along.state_error, *along.output_errors.values()) < AT_REST


class Turned(NamedTuple):
    """A state and the number of ticks."""

    x: float = 1.0
    shown: float = 0.0


class Turning(Plant):
    """x+ = 0.98 x + u, published plainly, turned by an angle, counted, and at each eighth tick only."""

    INPUTS = (number("u", "law/u", "1"),)
    OUTPUTS = tuple(number(name, f"plant/{name}", "1") for name in ("y", "turned", "counts", "window"))

    def first(self):
        return Turned()

    def outputs(self, x, t):
        angle = 1e-9 * t * 40.0
        return {"y": (x.x,), "turned": (x.x * math.cos(angle),), "counts": (round(20.0 * x.x) / 20.0,),
                "window": (x.shown,)}  # fmt: skip

    def advance(self, x, t, u):
        last = round(t / 1e7) % 8 == 7
        return Turned(0.98 * x.x + u[0], x.x if last else x.shown)


class Law(Block):
    INPUTS = (number("v", "plant/y", "1"),)
    OUTPUTS = (number("u", "law/u", "1"),)

    def update(self, x, t, v):
        return x, {"u": (0.01 * (1.0 - v[0]),)}


def turning():
    return Rig.from_blocks({"plant": Turning(period=0.01), "law": Law(period=0.01)}, duration=2.0)


def test_outputs_of_each_kind_are_named_and_rotating_ones_are_followed():
    view = linear_view(turning(), "", at=0.32)
    assert view.outputs == ("plant/y/data",)
    assert "turns with an angle" in view.left_out["plant/turned/data"]
    assert "goes in steps" in view.left_out["plant/counts/data"]
    assert "belongs to other ticks" in view.left_out["plant/window/data"]
    along = linear_along(turning(), 20, at=0.32, outputs=["plant/y/data", "plant/turned/data"])
    assert max(along.state_error, *along.output_errors.values()) < 1e-9
    angles = 40.0 * (0.32 + 0.01 * np.arange(20))
    k = along.states.index("plant.x")
    assert along.C[:, 1, k] == pytest.approx(np.cos(angles), abs=1e-9)
    x, y = along.answer(np.zeros((20, len(along.inputs))))
    assert not x.any()
    assert not y.any()


def test_a_view_along_a_run_is_written_and_impossible_ones_are_refused(tmp_path, capsys):
    command = ["linearise", "dc_motor_smc", "--at", "0.1", "--along", "3", "--output", "speed"]
    assert main([*command, "--out", str(tmp_path)]) == 0
    assert "3 periods of 0.0001 s from 0.1 s" in capsys.readouterr().out
    written = json.loads((tmp_path / "along.json").read_text())
    assert np.array(written["A"]).shape == (3, len(written["states"]), len(written["states"]))
    assert written["outputs"] == ["motor/state/shaft/velocity"]
    assert main([*command, "--open", "voltage"]) == 2
    assert "expected no --open beside it" in capsys.readouterr().err
    with pytest.raises(ScenarioError, match="expected at least 1"):
        linear_along("dc_motor_smc", 0)
