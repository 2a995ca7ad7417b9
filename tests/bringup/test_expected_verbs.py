"""What the verbs do and print: launches, linear views, golden bags, results, packages."""

import argparse
import importlib.util
import json
import math
import os
import re
import signal
from collections import namedtuple
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import softrig_nodes
from expected_text import check_expected
from pydantic import ValidationError
from setuptools.config.expand import canonic_data_files
from softrig_bringup import cli, launched
from softrig_bringup.cli import main, make_parser
from softrig_bringup.folder import ResultsFolder
from softrig_bringup.options.naming import folder_of
from softrig_bringup.pack import packed
from softrig_bringup.page.citations import Citation
from softrig_bringup.page.wiring import Node, Wire, Wiring
from softrig_bringup.plots.style import Style
from softrig_bringup.report.record import RunRecord
from softrig_bringup.results import page as results_page, results
from softrig_bringup.run import notebook, part, run as runs
from softrig_bringup.terminal import completion, progress
from softrig_bringup.verbs import (
    animate,
    check,
    golden,
    linear,
    new,
    plot_verb,
    run_verb,
    set_verb,
    view_verb,
)
from softrig_bringup.view import rviz as viewer
from softrig_core import (
    Block,
    NoOperatingPoint,
    Recording,
    Run,
    RunError,
    ScenarioError,
    load_scenario,
    rig_of,
    simulate,
)
from softrig_core.scenario.scenario import Draft
from softrig_core.verdict.findings import Finding
from softrig_nodes.processes.placement import Listener, Placement

LAG = """
title: First-order lag
system: lag
source: none
duration: 0.05
timeout: 20.0
nodes:
  plant: {package: faultrig, executable: plant}
  source: {package: faultrig, executable: source}
  gain: {package: faultrig, executable: gain}
figures:
  last: {function: final_value, arguments: {signal: lag/state/x/position}, unit: m}
expect: {last: between -10 and 10}
"""


@pytest.fixture
def lag(tmp_path, monkeypatch):
    (tmp_path / "lag.yaml").write_text(LAG)
    monkeypatch.setenv("SOFTRIG_SCENARIOS", str(tmp_path))
    monkeypatch.delenv("SOFTRIG_COMMAND", raising=False)
    monkeypatch.chdir(tmp_path)
    return tmp_path


# a launch -------------------------------------------------------------------------------------------------------------


@pytest.fixture
def launch(lag, monkeypatch):
    """Makes a launch of the lag; nothing is started, and its folders are in the test's folder."""
    logs = iter(range(100))
    monkeypatch.setattr(launched, "mkdtemp", lambda prefix: str(lag / f"log{next(logs)}"))
    monkeypatch.setattr(launched, "remove_leftovers", lambda: None)
    monkeypatch.setattr(launched, "join_domain", lambda domain: None)
    monkeypatch.setattr(launched, "atexit", SimpleNamespace(register=lambda *what, **how: None))
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", "")
    monkeypatch.setenv(launched.PARENT, "")

    def make(**values):
        for k in range(10):
            (lag / f"log{k}").mkdir(exist_ok=True)
        return launched.Launched({"scenario": "lag"} | values)

    return make


KEPT = ("mode", "seed", "start_timeout", "frames", "status", "shard")


def parameters(process):
    """The parameters file of the run that a launch makes of its arguments."""
    text = Path(process.parameters[0]).read_text()
    gathered = dict(line.strip().split(": ", 1) for line in text.splitlines() if ": " in line)
    kept = [f"{k} {gathered[f'run.{k}']}" for k in KEPT if f"run.{k}" in gathered]
    return ", ".join([*kept, *(["waits for a recorder"] if "rosbag2_recorder" in text else [])])


LAUNCHES = {
    "as it is": {},
    "in lockstep": {"mode": "lockstep", "seed": "4"},
    "in a namespace": {"namespace": "/a/b/", "record": "all", "out": "kept"},
    "judged": {"judge": "true", "frames": "false", "wait_for": "rosbag2_recorder other"},
    "with somebody else's plant": {"external": "plant"},
    "in one process": {"place": "container", "namespace": "a"},
    "with a viewer": {"use_rviz": "true", "mode": "lockstep"},
    "with a viewer in a namespace": {"use_rviz": "true", "namespace": "a"},
}


def test_the_processes_of_a_launch_are_as_expected(launch, lag):
    messages = []
    for name, values in LAUNCHES.items():
        made = launch(**values)
        messages.append(
            f"{name}: {made._placement}, keeps {made._record}, judges {made._judge}, {made._running} running"
        )
        for p in made.processes:
            about = [
                f"{p.package}/{p.executable}",
                p.name or "no name",
                f"in {p.namespace}" if p.namespace else "",
                p.kind,
            ]
            more = f"{dict(p.remappings)} {sorted(p.variables)} {' '.join(p.arguments)}"
            messages.append(f"  {' '.join(filter(None, about))} {more}".rstrip())
            if p.kind == "rig" and p.parameters:
                messages.append(f"    {parameters(p)}")
    check_expected("verbs/launched", (line.replace(str(lag), "HERE") for line in messages))


@pytest.mark.parametrize(
    ("values", "ends", "text", "concluded"),
    [
        ({}, [("a", 0, False), ("b", 0, False), ("c", 0, False)], ["", "", ""], None),
        ({"judge": "true"}, [("a", 0, False), ("b", 0, False), ("c", 0, False)], ["", "", "judged: status 1"], ("", 0)),
        ({"record": "true"}, [("a", 0, False), ("b", 0, False), ("c", 0, False)], ["", "", ""], ("", 0)),
        (
            {"judge": "true"},
            [("a", 0, False), ("b", -9, False), ("c", 1, True)],
            ["", "b ended with status -9", ""],
            ("b ended with status -9", 0),
        ),
        (
            {"judge": "true"},
            [("a", 0, True), ("b", 3, True), ("c", 0, True)],
            ["", "", "stopped by SIGINT at t = 0 s"],
            ("", signal.SIGINT),
        ),
        ({}, [("a", 0, False), ("b", 0, False), ("c", 4, False)], ["", "", "c ended with status 4"], None),
        ({}, [(name, 0, True) for name in "abc"], ["", "", f"stopped by SIGINT: {launched.UNASKED}"], None),
        ({}, [("a", 1, False), ("b", 0, True), ("c", 0, True)], ["a ended with status 1", "", ""], None),
    ],
)
def test_the_end_of_a_launch_is_the_end_of_its_last_process(launch, monkeypatch, values, ends, text, concluded):
    made, asked = launch(**values), []
    monkeypatch.setattr(launched, "gathered", lambda rig, log, names, prefix: (Recording(()), {}))
    monkeypatch.setattr(launched, "tripped", lambda rig, nodes: {})
    monkeypatch.setattr(launched, "gaps", lambda rig, recording: "")
    monkeypatch.setattr(run_verb, "conclude", lambda options, run, folder: asked.append((run.error, run.stopped)) or 1)
    assert [made.ended(*end) for end in ends] == text
    assert asked == ([concluded] if concluded else [])


def test_a_lockstep_launch_with_gaps_or_a_trip_ends_with_its_status(launch, monkeypatch):
    monkeypatch.setattr(
        launched, "gathered", lambda rig, log, names, prefix: (Recording(()), {"gain": {"error": "no answer"}})
    )
    monkeypatch.setattr(launched, "tripped", lambda rig, nodes: {"plant": "too hot"})
    monkeypatch.setattr(launched, "gaps", lambda rig, recording: "u: a gap")
    monkeypatch.setattr(run_verb, "too_slow", lambda options, rig, nodes, container: f"too slow, {container}")
    errors = []
    monkeypatch.setattr(run_verb, "conclude", lambda options, run, folder: errors.append(run.error) or 0)
    gathered = {}
    for mode in ("lockstep", "realtime"):
        made = launch(mode=mode, judge="true")
        gathered[mode] = [made.ended(n, 0, False) for n in "abc"][-1]
    assert gathered == {"lockstep": "plant: too hot", "realtime": "too slow, place:=container"}
    made = launch(judge="true")
    [made.ended(*end) for end in (("a", 2, False), ("b", 0, False), ("c", 0, False))]
    assert errors == ["u: a gap", "", "a ended with status 2; gain: no answer"]


