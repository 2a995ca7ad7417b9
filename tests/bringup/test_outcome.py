"""The result of a falsification: in words, as data, and as scenario files that can be run again."""

import math
from pathlib import Path

import pytest
import yaml
from conftest import make_scenario
from expected_text import check_expected, page_lines
from softrig_bringup.falsify import engine, outcome as outcome_module
from softrig_bringup.falsify.definition import Falsification
from softrig_bringup.falsify.engine import Outcome, _requirements
from softrig_bringup.falsify.outcome import _standing_alone, content, scenario_file, verdict
from softrig_bringup.falsify.page import history, lead
from softrig_bringup.falsify.search import SearchResult
from softrig_bringup.falsify.space import parse, space_of
from softrig_bringup.falsify.words import number, shown
from softrig_bringup.page.html import page as make_page
from softrig_bringup.study.work import LARGE
from softrig_core import ScenarioError, load_scenario

X = "lag/state/x/position"
LAG = """
title: Lag
system: lag
source: none
duration: 0.5
nodes:
  plant: {package: faultrig, executable: plant}
  source: {package: faultrig, executable: source}
  gain: {package: faultrig, executable: gain}
shared: {state: lag/state/x/position}
faults: {noise: {link: lag/state -> gain, kind: noise, value: [0.1]}}
figures: {last: {function: final_value, arguments: {signal: lag/state/x/position}}}
expect: {last: at most 0.4}
requirements: {low: always state <= 0.3}
plots: [{title: Both, signals: {lag/state/x: state, lag/state/noise/x: seen}}]
"""


@pytest.fixture
def space(tmp_path, monkeypatch):
    (tmp_path / "lag.yaml").write_text(LAG)
    monkeypatch.setenv("SOFTRIG_SCENARIOS", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    return space_of(load_scenario("lag"), [parse("gain.k", "1..4"), parse("lag/command/u/effort+", "-1..1*3")])


CHANGES = {"gain.k": 3.0000000000001, "profile_1.points": [0.1234567, -1.0, 1.0]}


def match_of(space, *, least=-0.25, corners=-0.125, small=True, case=True, broken=()):
    violated = least < 0.0
    scenario = space.scenario
    less = scenario.having(faults={n: f.model_dump() for n, f in scenario.faults.items() if n != "noise"})
    seen = SearchResult(least, (0.5,) * 4, 7, corners, [1.0, least])
    return Outcome(
        space=space, names=("low", "last"), nominal={"low": 0.2, "last": LARGE}, content={},
        worst={"low": least, "last": None} if case else {}, search=seen, case=(scenario, CHANGES) if case else None,
        small=(less, {"gain.k": 2.5}) if violated and small else None,
        small_margins={"low": -0.01, "last": -LARGE} if violated and small else {},
        shrinking=23 if violated else 0, broken=list(broken),
    )  # fmt: skip


def task(**more):
    return Falsification(name="demo", scenario="lag", over={"gain.k": "1..4"}, **more)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({}, "violated: low, least margin -0.25 (corners alone: -0.125); made small in 23 more runs"),
        ({"least": 0.125, "corners": 0.5}, "no violation in 7 runs; least margin 0.125 (corners alone: 0.5), at"),
        ({"least": 0.0, "corners": math.inf}, "no violation in 7 runs; least margin 0 (no corners asked), at"),
        ({"case": False, "least": math.inf}, "none of 7 runs could be judged"),
    ],
)
def test_the_result_is_reported_in_one_line(space, keys, words):
    assert verdict(match_of(space, **keys)) == words


