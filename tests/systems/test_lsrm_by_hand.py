"""The linear motor's controllers, profiles and figures over random inputs, against independent code.

Sources: the equations on the page lsrm_fuzzy, in loops; quadrature of the slope for the inductance, integrals of the
acceleration for the profiles. Figures stand here on even grids; on others in test_figures_over_time.py.
"""

import itertools
import math
from random import Random

import numpy as np
import pytest
from helpers import near
from scipy.integrate import quad
from softrig_core import ByHand, to_ns
from softrig_drives.lsrm import figures
from softrig_drives.lsrm.current_controller import CurrentController, CurrentControllerParams
from softrig_drives.lsrm.fuzzy import LsrmFuzzy
from softrig_drives.lsrm.load import LsrmLoad
from softrig_drives.lsrm.machine import Geometry, profile
from softrig_drives.lsrm.mrac import LsrmMrac
from softrig_drives.lsrm.pi import LsrmPi
from softrig_drives.lsrm.plant import LsrmPlant
from softrig_drives.lsrm.profile import Profile, Quintic
from softrig_drives.lsrm.profile_generator import ProfileGenerator, largest_force

MS = 1_000_000


GIVEN = Geometry()


def slope_of(xi, g=GIVEN):
    """Slope of the inductance over the way to the aligned position: a plateau with rounded edges, falling beyond it."""
    z = abs(abs(xi) - g.c) - g.h + g.w
    share = 1.0 if z <= 0.0 else 0.5 * (1.0 + math.cos(math.pi * z / (2.0 * g.w))) if z < 2.0 * g.w else 0.0
    return math.copysign(g.G * share, -xi)


def nearest(x, phase, g=GIVEN):
    """Distance to the nearest aligned position of a phase, found among many."""
    return min((x - phase * g.shift - n * g.tau for n in range(-30, 30)), key=abs)


def test_inductance_is_the_integral_of_its_slope_from_the_unaligned_position_on():
    g = Geometry(tau=0.06, G=0.5, L_u=4e-3, c=0.012, h=0.008, w=0.002)
    edges = [side * (g.c + far * g.h + near_ * g.w) for side in (-1, 1) for far in (-1, 1) for near_ in (-1, 1)]
    for x in np.linspace(-0.03, 0.03, 25).tolist():
        L = 4e-3 + quad(slope_of, -0.03, x, args=(g,), points=[e for e in (*edges, 0.0) if e < x], epsabs=1e-13)[0]
        assert profile(x, g.numbers()) == (pytest.approx(L, abs=1e-11), near(slope_of(x, g)))


@pytest.mark.parametrize("options", [{}, {"feed_forward": True, "K_pc": 0.2}, {"threshold": 0.4, "resolution": 1e-3}])
def test_the_current_loops_equal_their_formulas(options):
    law = ByHand(CurrentController(U_dc=100.0, I_max=8.0, K_ic=3.0, **options))
    p, draw = law.block.p, Random(9)
    z = [0.0] * 4
    for k in range(150):
        x, v, force = draw.uniform(-0.2, 0.2), draw.uniform(-1.0, 1.0), draw.choice((0.0, draw.uniform(-40.0, 40.0)))
        currents = [draw.choice((0.0, 0.019, 0.021, draw.uniform(0.0, 9.0))) for _ in range(4)]
        outputs = law.update(k, joint_states=(x, v), phase_currents=tuple(currents), force_cmd=(force,))
        seen = p.resolution * math.floor(x / p.resolution + 0.5)
        target = min(math.sqrt(2.0 * abs(force) / p.G), 8.0)
        for phase, i in enumerate(currents):
            g = slope_of(nearest(seen, phase))
            if g * math.copysign(1.0, force) > p.threshold * p.G and force != 0.0:
                wanted = p.K_pc * (target - i) + 3.0 * z[phase]
                wanted += (p.R + g * v) * target / 100.0 if p.feed_forward else 0.0
                duty = min(max(wanted, -1.0), 1.0)
                if wanted == duty or (target - i) * wanted <= 0.0:
                    z[phase] += (target - i) * p.period
                u = 100.0 * duty
            else:
                z[phase], u = 0.0, -100.0 if i > 0.02 else 0.0
            assert (law.x.integral[phase], outputs["phase_voltage"][phase]) == (near(z[phase]), near(u))