# a viewer -------------------------------------------------------------------------------------------------------------


def shape(value):
    """JSON in short: lists and maps unchanged, one line for each entry of the outer ones."""
    return json.dumps(value).replace("rviz_default_plugins/", "").replace("rviz_common/", "")


def test_the_layout_file_of_a_viewer_is_as_expected():
    """For a rig with a robot, one that draws markers, and one with neither."""
    plain = type("Plain", (), {"markers": Block.markers})
    robot = type("Robot", (), {"scene": staticmethod(lambda params: "a robot"), "markers": Block.markers})
    drawn = type("Drawn", (), {"markers": "its own"})
    messages = []
    for classes, namespace in (((plain, robot, drawn), "/a"), ((robot,), ""), ((plain,), "")):
        members = [SimpleNamespace(name=f"node_{k}", block_class=c, params=None) for k, c in enumerate(classes)]
        rig = SimpleNamespace(members=members)
        manager = json.loads(viewer.rviz_file(rig, namespace))
        displays = manager["Visualization Manager"].pop("Displays")
        messages += [f"{len(classes)} nodes in {namespace!r} {viewer.seen(rig)}", *(f"  {shape(d)}" for d in displays)]
    messages.append(shape(manager))
    check_expected("verbs/viewer", messages)


# poles and margins ----------------------------------------------------------------------------------------------------

Margins = namedtuple("Margins", "gain gain_down phase delay disk crossover")
Mode = namedtuple("Mode", "pole rate shares")
MATRIX = SimpleNamespace(A=np.eye(2), B=np.ones((2, 1)), C=np.ones((1, 2)), D=np.zeros((1, 1)))


def view(n=2, **more):
    modes = [
        Mode(complex(0.9 - 0.1 * k, 0.25 * (k == 1)), complex(-1.0 - k, 0.5 * (k == 1)), {"a": 0.75, "b": 0.25})
        for k in range(n)
    ]
    opened = SimpleNamespace(
        state_labels=["x"], A=np.array([[0.5]]), B=np.ones((1, 1)), C=np.ones((1, 1)), D=np.zeros((1, 1))
    )
    about = {
        "rig": "x",
        "at": 2.5,
        "period": 0.01,
        "error": 1e-9,
        "worst": "a",
        "state_error": 0.5,
        "output_errors": {"y": 2e-6},
        "left_out": {"z": "turns"},
        "stable": True,
        "values": {"u": 1.5},
        "units": {"u": "V"},
        "states": ["a", "b"],
        "inputs": ["u"],
        "outputs": ["y"],
        "modes": modes,
        "link": "u",
        "opened": opened,
        "loop_poles": np.array([0.5 + 0.25j]),
        "margins": Margins(2.5, 0.0, math.pi / 4, 0.0125, 0.75, 31.4159),
        **vars(MATRIX),
        "plot": lambda: SimpleNamespace(savefig=lambda path, dpi: Path(path).write_text(str(dpi))),
    }
    return SimpleNamespace(**about | more)


def test_poles_and_margins_are_printed_as_expected(monkeypatch, capsys, tmp_path):
    monkeypatch.setenv("COLUMNS", "400")  # wide enough for a long folder name
    messages, asked = [], []
    cases = {
        "a loop": ({}, []),
        "nine modes, opened where it is unstable": (
            {"n": 9, "stable": False, "margins": Margins(math.inf, 0.25, math.inf, math.inf, 1.0, 0.0)},
            [],
        ),
        "eight modes": ({"n": 8, "link": ""}, []),
        "not opened, not the rig": ({"n": 0, "link": "", "state_error": 0.51}, []),
        "written": (
            {},
            [
                "--out",
                str(tmp_path / "lin"),
                "--at",
                "2",
                "--open",
                "u",
                "--input",
                "i",
                "--output",
                "o",
                "--set",
                "a.k=1",
            ],
        ),
        "written, not opened": ({"link": ""}, ["--out", str(tmp_path / "other")]),
    }
    for name, (more, words) in cases.items():
        monkeypatch.setattr("softrig_bringup.options.grammar.read_draft", lambda name: Draft(name, Path(name), {}))
        monkeypatch.setattr(
            linear, "linear_view", lambda *what, more=more, **how: asked.append((what, how)) or view(**more)
        )
        assert main(["linearise", "x", *words]) == 0
        messages += [
            name,
            *(f"  {line.rstrip()}" for line in capsys.readouterr().out.replace(str(tmp_path), "HERE").splitlines()),
        ]
    check_expected("verbs/linear", messages)
    assert asked[0] == (("x", None), {"at": None, "inputs": None, "outputs": None, "overrides": {}})
    assert asked[4] == (("x", "u"), {"at": 2.0, "inputs": ["i"], "outputs": ["o"], "overrides": {"a.k": 1}})
    assert (tmp_path / "lin/linear.png").read_text() == "120"
    content = json.loads((tmp_path / "lin/linear.json").read_text())
    assert content["margins"] == {
        "gain": 2.5,
        "gain_down": 0.0,
        "phase": math.pi / 4,
        "delay": 0.0125,
        "disk": 0.75,
        "crossover": 31.4159,
    }
    assert content["opened"] == {
        "states": ["x"],
        "A": [[0.5]],
        "B": [[1.0]],
        "C": [[1.0]],
        "D": [[0.0]],
        "poles": [[0.5, 0.25]],
    }
    assert content["closed"] == {
        "states": ["a", "b"],
        "inputs": ["u"],
        "outputs": ["y"],
        "A": [[1.0, 0.0], [0.0, 1.0]],
        "B": [[1.0], [1.0]],
        "C": [[1.0, 1.0]],
        "D": [[0.0]],
    }
    assert content["modes"][1] == {"pole": [0.8, 0.25], "rate": [-2.0, 0.5], "states": {"a": 0.75, "b": 0.25}}
    assert linear.numbers(view(margins=Margins(math.inf, 0, 1, 1, 1, 1)))["margins"]["gain"] is None
    assert "margins" not in json.loads((tmp_path / "other/linear.json").read_text())
    assert not (tmp_path / "other/linear.png").exists()


def test_an_operating_point_is_printed_with_what_drifts(monkeypatch, capsys):
    point = SimpleNamespace(
        signals={"u": 1.23456789012},
        states={"a": -0.5, "b": 2.0},
        drifting={"b": 0.125},
        units={"u": "V", "b": "rad"},
        stable=False,
        slowest=1.0234567,
        steps=42,
        moved=0.00123,
    )
    monkeypatch.setattr(linear, "steady", lambda *what, **how: point)
    assert main(["steady", "x"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "u\t1.23456789 V",
        "a\t-0.5",
        "b\t2 rad\tdrifts by 0.125 a second",
        "unstable, slowest pole 1.02346; 42 steps; a run from there moves by 0.001",
    ]

    def nowhere(*what, **how):
        raise NoOperatingPoint("none")

    monkeypatch.setattr(linear, "steady", nowhere)
    assert main(["steady", "x"]) == 1
    assert capsys.readouterr().err == "softrig: none\n"


# golden bags ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("recorded", "line"),
    [
        ({}, "the same functions and packages"),
        ({"python": "3.11.1"}, "the same functions and packages"),  # the rig has shipped blocks only
        ({"numpy": "0"}, "other packages"),
        ({"math": "0", "numpy": "0"}, "other functions of the C library"),
        ({"machine": "0", "math": "0"}, "another architecture"),
    ],
)
def test_what_affects_the_bits_decides_how_a_golden_bag_is_compared(monkeypatch, recorded, line):
    now = {"machine": "x", "math": "a", "numpy": "1", "python": "3.13.0"}
    monkeypatch.setattr(golden, "versions", lambda: now)
    recipe = golden.Recipe(scenario="dc_motor_smc_b2", duration=0.1, made_with=now | recorded)
    result = golden.Golden(Path("x"), recipe, rig_of("dc_motor_smc_b2"))
    changed = {k: (v, now[k]) for k, v in recorded.items() if k != "python"}
    assert result.others == changed
    text = ", ".join(f"{k} {a} there, {b} here" for k, (a, b) in result.others.items())
    assert result.how == (f"within tolerances: {text}" if changed else "byte for byte")
    assert golden.line(result.others) == line
    assert golden.line(["python"]) == "another Python, and blocks of your own"