@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize(
    ("margins", "violated"),
    [({"low": -2.0, "last": 0.0}, ("low",)), ({"low": -2.0, "last": -1e-9}, ("low", "last")),
     ({"low": 0.0, "last": 1.0}, None), ({"low": 1.0, "last": -1.0}, ("last",))],
)  # fmt: skip
def test_a_violation_is_reduced_and_a_case_that_just_holds_is_not(
    space, tmp_path, monkeypatch, margins, violated, first
):
    asked, point = [], (0.5, 0.0, 0.5, 1.0)

    class Rows:
        def __init__(self, *arguments):
            asked.append(arguments[2:])

        def __enter__(self):
            return self

        def __exit__(self, *error):
            pass

        def rows(self, works):
            asked.append(works)
            return [
                {"number": k, "figures": margins, "overrides": {"gain.k": 2.5}, "error": "gone" * (k > 0)}
                for k, _ in enumerate(works)
            ]

    def searched(groups, measure, budget, **more):
        asked.append((groups, budget, more))
        return SearchResult(min(measure([point, (1.0,) * 4])), point, 2)

    for name, what in {
        "Batch": Rows, "Log": lambda *words: words, "search": searched, "trial": lambda *words, **more: words,
        "run": lambda work: {"figures": {"small": 1.0}}, "_violates": lambda case, names: asked.append(names) or True,
        "shrink": lambda space, changes, violates, budget: (violates("case") and ("small", changes), budget),
        "is_suspect": lambda rig: False,
    }.items():  # fmt: skip
        monkeypatch.setattr(engine, name, what)
    prepared = engine.Prepared(space, ("low", "last"), {"low": 4.0, "last": 0.5}, {"words": 1})
    reported = engine.falsify(task(first=first, budget=9, seed=3), prepared, tmp_path, workers=2, scheduler="x")
    workers, search, works, *small = asked
    assert workers == (2, "x")
    enough = 0.0 if first else -math.inf
    assert search == ([1, 3], 9, {"seed": 3, "sampler": "cmaes", "enough": enough})
    assert [(work[1], work[2], work[3:]) for work in works] == [
        (space.overrides(p), ("low", "last"), (k, 9)) for k, p in enumerate((point, (1.0,) * 4))
    ]
    assert reported.search.least == min(margins["low"] / 4.0, margins["last"] / 0.5)
    assert small == ([violated] if violated else [])
    assert (reported.small, reported.small_margins, reported.shrinking) == (
        (("small", {"gain.k": 2.5}), {"small": 1.0}, 100) if violated else (None, {}, 0)
    )
    assert (reported.case, reported.worst, reported.broken) == (
        (space.scenario, {"gain.k": 2.5}), margins, [({"gain.k": 2.5}, "gone")]
    )  # fmt: skip
    assert reported.violated == list(violated or ())


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "not judged"), (LARGE, "holds"), (-LARGE, "violated"), (math.inf, "holds"), (0.9 * LARGE, "9e+299"),
     (-0.123456789, "-0.123457"), (0.0, "0")],
)  # fmt: skip
def test_a_margin_is_a_number_or_a_word(value, text):
    assert number(value) == text


def test_changes_are_shown_with_few_digits():
    assert [shown(v) for v in (1.00000000001, 2, [0.12345678, 1.0])] == ["1", "2", "[0.123457, 1]"]


