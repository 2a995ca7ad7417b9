"""What a terminal of any width shows, line by line: tables, lists, bars, and the last lines of a run."""

import io
import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from expected_text import check_expected
from rich.console import Console
from softrig_bringup.cli import make_parser
from softrig_bringup.terminal import console, parts, progress, tables
from softrig_bringup.verbs import check, linear, list_verb as listing, run_verb
from softrig_core import Scenario, ScenarioError, load_scenario, rig_of
from softrig_core.scenario import index
from softrig_core.solver.solver import UNFINISHED
from softrig_core.verdict.findings import Finding
from softrig_core.verdict.result import Result


def shown(width, show):
    """The text printed on a terminal of a width, without spaces at line ends."""
    stream = io.StringIO()
    show(Console(file=stream, width=width, highlight=False, markup=False, color_system=None))
    return [line.rstrip() for line in stream.getvalue().splitlines()]


# tables ---------------------------------------------------------------------------------------------------------------

HEADS = ["figure", "measured", "expected", "unit", ""]
ROWS = [
    ["rise_time", "0.607", "0.607 ± 0.001", "s", "pass"],
    ["drop", "", "≤ 12.5", "m/s^2", ""],
    ["final", "-1.25", "", "", "MISS"],
]


def test_tables_of_verdicts_are_as_expected_on_terminals_of_any_width():
    messages = []
    for width in (60, 49, 48, 20):
        messages.append(f"{width} wide")
        messages += [f"  {line}" for line in shown(width, lambda c: tables.print_judged(c, HEADS, ROWS))]
    check_expected("terminal/judged", messages)


def test_tables_of_many_columns_continue_below_as_expected():
    heads = ["case", "law.gain_of_speed", "noise.k", "rise_time", "unit"]
    rows = [["0", "1.5", "0.001", "0.607", "s"], ["1", "12.25", "0.5", "", "s"]]
    messages = []
    for width, keys in ((60, 1), (39, 1), (24, 1), (24, 2), (12, 1), (10, 1)):
        messages.append(f"{width} wide, {keys} again")
        messages += [
            f"  {line}" for line in shown(width, lambda c, keys=keys: tables.print_columns(c, heads, rows, keys))
        ]
    messages.append("as it is by itself")
    messages += [f"  {line}" for line in shown(24, lambda c: tables.print_columns(c, heads, rows))]
    check_expected("terminal/columns", messages)


@pytest.mark.parametrize(
    ("head", "room", "folded"),
    [
        ("gain_of_speed", 20, "gain_of_speed"),
        ("gain_of_speed", 8, "gain_of_\nspeed"),
        ("gain_of_speed", 7, "gain_\nof_\nspeed"),
        ("gain_of_speed", 0, "gain_\nof_\nspeed"),
        ("law.k", 4, "law.\nk"),
        ("law.k", 5, "law.k"),
        ("speed", 1, "speed"),
        ("", 3, ""),
    ],
)
def test_headings_are_folded_at_underscores_and_dots(head, room, folded):
    assert tables._folded(head, room) == folded


def test_words_are_aligned_to_the_left_and_numbers_to_the_right():
    made = tables.table_of(["a", "b", "unit", ""], [["1", "2", "3", "4"]])
    assert [c.justify for c in made.columns] == ["left", "right", "left", "left"]
    assert all(c.no_wrap for c in made.columns)
    whole = max(map(len, shown(80, lambda c: c.print(made))))
    assert [tables.fits(Console(width=whole + w, file=io.StringIO()), made) for w in (-1, 0)] == [False, True]


# lists ----------------------------------------------------------------------------------------------------------------


def scenario(name, **more):
    about = {
        "name": name,
        "title": f"A {name}",
        "system": "tank",
        "source": "Nobody 2020",
        "duration": 2.0,
        "nodes": {"n": {"package": "p", "executable": "e"}},
    }
    return Scenario.model_validate(about | more)


SCENARIOS = [
    scenario("a"),
    scenario("a_1", duration=0.5),
    scenario("a_1_x"),
    scenario("a_1_y"),
    scenario("a_2"),
    scenario("a_2_z"),
    scenario("ab"),
    scenario("b", system="motor", source="Else"),
    scenario("b_1", system="motor", source="One more"),
]