def test_versions_of_python_are_distinguished_by_the_sum_function():
    assert [golden._era(v) for v in ("3.11.9", "3.12.0", "3.13.1", "3.14.0", "4.0", "unknown")] == [0, 1, 1, 2, 2, -1]


def test_the_sensitivity_of_a_rig_to_the_last_bits_is_ten_times_the_largest_difference_of_each_topic(monkeypatch):
    rig = rig_of("dc_motor_smc_b2", duration=0.01)
    made = golden.Golden(Path("x"), golden.Recipe(scenario="dc_motor_smc_b2", duration=0.01, seed=2), rig)
    plain, asked = simulate(rig, seed=2).recording, []

    def simulated(of, seed, overrides=None):
        asked.append(overrides)
        return SimpleNamespace(recording=plain)

    monkeypatch.setattr(golden, "simulate", simulated)
    assert made.sensitivity() == {}
    none, up, down = asked
    assert none is None
    plant = {n: v for n, v in golden.flatten(rig.clock.params).items() if isinstance(v, float) and v and n != "period"}
    assert up == {f"dc_motor_plant.{n}": v * (1 + 4 * 2.0**-52) for n, v in plant.items()}
    assert down == {f"dc_motor_plant.{n}": v * (1 - 4 * 2.0**-52) for n, v in plant.items()}
    shifts = {(4.0, "a/x"): 1e-4, (4.0, "a/y"): -2.34e-4, (-4.0, "a/x"): 3e-5, (4.0, "b/x"): 1e-11,
              (-4.0, "b/x"): 9.9e-11}  # fmt: skip

    class Shifted(dict):
        def __init__(self, bits):
            super().__init__(
                {
                    n: SimpleNamespace(x=np.zeros(3) + [0, shifts.get((bits, n), 0.0), np.nan])
                    for n in ("a/x", "a/y", "b/x")
                }
            )

    monkeypatch.setattr(golden, "Signals", Shifted)
    monkeypatch.setattr(golden, "topic_of", lambda name, topics: name[0])
    monkeypatch.setattr(golden.Golden, "rerun", lambda self: 0.0)
    monkeypatch.setattr(golden.Golden, "shaken", lambda self, bits: bits)
    assert made.sensitivity() == {"a/*": golden.Allowed(absolute=2.3e-3)}


def test_defaults_of_a_recipe():
    recipe = golden.Recipe(scenario="x", duration=1.0)
    assert recipe.model_dump() == {
        "scenario": "x",
        "duration": 1.0,
        "seed": 0,
        "default": {"absolute": 1e-9, "relative": 1e-9},
        "tolerances": {},
        "elsewhere": {},
        "why": "",
        "made_with": {},
    }
    for name in ("absolute", "relative"):
        assert getattr(golden.Allowed(**{name: 0.0}), name) == 0.0
        with pytest.raises(ValidationError, match="greater than or equal to 0"):
            golden.Allowed(**{name: -1e-9})


# results --------------------------------------------------------------------------------------------------------------


def finding(key, holds=True, **more):
    return Finding(scenario="lag", key=key, text=key, where="W", verdict="reproduced", holds=holds, measured_text="1",
                   asked="2", unit="m", **more)  # fmt: skip


def measured(name, error="", missed=(), kept=False, seconds=0.0):
    return results.Measured(name, {}, {}, [*missed], error, kept, seconds)


@pytest.mark.parametrize(
    ("rows", "runs_of", "status", "text"),
    [
        ([finding("a")], [measured("x")], 0, []),
        ([finding("a")], [measured("x", missed=["f", "g"])], 1, ["x: missed: f, g"]),
        (
            [finding("a", False)],
            [measured("x", "gone"), measured("y", missed=["f"])],
            3,
            ["x: gone", "y: missed: f", "lag: claim a: the verdict reproduced does not hold: measured 1, 2 m"],
        ),
        (
            [finding("a"), finding("b", None)],
            [measured("x", kept=True)],
            1,
            ["lag: claim b: the verdict reproduced cannot be checked: measured 1, 2 m"],
        ),
    ],
)
def test_the_status_of_claims_is_the_worst_of_its_claims_and_runs(
    lag, monkeypatch, capsys, rows, runs_of, status, text
):
    pages = []
    monkeypatch.setattr(results, "claiming", lambda systems: ["a scenario"])
    monkeypatch.setattr(results, "gather", lambda scenarios, workers, keep: (rows, {m.name: m for m in runs_of}))
    monkeypatch.setattr(results, "left_out", lambda systems: "more")
    monkeypatch.setattr(results, "study_findings", lambda systems, out, workers: (["a study"], [finding("c")]))
    monkeypatch.setattr(
        results,
        "html",
        lambda scenarios, result, without, out: pages.append((scenarios, len(result), without, out)) or "h",
    )
    monkeypatch.setattr(
        results, "markdown", lambda scenarios, result, without: pages.append((scenarios, len(result), without)) or "m"
    )
    modes = []
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: modes.append((str(path), mode)) or access(path, mode))
    assert main(["check", "--claims", "lag", "two", "--out", "o", "--json", "j.json"]) == status
    assert ("o", os.W_OK | os.X_OK) in modes
    printed = capsys.readouterr()
    assert printed.err.splitlines() == [f"softrig: {line}" for line in text]
    kept = ["1 of 1 runs are kept: neither code nor scenario has changed"] if runs_of[0].kept else []
    assert printed.out.splitlines() == [
        *kept,
        f"{results_page.counts(rows)}; more",
        "wrote o/results_lag_two.html and o/results_lag_two.md",
    ]
    assert [len(json.loads(Path("j.json").read_text())), (lag / "o/results_lag_two.html").read_text()] == [
        len(rows),
        "h",
    ]
    assert main(["check", "--claims", "--studies", "--out", "o"]) == status
    assert pages == [
        (["a scenario"], len(rows), "more", Path("o")),
        (["a scenario"], len(rows), "more"),
        (["a scenario", "a study"], len(rows) + 1, "", Path("o")),
        (["a scenario", "a study"], len(rows) + 1, ""),
    ]


def test_claims_are_cases_of_their_scenario_and_a_broken_run_is_an_error():
    other = replace(finding("c"), scenario="study_x")
    result = results.suites(
        [finding("a"), finding("b", False), other],
        {"lag": measured("lag", seconds=2.5), "gone": measured("gone", "no", seconds=1.0)},
    )
    assert [(s.name, s.seconds, s.error, [(c.name, c.failure, c.text) for c in s.cases]) for s in result] == [
        (
            "lag",
            2.5,
            "",
            [
                ("claim a", "", "reproduced: 1 m"),
                ("claim b", "the verdict reproduced does not hold: measured 1, 2 m", "reproduced: 1 m"),
            ],
        ),
        ("study_x", 0.0, "", [("claim c", "", "reproduced: 1 m")]),
        ("gone", 1.0, "no", []),
    ]


def test_a_run_is_cached_by_its_inputs(lag, monkeypatch):
    monkeypatch.setattr(results, "illustrate", lambda run, folder: (folder.path / "report.html").write_text(""))
    keep = lag / "kept"
    first = results.measure(("lag", keep))
    assert (first.name, first.kept, first.error, first.missed, [*first.figures], first.units) == (
        "lag",
        False,
        "",
        [],
        ["last"],
        {"last": "m"},
    )
    again = results.measure(("lag", keep))
    assert again == first._replace(kept=True)
    assert results._stored(keep / "lag", "another key") is None
    (keep / "lag/report.html").unlink()
    assert not results.measure(("lag", keep)).kept
    assert results.measure(("no_such", keep)).error.startswith("scenario 'no_such' is unknown")
    assert not (keep / "no_such").exists()
    belongs = results._belongs(SimpleNamespace(system="dc_motor", name="x_smc_b2"), "x_smc")
    assert (belongs, results._belongs(SimpleNamespace(system="dc_motor", name="x_smc2"), "x_smc")) == (True, False)