def test_the_output_of_the_current_integrals_is_kept_under_another_gain():
    def after(now, before):
        law = CurrentController(K_ic=now)
        return law.go_on(law.first()._replace(integral=(1.0, 2.0, 0.0, -1.0)), CurrentControllerParams(K_ic=before))

    assert after(4.0, 2.0).integral == (0.5, 1.0, 0.0, -0.5)
    assert after(2.0, 2.0).integral == (1.0, 2.0, 0.0, -1.0)
    assert after(0.0, 2.0).integral == (0.0,) * 4


def test_the_speed_controllers_equal_their_formulas():
    """PI with conditional anti-windup, the adaptive one within its bounds, the fuzzy one while no rule is clipped."""
    pi = ByHand(LsrmPi(K_F=10.0, K_p=2.0, K_i=5.0, F_max=9.0, period=0.01))
    mrac = ByHand(
        LsrmMrac(
            M=4.0,
            C=6.0,
            k_p=2.0,
            q=900.0,
            r=0.25,
            period=0.01,
            F_max=30.0,
            gains=(20.0, 30.0, 300.0),
            theta_0=(3.0, 1.0, 0.0),
            theta_min=(2.5, 0.0, -4.0),
            theta_max=(3.5, 2.0, 4.0),
        )
    )
    fuzzy = ByHand(LsrmFuzzy(K_e=4.0, K_de=6.0, K_u=8.0, F_max=5.0))
    draw = Random(6)
    integral, theta, force, last = 0.0, [3.0, 1.0, 0.0], 0.0, 0.0
    k_ = math.sqrt((8.0 / 4.0) ** 2 + (1.0 / 4.0) ** 2 * 900.0 / 0.25)
    reached = set()
    for k in range(200):
        v, wanted, a = draw.uniform(-0.4, 0.4), draw.uniform(-0.4, 0.4), draw.uniform(-2.0, 2.0)
        inputs = {"joint_states": (v,), "reference": (9.9, wanted, a)}
        u = 20.0 * (wanted - v) + integral
        if abs(u) <= 9.0 or u * (wanted - v) <= 0.0:
            integral += 50.0 * 0.01 * (wanted - v)
        assert pi.update(k, **inputs) == {"force_cmd": near((min(max(u, -9.0), 9.0),))}
        off = v - wanted
        phi = (a - k_ * off, v, 1.0)
        ends = zip((20.0, 30.0, 300.0), phi, (2.5, 0.0, -4.0), (3.5, 2.0, 4.0), strict=True)
        theta = [min(max(th - g * p * off * 0.01, lo), hi) for th, (g, p, lo, hi) in zip(theta, ends, strict=True)]
        reached |= {n for n, th in enumerate((*theta, *theta)) if th in (2.5, 0.0, -4.0, 3.5, 2.0, 4.0)}
        F = sum(th * p for th, p in zip(theta, phi, strict=True))
        assert mrac.update(k, **inputs) == {"force_cmd": near((min(max(F, -30.0), 30.0),)), "theta": near(tuple(theta))}
        e = wanted - v
        force = min(max(force + 8.0 * (e / 4.0 + (e - last) / 6.0), -5.0), 5.0)
        last = e
        assert fuzzy.update(k, **inputs) == {"force_cmd": near((force,))}
    assert {0, 1, 2} <= reached


def test_a_load_is_its_mass_and_the_friction_of_its_weight():
    load = ByHand(LsrmLoad(times=(0.0, 0.5, 0.7), masses=(1.0, 3.0, 0.0), mu=0.2))
    load.x = None
    for at, mass in ((0.0, 1.0), (0.499, 1.0), (0.5, 3.0), (0.699, 3.0), (0.7, 0.0), (9.0, 0.0)):
        assert load.update(to_ns(at)) == {"load": near((mass, 0.2 * mass * 9.81))}


# profiles --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["jerk", "trapezoid", "step"])
@pytest.mark.parametrize("v_d", [0.5, -0.3])
def test_a_profile_accelerates_cruises_and_brakes_as_specified(kind, v_d):
    """Acceleration from its shape, speed and distance by its integral; braking takes v_d t_db/2."""
    p = Profile(kind, v_d, 0.4, None, 1.0, 0.2)
    dt = 1e-4
    way = speed = 0.0

    def pull(t):
        for begin, length, sign in ((0.0, 0.4, 1.0), (1.0, 0.2, -1.0)):
            if begin < t < begin + length:
                s = (t - begin) / length
                return sign * v_d / length * (6.0 * s * (1.0 - s) if kind == "jerk" else 1.0)
        return 0.0

    for k in range(14_000):
        t = k * dt
        if kind == "step":
            speed = v_d if t <= 1.0 + 1e-12 else 0.0
        if k % 250 == 125:  # between two steps of the profile
            result = p.at(t)
            assert result[0] == pytest.approx(way, abs=1e-4)
            assert result[1] == pytest.approx(speed, abs=1e-4)
            assert result[2] == (0.0 if kind == "step" else near(pull(t)))
        if kind != "step":
            after = speed + dt * pull(t + dt / 2)
            way += dt * (speed + after) / 2
            speed = after
        else:
            way += dt * speed