@pytest.fixture
def listed(monkeypatch, tmp_path):
    known = {s.name: s for s in SCENARIOS}
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(index, "list_scenarios", lambda broken: {n: Path() for n in known})
    monkeypatch.setattr("softrig_core.scenario.scenario.load_scenario", known.__getitem__)
    monkeypatch.setattr("softrig_core.kit.compiled.cache_folder", lambda: tmp_path)
    monkeypatch.setattr(index, "scenario_folders", lambda: [tmp_path])
    (tmp_path / "runs/a").mkdir(parents=True)
    (tmp_path / "runs/a/metrics.json").write_text(json.dumps({"wall_s": 1.2345, "mode": "inprocess"}))
    (tmp_path / "runs/b").mkdir()
    (tmp_path / "runs/b/metrics.json").write_text("[]")
    return known


def test_the_list_is_as_expected(listed, monkeypatch, capsys):
    messages = []
    for columns, part in (
        ("70", ""),
        ("70", "a"),
        ("30", "mot"),
        ("", "a_1"),
        (None, "b"),
        ("70", "c"),
        ("70", "a_1_z"),
    ):
        monkeypatch.delenv("COLUMNS", raising=False) if columns is None else monkeypatch.setenv("COLUMNS", columns)
        status = listing.list_scenarios_of(part)
        printed = capsys.readouterr()
        messages.append(f"{'in a pipe' if columns is None else f'COLUMNS {columns}'}, {part!r}: status {status}")
        messages += [f"  {line.rstrip()}" for line in (printed.out + printed.err).splitlines()]
    check_expected("terminal/list", messages)


def test_a_list_with_a_file_that_is_not_a_scenario_ends_with_status_2(listed, monkeypatch, capsys):
    def broken(name):
        if name == "a_2":
            raise ScenarioError("a_2: no such thing")
        return listed[name]

    monkeypatch.setattr("softrig_core.scenario.scenario.load_scenario", broken)
    for columns in ("60", None):
        monkeypatch.delenv("COLUMNS", raising=False) if columns is None else monkeypatch.setenv("COLUMNS", columns)
        assert [listing.list_scenarios_of(part) for part in ("", "none")] == [2, 2]
        assert "softrig: a_2: no such thing\n" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("terminal", "columns", "width"), [(False, None, 1000), (False, "61", 61), (False, "x", 1000), (True, "62", 62)]
)
def test_lines_are_not_folded_in_a_pipe(monkeypatch, terminal, columns, width):
    monkeypatch.setattr("sys.stdout", stream := io.StringIO())
    monkeypatch.setattr(stream, "isatty", lambda: terminal, raising=False)
    monkeypatch.delenv("COLUMNS", raising=False) if columns is None else monkeypatch.setenv("COLUMNS", columns)
    assert console.console().width == width
    console.console(width=20).print("[red]a[/] \x1b[1m 1")
    assert stream.getvalue() == "[red]a[/] \\x1b[1m 1\n"
    assert console.styled("a\x1b", ("b\x1b", "red")).plain == "a\\x1bb\\x1b"


def test_signals_and_figures_are_listed_as_expected(capsys):
    messages = []
    for show in (lambda: parts.list_signals("dc_motor_smc_faults"), lambda: parts.list_figures("final_value")):
        assert show() == 0
        messages += capsys.readouterr().out.splitlines()
    (signature,) = (line for line in messages if line.startswith("final_value("))
    assert re.findall(r"\w+(?=:)", signature) == ["signals", "signal", "start", "end"]
    messages.remove(signature)  # the text of a signature depends on the version of Python
    check_expected("terminal/signals", messages)
    assert parts.list_figures("") == 0
    rows = [line.split("\t") for line in capsys.readouterr().out.splitlines()]
    assert {len(r) for r in rows} == {3}
    assert [r[0] for r in rows] == parts.registered()
    assert all(r[2] for r in rows)
    asked = []
    options = {"signals": None, "parameters": None, "figures": None, "filter": "x"}
    for name in ("list_signals", "list_parameters", "list_figures", "list_scenarios_of"):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(
                listing if name == "list_scenarios_of" else parts,
                name,
                lambda what, name=name: asked.append((name, what)) or 5,
            )
            key = {f"list_{k}": k for k in ("signals", "parameters", "figures")}.get(name)
            assert listing.main(SimpleNamespace(**options | ({key: ""} if key else {}))) == 5
    assert asked == [("list_signals", ""), ("list_parameters", ""), ("list_figures", ""), ("list_scenarios_of", "x")]


