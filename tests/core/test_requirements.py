"""Requirements: formulas against a brute-force evaluator, bad input, what cannot be judged, where they are violated."""

import math

import numpy as np
import pytest
from conftest import make_scenario
from hypothesis import given, settings, strategies as st
from softrig_core import SECOND, RunError, ScenarioError, evaluate, figures_of, rig_of, simulate
from softrig_core.judge.expectation import Expectation
from softrig_core.judge.formula import Record, horizon, margin_unit, read, variables

PERIOD = 0.1
KNOWN = {"x": None, "y": None, "level": 0.5}


def write(tree):
    """A formula as text."""
    kind, *parts = tree
    if kind == "atom":
        return parts[0]
    if kind == "not":
        return f"not ({write(parts[0])})"
    if kind in ("and", "or", "->"):
        return f"(({write(parts[0])}) {kind} ({write(parts[1])}))"
    low, high = parts[0]
    window = (
        "" if high is None and low == 0 else f"[{low * PERIOD:g}, {'inf' if high is None else f'{high * PERIOD:g}'}]"
    )
    if kind == "until":
        return f"(({write(parts[1])}) until{window} ({write(parts[2])}))"
    return f"{kind}{window} ({write(parts[1])})"


ATOMS = {
    "x > level": lambda s: s["x"] - 0.5,
    "y <= 0.25 * x": lambda s: 0.25 * s["x"] - s["y"],
    "abs(x - y) < 1": lambda s: 1.0 - abs(s["x"] - s["y"]),
}


def reach(tree):
    """How far a formula looks ahead, in ticks; without end counts as far as its lower limit."""
    kind, *parts = tree
    if kind == "atom":
        return 0
    if kind in ("not", "and", "or", "->"):
        return max(map(reach, parts))
    low, high = parts[0]
    return max(map(reach, parts[1:])) + (low if high is None else high)


def brute(tree, samples, k):
    """Robustness at sample `k`, by the definition."""
    kind, *parts = tree
    n = len(samples)
    if kind == "atom":
        return ATOMS[parts[0]](samples[k])
    if kind == "not":
        return -brute(parts[0], samples, k)
    if kind in ("and", "or", "->"):
        a, b = (brute(p, samples, k) for p in parts)
        return {"and": min(a, b), "or": max(a, b), "->": max(-a, b)}[kind]
    low, high = parts[0]
    if kind == "until":
        found = -math.inf
        for i in range(k + low, min(n, k + high + 1)):
            held = min((brute(parts[1], samples, j) for j in range(k, i)), default=math.inf)
            found = max(found, min(brute(parts[2], samples, i), held))
        return found
    last = n - 1 - reach(parts[1]) if high is None else min(n - 1, k + high)
    values = [brute(parts[1], samples, i) for i in range(k + low, last + 1)]
    return min(values, default=math.inf) if kind == "always" else max(values, default=-math.inf)


window = st.tuples(st.integers(0, 3), st.integers(0, 4)).map(lambda w: (w[0], w[0] + w[1]))
formulas = st.recursive(
    st.sampled_from([("atom", a) for a in ATOMS]),
    lambda inner: st.one_of(
        st.tuples(st.just("not"), inner),
        st.tuples(st.sampled_from(["and", "or", "->"]), inner, inner),
        st.tuples(st.sampled_from(["always", "eventually"]), st.one_of(window, st.just((0, None))), inner),
        st.tuples(st.just("until"), window, inner, inner),
    ),
    max_leaves=5,
)


def clamp(x):
    return math.copysign(1e299, x) if abs(x) > 1e299 else x