# films ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("start", "end", "length", "window"),
    [
        (0.0, None, 2.0, (0.0, 2.0)),
        (0.5, 1.0, 2.0, (0.5, 1.0)),
        (0.5, 3.0, 2.0, (0.5, 2.0)),
        (1.0, 1.0, 2.0, None),
        (2.0, None, 2.0, None),
        (0.0, None, 0.0, None),
    ],
)
def test_a_film_shows_a_part_of_its_run(start, end, length, window):
    if window is None:
        with pytest.raises(
            ScenarioError,
            match=rf"--from {start:g} s to .* s: expected a part of the run, which is {length:g} s long",
        ):
            animate._window(start, end, length)
    else:
        assert animate._window(start, end, length) == window


def test_a_film_of_a_scenario_simulates_no_longer_than_it_shows(monkeypatch, tmp_path, capsys):
    asked = []
    made = SimpleNamespace(duration=4.5678, frames=[1, 2], drawing=SimpleNamespace(rig=rig_of("induction_dtc_short")))
    monkeypatch.setattr(
        animate,
        "simulate",
        lambda rig, progress: asked.append((rig.scenario.duration, progress)) or SimpleNamespace(signals="s"),
    )
    monkeypatch.setattr(
        animate,
        "film",
        lambda drawing, signals, first, last, speed: asked.append((signals, first, last, speed)) or made,
    )
    monkeypatch.setattr(animate, "animated", lambda film: "x" * 20_000)
    monkeypatch.chdir(tmp_path)
    assert main(["draw", "animate", "induction_dtc_short"]) == 0
    assert (
        main(
            [
                "draw",
                "animate",
                "induction_dtc_short",
                "--from",
                "0.02",
                "--to",
                "0.05",
                "--speed",
                "0.5",
                "-o",
                "f.svg",
            ]
        )
        == 0
    )
    assert asked == [(0.1, True), ("s", 0.0, 0.1, None), (0.05, True), ("s", 0.02, 0.05, 0.5)]
    assert capsys.readouterr().out.splitlines() == [
        "induction_dtc_short.svg: 4.57 s, 2 frames, 0.02 MB",
        "f.svg: 4.57 s, 2 frames, 0.02 MB",
    ]
    monkeypatch.setattr("softrig_bringup.film.raster.pixels", lambda film, form: (b"p", f"reduced {form}"))
    assert animate.write(made, tmp_path / "f.gif") == "reduced gif"
    assert (tmp_path / "f.gif").read_bytes() == b"p"
    assert (animate.film_of.__defaults__, animate.write(made, tmp_path / "g.svg")) == ((0.0, None, None), "")


# a package to begin with ----------------------------------------------------------------------------------------------


@pytest.fixture
def taken(monkeypatch, tmp_path_factory):
    """An installed package, and an existing scenario."""
    installed = tmp_path_factory.mktemp("installed")
    (installed / "My_Tool-1.0.dist-info").mkdir()
    (installed / "My_Tool-1.0.dist-info" / "METADATA").write_text("Name: My-Tool\nVersion: 1.0\n")
    monkeypatch.syspath_prepend(installed)
    monkeypatch.setattr(new, "find", lambda name: Path("lag.yaml") if name == "lag" else None)


def test_a_new_package_is_as_expected(lag, taken, monkeypatch, capsys):
    """Its files, and the lines that describe it; in a checkout and without one."""
    messages = []
    for kind, command in ((None, None), ("law", "/s/softrig"), ("plant", None)):
        monkeypatch.setenv("SOFTRIG_COMMAND", command) if command else monkeypatch.delenv(
            "SOFTRIG_COMMAND", raising=False
        )
        name = f"my_{kind or 'rig'}"
        assert main(["new", name, *(["--only", kind] if kind else []), "--into", "here"]) == 0
        folder = lag / "here" / name
        messages += [f"{kind or 'both'}", *(f"  says {line}" for line in capsys.readouterr().out.splitlines())]
        for file in sorted(p for p in folder.rglob("*") if p.is_file()):
            messages.append(f"  {file.relative_to(folder)}{'' if file.stat().st_size else ', empty'}")
        texts = {p.name: p.read_text() for p in folder.rglob("*") if p.is_file()}
        messages += [f"  depends {line.strip()}" for line in texts["package.xml"].splitlines() if "exec_depend" in line]
        messages += [f"  {line.strip()}" for line in texts["setup.cfg"].splitlines() if ".main" in line]
        messages += [f"  {line.strip()}" for line in texts["README.md"].splitlines() if "softrig" in line]
        assert not [n for n, text in texts.items() if "$name" in text or "${" in text]
    check_expected("verbs/new", messages)
    assert new.first("/a") == "pip install /a && softrig"


def test_a_second_scenario_of_a_package_is_installed_with_it(lag, taken):
    """By setuptools as colcon runs it, and without an optional source."""
    folder = new.new_package("my_rig", lag / "x")
    second = folder / "scenarios" / "my_second.yaml"
    text = (folder / "scenarios" / "my_rig.yaml").read_text()
    second.write_text("".join(f"{line}\n" for line in text.splitlines() if not line.startswith("source:")))
    result = canonic_data_files({"scenarios": ["scenarios/*.yaml"]}, root_dir=folder)
    assert "share/my_rig/scenarios = scenarios/*.yaml" in (folder / "setup.cfg").read_text()
    assert result == [("scenarios", ["scenarios/my_rig.yaml", "scenarios/my_second.yaml"])]
    assert load_scenario(str(second)).source == ""


def test_names_of_packages_are_checked(lag, taken):
    for name in ("a", "ab", "a_1", "a1b2", "my_tools"):
        assert new.new_package(name, lag / "x") == lag / "x" / name
    bad = ("A", "1a", "a_", "a__b", "a-b", "", "_a", "é", "json", "test", "class", "numpy", "my_tool", "lag")
    for name in bad:
        with pytest.raises(ScenarioError, match=f"package name '{name}'"):
            new.new_package(name, lag / "x")
    for make in (Path.mkdir, lambda path: path.symlink_to("nowhere")):
        make(lag / "x" / (name := f"there_{make is Path.mkdir:d}"))
        with pytest.raises(ScenarioError, match="exists already; choose another name"):
            new.new_package(name, lag / "x")


# a run ----------------------------------------------------------------------------------------------------------------


def test_the_folder_of_a_run_is_as_expected(lag, monkeypatch, capsys):
    """A new one, one beside a folder that must stay, or a refusal; with the reason why an interrupted run cannot be
    made again.
    """
    rig, outside = (
        rig_of("lag"),
        rig_of(
            rig_of("lag").scenario.having(
                nodes={
                    n: e.model_copy(update={"external": n == "gain"}) for n, e in rig_of("lag").scenario.nodes.items()
                }
            )
        ),
    )
    messages = []

    def kept(name, once=("in real time",)):
        (lag / name).mkdir(parents=True)
        (lag / name / "metrics.json").write_text(json.dumps({"scenario": "lag", "mode": "m", "seed": 1, "once": once}))
        (lag / name / "softrig_files.json").write_text('["metrics.json", "softrig_files.json"]')

    def go(*words, of=rig):
        options = make_parser().parse_args(["run", *words])
        try:
            folder = run_verb.results_folder(options, of)
            listed = json.loads((folder.path / "softrig_files.json").read_text())
            messages.append(f"{' '.join(words)}: {folder.path}, list {listed}")
            folder.let_go()
        except ScenarioError as error:
            messages.append(f"{' '.join(words)}: refused: {error}")
        messages.extend(f"  {line}" for line in capsys.readouterr().err.splitlines())

    go("lag")
    go("lag", "--realtime")
    go("lag", "--out", "o", of=outside)
    kept("runs/lag-seed_1")
    kept("runs/lag-seed_1-2")
    kept("plain", ())
    go("lag", "--seed", "1")
    go("lag", "--seed", "1", "--force")
    kept("mine")
    go("lag", "--out", "mine")
    go("lag", "--out", "plain")
    go("--like", "mine")
    go("--like", "runs/lag-again")
    go("--like", "mine/bag", "--out", "mine")
    go("--from", "mine@0.5", "--out", "mine")
    go("--from", "mine@0.5", "--out", "else")
    held = ResultsFolder(lag / "held")
    held.hold()
    go("lag", "--out", "held")
    check_expected(
        "verbs/where",
        (line.replace(str(lag), "HERE").replace(f"process {os.getpid()}", "process N") for line in messages),
    )