# bars -----------------------------------------------------------------------------------------------------------------


def test_a_long_run_reports_its_progress_every_ten_seconds(monkeypatch, capsys):
    clock = SimpleNamespace(now=0.0, monotonic=lambda: clock.now)
    monkeypatch.setattr(progress, "time", clock)
    with progress.progress("mine", 20.0) as tell:
        for now, t in ((10.0, 1), (10.1, 2_500_000_000), (20.0, 3_000_000_000), (20.2, 12_345_678_901)):
            clock.now = now
            tell(t)
    assert capsys.readouterr().err == "softrig: mine: 2.5 of 20 s\nsoftrig: mine: 12.3 of 20 s\n"


def test_a_bar_in_a_notebook_is_drawn_ten_times_a_second_and_then_removed(monkeypatch):
    clock = SimpleNamespace(now=0.0, monotonic=lambda: clock.now)
    monkeypatch.setattr(progress, "time", clock)
    messages = []
    cell = SimpleNamespace(update=lambda what, raw: messages.append(what["text/plain"] or what["text/html"] or "gone"))

    def display(what, raw, display_id):
        messages.append((what["text/html"], raw, display_id))
        return cell

    monkeypatch.setattr(progress, "_notebook", lambda: display)
    with progress.progress("a <b>", 2.0) as tell:
        for now, t in ((0.1, 1), (0.11, 500_000_000), (0.2, 700_000_000), (0.22, 1_234_567_890)):
            clock.now = now
            tell(t)
    assert messages == [
        ('a &lt;b&gt; <progress value="0" max="2"></progress> 0 of 2 s', True, True),
        "a <b>: 0.5 of 2 s",
        "a <b>: 1.23 of 2 s",
        "gone",
    ]


def test_a_notebook_is_recognised_by_its_kernel(monkeypatch):
    shell = SimpleNamespace()
    ipython = SimpleNamespace(get_ipython=lambda: shell)
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    monkeypatch.setitem(sys.modules, "IPython.display", SimpleNamespace(display="show"))
    assert progress._notebook() is None  # ipython in a terminal
    shell.kernel = True
    assert progress._notebook() == "show"
    monkeypatch.setattr(ipython, "get_ipython", lambda: None)
    assert progress._notebook() is None


# lines of a run -------------------------------------------------------------------------------------------------------


def result(name, value, passed=True, **more):
    return Result(name=name, value=value, passed=passed, **more)


JUDGED = [
    result("rise_time", 0.6069512, unit="s", published=0.607, expected=0.607, tolerance=0.001),
    result("cost", 15459.5, False, at_most=15459.0, published=15459.0012),
    result("ripple", 0.25, unit="A"),
    result("late", None, False, at_most=1.0, error="no sample after 2 s"),
    result("settles", None, False, at_most=1.0, error="never", unit="s"),
    result("margin", -0.5, False, at_least=0.0, violated_s=((0.5, 1.0), (1.5, 1.5)), at_s=0.75, unit="V"),
    result("always", 0.125, at_least=0.0, open_from_s=1.9, at_s=0.1),
]
CLAIMS = [
    Finding(
        scenario="x",
        key="a",
        text="a",
        where="W",
        verdict="reproduced",
        holds=False,
        measured_text="2",
        asked="1 ± 0.1",
    ),
    Finding(scenario="x", key="b", text="b", where="W", verdict="reproduced", holds=True),
]
CHANGED = [replace(r, follows=r.name in ("margin", "always")).not_judged("k = 1") for r in JUDGED]
STATUS = {
    "plant": {"ticks": 900, "missed_deadlines": 100, "late_ticks": 3, "latest_ms": 1.23456, "cpu_s": 2.0},
    "law": {"ticks": 10, "reports": {"clip": [1, "clipped", 4]}, "refused": {"u": [2, "nan"]}},
}