def test_a_profile_is_exact_at_its_edges():
    """At t_d it cruises; at t_b it does not brake yet; at the end of the braking it is at rest."""
    p = Profile("trapezoid", 1.0, 0.5, None, 2.0, 0.25)
    assert [p.at(t)[1:] for t in (0.0, 0.5, 2.0, 2.25, 3.0)] == [
        (0.0, 2.0),
        (1.0, 0.0),
        (1.0, 0.0),
        (0.0, 0.0),
        (0.0, 0.0),
    ]
    assert [p.at(t)[0] for t in (0.5, 2.0, 2.25, 9.0)] == [0.25, 1.75, 1.875, 1.875]
    step = Profile("step", 1.0, 0.5, None, 2.0, 0.25)
    assert [step.at(t) for t in (0.0, 2.0, 2.1)] == [(0.0, 1.0, 0.0), (2.0, 1.0, 0.0), (2.0, 0.0, 0.0)]


def test_the_range_of_a_speed_is_that_of_its_samples():
    draw = Random(3)
    for _ in range(12):
        T = draw.uniform(0.3, 2.0)
        q = Quintic.between(*(draw.uniform(-1.0, 1.0) for _ in range(3)), T, draw.uniform(-2.0, 2.0))
        speeds = [q.at(T * n / 500)[1] for n in range(501)]
        assert q.speed_range(T) == pytest.approx((min(speeds), max(speeds)), abs=1e-3)


@pytest.mark.parametrize(
    ("values", "reported"),
    [
        ({"v_d": 0.5, "t_d": 0.4, "F_max": 17.2}, "reference infeasible: it needs 17.3 N, the motor gives 17.2 N"),
        ({"v_d": 0.5, "t_d": 0.4, "F_max": 17.29}, ""),
        ({"v_d": -0.5, "t_d": 0.4, "F_max": 17.2}, "reference infeasible: it needs 17.3 N, the motor gives 17.2 N"),
        ({"t_d": 9.0, "t_b": 10.0, "t_db": 0.05, "F_max": 30.0}, "reference infeasible: it needs 69.3 N"),
        ({"profile": "step", "F_max": 12.0}, ""),  # 24 N s/m at 0.5 m/s need 12 N
        ({"profile": "step", "F_max": 11.9}, "reference infeasible: it needs 12 N"),
        ({"x_d": 0.1}, ""),
        ({"x_d": 0.2}, "x_d = 0.2 m: the speed runs from 0 to 0.756 m/s, outside 0 to 0.5 m/s"),
        ({"x_d": 0.05}, "x_d = 0.05 m: the speed runs from -0.05738 to 0.5 m/s, outside 0 to 0.5 m/s"),
        ({"x_d": -0.2, "v_d": -0.5}, "x_d = -0.2 m: the speed runs from -0.756 to 0 m/s, outside 0 to -0.5 m/s"),
        ({"x_d": 0.2, "profile": "trapezoid"}, ""),
    ],
)
def test_an_impossible_profile_is_reported(values, reported):
    source = ByHand(ProfileGenerator(**{"F_max": 1e4, **values}))
    messages = [text for _, text, *_ in source.reports.values()]
    assert bool(messages) is bool(reported)
    assert reported in "".join(messages)
    source.reports.clear()
    source.block.go_on((), source.block.p)
    source.store_reports()
    assert bool(source.reports) is bool(reported)


def test_the_largest_force_is_that_of_both_ramps():
    up, down = Profile("trapezoid", 1.0, 0.5, None), Profile("trapezoid", 1.0, 0.5, None, 2.0, 0.1)
    assert largest_force(up, 3.0, 2.0) == near(3.0 * 2.0 + 2.0 * 1.0 * 399 / 400)
    assert largest_force(down, 3.0, 2.0) == near(30.0 - 2.0 * 1.0 / 400)


# the plant -------------------------------------------------------------------------------------------------------