def test_a_broken_a_stopped_and_an_incomplete_run_are_reported(lag, monkeypatch, tmp_path):
    rig, inprocess = rig_of("lag"), Placement("inprocess")
    done = runs.execute(rig, inprocess, tmp_path)
    assert (done.error, done.stopped, done.mode, done.epoch) == ("", 0, "inprocess", 0)
    assert done.wall_s > 0.0
    assert done.status["plant"]["native"] is not None
    assert done.recording.topics == simulate(rig).recording.topics

    def failing(error):
        def run(*_, **__):
            raise error

        monkeypatch.setattr(runs, "run_inprocess", run)
        return runs.execute(rig, inprocess, tmp_path)

    assert failing(RunError("gone")).error == "gone"
    assert (failing(KeyboardInterrupt()).stopped, failing(KeyboardInterrupt()).error) == (signal.SIGINT, "")
    monkeypatch.setattr(runs, "run_inprocess", lambda *_, **__: {})
    assert "first gap at t = 0 s" in runs.execute(rig, inprocess, tmp_path).error
    outcome = SimpleNamespace(
        recording=Recording((t, p.msgtype) for t, p in rig.topics.items()),
        status={"a": {}},
        epoch=7,
        error="",
        stopped=0,
    )
    asked = []
    monkeypatch.setattr(softrig_nodes, "run_processes", lambda *what: asked.append(what) or outcome)
    result = runs.execute(rig, Placement("processes", "realtime"), tmp_path)
    assert (result.error, result.epoch, result.status, result.mode) == (
        "",
        7,
        {"a": {}},
        "realtime",
    )  # without ticks none can be missed
    assert asked[0][:3] == (rig, 0, tmp_path)
    assert runs._plant_ticks(result) == 0  # the plant has published nothing
    result.status = {"plant": {"ticks": 5}}
    assert runs._plant_ticks(result) == 5
    assert "first gap" in runs.execute(rig, Placement("processes"), tmp_path).error
    outcome.stopped = 15
    assert (
        runs.execute(rig, Placement("processes"), tmp_path).error,
        runs.execute(rig, Placement("processes"), tmp_path).stopped,
    ) == ("", 15)


def test_a_part_of_a_rig_runs_on_one_machine(lag, monkeypatch, capsys):
    asked, outcome = [], SimpleNamespace(error="", stopped=0)
    monkeypatch.setattr(softrig_nodes, "run_processes", lambda *what: asked.append(what) or outcome)
    rig = rig_of("lag")
    words = ["run", "lag", "--only", "gain", "--domain", "7"]

    def go(*more):
        return part.run_part(rig, make_parser().parse_args([*words, *more]))

    assert go() == 0
    printed = capsys.readouterr().err.splitlines()
    assert printed[0] == "softrig: gain here, domain 7; elsewhere: plant, source"
    assert printed[1].startswith("softrig: recorded in runs/lag-gain/log; for a bag of the whole rig, copy")
    (of, seed, log, placement, listener) = asked[0]
    assert (of, seed, log, placement.only, placement.domain, placement.wait) == (
        rig,
        0,
        lag / "runs/lag-gain/log",
        ["gain"],
        7,
        0.0,
    )
    assert listener == Listener(announce=part.print_line)
    assert go("--out", "o", "--wait", "3", "--only", "plant", "--only", "source") == 0
    assert (asked[1][2], asked[1][3].wait) == (lag / "o/log", 3.0)
    assert "elsewhere: nobody" in capsys.readouterr().err
    outcome.stopped = 2
    assert go() == 130
    outcome.error = "gone"
    assert go() == 3
    assert capsys.readouterr().err.endswith("softrig: the run broke: gone\n")
    for more, why in (
        (
            ["--only", "gian"],
            "--only gian: no such node .did you mean 'gain'.*; those to be started are plant, source, gain",
        ),
        (["--mode", "inprocess"], "--only: in process all blocks run on one machine"),
    ):
        with pytest.raises(ScenarioError, match=why):
            go(*more)
    with pytest.raises(ScenarioError, match="--only: expected --domain N"):
        part.run_part(rig, make_parser().parse_args(words[:-2]))


# what `view` opens ----------------------------------------------------------------------------------------------------


def test_a_scenario_is_viewed_as_a_run_that_begins_paused_and_a_run_as_a_recording(lag, monkeypatch):
    asked = []
    monkeypatch.setattr(
        run_verb, "run", lambda options: asked.append((options.view, options.paused, options.pace)) or 5
    )
    assert [main(["view", "lag", *words]) for words in ([], ["--running", "--pace", "full"])] == [5, 5]
    assert asked == [(True, True, 1.0), (True, False, 0.0)]
    seen = []
    monkeypatch.setattr(view_verb, "need", lambda *what: None)
    monkeypatch.setattr(view_verb, "rig_of_run", lambda path, namespace: (rig_of("lag"), simulate("lag").signals))
    monkeypatch.setattr(
        "softrig_bringup.view.serve.serve", lambda source, how, address: seen.append((source.results, how, address))
    )
    (lag / "one/bag").mkdir(parents=True)
    (lag / "one/metrics.json").write_text('{"mode": "container", "metrics": [1]}')
    (lag / "alone").mkdir()
    (lag / "x.mcap").write_text("")
    for path in ("one", "one/bag", "alone", "x.mcap"):
        assert main(["view", path, "--address", ":1"]) == 0
    assert seen == [([1], "container", ":1")] * 2 + [([], "bag", ":1")] * 2

    def struck(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("softrig_bringup.view.serve.serve", struck)
    assert main(["view", "one"]) == 0


def test_the_command_line_passes_on_arguments_of_other_parsers(monkeypatch, capsys):
    monkeypatch.setattr("softrig_bags.cli.main_bag", lambda words: print("bag", words) or 4)
    monkeypatch.setattr("softrig_bags.cli.main_play", lambda words: print("play", words) or 5)
    assert [main(["bag", "info", "x"]), main(["bag", "play", "x", "--y"]), main(["bag", "play", "-q", "x"])] == [
        4,
        5,
        5,
    ]
    assert capsys.readouterr().out == "bag ['info', 'x']\nplay ['x', '--y']\n"
    for words, message in (
        (["plot", "x"], "`softrig plot` is `softrig draw plot RUN` now"),
        (["setup"], "need scripts/softrig"),
        (["env"], "need scripts/softrig"),
    ):
        assert main(words) == 2
        assert message in capsys.readouterr().err
    for shell, text in (("zsh", "#compdef softrig"), ("fish", "complete --command softrig"), ("bash", "complete ")):
        assert main(["env", "--completion", shell]) == 0
        assert text in capsys.readouterr().out
    asked = []
    monkeypatch.setattr("softrig_nodes.processes.executables.node_main", lambda *what: asked.append(what) or 6)
    assert main(["node", "p", "e", "--ros-args", "-p", "a:=1"]) == 6
    assert asked == [("p", "e", ["--ros-args", "-p", "a:=1"])]
    listed = [name for names in cli.GROUPS.values() for name in names]
    verbs = next(a for a in make_parser()._actions if isinstance(a, argparse._SubParsersAction)).choices
    assert sorted(listed) == sorted(verbs)
    assert isinstance(Run, type)


# completion -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "point", "words", "first"),
    [
        ("softrig bag inf", None, ["bag"], "2"),
        ("softrig bag play ", None, ["bag", "play"], "3"),
        ("softrig bag play", None, ["bag"], "2"),  # the word at the cursor is still incomplete
        ("softrig bag", None, [], None),
        ("softrig bag ", None, ["bag"], "2"),
        ("softrig run x", None, [], None),
        ("softrig bag inf", 11, [], None),  # the cursor is within the verb
        ("softrig export 'x", None, [], None),
        ("", None, [], None),
    ],
)
def test_the_verb_of_another_parser_is_recognised_by_the_preceding_words(monkeypatch, line, point, words, first):
    monkeypatch.setenv("COMP_LINE", line)
    monkeypatch.setenv("COMP_POINT", str(len(line) if point is None else point))
    monkeypatch.delenv("_ARGCOMPLETE", raising=False)
    monkeypatch.setenv("_ARGCOMPLETE", "")
    assert completion.asked({"bag", "bag play", "export"}) == words
    assert os.environ["_ARGCOMPLETE"] == (first or "")


