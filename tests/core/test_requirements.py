"""Requirements: bad input, cases that cannot be judged, where they are violated, live ones (formulas:
`test_formulas`).
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import make_scenario
from softrig_core import ByHand, RunError, ScenarioError, evaluate, figures_of, rig_of, simulate
from softrig_core.judge.expectation import Expectation
from softrig_core.judge.formula import margin_unit, outline, read, variables
from softrig_core.judge.requirement_entry import Requirement, check_lengths
from softrig_core.judge.robustness import Record
from softrig_core.verdict.requirements import _ticker
from softrig_core.wire.signals import Signal

NODES = {"plant": "plant", "source": "source", "gain": "gain"}


def requirement(formula, *, shared=None, duration=1.0, **about):
    """The rig of the test blocks with one requirement."""
    names = {"state": "state/lag/position", "command": "command/drive/effort", "level": 0.5} | (shared or {})
    keys = {"formula": formula, **about}
    return rig_of(make_scenario(NODES, duration, shared=names, requirements={"it": keys}))


def figure_of(rig, signals):
    return next(r for r in evaluate(rig, signals) if r.name == "it")


LIVE = {
    "state": "lag/state/x/position",
    "command": "lag/command/u/effort",
    "speed": "lag/state/x/velocity",
    "gain": "$gain.k",
}


def wired(formula, **about):
    return requirement(formula, shared={**LIVE, **about.pop("shared", {})}, **about)


def test_a_margin_is_in_the_signals_unit_and_has_the_place_of_its_violation():
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
    assert [figure_of(r, simulate(r).signals).value for r in (short, whole)] == [
        figure_of(whole, simulate(whole).signals).value
    ] * 2


def test_a_requirement_is_a_figure_of_a_run_and_passes_if_it_holds():
    run = simulate(wired("always abs(command) <= 10 * gain"))
    _, u = run.signals["lag/command/u/effort"]
    assert run.figures["it"] == pytest.approx(20 - np.abs(u).max(), abs=1e-12)
    assert not run.missed


def test_units_of_both_sides_must_fit_and_several_need_a_scale():
    with pytest.raises(ScenarioError, match="requirement it: 'm' beside 'N'"):
        figures_of(wired("always state <= command"))
    with pytest.raises(ScenarioError, match=r"requirement it: .*a pure number' beside 'N'"):
        figures_of(wired("always sin(state) <= command"))
    figures_of(wired("always command <= 10 * sin(level)"))  # the unit of a constant is free
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
        ("always sate > 0", r"'sate' is not a name \(did you mean 'state'\?\)"),
        ("alway[0, 1] state > 0", r"'alway' is not a name \(did you mean 'always'\?\)"),
        ("always (state > 0", "unclosed|expected"),
        ("always[0.5, 0.1] state > 0", "lower bound 0.5 is greater than upper bound 0.1"),
        ("state > 0", "t = 0 only: write 'always"),
        ("always -state^2 < 0", "minus before a power"),
        ("always[0.0001, 0.0002] state > 0", "no tick of plant"),
        ("always rising(state + 1) -> state > 0", "rising.*needs the name of a signal"),
        ("always rising(state", r"rising\(\.\.\.\) needs the name of a signal"),
        ("always rising(level) -> state > 0", r"rising\(\.\.\.\) needs the name of a signal"),
        ("always state + 1", "expected a comparison"),
        ("", "at least 1 character"),
        ("always abs() < 1", "abs takes one number, got 0"),
        ("always min(state) < 1", "min takes two numbers or more, got 1"),
        ("always sin(state, state) < 1", "sin takes one number, got 2"),
        ("always[0, 1e300] state < 1", r"an interval up to 1e\+300 s; expected at most 1e\+09 s, or inf"),
        ("always state / 0 < 1", "a division by zero"),
        ("always state % (level - 0.5) < 1", "a division by zero"),
        ("always log(0 - 1) < state", "log of numbers for which it is undefined"),
        ("always state^0.5 < 1", "a power of something in m takes a whole number"),
        ("always state^level < 1", "a power of something in m takes a whole number"),
        ("always state^state < 1", "a power of something in m takes a whole number"),
        ("always sqrt(state) < 1", "sqrt of something with a unit: compare squares instead"),
    ],
)
def test_a_meaningless_formula_is_refused_before_the_run(formula, reason):
    with pytest.raises((ScenarioError, ValueError), match=reason):
        figures_of(wired(formula))


def test_a_requirement_that_the_record_cannot_decide_is_not_judged_and_does_not_pass():
    rig = wired("always[0, 2] state <= 100", duration=1.0)
    result = figure_of(rig, simulate(rig).signals)
    assert (result.value, result.passed) == (None, False)
    assert result.error == "not judged: the record ends at 1 s, the requirement's last window at 2 s"


def test_the_decided_part_of_a_record_that_ends_early_is_judged():
    rig = wired("always[0, 2] state <= 0.3")
    run = simulate(rig)
    result = figure_of(rig, run.signals)
    worst = 0.3 - run.signals["lag/state/x/position"].x.max()
    assert (result.value, result.passed, result.open_from_s) == (pytest.approx(worst, abs=1e-15), False, 1.0)
    rig = wired("eventually[0, 2] state >= 0.3")
    result = figure_of(rig, simulate(rig).signals)
    assert (result.value, result.passed) == (pytest.approx(-worst, abs=1e-15), True)
    sure_of_half = rig.scenario.model_copy(update={"expect": {"it": Expectation(at_least=0.0, at_most=1.0)}})
    # The value may still increase, so the verdict is open.
    assert not figure_of(rig_of(sure_of_half), run.signals).passed


@pytest.mark.parametrize(
    ("formula", "settled"),
    [
        ("always[0, inf] state <= 0.3", True),  # a violation is final
        ("always[0, inf] state <= 100", False),
        ("always[0, 0.5] state <= 100", True),
        ("eventually[0, inf] state >= 100", False),  # the value may still reach 100
        ("eventually[0, inf] state >= 0.3", True),
        ("eventually[0, 0.5] state >= 100", True),
    ],
)
def test_a_verdict_during_a_run_is_settled_if_nothing_later_can_change_it(formula, settled):
    rig = wired(formula)
    signals = simulate(rig).signals
    (result,) = (r for r in evaluate(rig, signals, under_way=True) if r.name == "it")
    assert result.settled == settled
    assert not figure_of(rig, signals).settled  # a finished run has nothing left to settle


@pytest.mark.parametrize("live", [False, True])
def test_the_last_window_hides_no_violation_beside_it(live):
    """In the last second nothing is known of the next second, but the existing samples count."""
    rig = wired("always (state <= 0.3 and (state > 0.05 -> eventually[0, 1] state < 0.05))", live=live)
    run = simulate(rig)
    t, x = run.signals["lag/state/x/position"]
    result = next(r for r in run.results if r.name == "it")
    assert x.max() > 0.3
    assert (result.value, result.passed) == (pytest.approx(0.3 - x.max(), abs=1e-15), False)
    still = [k for k in range(len(t)) if 0.05 < x[k] <= 0.3 and t[k] + 1 > t[-1] and not (x[k:] < 0.05).any()]
    assert result.open_from_s == t[still[0]]
    if live:
        upper = run.signals["requirement/it/upper/position"].x
        assert upper[-1] == 0.3 - x[:-1].max()  # the window ends before the last instant


def test_undefined_arithmetic_is_not_judged_in_any_requirement():
    for formula in ("always log(0 - 1 - state/state) > 0", "always log(0 - 1 - state/state) <= 0"):
        run = simulate(wired(formula, live=True))
        result = next(r for r in run.results if r.name == "it")
        assert (result.value, result.passed) == (None, False)
        assert result.error.startswith("not judged: undefined from t = 0 s on")
        assert not run.signals["requirement/it/decided/position"].x.any()
    guarded = wired("always (command > 0 -> ln(command / level) <= 100)", scale={"N": 1.0, "": 1.0})
    run = simulate(guarded)
    assert run.signals["lag/command/u/effort"].x.min() == 0.0  # undefined at 0, where the condition is false
    assert run.results[0].passed


@pytest.mark.parametrize("live", [False, True])
def test_an_invalid_number_leaves_only_its_own_requirement_not_judged(live):
    nodes = {"plant": "plant", "source": "source", "gain": "gain"}
    names = {"state": "lag/state/x/position", "seen": "lag/state/bad/x/position"}
    faults = {"bad": {"link": "lag/state -> gain", "kind": "invalid", "from": 0.5, "to": 0.52}}
    formulas = {
        "its": "always[0, 0.9] abs(seen) <= 100",
        "other": "always abs(state) <= 100",
        "known": "always seen <= 0.1",
    }
    required = {name: {"formula": formula, "live": live} for name, formula in formulas.items()}
    run = simulate(rig_of(make_scenario(nodes, shared=names, faults=faults, requirements=required)))
    results = {r.name: r for r in run.results}
    assert (results["its"].value, results["its"].passed) == (None, False)
    assert results["its"].error.startswith("not judged: undefined at t = 0.5 s")
    assert results["other"].passed
    if live:  # the node that judges gets no such message, so it decides nothing for these ticks
        assert run.signals["requirement/its/lower/position"].x.max() < 0.0
        ends = [run.signals[f"requirement/its/{bound}/position"].x[-1] for bound in ("lower", "upper")]
        assert ends[0] < 0.0 <= ends[1]
    assert results["known"].value == pytest.approx(0.1 - np.nanmax(run.signals["lag/state/bad/x/position"].x))


def test_the_record_extends_to_the_end_although_its_signal_is_published_rarely():
    """At 1 s the plant publishes; the source, with a period of 0.3 s, has published last at 0.9 s."""
    nodes = {"source": {"executable": "source", "parameters": {"period": 0.3}}, "plant": "plant", "gain": "gain"}
    for order in (nodes, dict(reversed(nodes.items()))):
        rig = rig_of(make_scenario(order, shared=LIVE, requirements={"it": "always[0, 1] state <= 100"}))
        assert figure_of(rig, simulate(rig).signals).passed


def test_an_interrupted_run_is_judged_up_to_the_last_message_of_the_fastest_node():
    """Two plants publish until 1 s. At 0.64 s, where the run breaks, the slow one has published last at 0.5 s."""
    other = {"lag/state": "slow/state", "lag/command": "slow/command"}
    nodes = {
        "slow_plant": {
            "executable": "plant",
            "parameters": {"period": 0.5},
            "remap": {**other, "lag/applied": "slow/applied"},
        },
        "slow_gain": {"executable": "gain", "parameters": {"period": 0.5}, "remap": other},
        "plant": "plant",
        "source": "source",
        "gain": "gain",
    }
    for order in (nodes, dict(reversed(nodes.items()))):
        rig = rig_of(make_scenario(order, shared=LIVE, requirements={"it": "always[0, 0.64] state <= 100"}))
        run = simulate(rig)
        for end, error in ((0.645, ""), (0.635, "not judged: the record ends at 0.63 s")):
            kept = {name: run.signals[name] for name in run.signals}
            cut = {name: Signal(s.t[s.t < end], s.x[s.t < end]) for name, s in kept.items()}
            result = figure_of(rig, cut)
            assert (result.passed, result.error[: len(error)]) == (not error, error)


def test_a_file_whose_requirement_reaches_beyond_its_end_is_refused(tmp_path):
    from softrig_core import load_scenario

    file = tmp_path / "mine.yaml"
    file.write_text("extends: dc_motor_smc_b2\ntitle: mine\nrequirements: {late: 'always[5, 7] abs(voltage) <= 24'}\n")
    with pytest.raises(ScenarioError, match=r"requirement late: its last window ends 7 s after the start"):
        load_scenario(str(file))
    file.write_text(file.read_text().replace("[5, 7]", "[1, 2]").replace("late:", "overshoot:"))
    with pytest.raises(ScenarioError, match="overshoot is the name of a figure, too"):
        load_scenario(str(file))


@pytest.mark.parametrize(
    ("formula", "fits"),
    [
        ("always[0, 2] x > 0", True),
        ("always[0, 2.000001] x > 0", False),
        ("always[0, 1.5] (eventually[0, 0.5] x > 0)", True),
        ("always[0, 1.5] (eventually[0, 0.6] x > 0)", False),
        ("always[2, inf] x > 0", True),
        ("eventually[2.1, inf] x > 0", False),
        ("always (x > 0 -> (once[0, 9] x > 0))", True),
        ("(x > 0) until[0, 2.5] (x < 0)", False),
        ("always x >", False),
    ],
)
def test_a_requirement_is_at_most_as_long_as_its_run(formula, fits):
    requirements = {"it": Requirement(formula=formula)}
    if fits:
        check_lengths(2.0, {"x": None}, requirements)
        return
    with pytest.raises(ScenarioError, match=r"^requirement it: "):
        check_lengths(2.0, {"x": None}, requirements)


def test_the_record_extends_to_the_last_message_of_the_fastest_of_those_that_last_longest():
    def member(name, every, last, sporadic=False, labels=("x", "y")):
        port = SimpleNamespace(topic=name, labels=labels, sporadic=sporadic)
        return SimpleNamespace(schedule=SimpleNamespace(every=every, last=last), outputs=[port])

    slow, quick, short = member("slow", 10, 500), member("quick", 2, 500), member("short", 1, 499)
    rare, empty, never = member("rare", 1, 900, True), member("empty", 1, 900, labels=()), member("never", 1, None)
    for members in ((slow, quick, short, rare, empty, never), (never, short, empty, rare, quick, slow)):
        assert _ticker(SimpleNamespace(members=members)) == "quick/x"
    assert _ticker(SimpleNamespace(members=[never])) == "never/x"


def test_edges_and_bare_names_decide_without_a_distance():
    grid = np.arange(6) * 1e8
    known = {"fault": None, "x": None}
    tree, conditions = read("always (rising(fault) -> eventually[0, 0.2] x < 1)", known)
    assert [c.signal for c in conditions.values()] == ["fault"]
    (edge,) = conditions
    rises = np.array([-1, -1, 1, -1, -1, -1]) * math.inf
    x = np.array([9.0, 9.0, 9.0, 4.0, 3.0, 0.0])
    margin = Record(grid, {"x": x}, truths={edge: rises}).margin(tree)
    assert (margin.value, margin.at, margin.violated) == (-2.0, 0.4, ((0.2, 0.2),))
    tree, _ = read("always not fault", known)
    (name,) = variables(tree)
    assert Record(grid, {}, truths={name: rises}).margin(tree).value == -math.inf
    assert Record(grid, {}, truths={name: -np.abs(rises)}).margin(tree).value == math.inf


def test_the_unit_of_a_margin_is_that_of_its_signal():
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


def test_a_signal_without_a_message_yet_compares_as_false(tmp_path):
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
def test_a_watched_margin_approaches_that_of_the_record(formula):
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


def test_a_watched_requirement_ends_the_run_at_the_tick_of_its_violation():
    rig = live("always state <= 0.3", ends=True)
    free = simulate(wired("always state <= 0.3"))
    t, x = free.signals["lag/state/x/position"]
    first = t[np.flatnonzero(x > 0.3)[0]]
    with pytest.raises(RunError, match=rf"requirement_it: always state <= 0.3 is violated.*known at t = {first:.9g} s"):
        simulate(rig)
    assert simulate(live("always state <= 100", ends=True)).results[0].passed


def test_a_watched_requirement_goes_back_to_any_tick():
    rig = wired("always (rising(command) -> eventually[0, 0.05] state >= 0)", live=True)
    (member,) = [m for m in rig.members if m.name == "requirement_it"]
    monitor = ByHand(member.block(0))
    ports = [p.name for p in member.inputs]
    assert len(ports) == 2
    rng = np.random.default_rng(1)
    rows = rng.normal(0.2, 1.0, (60, 2)).tolist()

    def go(k, n, sign=1.0):
        messages = []
        for i in range(k, n):
            values = {name: (sign * x,) for name, x in zip(ports, rows[i], strict=True)}
            messages.append(monitor.update(i * 10_000_000, **values)["margin"])
        return messages

    whole = go(0, 60)
    assert len(set(whole)) > 3
    monitor.reset(0)
    assert go(0, 20) == whole[:20]
    saved = monitor.save()
    elsewhere = go(20, 60, -1.0)
    assert elsewhere != whole[20:]
    for _ in range(2):
        monitor.load(saved)
        assert go(20, 60) == whole[20:]


def test_a_formula_uses_numbers_of_nodes_and_figures_of_the_run():
    figures = {"peak": {"function": "maximum", "arguments": {"signal": "lag/state/x/position"}}}
    figures |= {"there": {"function": "reach_time", "arguments": {"signal": "lag/state/x/position", "level": 0.1}}}

    def margin(formula, **about):
        names = {k: LIVE[k] for k in ("state", "gain")}
        keys = {"shared": names, "requirements": {"it": {"formula": formula, **about}}, "figures": figures}
        return figure_of(rig := rig_of(make_scenario(NODES, 1.0, **keys)), simulate(rig).signals)

    run = simulate(rig_of(make_scenario(NODES, 1.0, shared={"state": LIVE["state"]}, figures=figures)))
    t, x = run.signals["lag/state/x/position"]
    assert margin("always state <= 3 * $gain.k").value == pytest.approx(3.0 * run.rig.parameter("gain", "k") - x.max())
    assert margin("always state <= peak").value == 0.0
    late = margin("always[there, inf] state >= 0.1")
    assert late.value == pytest.approx(x[t >= run.figures["there"] - 1e-12].min() - 0.1)
    after = margin("always[there + 2 * $plant.period, inf] state >= 0.1")
    assert after.value > late.value
    assert "the figure never of" not in after.error


@pytest.mark.parametrize(
    ("formula", "reason"),
    [
        ("always state <= $gain.kk", r"gain has .*k"),
        ("always state <= $pump.k", "the nodes are"),
        ("always[0, state] state <= 1", "state in an interval changes while the rig runs"),
        ("always[0, stat] state <= 1", "stat in an interval is unknown"),
        ("always[0, 1 +] state <= 1", "is not a number"),
        ("always[0 - $gain.k, 1] state <= 1", "expected a time of at least 0 s"),
        ("always[peak, inf] state <= 1", "peak in an interval is in .*, expected s"),
        ("always peak", "peak is a figure"),
    ],
)
def test_invalid_numbers_of_nodes_are_refused(formula, reason):
    figures = {"peak": {"function": "maximum", "arguments": {"signal": "lag/state/x/position"}}}
    names = {"state": LIVE["state"]}
    with pytest.raises(ScenarioError, match=reason):
        figures_of(
            rig_of(make_scenario(NODES, 1.0, shared=names, requirements={"it": {"formula": formula}}, figures=figures))
        )


def test_a_figure_without_a_value_leaves_its_requirement_not_judged():
    figures = {"never": {"function": "reach_time", "arguments": {"signal": "lag/state/x/position", "level": 1e6}}}
    keys = {"requirements": {"it": {"formula": "always[never, inf] state <= 9"}}, "figures": figures}
    rig = rig_of(make_scenario(NODES, 1.0, shared={"state": LIVE["state"]}, **keys))
    result = figure_of(rig, simulate(rig).signals)
    assert not result.passed
    assert result.error == "not judged: the figure never of its formula never happens"


@pytest.mark.parametrize(
    ("formula", "own"),
    [
        ("always[0, inf] abs(v - ref) <= 0.02 * ref", False),
        ("always share <= 1", False),
        ("always v >= 0", False),
        ("always v <= limit", False),
        ("always[wait, inf] v <= limit + 0 * ref", False),
        ("always[2 * wait + 0.1, inf] v <= ref", False),
        ("always v <= 40", True),
        ("always abs(v - ref) <= 2e-4", True),
        ("always v <= ref + 3", True),
        ("always[1.5, inf] v <= ref", True),
        ("eventually[0, 3] v <= ref", True),
        ("always (v <= ref and v >= 0 - 5)", True),
    ],
)
def test_numbers_with_a_unit_and_times_do_not_scale_with_the_machine(formula, own):
    known = {"v": None, "ref": None, "share": None, "limit": 3.0, "wait": 0.5}
    assert outline(formula, known).has_bounds({"v": "V", "ref": "V", "share": ""}) is own