@pytest.mark.parametrize("name", ["violated", "holds", "none"])
def test_the_outcome_is_printed_as_expected(space, name, capsys, monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    keys = {
        "violated": {"broken": [({"gain.k": 1.0}, "node gain: gone"), ({}, "other")]},
        "holds": {"least": 0.125},
        "none": {"case": False, "least": math.inf},
    }[name]
    files = {"worst": Path("out/demo_worst.yaml")} if name == "violated" else {}
    outcome_module.print_outcome(task(), match_of(space, **keys), Path("out"), files)
    check_expected(f"falsified/{name}", [line.rstrip() for line in capsys.readouterr().out.splitlines()])


def test_the_outcome_as_data_is_complete(space):
    reported = content(task(seed=3, sampler="tpe"), match_of(space, broken=[({"gain.k": 1.0}, "gone")]))
    assert reported == {
        "falsification": "demo", "scenario": "lag", "seed": 3, "sampler": "tpe", "over": {"gain.k": "1..4"},
        "requirements": ["low", "last"], "runs": 7, "least": -0.25, "least_at_corners": -0.125, "violated": ["low"],
        "nominal": {"low": 0.2, "last": LARGE}, "worst": {"low": -0.25, "last": None},
        "small": {"low": -0.01, "last": -LARGE}, "changes": CHANGES, "small_changes": {"gain.k": 2.5},
        "broken": [{"changes": {"gain.k": 1.0}, "error": "gone"}], "trace": [1.0, -0.25],
        "not_judged": [], "published_for": "",
    }  # fmt: skip
    nothing = content(task(), match_of(space, case=False, least=math.inf))
    assert (nothing["changes"], nothing["small_changes"], nothing["worst"], nothing["small"]) == ({}, {}, {}, {})


def test_a_case_is_a_scenario_file_that_lists_its_changes(space, tmp_path):
    """A case of a scenario by name extends it: parameters of nodes, faults with their own, and which of them are
    removed.
    """
    outcome = match_of(space)
    text = scenario_file(task(seed=3), "worst", outcome.case, outcome)
    assert text.startswith("# Found by: softrig falsify demo; 2 runs, seed 3.\nextends: lag\n")
    worst, small = (yaml.safe_load(scenario_file(task(), kind, case, outcome)) for kind, case in (
        ("worst", outcome.case), ("small", outcome.small)))  # fmt: skip
    assert worst["title"] == "Lag: low, worst case found"
    assert (worst["seed"], worst["duration"], worst["nodes"]) == (
        0, 0.5, {"gain": {"parameters": {"k": 3.0000000000001}}}
    )  # fmt: skip
    assert worst["faults"]["profile_1"]["points"] == [0.1234567, -1.0, 1.0]
    assert worst["faults"]["noise"]["value"] == [0.1]
    assert "plots" not in worst
    assert (worst["requirements"], worst["expect"]) == (
        {"low": {"formula": "always state <= 0.3"}},
        {"last": {"at_most": 0.4}},
    )
    assert small["title"] == "Lag: low, small case found"
    assert small["faults"]["noise"] is None  # it switches off the noise of the scenario that it extends
    assert small["nodes"] == {"gain": {"parameters": {"k": 2.5}}}
    for kind, case in (("worst", outcome.case), ("small", outcome.small)):
        loaded = _standing_alone(scenario_file(task(), kind, case, outcome), tmp_path / "x.yaml")
        wanted = case[0].changed(overrides=case[1])
        assert (loaded.nodes, loaded.faults, loaded.requirements) == (wanted.nodes, wanted.faults, wanted.requirements)
    held = match_of(space, least=0.5)
    assert yaml.safe_load(scenario_file(task(), "worst", held.case, held))["title"] == (
        "Lag: least margin, worst case found"
    )


def test_a_case_of_a_file_is_written_completely(space, tmp_path):
    outcome = match_of(space)
    whole = task().model_copy(update={"scenario": str(tmp_path / "gone.yaml")})
    text = scenario_file(whole, "worst", outcome.case, outcome)
    reported = yaml.safe_load(text)
    assert "extends" not in reported
    assert {"name", "expect", "claims"}.isdisjoint(reported)
    assert reported["nodes"]["plant"]["executable"] == "plant"
    assert (reported["title"], list(reported["faults"])) == ("Lag: low, worst case found", ["noise", "profile_1"])
    assert max(map(len, text.splitlines())) <= 112
    loaded = _standing_alone(text, tmp_path / "x.yaml")
    assert loaded.faults["profile_1"].model_dump()["points"] == [0.1234567, -1.0, 1.0]


def test_the_requirements_of_a_scenario_that_can_be_searched_are_as_expected():
    nodes = {"plant": "plant", "source": "source", "gain": "gain"}
    figures = {n: {"function": "final_value", "arguments": {"signal": X}} for n in ("most", "least", "both", "none")}
    judged = make_scenario(
        nodes, figures=figures, expect={"most": "at most 1", "least": "at least 0", "both": "0.5 +- 0.1"},
        shared={"state": X}, requirements={"low": "always state <= 0.3", "high": "always state <= 3"},
    )  # fmt: skip
    bare = make_scenario(nodes, figures=figures, expect={"most": "at most 1"})
    assert _requirements(judged, []) == ("low", "high")
    assert _requirements(judged, ["high", "most", "least"]) == ("high", "most", "least")
    assert _requirements(bare, ["most"]) == ("most",)
    unbound = "no bound that a run could violate; it needs an entry expect: "
    for scenario, wanted, text in (
        (bare, [], "test has no requirements; it needs an entry requirements: NAME: FORMULA, or --requirement FIGURE "
                   "with an expected bound"),
        (judged, ["both"], f"test: figure both has an expectation on both sides, {unbound}both: at most NUMBER "
                          "(or at least NUMBER)"),
        (judged, ["none"], f"test: figure none has no expectation, {unbound}none: at most NUMBER (or at least NUMBER)"),
        (judged, ["lo"], "test has no requirement 'lo' (did you mean 'low'?); it has low, high, most, least"),
        (make_scenario(nodes), ["lo"], "test has no requirement 'lo'; it has none"),
    ):  # fmt: skip
        with pytest.raises(ScenarioError) as refused:
            _requirements(scenario, wanted)
        assert str(refused.value) == text


@pytest.mark.parametrize(
    ("name", "keys"), [("violated", {}), ("held", {"least": 0.125}), ("unjudged", {"case": False})]
)
def test_a_page_begins_with_question_and_answer_as_expected(name, keys, space):
    over = {"gain.k": "1..4", "lag/command/u/effort+": "-1..1*3"}
    task = Falsification(name="late", title="Late", scenario="lag", over=over, budget=9)
    files = {"worst": Path("out/late_worst.yaml")} if name == "violated" else {}
    body = lead(task, match_of(space, **keys), {"low": "m", "last": "m"}, files)
    check_expected(f"falsified/page_{name}", page_lines(make_page("Late", body)))


def test_the_history_of_a_search_is_the_least_margin_so_far(space):
    (ax,) = history(match_of(space)).axes
    (margins,) = ax.lines
    (violated,) = (item for item in ax.items if type(item).__name__ == "Rule")
    assert (margins.x.tolist(), margins.y.tolist()) == ([1.0, 2.0], [1.0, -0.25])
    assert (violated.axis, violated.at) == ("y", 0.0)