def test_words_become_scenarios_settings_nodes_packages_and_executables(lag, monkeypatch):
    of = SimpleNamespace
    assert completion._COMPLETERS["scenario"]() == completion._COMPLETERS["names"]()
    assert "lag" in completion._scenarios()
    scenario = {"title": "t", "system": "s", "source": "n", "extends": "lag", "shared": {"v": 1.0}}
    (lag / "more.yaml").write_text(json.dumps(scenario))
    for arguments in ({"scenario": "more"}, {"study": "more", "scenario": ""}, {"what": "more"}):
        result = completion._settings(of(**arguments))
        assert result[0] == "v="
        assert {"gain.k=", "plant.period=", "gain.noise="} <= {*result}
        assert list(completion._nodes(of(**arguments))) == ["plant", "source", "gain"]
    assert completion._settings(of(scenario="none")) == []
    for prefix, package, manifest in (
        (lag / "a", "rig", "softrig_core"),
        (lag / "b", "other", "rclpy"),
        (lag / "c", "bare", None),
    ):
        (prefix / "lib" / package).mkdir(parents=True)
        (prefix / "lib" / package / "run").write_text("")
        (prefix / "lib" / package / "folder").mkdir()
        if manifest:
            (prefix / "share" / package).mkdir(parents=True)
            (prefix / "share" / package / "package.xml").write_text(manifest)
    monkeypatch.setattr("softrig_core.kit.resource.prefixes", lambda: [lag / n for n in "abc"])
    assert completion._packages() == {"rig": ["run"]}
    assert completion._executables(of(package="rig")) == ["run"]
    assert completion._executables(of(package="none")) == ()
    completion.complete(whole := make_parser())
    verbs = next(a for a in whole._actions if isinstance(a, argparse._SubParsersAction)).choices
    completed = {f"{n} {a.dest}": a.completer for n, v in verbs.items() for a in v._actions if hasattr(a, "completer")}
    assert completed["run set"] is completed["study grid"] is completed["falsify over"] is completion._settings
    assert completed["run external"] is completed["view only"] is completion._nodes
    assert "run out" not in completed


# other ways -----------------------------------------------------------------------------------------------------------


def test_live_parameters_are_set_in_a_domain_and_refusals_printed(monkeypatch, capsys):
    asked, refusals = [], []
    monkeypatch.setenv("ROS_DOMAIN_ID", "1")
    monkeypatch.setattr(
        set_verb,
        "set_parameters",
        lambda wanted, wait: asked.append((wanted, wait, os.environ["ROS_DOMAIN_ID"])) or refusals,
    )
    assert main(["set", "a.k", "2"]) == 0
    refusals.append("a refuses k: no")
    assert main(["set", "a.k", "2", "b.j", "x", "--domain", "7", "--wait", "3"]) == 1
    assert asked == [({"a": {"k": 2}}, 10.0, "1"), ({"a": {"k": 2}, "b": {"j": "x"}}, 3.0, "7")]
    assert capsys.readouterr().err == "softrig: set: a refuses k: no\n"


def test_a_bar_on_a_terminal_counts_the_seconds_of_the_run(monkeypatch):
    seen = []

    class Bar:
        def __init__(self, *columns, console, transient):
            seen.append((len(columns), columns[2].text_format, columns[0].markup, transient))

        def __enter__(self):
            return self

        def __exit__(self, *_):
            seen.append("gone")

        def add_task(self, title, total):
            seen.append((title, total))
            return 5

        def update(self, task, completed):
            seen.append((task, completed))

    monkeypatch.setattr("rich.progress.Progress", Bar)
    monkeypatch.setattr(
        progress.sys, "stderr", SimpleNamespace(isatty=lambda: True, write=lambda text: None, flush=lambda: None)
    )
    with progress.progress("mine", 2.0) as tell:
        tell(1_500_000_000)
    assert seen == [(5, "{task.completed:.3g} of {task.total:.3g} s", False, True), ("mine", 2.0), (5, 1.5), "gone"]


def test_a_film_of_a_run_ends_with_the_drawn_signals(lag, monkeypatch):
    asked = []
    t = np.array([0.0, 1.0, 1.5])
    signals = {"a": SimpleNamespace(t=t), "b": SimpleNamespace(t=t[:2]), "c": SimpleNamespace(t=t[:0])}
    drawing = SimpleNamespace(signals=("a", "b", "c", "d"))
    monkeypatch.setattr(animate, "rig_of_run", lambda path: (None, signals))
    monkeypatch.setattr(animate, "drawing_for", lambda rig: drawing)
    monkeypatch.setattr(animate, "film", lambda *what: asked.append(what))
    animate.film_of(str(lag), 0.25, None, 2.0)
    assert asked == [(drawing, signals, 0.25, 1.5, 2.0)]
    for out in ("f.mp4", "svg"):
        assert main(["draw", "animate", str(lag), "-o", out]) == 2
    monkeypatch.setattr(animate, "drawing_for", lambda rig: None)
    with pytest.raises(ScenarioError, match=r"^lag: no drawing of plant \(faultrig/plant\)$"):
        animate._drawing(rig_of("lag"))


def test_a_run_in_a_cell_has_four_pictures_at_most(lag, monkeypatch):
    run, asked = simulate("lag"), []
    head = bytes(16) + (64).to_bytes(4, "big") + (48).to_bytes(4, "big")

    def plot_run(signals, rig, folder, most, results):
        asked.append(most)
        for k in range(6):
            (folder / f"p{k}.png").write_bytes(head)
        return sorted(folder.iterdir())

    monkeypatch.setattr(notebook, "plot_run", plot_run)
    cell = notebook.html(run)
    assert (asked, cell.count("<img"), 'alt="p3"' in cell, 'alt="p4"' in cell) == ([4], 4, True, False)
    assert cell.startswith("<div><p><b>First-order lag</b> · Run of lag (inprocess, seed 0)")
    saved = []
    figure = SimpleNamespace(savefig=lambda buffer, format: saved.append(format) or buffer.write(b"png"))
    monkeypatch.setattr(
        notebook,
        "plot_entry",
        lambda signals, rig, entry: asked.append((entry.title, [*entry.signals], entry.window)) or figure,
    )
    assert notebook.plot(run, ["lag/state/x/position"], (0.0, 0.5))._repr_png_() == b"png"
    assert asked[1:] == [("First-order lag", ["lag/state/x/position"], (0.0, 0.5))]
    assert saved == ["png"]