def test_the_plant_is_exact_at_its_limits():
    """The full supply is allowed; a load of zero is allowed; a current at the trip level is not a fault."""
    plant = ByHand(LsrmPlant(U_dc=150.0))
    plant.advance(0, phase_voltage=(150.0, -150.0, 0.0, 0.0), load=(0.0, 0.0))
    assert plant.reports == {}
    for load in ((-1e-9, 0.0), (0.0, -1e-9), (-1.0, 3.0), (3.0, -1.0)):
        plant.reports.clear()
        plant.advance(0, phase_voltage=(0.0,) * 4, load=load)
        assert (list(plant.reports), plant.x.load.values) == (["bad_load"], (0.0, 0.0))
    for volts in ((151.0, 0.0, 0.0, 0.0), (0.0, 0.0, -151.0, 0.0)):
        plant.reports.clear()
        plant.advance(0, phase_voltage=volts, load=(2.0, 1.0))
        assert (list(plant.reports), plant.x.load.values) == (["clipped"], (2.0, 1.0))


@pytest.mark.parametrize("phase", range(4))
def test_each_phase_trips_the_half_bridges(phase):
    """At the unaligned position of a phase, where its inductance is the least: 12 A are 0.072 Wb."""
    names = ("psi_a", "psi_b", "psi_c", "psi_d")
    for current, trips in ((11.999, False), (12.001, True)):
        plant = ByHand(LsrmPlant(R=1e-9, locked=True, x_0=0.026 + 0.013 * phase))
        plant.x = plant.x._replace(**{names[phase]: 0.006 * current})
        plant.advance(0, phase_voltage=(0.0,) * 4, load=None)
        assert plant.x.fault is trips
        assert plant.outputs(0)["phase_currents"][phase] == pytest.approx(current, rel=1e-6)
        plant.advance(0, phase_voltage=(0.0,) * 4, load=None)  # after a fault the supply drives the flux to zero
        used = 0.006 * current - getattr(plant.x, names[phase])
        assert used == pytest.approx(150.0 * 5e-5 if trips else 0.0, abs=1e-9)


def test_markers_are_teeth_at_each_pitch_and_four_poles_on_a_body():
    """Widths of 21 and 13 mm, a gap of 2 mm at 20 mm from the middle; each tooth three lines around a rectangle."""
    plant = ByHand(LsrmPlant(x_0=0.1))
    stator, translator = plant.markers()
    assert (stator.frame_id, stator.name, stator.kind, stator.size) == ("stator", "stator", "line_list", 0.001)
    assert (translator.frame_id, translator.name, translator.size) == ("stator", "translator", 0.001)
    assert (stator.color, translator.color) == ((0.5, 0.5, 0.5, 1.0), (0.8, 0.3, 0.1, 1.0))

    def lines(marker):
        pairs = zip(marker.points[::2], marker.points[1::2], strict=True)
        return sorted(sorted(tuple(round(v, 9) + 0.0 for v in p) for p in pair) for pair in pairs)

    def around(x, width, foot, tip):
        corners = [(x - width / 2, foot), (x - width / 2, tip), (x + width / 2, tip), (x + width / 2, foot)]
        return [[(*a, 0.0), (*b, 0.0)] for a, b in itertools.pairwise(corners)]

    teeth = [w for n in range(-4, 20) for s in (1, -1) for w in around(0.052 * n, 0.021, s * 0.048, s * 0.022)]
    poles = [w for n in range(4) for s in (1, -1) for w in around(0.1 + 0.039 * n, 0.013, s * 0.01, s * 0.02)]
    left, right = 0.1 - 0.0195, 0.1 + 3 * 0.039 + 0.0195
    body = [(left, 0.01, 0.0), (right, 0.01, 0.0), (right, -0.01, 0.0), (left, -0.01, 0.0)]
    poles += [[a, b] for a, b in zip(body, [*body[1:], body[0]], strict=True)]
    for marker, expected in ((stator, teeth), (translator, poles)):
        assert lines(marker) == sorted(sorted(tuple(round(v, 9) + 0.0 for v in p) for p in w) for w in expected)


# figures ---------------------------------------------------------------------------------------------------------


