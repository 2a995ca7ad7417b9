"""The shipped falsifications: their worst run, the reduced violation, and that both can be run again."""

import json

import pytest
from softrig_bringup.cli import main
from softrig_bringup.falsify.definition import falsification_of, list_falsifications
from softrig_bringup.falsify.space import parse, space_of
from softrig_core import load_scenario, simulate


@pytest.mark.parametrize("name", sorted(list_falsifications()))
def test_every_shipped_falsification_fits_its_rig(name):
    task = falsification_of(name, {})
    scenario = load_scenario(task.scenario)
    assert set(task.requirements) <= scenario.requirements.keys() | scenario.expect.keys()
    space = space_of(scenario, [parse(key, text) for key, text in task.over.items()])
    for over, nominal in zip(space.overs, space.nominal, strict=True):  # the paper's values lie in the range
        numbers = nominal if isinstance(nominal, list) else [nominal]
        assert all(over.low <= x <= over.high for x in numbers)


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(list_falsifications()))
def test_outcome(name, tmp_path):
    # Least margins of the worst run, and the changes of the small case.
    known = {
        "dc_motor_insensitive": (
            {"settles": -2.0828},
            {"dc_motor_plant.Kt": 0.0149055, "dc_motor_plant.J": 0.000397656},
        ),
        "dc_motor_fsfb_late": (
            {"no_overshoot": -0.02531},
            {"fieldbus_delay.delay": 0.1000045, "fieldbus_delay.jitter": 0.0200057},
        ),
        "lsrm_fuzzy_load": ({"overshoot_within": -0.025948, "arrives": -0.029151}, {"lsrm_plant.C": 6.16821}),
        "rehab_impedance_gain": ({"tracks": -0.0038937}, {"voltage_controller.emvc.alpha_hat": [5.93869]}),
        "pwa_delay_tank": ({"never_dry": -0.0005}, {"tank_plant.delay": 6.52030}),
        "tcp_aqm_flows": ({"settles": -117.6}, {"tcp_fluid.tau_p": 0.217495}),
        "rectifier_mpc_load": ({"recovers": -197.353, "dip": -145.353}, {"gpc_controller.lam": 253.398}),
        # Margins of delay: 0.0200056 s, and 0.4192653 s (test_pwa_delay.py::test_margin_of_the_pendulum_by_growth).
        "pwa_delay_growth": ({"growth": -0.00494562}, {"switched_delay_plant.delay": 0.02000596}),
        "pwa_delay_growth_pendulum": ({"growth": -0.0650097}, {"switched_delay_plant.delay": 0.4192676}),
        "induction_dtc_resistance": ({"tracks": -1246.098, "current": -15.6082}, {"im_plant.R_s": 3.68478}),
    }
    status = main(["falsify", name, "--out", str(tmp_path), "--workers", "2"])
    content = json.loads((tmp_path / "outcome.json").read_text())
    assert (status, bool(content["violated"])) == (1, True)
    small = simulate(load_scenario(str(tmp_path / f"{name}_small.yaml")))
    bounds = small.rig.scenario.expect  # the margin of a figure is its distance to the bound
    assert {n: bounds[n].margin(x) if n in bounds else x for n in content["small"] for x in [small.figures[n]]} == (
        content["small"]
    )
    worst, changes = known.get(name, ({}, {}))
    assert content["runs"] == falsification_of(name, {}).budget  # all runs are made
    for key, margin in worst.items():
        assert content["worst"][key] == pytest.approx(margin, rel=1e-4)
    for key, value in changes.items():
        assert content["small_changes"][key] == pytest.approx(value, rel=1e-4)
