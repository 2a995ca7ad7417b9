"""Changes that a user can make: one in each system, compared with physics and not with an earlier run."""

from __future__ import annotations

import math

import numpy as np
import pytest
from softrig_core import ByHand, simulate, to_ns
from softrig_core.block.params import build
from softrig_drives.dc_axis.plant import DcAxisPlant
from softrig_drives.dc_motor.plant import DcMotorPlant
from softrig_drives.induction_dtc.plant import ImPlant
from softrig_drives.lsrm.fuzzy import TABLE_II, LsrmFuzzy
from softrig_drives.lsrm.plant import LsrmPlant
from softrig_power.dispatch.certify import Optimiser
from softrig_power.dispatch.units import Units
from softrig_power.fault_location import study
from softrig_power.fault_location.line.parameters import RigParams
from softrig_power.fault_location.method.location import locate
from softrig_power.fault_location.method.objective import LocatorParams
from softrig_power.pv.plant import PvPlant
from softrig_power.rectifier.plant import RectifierPlant
from softrig_robots.manipulator.plant import ManipulatorPlant
from softrig_systems.optimal_control.method.mvim import solve
from softrig_systems.optimal_control.problems import INERTIA, find, spacecraft
from softrig_systems.pwa_delay.plants import TankPlant


def moved(plant, steps, **inputs):
    """Advance a plant under constant inputs; return its outputs at the end."""
    node = ByHand(plant)
    for k in range(steps):
        node.advance(to_ns(k * plant.p.period), **inputs)
    return node.outputs(to_ns(steps * plant.p.period))


def test_dc_motor_twice_the_inertia_half_the_acceleration():
    speeds = [moved(DcMotorPlant(J=J, b=0.0, period=1e-4), 10, command=(6.0,))["state"] for J in (4e-4, 8e-4)]
    velocity = [s[1] for s in speeds]
    assert velocity[0] > 0.0
    assert velocity[1] == pytest.approx(0.5 * velocity[0], rel=1e-3)
    still = DcMotorPlant(Ke=0.1)  # without a load, back-EMF and friction determine the final speed
    speed = moved(still, round(60.0 / still.p.period), command=(6.0,))["state"][1]
    p = still.p
    assert speed == pytest.approx(6.0 * p.Kt / (p.R * p.b + p.Kt * p.Ke), rel=1e-3)


def test_dc_axis_twice_the_gain_twice_the_acceleration():
    ways = [moved(DcAxisPlant(gain=g), 20, command=(2.0,))["true_state"] for g in (2.2862, 4.5724)]
    assert ways[0][0] > 0.0
    assert ways[1] == pytest.approx([2.0 * x for x in ways[0]], rel=1e-9)


def test_induction_machine_twice_the_inertia_half_the_acceleration():
    """With a load torque on the shaft of a machine without voltage, because its flux is then zero."""
    speeds = []
    for J in (0.015, 0.03):
        plant = ImPlant(J=J)
        inputs = {port.name: (0.0,) * port.size for port in plant.ports(plant.p)[0]}
        inputs["load_torque"] = (3.0,)
        speeds.append(moved(plant, 200, **inputs)["joint_states"][1])
    assert speeds[0] == pytest.approx(-3.0 / 0.015 * 200 * 5e-5, rel=1e-6)
    assert speeds[1] == pytest.approx(0.5 * speeds[0], rel=1e-6)


def test_lsrm_twice_the_mass_half_the_acceleration():
    ways = [
        moved(LsrmPlant(M=M, C=0.0, k_p=0.0, x_0=0.01), 40, phase_voltage=(60.0, 0.0, 0.0, 0.0), load=None)[
            "joint_states"
        ]
        for M in (50.0, 100.0)
    ]
    assert abs(ways[0][1]) > 1e-4
    assert ways[1][1] == pytest.approx(0.5 * ways[0][1], rel=1e-3)