def drive(t, v, x, F, reference=None, name=""):
    signals = {figures.SPEED: (t, v), figures.POSITION: (t, x), figures.FORCE: (t, F)}
    if reference is not None:
        signals[figures.REFERENCE] = reference
    return {f"{name}/{k}" if name else k: s for k, s in signals.items()}


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("name", ["", "jerk"])
def test_figures_of_a_motion_are_loops_over_its_samples(sign, name):
    """Forwards, and backwards as its mirror image."""
    rng = np.random.default_rng(2)
    t = np.arange(200) * 0.001
    v = sign * (np.minimum(6.0 * t, 0.5) + 0.02 * np.sin(80.0 * t) + 0.002 * rng.normal(size=200))
    x, F = np.cumsum(v) * 0.001, sign * (10.0 + 3.0 * np.sin(300.0 * t) + rng.normal(size=200))
    when = np.arange(40) * 0.005 + 0.0002  # the reference is published less often, and between two samples
    wanted = sign * np.minimum(6.0 * when, 0.5)
    signals, v_d = drive(t, v, x, F, (when, wanted), name), sign * 0.5
    fast = [sign * b for a, b in zip(t, v, strict=True) if a >= 0.09]
    assert figures.overshoot(signals, v_d=v_d, start=0.09, drive=name) == near(100.0 * (max(fast) - 0.5) / 0.5)
    assert figures.dip(signals, v_d=v_d, start=0.09, drive=name) == near(100.0 * (0.5 - min(fast)) / 0.5)
    errors = [abs(w - v[int((at + 1e-9) / 0.001)]) for at, w in zip(when, wanted, strict=True)]
    # Each reference holds until the next one, and the last to the end of the record.
    holds = [0.005] * 39 + [0.199 - when[-1]]
    first = when[0]
    assert figures.iae(signals, drive=name) == near(sum(h * e for h, e in zip(holds, errors, strict=True)))
    assert figures.itae(signals, drive=name) == near(
        sum(h * (a - first) * e for h, a, e in zip(holds, when, errors, strict=True))
    )
    means = [sum(F[k : k + 5]) / 5 for k in range(196)]
    assert figures.peak_force(signals, drive=name) == near(sign * max(sign * m for m in means))
    assert figures.peak_force(signals, sign=-sign, drive=name) == near(-sign * max(-sign * m for m in means))
    wide = [sum(F[k : k + 20]) / 20 for k in range(20, 81)]
    assert figures.peak_force(signals, width=0.02, start=0.02, end=0.099, drive=name) == near(
        sign * max(sign * m for m in wide)
    )
    last = [f for f, at in zip(F, x, strict=True) if abs(at - x[-1]) < 0.04]
    mean = sum(last) / len(last)
    spread = math.sqrt(sum((f - mean) ** 2 for f in last) / len(last))
    assert figures.mean_force(signals, pitch=0.02, drive=name) == near(mean)
    assert figures.force_ripple(signals, pitch=0.02, drive=name) == near(spread)
    assert figures.mean_force(signals, pitch=0.04, pitches=1, drive=name) == near(mean)
    with pytest.raises(ValueError, match=r"^the translator moved 0.0\d+ m, needed 0.12 m$"):
        figures.force_ripple(signals, pitch=0.06, drive=name)
    at = next(k for k in range(200) if sign * v[k] >= 0.99 * 0.5)
    between = (0.495 - sign * v[at - 1]) / (sign * (v[at] - v[at - 1]))
    assert figures.arrival(signals, v_d=v_d, drive=name) == near(t[at - 1] + 0.001 * between)
    assert figures.arrival(signals, v_d=v_d, part=1.2, drive=name) == math.inf
    assert figures.arrival(signals, v_d=v_d, part=-0.5, drive=name) == 0.0
    way = drive(np.arange(3) * 1.0, v[:3], np.array([0.0, 0.5, 1.0]), np.array([4.0, 6.0, 8.0]))
    # The way is exactly one pitch; the first sample lies one pitch back.
    assert figures.mean_force(way, pitch=0.5) == 7.0


def test_the_peak_force_of_a_motion_both_ways_is_the_larger_one():
    t, F = np.arange(6) * 1.0, np.array([0.0, 5.0, 2.0, 0.0, -7.0, -1.0])
    for x, peak in (
        ([0, 1, 2, 3, 2.7, 2.6], 5.0),  # a short way back is not a change of direction
        ([0, 1, 2, 2, 1, 0], -7.0),  # forth and back
        ([0, -1, -2, -2, -3, -4], -7.0),
        ([0, 0, 0, 0, 0, 0], 5.0),
        ([0, 5, 10, 10, 9, 8], 5.0),  # the way back of a fifth is exactly the limit
    ):
        signals = drive(t, F, np.array(x, float), F)
        assert figures.peak_force(signals, width=1.0) == peak