def done(**more):
    about = {
        "results": JUDGED,
        "claims": CLAIMS,
        "status": STATUS,
        "mode": "inprocess",
        "epoch": 0,
        "stopped": 0,
        "error": "",
        "wall_s": 0.5,
        "stopped_at": "",
        "rig": rig_of("dc_motor_smc_b2"),
        "branched": (),
    }
    return SimpleNamespace(**about | more)


CONTENT = {
    "scenario": "x",
    "title": "Mine",
    "label": "",
    "changed": [],
    "ticks": 1234,
    "reached_s": 1.25,
    "duration_s": 2.0,
}


@pytest.mark.parametrize(
    ("name", "content", "more"),
    [
        ("plain", {}, {}),
        ("changed", {"changed": ["k=2", "seed 3"], "label": "soft"}, {"results": CHANGED, "published_for": "k = 1"}),
        ("stopped", {"reached_s": 0.0}, {"stopped": 2}),
        ("real_time", {}, {"epoch": 5, "results": JUDGED[2:3], "claims": [], "status": {}}),
    ],
)
def test_the_last_lines_of_a_run_are_as_expected(name, content, more, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)

    def show(console):
        monkeypatch.setattr(run_verb, "make_console", lambda: console)
        run_verb._print_figures(CONTENT | content, done(**more), tmp_path / "runs" / "x")

    check_expected(f"terminal/run_{name}", shown(100, show))


def options(*words):
    return make_parser().parse_args(["run", "x", *words])


@pytest.mark.parametrize(
    ("words", "kept", "more", "status"),
    [
        ((), {}, {}, 0),
        ((), {}, {"results": JUDGED[1:2]}, 1),
        ((), {}, {"claims": CLAIMS[:1]}, 1),
        ((), {}, {"claims": CLAIMS[1:]}, 0),
        ((), {}, {"results": [JUDGED[1].not_judged("k = 1")]}, 0),
        ((), {}, {"results": [replace(JUDGED[1], follows=True).not_judged("k = 1")]}, 1),
        ((), {"same": False}, {}, 1),
        ((), {}, {"error": "x", "stopped": 2}, 3),
        ((), {"same": False}, {"stopped": 15}, 143),
        (("--max-missed", "10"), {}, {"status": STATUS}, 0),  # exactly the number that the limit allows
        (("--max-missed", "9.9"), {}, {"status": STATUS}, 1),
    ],
)
def test_the_exit_status_of_a_run(words, kept, more, status):
    about = {"content": {}, "same": True, "remarks": []} | kept
    run = done(**{"results": JUDGED[:1], "claims": [], "status": {}} | more)
    assert run_verb._judged(options(*words), run_verb._Results(**about), run) == status


def test_the_text_about_a_machine_that_is_too_slow_is_as_expected(monkeypatch):
    late = {
        "plant": {"ticks": 900, "missed_deadlines": 100},
        "law": {"ticks": 899, "missed_deadlines": 101},
        "log": {"missed_deadlines": 0},
    }
    work = {"plan": {"reports": {UNFINISHED: [1, "x", 3]}, "ticks": 5}}
    messages = []
    for words, status, trips, broken in (
        ("", late, {}, False),
        ("", {"plant": late["plant"]}, {}, False),
        ("--max-missed 5 --mode container", late, {}, False),
        ("--max-missed 60", late, {}, False),
        ("--max-missed 60", late, {}, True),
        ("", {"plant": {"ticks": 999, "missed_deadlines": 1}}, {"plant": "too hot"}, False),
        ("", late | work, {}, False),
        ("", work, {}, False),
        ("", {}, {"plant": "too hot"}, True),
    ):
        monkeypatch.setattr(run_verb, "tripped", lambda rig, status, trips=trips: trips)
        text = run_verb.too_slow(options(*words.split()), None, status, broken)
        messages.append(
            f"{words or 'plain'}, {', '.join(status) or 'nobody'}{', broken' * broken}{', tripped' * bool(trips)}:"
        )
        messages.append(f"  {text or 'nothing'}")
    monkeypatch.setattr(run_verb, "tripped", lambda rig, status: {})
    messages.append(run_verb.too_slow(options(), None, late, container="place:=container"))
    check_expected("terminal/slow", messages)