def test_pictures_are_drawn_again_with_the_requested_options(lag, monkeypatch, capsys):
    run, asked, name = simulate("lag"), [], "lag/state/x/position"
    plotted = rig_of(run.rig.scenario.having(plots=[{"title": "Position", "signals": {name: "x"}}]))

    def drawn(result, rig, entry, style):
        asked.append((entry.title, [*entry.signals], entry.window, style))
        return SimpleNamespace(
            savefig=lambda file, format, dpi, metadata: file.write(f"{dpi} {format} {metadata}".encode())
        )

    monkeypatch.setattr(plot_verb, "rig_of_run", lambda path, namespace: (plotted, run.signals))
    monkeypatch.setattr(plot_verb, "plot_entry", drawn)
    more = ["--width", "50.8", "--font", "8", "--format", "svg", "--csv", "--window", "0", "0.02", "--out", "p"]
    for words in ([name], [name, *more], [], ["--no-title"]):
        assert main(["draw", "plot", ".", *words]) == 0
    assert asked == [
        ("lag state x position", [name], None, Style(title=False)),
        ("lag state x position", [name], (0.0, 0.02), Style(False, 8.0, 2.0)),
        ("Position", [name], None, Style()),
        ("Position", [name], None, Style(title=False)),
    ]
    of_one = f"pictures/{folder_of([lag.name], [str(lag)])}"
    assert capsys.readouterr().out.splitlines() == [
        f"{of_one}/lag_state_x_position-{folder_of(['lag state x position'])[-8:]}/plot_01_lag_state_x_position.pdf",
        "p/plot_01_lag_state_x_position.svg",
        "p/plot_01_lag_state_x_position.csv",
        *[f"{of_one}/plot_01_position.pdf"] * 2,
    ]
    assert (lag / of_one / "plot_01_position.pdf").read_text().startswith("300 pdf {")
    rows = (lag / "p/plot_01_lag_state_x_position.csv").read_text().splitlines()
    assert (rows[0], len(rows)) == ("t (s),lag/state/x/position (m)", 4)

    def latex(file, format, dpi, metadata):
        raise RuntimeError("no xelatex\nmore")

    monkeypatch.setattr(plot_verb, "plot_entry", lambda *what: SimpleNamespace(savefig=latex))
    assert main(["draw", "plot", ".", name, "--format", "pgf"]) == 2
    assert "pgf: no xelatex; it needs LaTeX (xelatex), pdf does not" in capsys.readouterr().err


def test_the_life_of_a_golden_bag_is_as_expected(tmp_path, monkeypatch, capsys):
    """Recorded, recorded again, with another length, checked here and as if elsewhere, and the file with its
    tolerances.
    """
    # A sweep prints its progress only on a slow machine; here no machine counts as slow.
    monkeypatch.setattr("softrig_optim.sweep.NEWS", math.inf)
    words = ["dc_motor_smc_b2", "--bags", str(tmp_path)]
    messages = []

    def go(*more, verb=("golden",)):
        status = main([*verb, *words, *more])
        printed = capsys.readouterr()
        messages.append(f"{' '.join([*verb, *more])}: status {status}")
        messages.extend(
            f"  {re.sub(r'[0-9]+ kB', 'N kB', line)}" for line in printed.out.splitlines() if "CPython" not in line
        )
        messages.extend(f"  {line}" for line in printed.err.splitlines())

    go("--duration", "0.02", "--seed", "3")
    go(verb=("check", "--golden"))
    file = tmp_path / "dc_motor_smc_b2/golden.yaml"
    monkeypatch.setattr(golden, "DECIDE", ("numpy",))
    file.write_text(re.sub(r"numpy: .*", "numpy: old", file.read_text().replace("why: ''", f"why: {'by hand ' * 20}")))
    monkeypatch.setattr(golden, "versions", lambda: runs.versions() | {"numpy": "new"})
    go(verb=("check", "--golden"))
    go("--duration", "0.01")
    bag = tmp_path / "dc_motor_smc_b2/bag"
    golden._check_folder(bag)
    for name in ("bag_x.mcap", "notes"):
        (bag / name).write_text("")
        with pytest.raises(ScenarioError, match=rf"bag/{name} was not made by `softrig golden`; move it away"):
            golden._check_folder(bag)
        (bag / name).unlink()
    made = golden.load(tmp_path / "dc_motor_smc_b2", seed=4)
    assert (made.recipe.seed, made.recipe.duration, made.bag) == (4, 0.01, bag)
    text = file.read_text().replace(made.recipe.made_with["softrig_core"], "V").splitlines()
    messages += ["golden.yaml", *(f"  {line}" for line in text[: text.index("made_with:")])]
    check_expected("verbs/golden", messages)
    assert max(map(len, text)) <= 110


# a run from its words to its end --------------------------------------------------------------------------------------


@pytest.fixture
def flow(lag, monkeypatch):
    """The steps of a run; nothing is run."""
    steps, listeners = [], []
    done = simulate("lag")

    def execute(rig, placement, log, listener):
        listeners.append(listener)
        steps.append(("execute", str(placement), log))
        return done

    shown = SimpleNamespace(
        open=lambda domain: steps.append(("open", domain)), over=lambda run, folder: steps.append(("over", folder.name))
    )

    @contextmanager
    def page(scenario, log, placement, address):
        steps.append(("page", address))
        yield shown

    monkeypatch.setattr(run_verb, "prepare", lambda variables: steps.append(("prepare",)))
    monkeypatch.setattr(run_verb, "environment", lambda domain, directory: {})
    monkeypatch.setattr(run_verb, "execute", execute)
    monkeypatch.setattr(run_verb, "page", page)
    monkeypatch.setattr(run_verb, "need", lambda *what: steps.append(("need", *what)))
    monkeypatch.setattr("softrig_bringup.view.serve.free_address", lambda address: steps.append(("free", address)))
    monkeypatch.setattr(
        "softrig_bringup.view.here.show_here",
        lambda rig, placement, address, folder, conclude: steps.append(("here", address, folder.path.name)) or 9,
    )
    monkeypatch.setattr(
        "softrig_bringup.run.part.run_part", lambda rig, options: steps.append(("part", options.only)) or 8
    )
    monkeypatch.setattr(
        run_verb,
        "conclude",
        lambda options, run, folder: steps.append(("conclude", run is done, folder and folder.path.name)) or 7,
    )
    monkeypatch.setattr(run_verb, "_how_to_connect", lambda domain, log: f"connect {domain}")
    return steps, listeners


def test_the_steps_of_a_run_are_in_order(flow, lag, capsys):
    steps, listeners = flow
    assert main(["run", "lag", "--mode", "inprocess"]) == 7
    log = lag / "runs/lag/log"
    assert steps == [("page", ""), ("execute", "inprocess", log), ("conclude", True, "lag"), ("over", "lag")]
    steps.clear()
    assert main(["run", "lag", "--mode", "container", "--connect", "--out", "o"]) == 7
    listeners[-1].opened(5)
    assert steps == [
        ("prepare",),
        ("page", ""),
        ("execute", "container", lag / "o/log"),
        ("conclude", True, "o"),
        ("over", "o"),
    ]
    assert "softrig: connect 5\n" in capsys.readouterr().err
    steps.clear()
    assert main(["view", "lag", "--address", ":1"]) == 7
    listeners[-1].opened(6)
    assert steps[:3] == [("need", "bokeh", "view"), ("free", ":1"), ("prepare",)]
    assert steps[-1] == ("open", 6)
    steps.clear()
    assert main(["view", "lag", "--mode", "inprocess"]) == 9
    assert steps == [
        ("need", "bokeh", "view"),
        ("free", "127.0.0.1:0"),
        ("here", "127.0.0.1:0", "lag-2" if (lag / "runs/lag-2").exists() else "lag"),
    ]
    steps.clear()
    assert main(["run", "lag", "--only", "gain", "--domain", "5"]) == 8
    assert steps == [("prepare",), ("part", ["gain"])]
    for words, text in (
        (["run", "lag", "--realtime", "--mode", "inprocess"], "runs in process have no wall clock"),
        (["view", "lag", "--only", "gain"], "--only: view needs a whole rig"),
    ):
        steps.clear()
        assert main(words) == 2
        assert (text in capsys.readouterr().err, steps) == (True, [])