@settings(max_examples=150)
@given(
    tree=formulas.map(lambda t: ("always", (0, 2), t)), extra=st.integers(0, 6),
    values=st.lists(st.tuples(st.floats(-3, 3), st.floats(-3, 3)), min_size=40, max_size=40), slow=st.integers(1, 4),
)  # fmt: skip
def test_margins_are_those_of_the_definition(tree, extra, values, slow):
    ticks = reach(tree) + extra + 1
    values = (values * (ticks // len(values) + 1))[:ticks]
    samples = [
        {"x": x, "y": values[k - k % slow][1]} for k, (x, _) in enumerate(values)
    ]  # y comes at every slow-th tick
    parsed, _ = read(write(tree), KNOWN)
    assert horizon(parsed) == pytest.approx(reach(tree) * PERIOD * SECOND)
    times = np.array([round(k * PERIOD * SECOND) for k in range(ticks)], dtype=np.float64)
    names = variables(parsed)
    record = Record(times, {n: np.array([s[n] for s in samples]) for n in names})
    expected = brute(tree, samples, 0)
    margin = record.margin(parsed)
    assert clamp(margin.value) == pytest.approx(clamp(expected), abs=1e-12)
    assert (margin.value < 0) == bool(margin.violated)


def requirement(formula, *, shared=None, duration=1.0, **about):
    """The rig of the test blocks with one requirement."""
    names = {"state": "state/lag/position", "command": "command/drive/effort", "level": 0.5} | (shared or {})
    nodes = {"plant": "plant", "source": "source", "gain": "gain"}
    given = {"formula": formula, **about}
    return rig_of(make_scenario(nodes, duration, shared=names, requirements={"it": given}))


def figure_of(rig, signals):
    return next(r for r in evaluate(rig, signals) if r.name == "it")


LIVE = {"state": "lag/state/x/position", "command": "lag/command/u/effort", "speed": "lag/state/x/velocity",
        "gain": "$gain.k"}  # fmt: skip


def wired(formula, **about):
    return requirement(formula, shared={**LIVE, **about.pop("shared", {})}, **about)


def test_a_margin_is_in_the_signals_unit_and_names_where_it_is_violated():
    rig = wired("always[0.2, 0.8] state <= 0.3")
    run = simulate(rig)
    result = figure_of(rig, run.signals)
    t, x = run.signals["lag/state/x/position"]
    inside = (t >= 0.2 - 1e-9) & (t <= 0.8 + 1e-9)
    worst = np.argmax(x[inside])
    assert (result.value, result.unit, result.passed) == (pytest.approx(0.3 - x[inside][worst], abs=1e-15), "m", False)
    margin = next(f.function for f in figures_of(rig) if f.name == "it").margin(run.signals)
    assert margin.at == pytest.approx(t[inside][worst])
    bad = t[inside][x[inside] > 0.3]
    assert margin.violated == ((pytest.approx(bad[0]), pytest.approx(bad[-1])),)


@pytest.mark.parametrize("live", [False, True])
def test_a_shared_signal_may_be_named_without_its_only_field(live):
    short = wired("always abs(command) <= 1.0", shared={"command": "lag/command/u"}, live=live)
    whole = wired("always abs(command) <= 1.0", live=live)
    assert [figure_of(r, simulate(r).signals).value for r in (short, whole)] == [figure_of(
        whole, simulate(whole).signals).value] * 2  # fmt: skip


def test_a_requirement_is_a_figure_of_a_run_and_passes_where_it_holds():
    run = simulate(wired("always abs(command) <= 10 * gain"))
    _, u = run.signals["lag/command/u/effort"]
    assert run.figures["it"] == pytest.approx(20 - np.abs(u).max(), abs=1e-12)
    assert not run.missed


def test_units_of_both_sides_must_fit_and_several_need_a_scale():
    with pytest.raises(ScenarioError, match="requirement it: 'm' beside 'N'"):
        figures_of(wired("always state <= command"))
    both = "always (state <= 1 and command <= 20)"
    with pytest.raises(ScenarioError, match=r"in N, m.*what counts as one"):
        figures_of(wired(both))
    rig = wired(both, scale={"m": 0.5, "N": 100.0})
    run = simulate(rig)
    x, u = run.signals["lag/state/x/position"].x, run.signals["lag/command/u/effort"].x
    result = figure_of(rig, run.signals)
    assert result.value == pytest.approx(min((1 - x.max()) / 0.5, (20 - u.max()) / 100.0), rel=1e-12)
    assert result.unit == ""
    with pytest.raises(ScenarioError, match="no number for 'N'"):
        figures_of(wired(both, scale={"m": 0.5}))


@pytest.mark.parametrize(
    ("formula", "reason"),
    [
        ("always sate > 0", r"'sate' is no name \(did you mean 'state'\?\)"),
        ("alway[0, 1] state > 0", r"'alway' is no name \(did you mean 'always'\?\)"),
        ("always (state > 0", "unclosed|expected"),
        ("always[0.5, 0.1] state > 0", "lower bound 0.5 is greater than upper bound 0.1"),
        ("state > 0", "t = 0 only: write 'always"),
        ("always -state^2 < 0", "minus before a power"),
        ("always[0.0001, 0.0002] state > 0", "no tick of plant"),
        ("always rising(state + 1) -> state > 0", "rising.*takes the name of a signal"),
        ("always state + 1", "expected a comparison"),
        ("", "at least 1 character"),
    ],
)
def test_a_formula_that_means_nothing_is_refused_before_the_run(formula, reason):
    with pytest.raises((ScenarioError, ValueError), match=reason):
        figures_of(wired(formula))


def test_what_the_record_cannot_tell_is_not_judged_and_does_not_pass():
    rig = wired("always[0, 2] state <= 100", duration=1.0)
    result = figure_of(rig, simulate(rig).signals)
    assert (result.value, result.passed) == (None, False)
    assert result.error == "not judged: the record ends at 1 s, the requirement's last window at 2 s"


def test_a_file_whose_requirement_looks_beyond_its_end_is_refused(tmp_path):
    from softrig_core import load_scenario

    file = tmp_path / "mine.yaml"
    file.write_text("extends: dc_motor_smc_b2\ntitle: mine\nrequirements: {late: 'always[5, 7] abs(voltage) <= 24'}\n")
    with pytest.raises(ScenarioError, match=r"requirement late: its last window ends 7 s after the start"):
        load_scenario(str(file))
    file.write_text(file.read_text().replace("[5, 7]", "[1, 2]").replace("late:", "overshoot:"))
    with pytest.raises(ScenarioError, match="overshoot is the name of a figure, too"):
        load_scenario(str(file))


def test_edges_and_bare_names_decide_without_being_a_distance():
    grid = np.arange(6) * 1e8
    known = {"fault": None, "x": None}
    tree, conditions = read("always (rising(fault) -> eventually[0, 0.2] x < 1)", known)
    assert [c.signal for c in conditions.values()] == ["fault"]
    (edge,) = conditions
    rises = np.array([-1, -1, 1, -1, -1, -1]) * 1e300
    x = np.array([9.0, 9.0, 9.0, 4.0, 3.0, 0.0])
    margin = Record(grid, {edge: rises, "x": x}).margin(tree)
    assert (margin.value, margin.at, margin.violated) == (-2.0, 0.4, ((0.2, 0.2),))
    tree, _ = read("always not fault", known)
    (name,) = variables(tree)
    assert Record(grid, {name: rises}).margin(tree).value == -math.inf
    assert Record(grid, {name: -np.abs(rises)}).margin(tree).value == math.inf


def test_the_unit_of_a_margin():
    units = {"v": "V", "i": "A", "w": "rad/s"}

    def unit(formula):
        return margin_unit(read(formula, dict.fromkeys(units))[0], units, {})[1]

    assert unit("always abs(v) <= 12") == "V"
    assert unit("always v * i <= 10") == unit("always max(v * i, 3) - 1 > i * v") == "V A"
    assert unit("always w^2 > 3") == "rad^2/s^2"
    assert unit("always v / v > 3") == ""
    for wrong in ("always v + i > 0", "always min(v, w) > 0", "always w^2 > w", "always sqrt(v) > 1"):
        with pytest.raises(ScenarioError):
            unit(wrong)


def test_what_has_not_come_yet_compares_as_false(tmp_path):
    nodes = {"plant": "plant", "burst": {"executable": "burst", "parameters": {"at": [0.05]}}, "gain": "burst_gain"}
    rig = rig_of(make_scenario(nodes, 0.2))
    topic = next(p.topic for m in rig.members for p in m.outputs if p.sporadic)
    label = rig.topics[topic].labels[0]
    formulas = {"comes": "eventually burst > -1e9", "from_the_start": "always burst > -1e9"}
    scenario = make_scenario(nodes, 0.2, shared={"burst": f"{topic}/{label}"}, requirements=formulas)
    run = simulate(rig_of(scenario))
    margins = {r.name: r.number for r in run.results}
    assert margins["comes"] > 0.0
    assert margins["from_the_start"] == -math.inf
    spans = next(r.violated_s for r in run.results if r.name == "from_the_start")
    assert spans[0][0] == 0.0
    assert spans[-1][1] < 0.05


def test_a_scenario_may_expect_that_a_requirement_is_violated():
    rig = wired("always[0.2, 0.8] state <= 0.3")
    scenario = rig.scenario.model_copy(update={"expect": {"it": Expectation(at_most=0.0)}})
    run = simulate(rig_of(scenario))
    assert [r.passed for r in run.results] == [True]


def live(formula, **about):
    return wired(formula, **about)


@pytest.mark.parametrize(
    "formula",
    [
        "always[0.2, 0.8] state <= 0.3",
        "eventually[0.1, 0.9] state > 0.2",
        "always (rising(command) -> eventually[0, 0.05] state >= 0)",
        "always[0, 0.5] (state <= 0.4 and state >= -1)",
    ],
)
def test_a_watched_margin_closes_in_on_that_of_the_record(formula):
    rig = live(formula, live=True)
    run = simulate(rig)
    margin = figure_of(rig, run.signals).number
    lower, upper, decided = (run.signals[f"requirement/it/{name}/position"].x for name in ("lower", "upper", "decided"))
    assert np.all(lower <= upper)
    assert np.all(np.diff(upper) <= 0.0)
    assert np.all(np.diff(lower) >= 0.0)
    assert lower[-1] <= margin <= upper[-1]
    if decided[-1]:
        assert upper[-1] == margin


def test_a_watched_requirement_ends_the_run_at_the_tick_at_which_it_is_violated():
    rig = live("always state <= 0.3", ends=True)
    free = simulate(wired("always state <= 0.3"))
    t, x = free.signals["lag/state/x/position"]
    first = t[np.flatnonzero(x > 0.3)[0]]
    with pytest.raises(RunError, match=rf"requirement_it: always state <= 0.3 is violated.*known at t = {first:.9g} s"):
        simulate(rig)
    assert simulate(live("always state <= 100", ends=True)).results[0].passed