@pytest.mark.parametrize(
    ("change", "share"),
    [({"K_e": 0.5}, 2.0), ({"K_u": 4.0}, 2.0), ({"K_de": 0.02}, 1.0), ({"rules": tuple(-r for r in TABLE_II)}, -1.0)],
)
def test_fuzzy_law_ramps_as_its_scaling_factors_say(change, share):
    """Under a constant error the force rises by K_u e/K_e in each period, and falls with the rules turned round."""
    rises = []
    for law in (ByHand(LsrmFuzzy()), ByHand(LsrmFuzzy(**change))):
        forces = [law.update(k, joint_states=(0.3,), reference=(0.0, 0.35, 0.0))["force_cmd"][0] for k in range(20)]
        rises.append(forces[-1] - forces[-11])
    assert rises[0] == pytest.approx(10.0 * 2.0 * 0.05 / 1.0, rel=1e-9)
    assert rises[1] == pytest.approx(share * rises[0], rel=1e-9)


def test_manipulator_of_twice_the_mass_falls_as_fast():
    """As Galilei found: masses and inertias are doubled, and the motors have neither inertia nor voltage."""
    falls = []
    for share in (1.0, 2.0):
        links = {"mass": [share * m for m in (19.0, 18.18, 10.99)]}
        base = ManipulatorPlant().p.links
        links["inertia"] = [share * i for i in base.inertia]
        falls.append(_free_fall(ManipulatorPlant(links=links, position=(0.3, 0.2, -0.4))))
    assert max(abs(a) for a in falls[0]) > 1.0
    assert falls[1] == pytest.approx(falls[0], rel=1e-9, abs=1e-9)
    heavy = _free_fall(
        ManipulatorPlant(links={"mass": [2.0 * m for m in (19.0, 18.18, 10.99)]}, position=(0.3, 0.2, -0.4))
    )
    assert heavy != pytest.approx(falls[0], rel=1e-3)  # only the masses are doubled, not the inertias


def _free_fall(plant):
    """Joint accelerations of the links alone at rest, -M(q)^-1 g(q)."""
    import pinocchio

    model = pinocchio.buildModelFromXML(ManipulatorPlant.robot(plant.p))
    data, q = model.createData(), np.array(plant.p.position)
    return pinocchio.aba(model, data, q, np.zeros(3), np.zeros(3)).tolist()


@pytest.mark.long
def test_rehab_robot_of_twice_the_stiffness_is_displaced_half_as_far():
    """Active exercise under a constant force of the patient: K_d e = J' F at rest."""
    ways = []
    for stiffness in (100.0, 200.0):
        run = simulate(
            "rehab_impedance_r5",
            duration=9.0,
            overrides={"impedance.stiffness": [stiffness], "impedance.inertia": [0.1], "impedance.damping": [10.0]},
        )
        t, regenerated = run.signals["regenerated/hip/position"]
        wanted = np.interp(t, *run.signals["reference/hip/position"])
        ways.append(np.abs(regenerated - wanted).max())
    assert ways[0] > 0.01
    assert ways[1] == pytest.approx(0.5 * ways[0], rel=0.1)


@pytest.mark.long
def test_tcp_with_twice_the_flows_has_half_the_window():
    windows = []
    for flows in (40, 80):
        run = simulate("tcp_aqm_smc", duration=40.0, overrides={"tcp_fluid.N": flows, "aqm_controller.N": flows})
        assert run.signals["network/truth/queue/position"].x[-1] == pytest.approx(120.0, abs=0.5)
        windows.append(run.signals["network/state/window/position"].x[-1])
        round_trip = 0.2 + 120.0 / 3750.0
        assert windows[-1] == pytest.approx(round_trip * 3750.0 / flows, rel=0.01)  # W = R C/N in the steady state
        p = run.signals["aqm/command/drop_probability/effort"].x[-1]
        assert p == pytest.approx(2.0 / windows[-1] ** 2, rel=0.02)  # W^2 p = 2 in the steady state
    assert windows[1] == pytest.approx(0.5 * windows[0], rel=0.01)