def test_a_broken_run_names_its_files_and_a_stopped_one_its_time(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    kept = run_verb._Results({}, True, ["told so"])
    monkeypatch.setattr(run_verb, "_print_figures", lambda content, run, out: print("figures"))
    monkeypatch.setattr(run_verb, "assumptions", lambda members: ["assumed so"])
    for out, more in (
        (tmp_path / "runs/x", {"error": "gone"}),
        (None, {"error": "gone"}),
        (Path("/else"), {"stopped": 2, "stopped_at": "stopped"}),
    ):
        run_verb._print_results(kept, done(**more), out)
    printed = capsys.readouterr()
    assert printed.out == "figures\n"
    assert printed.err.splitlines() == [
        "softrig: the run broke: gone",
        "softrig: what was recorded up to there is in runs/x, the output of the nodes in its log/",
        "softrig: the run broke: gone",
        "softrig: assumed so",
        "softrig: told so",
        "softrig: stopped",
    ]
    assert run_verb._shown(Path("/else/x")) == "/else/x"
    monkeypatch.setattr(
        run_verb,
        "environment",
        lambda domain, directory: {
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "RMW_IMPLEMENTATION": "x",
            "OTHER": "y",
        },
    )
    printed = "to connect: export ROS_DOMAIN_ID=3 ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST RMW_IMPLEMENTATION=x"
    assert run_verb._how_to_connect(3, tmp_path) == printed


# other verbs ----------------------------------------------------------------------------------------------------------


def test_a_case_of_check_is_a_figure_or_a_claim_of_a_run():
    outcome = check.outcome_of(done(rig=SimpleNamespace(scenario=SimpleNamespace(name="x"))), 1.23456)
    assert (outcome["scenario"], outcome["wall_s"], outcome["error"], len(outcome["metrics"])) == (
        "x",
        1.235,
        "",
        len(JUDGED),
    )
    suite = check.suite_of(outcome)
    messages = [f"{c.name}: {c.text}{f' / {c.failure}' if c.failure else ''}" for c in suite.cases]
    assert messages == [
        "rise_time: 0.6069512 s",
        "cost: 15459.5 / 15459.5, expected ≤ 15459",
        "late: no sample after 2 s / no sample after 2 s, expected ≤ 1",
        "settles: never / never, expected ≤ 1 s",
        "margin: -0.5 V / -0.5 V, expected ≥ 0 V; violated from 0.5 to 1 s, at 1.5 s",
        "always: 0.125",
        "claim a: 2 / the verdict reproduced does not hold: measured 2, 1 ± 0.1",
        "claim b: ",
    ]
    assert (suite.name, suite.seconds, suite.error) == ("x", 1.235, "")
    broke = check.outcome_of(done(error="gone", rig=SimpleNamespace(scenario=SimpleNamespace(name="x"))), 1.0)
    assert (broke["error"], broke["metrics"], broke["claims"]) == ("gone", [], [])


def test_numbers_of_a_linear_view_are_written_short():
    assert [linear._complex(v) for v in (1.23456 + 0j, 1.0 - 2.34567j, -0.5 + 1e-9j)] == [
        "1.235",
        "1 +- 2.346j",
        "-0.5 +- 1e-09j",
    ]
    assert linear._states({"a": 0.5, "b": 0.25, "c": 0.2, "d": 0.05}) == "a 50%, b 25%, c 20%"
    assert pytest.approx(180.0) == linear.DEGREES * 3.141592653589793
    assert load_scenario("dc_motor_smc_b2").duration == 6.0
