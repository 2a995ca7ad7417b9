"""Scenario files: inheritance, references, expectations and claims, all checked before the run."""

import math

import pytest
from conftest import few, in_process, make_scenario
from faultrig import Gain, Lag, Source
from softrig_core import (
    ByHand,
    Rig,
    ScenarioError,
    Signals,
    evaluate,
    figures_of,
    list_scenarios,
    load_scenario,
    rig_of,
    simulate,
)
from softrig_core.block.port import WORLD
from softrig_core.block.scene import scene_of, standing
from softrig_core.judge import registry
from softrig_core.judge.claims import Claim
from softrig_core.judge.expectation import Expectation, parse
from softrig_core.judge.units import compose, factor
from softrig_core.scenario.references import fill
from softrig_core.scenario.scenario_file import inherit
from softrig_core.scenario.yaml_file import NODES, SIZE, read_yaml
from softrig_core.verdict.findings import findings, needed
from softrig_core.wire.types import VECTOR

BASE = """
title: First-order lag
system: lag
source: none
duration: 1.0
shared: {k: 2.0, x: lag/state/x/position, late: $plant.gain, mean_from: 0.5}
nodes:
  plant: {package: faultrig, executable: plant, parameters: {gain: 0.75}}
  source: {package: faultrig, executable: source}
  gain: {package: faultrig, executable: gain, parameters: {k: $k}}
figures:
  last: {function: final_value, arguments: {signal: $x}}
  mean: {arguments: {signal: $x, start: $mean_from}}
  peak: {arguments: {signal: lag/command/u/effort, start: $late}}
expect: {last: between 0 and 1}
claims:
  last: {published: 0.5, tolerance: 50 %, where: Table I, verdict: reproduced}
plots:
  - {title: Position, signals: {$x: x}}
variants:
  fast:
    shared: {k: 4.0}
    figures: {peak: null, last: {function: maximum, arguments: {signal: $x}}}
    expect: {mean: at least 0}
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("SOFTRIG_SCENARIOS", str(tmp_path))
    monkeypatch.setenv("AMENT_PREFIX_PATH", "")
    (tmp_path / "lag.yaml").write_text(BASE)
    return tmp_path


def change(folder, old, new):
    assert old in BASE
    (folder / "lag.yaml").write_text(BASE.replace(old, new))
    return load_scenario("lag")


# the shipped files ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", few(sorted(list_scenarios()), 150))
def test_every_scenario_can_be_checked_before_its_run(name):
    scenario = load_scenario(name)
    rig = rig_of(scenario)
    figures_of(rig)
    needed(scenario)
    others = {p.frame for m in rig.members for p in m.outputs if p.type.framed and p.msgtype != VECTOR.name} - {WORLD}
    if others:  # the frame of a vector is that of its publisher
        assert others <= {frame for m in rig.members for frame in frames(m)}


def frames(member):
    """The frames that a node publishes on /tf and /tf_static."""
    block = ByHand(member.block(0))
    scene = scene_of(member.block_class, member.params)
    port = next((p for p in member.outputs if scene is not None and p.name == scene.port), None)
    q = [0.0] * sum(label.endswith("/position") for label in port.labels) if port else []
    moving = scene.moving(q) if scene is not None else []
    return {pose.child for pose in (*standing(block.markers(), scene, member.outputs), *moving)}


def test_figures_of_other_scenarios_that_claims_name_exist():
    for name in list_scenarios():
        for key, claim in load_scenario(name).claims.items():
            for reference in (claim.figure, *claim.references()):
                other, _, figure = reference.rpartition(".")
                if other:
                    assert figure in load_scenario(other).figures, (name, key)


# inheritance ------------------------------------------------------------------------------------------------------


def test_figures_are_inherited_expectations_and_claims_are_not(folder):
    fast = load_scenario("lag_fast")
    assert list(fast.figures) == ["last", "mean"]
    assert list(fast.expect) == ["mean"]
    assert fast.claims == {}
    assert fast.nodes["gain"].parameters == {"k": 4.0}
    assert fast.figures["last"].arguments == {"signal": "lag/state/x/position"}
    (folder / "child.yaml").write_text("extends: lag\ntitle: C\n")
    child = load_scenario("child")
    assert (child.expect, child.claims) == ({}, {})
    assert list(child.figures) == ["last", "mean", "peak"]


def test_another_executable_or_function_drops_parameters_and_arguments():
    base = {
        "nodes": {"a": {"package": "p", "executable": "x", "parameters": {"k": 1}, "remap": {"u": "v"}}},
        "figures": {"f": {"function": "rise_time", "arguments": {"final": 1.0}, "unit": "s"}},
    }
    same = inherit(base, {"nodes": {"a": {"executable": "x", "parameters": {"l": 2}}}})
    assert same["nodes"]["a"]["parameters"] == {"k": 1, "l": 2}
    other = inherit(base, {"nodes": {"a": {"executable": "y"}}, "figures": {"f": {"function": "peak"}}})
    assert other["nodes"]["a"] == {"package": "p", "executable": "y", "remap": {"u": "v"}}
    assert other["figures"]["f"] == {"function": "peak"}
    assert inherit(base, {"nodes": {"a": None}})["nodes"] == {}


def test_a_shared_value_can_be_set_and_reaches_all_references(folder):
    assert load_scenario("lag", {"k": 7.0}).nodes["gain"].parameters == {"k": 7.0}
    with pytest.raises(ScenarioError, match=r"override 'kk' .did you mean 'k'..: .* or a shared value \(k, x"):
        load_scenario("lag", {"kk": 7.0})


def test_a_change_overrides_a_shared_mapping(folder):
    shared, node = "shared: {k: 2.0,", "{package: faultrig, executable: plant, parameters: {gain: 0.75}}"
    for whole, value in (
        ("{package: faultrig, executable: plant, parameters: $all}", "{gain: 0.75, limit: 3.0}"),
        ("$all", "{package: faultrig, executable: plant, parameters: {gain: 0.75, limit: 3.0}}"),
    ):
        text = BASE.replace(shared, f"shared: {{all: {value}, k: 2.0,").replace(node, whole)
        (folder / "lag.yaml").write_text(text)
        plant = load_scenario("lag", {"plant.gain": 0.5}).nodes["plant"]
        assert (plant.executable, plant.parameters) == ("plant", {"gain": 0.5, "limit": 3.0})
        (folder / "child.yaml").write_text(
            "extends: lag\nnodes: {plant: {parameters: {gain: 0.25, limit: null}}}\n"
            "variants: {more: {shared: {k: 5.0}, nodes: {plant: {parameters: {limit: $k}}}}}\n"
        )
        assert load_scenario("child").nodes["plant"].parameters == {"gain": 0.25}
        assert load_scenario("child_more").nodes["plant"].parameters == {"gain": 0.25, "limit": 5.0}
        assert load_scenario("child_more", {"k": 4.0, "plant.gain": 0.1}).nodes["plant"].parameters == {
            "gain": 0.1,
            "limit": 4.0,
        }


def test_a_file_that_changed_is_read_again(folder):
    assert load_scenario("lag").duration == 1.0
    assert change(folder, "duration: 1.0", "duration: 22.0").duration == 22.0


# references -------------------------------------------------------------------------------------------------------


def test_references_take_parameters_of_nodes_defaults_included(folder):
    (peak,) = (f for f in figures_of(rig_of("lag")) if f.name == "peak")
    assert peak.arguments == {"signal": "lag/command/u/effort", "start": 0.75}
    rig = rig_of(change(folder, "{k: $k}", "{k: $plant.limit}"))
    assert next(m.params.k for m in rig.members if m.name == "gain") == 10.0
    assert fill({"a": "$$b", "c": ["$d"]}, {"d": "$e", "e": [1]}) == {"a": "$$b", "c": [[1]]}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("{k: $k}", "{k: $q}", r"lag.yaml: \$q: the shared values are k, x"),
        ("k: 2.0", "k: $k", "shared value k refers to itself: k -> k"),
        ("{k: $k}", "{k: $plant.gian}", r"node gain: \$plant.gian: plant has period, gain, limit"),
        ("{k: $k}", "{k: $plan.gain}", r"\$plan.gain: the nodes are plant, source, gain"),
        ("{gain: 0.75}", "{gain: $plant.limit}", "its parameters refer to themselves: plant -> plant"),
        ("start: $late", "start: $plant.gian", r"figure peak: \$plant.gian: plant has"),
        ("function: final_value", "function: finalvalue", "'finalvalue' is registered .did you mean 'final_value'"),
        ("function: final_value", "function: 'os:system'", "no figure function 'os:system' is registered"),
        ("start: $mean_from", "stat: 0.5", "figure mean: unknown argument stat; it takes signal, start, end"),
        ("start: $mean_from", "start: soon", "figure mean: argument start = 'soon'"),
        ("{signal: $x, start: $mean_from}", "{start: 0.5}", "figure mean: argument signal is missing"),
        ("signal: lag/command/u/effort", "signal: lag/command/w", "figure peak: no signal 'lag/command/w'"),
        ("  mean: {", "  mean: {unit: kg, ", "figure mean: unit 'kg', but mean gives 'm'"),
        ("start: $late}", "reference: lag/state/x/position}", "signal in 'N', but its reference in 'm'"),
        ("expect: {last", "expect: {lost", "expect: no figure 'lost'; the figures are last, mean, peak"),
        ("  last: {published", "  lost: {published", "claims: no figure 'lost'"),
        ("between 0 and 1", "about 1", "expect.last: expected a number, 'X"),
        ("between 0 and 1", "1 +- 0.3", "expect.last: the tolerance is 30% of the value"),
        ("between 0 and 1", "between 1 and 0", "expect.last: between 1 and 0: nothing is"),
        ("verdict: reproduced", "verdict: refuted", "claims.last: the verdict refuted needs a reason"),
        ("  mean: {", "  last: {", "duplicate key 'last'"),
    ],
)
def test_errors_of_a_scenario_are_reported_before_the_run(folder, old, new, message):
    with pytest.raises(ScenarioError, match=message) as caught:
        figures_of(rig_of(change(folder, old, new)))
    assert "\n" not in str(caught.value)


# expectations -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "inside", "outside"),
    [
        (44, [44.0], [44.0001]),
        ("0.694 +- 0.007", [0.6871, 0.7009], [0.6869, 0.7011]),
        ("-200 +- 1 %", [-198.1, -201.9], [-197.9, -202.1, 200.0]),
        ("0 +- 0.1", [0.1, -0.1], [0.11]),
        ("at most 0.02", [0.02, -5.0], [0.021]),
        ("at least 3", [3.0, 1e9], [2.99]),
        ("between -1 and 2e-1", [-1.0, 0.2], [-1.01, 0.21]),
    ],
)
def test_expectations_have_their_documented_meaning(text, inside, outside):
    expectation = parse(text)
    assert all(expectation.holds(x) for x in inside)
    assert not any(expectation.holds(x) for x in (*outside, math.nan, math.inf, -math.inf))


def test_a_figure_without_expectation_never_fails_and_one_with_it_does():
    figures = {"never": {"function": "rise_time", "arguments": {"signal": "lag/state/x/position", "final": 1e9}}}
    nodes = {"plant": "plant", "source": "source", "gain": "gain"}
    rig = rig_of(make_scenario(nodes, figures=figures))
    (result,) = evaluate(rig, Signals(in_process(rig)))
    assert (result.value, result.number, result.passed, result.judged) == (None, math.inf, True, False)
    rig = rig_of(make_scenario(nodes, figures=figures, expect={"never": "at most 1"}))
    (result,) = evaluate(rig, Signals(in_process(rig)))
    assert (result.passed, result.error) == (False, "never")
    assert Expectation().holds(1.0)


# claims -----------------------------------------------------------------------------------------------------------


def claim(**keys):
    return Claim.model_validate({"where": "Table I", "verdict": "reproduced", "reason": "so", "text": "so"} | keys)


def finding(claim, figures):
    nodes = {"plant": "plant", "source": "source", "gain": "gain"}
    known = {"last": {"function": "final_value", "arguments": {"signal": "lag/state/x/position"}}}
    scenario = make_scenario(nodes, figures=known, claims={"last": claim})
    (result,) = findings(scenario, lambda name: figures.get(name), {"last": "m"})
    return result


@pytest.mark.parametrize("verdict", ["reproduced", "fitted", "corrected", "refuted"])
@pytest.mark.parametrize(
    ("keys", "value", "agrees"),
    [
        ({"published": 2.0}, 2.09, True),
        ({"published": 2.0}, 2.11, False),
        ({"published": 2.0, "tolerance": "1 %"}, 2.03, False),
        ({"published": 0.0, "tolerance": 0.1}, -0.09, True),
        ({"published": 2.0}, math.inf, False),
        ({"published": 2.0}, math.nan, False),
        ({"below": 3.0}, 2.9, True),
        ({"below": 3.0}, 3.0, False),
        ({"above": "other.last"}, 5.1, True),
        ({"above": "other.last"}, math.inf, True),
        ({"above": "other.last"}, 4.9, False),
        ({"above": "other.last"}, 5.0, False),
        ({"equals": "other.last", "tolerance": "10 %"}, 5.4, True),
        ({"above": 1.0, "below": "other.last"}, 0.5, False),
    ],
)
def test_a_verdict_holds_or_is_false(verdict, keys, value, agrees):
    result = finding(claim(verdict=verdict, **keys), {"test": {"last": value}, "other": {"last": 5.0}})
    assert result.holds is (agrees != (verdict == "refuted"))


def test_an_unmeasured_claim_stays_open_and_one_that_cannot_be_checked_holds():
    assert finding(claim(above="other.last"), {"test": {"last": 1.0}}).holds is None
    assert finding(claim(published=1.0), {}).holds is None
    open_ = finding(claim(verdict="not_checkable", figure="last", published=9.0), {"test": {"last": 1.0}})
    assert (open_.holds, open_.measured) == (True, 1.0)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({}, "expected a published number, or below, above or equals"),
        ({"published": 1.0, "below": 2.0}, "published and below: expected one of them"),
        ({"published": 0.0}, "a published value of 0 needs a tolerance"),
        ({"published": 1.0, "tolerance": "much"}, "a percentage"),
        ({"below": 1.0, "text": ""}, "needs its text"),
        ({"published": 1.0, "where": ""}, "at least 1 character"),
        ({"published": 1.0, "verdict": "true"}, "Input should be 'reproduced'"),
    ],
)
def test_an_incomplete_claim_is_refused(keys, message):
    with pytest.raises(ValueError, match=message):
        claim(**keys)


# units, YAML, registry --------------------------------------------------------------------------------------------


def test_units_of_figures_follow_from_the_signals():
    assert compose("{signal}/s", "V") == "V/s"
    assert compose("{signal}^2", "rad") == "rad^2"
    assert compose("{signal} s", "deg") == "deg s"
    assert compose("{signal}/s", "") == "1/s"
    assert compose("s", "V") == "s"
    assert factor("rad^2", "deg^2") == pytest.approx(math.degrees(1.0) ** 2)
    assert factor("rad/s", "deg/s") == pytest.approx(math.degrees(1.0))
    assert factor("s m", "m s") == 1.0
    assert factor("s", "ms") == 1000.0
    assert factor("s", "m") is None


def test_yaml_is_read_as_version_1_2():
    result = read_yaml("{a: 1e-5, b: 1.0e+6, c: on, d: 0o10, e: 12:30, f: ~, g: .inf, h: 0x10, i: -.5, j: 'x'}", "t")
    assert result == {
        "a": 1e-5,
        "b": 1e6,
        "c": "on",
        "d": 8,
        "e": "12:30",
        "f": None,
        "g": math.inf,
        "h": 16,
        "i": -0.5,
        "j": "x",
    }


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\na: 2", "t: not valid YAML: .*duplicate key 'a'"),
        ("[" * 60 + "]" * 60, "nested deeper than 40"),
        ("x" * (SIZE + 1), "characters, expected at most"),
        (
            "a0: &a0 [x]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 9)),
            f"more than {NODES} values",
        ),
        ("&a [*a]", "alias"),
        ("!!python/object/apply:os.system ['true']", "not valid YAML"),
        ("{[1]: 2}", "not valid YAML|not a plain word"),
    ],
)
def test_malicious_yaml_is_refused_in_one_line(text, message):
    with pytest.raises(ScenarioError, match=message) as caught:
        read_yaml(text, "t")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300


def test_measures_can_come_from_installed_packages():
    known = registry.registered()
    assert {"rise_time", "dtc_flux_error_peak", "pv_gmpp"} <= set(known)
    for name in known:
        assert callable(registry.find(name))


# the front door ---------------------------------------------------------------------------------------------------


def test_a_rig_of_block_objects_equals_the_rig_of_the_file(folder):
    from_file = simulate("lag", duration=0.5)
    rig = Rig.from_blocks({"plant": Lag(gain=0.75), "source": Source(), "gain": Gain(k=2.0)}, duration=0.5)
    wired = simulate(rig)
    assert wired.recording.topics["lag/state"].data == from_file.recording.topics["lag/state"].data
    changed = simulate(rig, duration=0.25, overrides={"gain.k": 4.0})
    assert changed.signals["lag/state/x/position"].t[-1] == 0.25
    assert changed.recording.topics["lag/state"].data[:20] != from_file.recording.topics["lag/state"].data[:20]


def test_simulate_gives_figures_claims_and_what_missed(folder):
    run = simulate("lag", overrides={"k": 4.0}, seed=3)
    assert run.seed == 3
    t, x = run.signals["lag/state/x/position"]
    assert run.figures["last"] == x[-1]
    assert t[-1] == 1.0
    assert run.missed == []
    assert run.published_for == "k = 2"
    assert [c.key for c in run.claims] == ["last"]
    assert {r.name for r in run.results if r.published_for} == {"last"}
    with pytest.raises(ScenarioError, match=r"node 'pump'|override 'pump.k'"):
        simulate(load_scenario("lag"), overrides={"pump.k": 1.0})
    with pytest.raises(ScenarioError, match="duration"):
        simulate("lag", duration=-1.0)