def test_tank_of_twice_the_area_rises_half_as_fast():
    """From an empty tank, before anything drains; the pipe has no delay."""
    levels = []
    for area in (10.0, 20.0):
        plant = TankPlant(A=area, c=1e-6, delay=0.0, x0=0.0, k_low=0.0, k_high=0.0)
        levels.append(moved(plant, 100, inflow=(500.0,))["level"][0])
    assert levels[0] == pytest.approx(500.0 / (10.0 * 1000.0) * 1.0, rel=1e-3)
    assert levels[1] == pytest.approx(0.5 * levels[0], rel=1e-3)


def test_spacecraft_with_twice_the_time_needs_half_the_cost_with_twice_the_inertia_four_times():
    base = solve(find("spacecraft"), 12).J[-1]
    assert solve(find("spacecraft").changed(horizon=200.0), 20).J[-1] == pytest.approx(0.5 * base, rel=1e-6)
    heavy = spacecraft(tuple(2.0 * i for i in INERTIA))
    assert solve(heavy, 12).J[-1] == pytest.approx(4.0 * base, rel=1e-6)


def test_gupfc_circuits_carry_what_is_asked():
    run = simulate(
        "gupfc",
        duration=0.5,
        overrides={"references_1.values": [1.15, -0.2] * 3, "references_2.values": [0.9, -0.35] * 3},
    )
    measured = [run.signals[f"gupfc/status/{name}/position"] for name in ("p1", "q1", "p2", "q2")]
    assert [s.x[s.t > 0.4].mean() for s in measured] == pytest.approx([1.15, -0.2, 0.9, -0.35], abs=0.01)


def test_pv_string_in_half_the_light_gives_half_the_current():
    currents = []
    for light in (800.0, 400.0):
        plant = PvPlant(irradiance=(light,) * 4)
        # Far left of the maximum the string is a current source.
        outputs = moved(plant, 400, duty=(0.85,), environment=None)
        currents.append(outputs[next(iter(outputs))])
        assert plant.p.irradiance == (light,) * 4
    index = int(np.argmin([abs(b / a - 0.5) for a, b in zip(*currents, strict=True)]))
    assert currents[1][index] == pytest.approx(0.5 * currents[0][index], rel=0.02)


def test_rectifier_of_twice_the_capacitance_sags_half_as_fast():
    sags = []
    for C in (990e-6, 1980e-6):
        plant = RectifierPlant(C=C)
        drop = plant.p.drop
        quiet = moved(plant, 5, command=(drop,), events=None)["dc_link"][0]
        assert quiet == pytest.approx(400.0, abs=1e-3)
        sags.append(400.0 - moved(plant, 1, command=(drop,), events=(8.0, 180.0, 0.0))["dc_link"][0])
    # At constant power, v^2 decays to half its value with the time constant R_L C/2.
    for sag, C in zip(sags, (990e-6, 1980e-6), strict=True):
        v = 400.0 * math.sqrt(0.5 + 0.5 * math.exp(-2.0 * 0.83e-3 / (8.0 * C)))
        assert sag == pytest.approx(400.0 - v, rel=2e-3)


def test_fault_on_a_line_of_other_constants_is_found_with_these_alone():
    """Four times the capacitance: half the speed of the waves, half the surge impedance."""
    line = {"line.c1": 4 * 0.013e-6, "line.length": 60.0}
    record = study.simulate(build(RigParams, line | {"fault.type": "AG", "fault.x_km": 21.0}))
    assert locate(record, build(LocatorParams, line)).x_km == pytest.approx(21.0, abs=0.03)
    other = locate(record, build(LocatorParams, {"line.length": 60.0}))
    assert other.x_km is None or abs(other.x_km - 21.0) > 0.1


def test_dispatch_of_fuel_twice_as_dear_costs_twice_as_much_at_the_same_outputs():
    units = Units.read("units_3")
    dear = Units(units.ids, units.table * np.array([1.0, 1.0, 2.0, 2.0, 2.0, 2.0, 1.0]))
    now, then = Optimiser(units).certified(850.0), Optimiser(dear).certified(850.0)
    assert then.cost == pytest.approx(2.0 * now.cost, rel=1e-9)
    assert np.sort(then.P) == pytest.approx(np.sort(now.P), abs=1e-4)
    assert math.isfinite(then.bound)
    assert then.gap <= 1e-3