def test_the_results_of_a_run_are_written_and_its_status_returned(lag, monkeypatch, capsys):
    """A plain run, a changed and labelled one with an outside node, one that keeps nothing."""
    done, drawn = simulate("lag"), []
    done.wall_s = 0.5
    monkeypatch.setattr(run_verb, "illustrate", lambda run, folder, form: drawn.append((folder.path.name, form)))
    messages = []

    def go(name, *words, **more):
        options = make_parser().parse_args(["run", "lag", *words])
        for key, value in more.items():
            setattr(done, key, value)
        folder = None if name is None else ResultsFolder(lag / name)
        if folder:
            folder.clear()
        kept = run_verb._keep(options, done, folder)
        content = kept.content
        text = f"changed {list(content['changed'])}, same {kept.same}, told {list(kept.remarks)}"
        messages.append(f"{' '.join(words) or 'plain'}: {text}")
        messages.append(f"  {content['title']}, label {content['label']!r}, {content['command']}")
        if folder:
            messages.append(f"  {sorted(p.name for p in (lag / name).iterdir())}")

    go("a", "--mode", "inprocess")
    go("b", "--set", "gain.k=2", "--label", "soft", "--junit", "unit.xml", "--no-record", "--format", "pdf")
    messages += [f"    {line.strip()}" for line in (lag / "unit.xml").read_text().splitlines() if "suite" in line]
    go("c", "--external", "gain", "--no-plots")
    go(None, "--seed", "3")
    go("d", branched=[{"at_s": 0.02, "from_s": 0.03, "left": ""}])
    messages.append(f"drawn {drawn}")
    check_expected("verbs/kept", (line.replace(str(lag), "HERE") for line in messages))
    assert run_verb.conclude(make_parser().parse_args(["run", "lag", "--no-plots"]), simulate("lag"), None) == 0


def test_check_runs_scenarios_and_reports_which_hold(lag, monkeypatch, capsys):
    good = {"scenario": "lag", "wall_s": 1.0, "error": "", "metrics": [], "claims": [], "kind": "", "differs": []}
    claim = {"key": "a", "false": "", "measured_text": "1", "holds": True}
    outcomes = []
    asked = []
    monkeypatch.setattr(
        check, "sweep", lambda do, names, title, workers: asked.append((names, title, workers)) or outcomes
    )
    for result, status, text in (
        ([good | {"claims": [claim]}], 0, ["lag: 1 hold, 0 do not"]),
        (
            [good | {"claims": [claim, claim | {"key": "b", "false": "no"}]}],
            1,
            ["lag: 1 hold, 1 do not", "  claim b: no"],
        ),
        (
            [good, good | {"error": "gone", "kind": "broke"}],
            3,
            ["lag: nothing is judged: it has no expectations", "lag: broke: gone"],
        ),
        ([good], 2, ["lag: nothing is judged: it has no expectations"]),
    ):
        outcomes[:] = result
        assert main(["check", "lag", "--workers", "2"]) == status
        assert capsys.readouterr().out.splitlines() == text
    assert asked == [([check.Judged("lag", "lag", "")], "check", 2)] * 4
    assert main(["check", "lag", "--json", "nowhere/x.json"]) == 2
    assert "nowhere/x.json: there is no folder" in capsys.readouterr().err

    def broken(name, thorough):
        raise RunError("gone")

    assert check.judge(check.Judged("lag", "lag", ""))["metrics"][0]["name"] == "last"
    monkeypatch.setattr(check, "simulate", broken)
    assert {k: v for k, v in check.judge(check.Judged("lag", "lag", "")).items() if k != "wall_s"} == {
        "scenario": "lag",
        "metrics": [],
        "claims": [],
        "error": "gone",
        "kind": "broke",
        "differs": [],
    }
    assert check.judge(check.Judged("lag", "lag", ""))["wall_s"] >= 0.0


def test_only_claims_of_the_requested_systems_are_judged(lag, monkeypatch, capsys):
    def one(name, system, claims):
        return SimpleNamespace(name=name, system=system, claims=claims, scenario=name, source=f"of {name}",
                               model_copy=lambda update: SimpleNamespace(**update, system=system))  # fmt: skip

    known = {n: one(n, s, c) for n, s, c in (("a_1", "a", {"x": 1, "y": 2}), ("a_2", "a", {}), ("b_1", "b", {"z": 1}))}
    monkeypatch.setattr(results, "list_scenarios", lambda: list(known))
    monkeypatch.setattr(results, "load_scenario", known.__getitem__)
    assert [[s.name for s in results.claiming(of)] for of in ((), ("a",), ("b_1", "a"), ("a_2",))] == [
        ["a_1", "b_1"],
        ["a_1"],
        ["a_1", "b_1"],
        [],
    ]
    with pytest.raises(ScenarioError, match=r"^no system .c.; there are a, b$"):
        results.claiming(["a", "c"])
    monkeypatch.setattr(results, "list_studies", lambda: list(known))
    monkeypatch.setattr(results, "load_study", known.__getitem__)
    assert results.left_out([]) == "3 more claims are of studies (a_1, b_1): hundreds of runs, with --studies"
    assert results.left_out(["a"]) == "2 more claims are of studies (a_1): hundreds of runs, with --studies"
    assert results.left_out(["a_2"]) == ""
    ran, cleared = [], []

    def run_study(study, out, workers):
        ran.append((study.name, out, workers))
        if study.name == "b_1" and len(ran) == 2:
            raise results.OtherContentError("other")
        return SimpleNamespace(rows=lambda: ["row"])

    monkeypatch.setattr(results, "run_study", run_study)
    monkeypatch.setattr(
        results,
        "ResultsFolder",
        lambda path, own_files: SimpleNamespace(clear=lambda: cleared.append((path, own_files))),
    )
    monkeypatch.setattr(results, "without_signals", list)
    monkeypatch.setattr(results, "results", lambda study, done, units: (study.name, done))
    monkeypatch.setattr(results, "claims", lambda study, result: [result])
    scenarios, rows = results.study_findings([], Path("o"), 2)
    assert ran == [("a_1", Path("o/a_1"), 2), ("b_1", Path("o/b_1"), 2), ("b_1", Path("o/b_1"), 2)]
    assert (cleared, rows) == ([(Path("o/b_1"), results.STUDY)], [("a_1", ["row"]), ("b_1", ["row"])])
    assert [(s.name, s.source) for s in scenarios] == [("a_1", "of a_1"), ("b_1", "of b_1")]
    assert results.study_findings(["a_2"], Path("o"))[1] == [("a_1", ["row"])][:0]


# what is written down once --------------------------------------------------------------------------------------------


def test_a_checkout_is_reported_by_its_commit_and_its_lock_file(tmp_path, monkeypatch):
    (tmp_path / "locks").mkdir()
    monkeypatch.setenv("SOFTRIG_COMMAND", str(tmp_path / "softrig"))
    messages = {"rev-parse": "abc\n", "status": " M x\n"}
    asked = []

    def git(command, **how):
        asked.append((command[:3], how))
        return SimpleNamespace(stdout=messages[command[6] if command[6] in messages else command[7]])

    monkeypatch.setattr(runs.subprocess, "run", git)
    style = runs.checkout.__wrapped__
    assert style() == {}
    (tmp_path / "locks/run.lock").write_text("x")
    lock = {"run.lock": "sha256:2d711642b726b04401627ca9fbac32f5c8530fb1903cc4db02258717921a4881"}
    assert style() == {"commit": "abc+"} | lock
    messages["status"] = ""
    assert style() == {"commit": "abc"} | lock
    assert asked[0] == (
        ["git", "-C", str(tmp_path)],
        {"capture_output": True, "text": True, "timeout": 10, "check": True},
    )

    def none(command, **how):
        raise FileNotFoundError

    monkeypatch.setattr(runs.subprocess, "run", none)
    assert style() == lock


def test_records_are_immutable_and_libraries_use_one_core():
    assert packed.Digest.model_config["frozen"]
    assert packed.About.model_config["frozen"]
    assert all(kind.__dataclass_params__.frozen for kind in (Citation, Node, Wire, Wiring, RunRecord))
    process = viewer.Process("p", "e")
    assert (process.arguments, process.parameters, process.remappings, process.variables, process.kind) == (
        [],
        [],
        [],
        {},
        "rig",
    )
    with pytest.MonkeyPatch.context() as patch:
        for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
            patch.delenv(name, raising=False)
        spec = importlib.util.spec_from_file_location("softrig_bringup.once_more", cli.__file__)
        spec.loader.exec_module(importlib.util.module_from_spec(spec))
        assert (os.environ["OMP_NUM_THREADS"], os.environ["OPENBLAS_NUM_THREADS"]) == ("1", "1")
