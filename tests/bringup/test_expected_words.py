"""The words of the command line: each verb with its options, how they are parsed, and how a command is printed again.

As `tests/expected/words*.txt` have them.
"""

import argparse
import re
import shlex
from fractions import Fraction
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import pytest
from expected_text import check_expected
from hypothesis import given, settings as trying, strategies as st
from softrig_bringup import launched
from softrig_bringup.cli import _of_the_script, make_parser
from softrig_bringup.options import grammar, params_file, repeat as repeating, run_options
from softrig_bringup.verbs import declared, set_verb
from softrig_core import ScenarioError
from softrig_core.command_line import Number

KINDS = {argparse._StoreAction: "", argparse._StoreTrueAction: "switch", argparse._AppendAction: "several"}


@cache
def parser():
    return make_parser()


def kind(action):
    """What is parsed: a number with its bounds, or the name of its parser."""
    of = action.type
    if isinstance(of, Number):
        return f"{of.kind.__name__} from {of.low:g} to {of.high:g}"
    return getattr(of, "__name__", "" if action.nargs == 0 else "text")


def words(of, verb):
    """A verb and its options, one line each: name, parser, how often, default."""
    beside = {k: v for k, v in of._defaults.items() if k != "verb"}
    called = of._defaults.get("verb")
    yield " ".join([verb, *([f"calls {called.args[0]}"] if called else []), *(f"{k}={v!r}" for k, v in beside.items())])
    together = {a.dest: k for k, g in enumerate(of._mutually_exclusive_groups, 1) for a in g._group_actions}
    for a in of._actions:
        if isinstance(a, argparse._SubParsersAction):
            yield f"  {a.metavar}{'' if a.required else ', or nothing'}"
            for name, sub in a.choices.items():
                yield from (f"    {line}" for line in words(sub, name))
        elif not isinstance(a, argparse._HelpAction):
            messages = [" ".join(a.option_strings) or a.dest, KINDS.get(type(a), type(a).__name__), kind(a)]
            named = a.option_strings[-1][2:].replace("-", "_") if a.option_strings else a.dest
            messages += [f"into {a.dest}"] if named != a.dest else []
            messages += [f"one of {' '.join(a.choices)}"] if a.choices else []
            messages += [f"times {a.nargs}"] if a.nargs not in (None, 0) else []
            messages += [f"alone {a.const!r}"] if a.nargs == "?" and a.const is not None else []
            messages += [f"else {a.default!s}".strip()] if a.default not in (None, False, argparse.SUPPRESS) else []
            messages += ["nothing where it is not said"] if a.default is argparse.SUPPRESS else []
            messages += ["wanted"] if a.required and a.option_strings else []
            messages += [f"one of group {together[a.dest]}"] if a.dest in together else []
            yield f"  {', '.join(filter(None, messages))}"


def test_all_verbs_and_options_are_as_expected():
    check_expected("words", words(parser(), "softrig"))


def answer(function, *arguments):
    """What a function returns, or how it refuses."""
    try:
        result = function(*arguments)
    except (ScenarioError, argparse.ArgumentTypeError) as error:
        return f"refused: {error}"
    return result if isinstance(result, str) else repr(result).replace("PosixPath", "Path")


READ = [
    (
        grammar.settings,
        [["a.b=1", "c=[1, 2.5]", "d={e: 1}", "f=yes", "g=null", "h=a b"], ["a"], ["=1"], ["a="], ["a=[1"]],
    ),
    (
        grammar.span,
        [
            "1..2",
            " 1.5 .. 2",
            "1.5..2",
            "-1..-0.5",
            "log 1..10",
            "log  0.1..1e3",
            "1e-3..1e3*5",
            "0..1*1",
            "0..1*50",
            "0..1~3",
            ".5..1.",
            "+1..2",
            "2..1",
            "1..1",
            "log 0..1",
            "log -1..1",
            "0..1*0",
            "0..1*51",
            "0..1~51",
            "1",
            "a..b",
            "0..1*",
            "0..1*2.5",
            3,
        ],
    ),
    (
        grammar.values,
        [
            "1,2,3",
            "a,b",
            "0:1:0.25",
            "0:1:0.3",
            "1:4",
            "4:1:-1",
            "-1:1",
            "1.0:3:1",
            "0:0.3:0.1",
            "1:1:5",
            "0:9999",
            "0:10000",
            "1:0",
            "0:1:0",
            "x:y",
            "true,null",
            "[1, 2],3",
            "'0:1:0.5'",
            "1e-3:3e-3:1e-3",
        ],
    ),
    (
        set_verb._by_node,
        [
            ["a.k", "1"],
            ["a.k", "1", "a.j", "x", "b.l.m", "[1, 2.5]"],
            ["a.k", "[1, 2]"],
            ["a.k", "[1, true]"],
            ["a.k", "[true, false]"],
            ["a.k", "[a, 1]"],
            ["a.k", "[[1]]"],
            ["a.k", "[]"],
            ["a.k"],
            ["k", "1"],
            ["a.", "1"],
            [".k", "1"],
            ["a.k", "{b: 1}"],
            ["a.k", "null"],
            ["a.k", "yes"],
            ["a.k", "[1"],
        ],
    ),
    (run_options._moment, ["a@1", "a/b@0", "a@b@2.5", "@1", "a@", "a@-1", "a@nan", "a", "a@1e3"]),
    (run_options._mode, ["processes", "realtime", "x"]),
    (declared._pace, ["full", "1", "0.001", "1000", "0", "0.0009", "1000.1", "x"]),
    (
        launched.strange,
        [
            ["ros2", "launch", "x"],
            ["a/rig.launch.py"],
            ["rig.launch.py", "scenario:=x", "mode:=realtime"],
            ["rig.launch.py", "scenaro:=x"],
            ["my.launch.py", "scenaro:=x"],
            ["rig.launch.py", "x:=", "mode:=y"],
        ],
    ),
    (
        _of_the_script,
        [
            [],
            ["env"],
            ["env", "-h"],
            ["env", "colcon"],
            ["setup"],
            ["setup", "--help"],
            ["bench", "x", "-h"],
            ["run", "setup"],
            ["--workspace"],
            ["--workspace=x", "run"],
            ["docs", "--serve"],
            ["python", "x.py"],
        ],
    ),
    (
        repeating.for_reader,
        [
            "/a/b/softrig run x --mode inprocess",
            "softrig run /a/config/scenarios/x.yaml --out /b/c --seed 3",
            "softrig --workspace /w run /a/mine.yaml --params-file /a/b.yaml",
            "softrig run --like /a/b/ --set 'n.k=[1, 2]'",
            "",
            "softrig run 'x",
            "softrig run a/b.yaml --set a=/b",
            "softrig run x --out",
        ],
    ),
]


def test_typed_words_are_parsed_as_expected():
    messages = []
    for function, cases in READ:
        messages.append(f"{function.__module__.rpartition('.')[2]}.{function.__name__}")
        for case in cases:
            result = answer(function, *(("n", case) if function in (grammar.span, grammar.values) else (case,)))
            if function is grammar.values and result.startswith("[") and result.count(",") > 20:
                result = f"{result.count(',') + 1} values, {result[:10]} to {result[-12:]}"
            messages.append(f"  {case!r} -> {result or 'nothing'}")
    check_expected("words_read", messages)


@trying(max_examples=60, deadline=None)
@given(st.integers(-50, 50), st.integers(0, 40), st.integers(1, 9))
def test_a_range_has_both_ends_and_equal_steps(low, count, tenths):
    """Exactly, as fractions: LOW, LOW + STEP, ... up to HIGH; a HIGH between two steps is not reached."""
    step = Fraction(tenths, 10)
    for beyond in (Fraction(0), step / 2):
        high = low + count * step + beyond
        result = grammar.values("n", f"{low}:{float(high)!r}:{float(step)!r}")
        assert result == [pytest.approx(float(low + k * step), abs=1e-12) for k in range(count + 1)]
        assert grammar.values("n", f"{low}:{low + count}") == list(range(low, low + count + 1))


def test_params_files_are_read_as_expected(tmp_path):
    """Dotted and nested names, nodes with or without a namespace; parameters of every ROS node are left out."""
    cases = {
        "plain": "law: {ros__parameters: {k: 2.0, use_sim_time: true, run: {mode: lockstep}, a: {b: 1, c: {d: x}}}}",
        "namespace": "/rig/law: {ros__parameters: {qos_overrides: {x: 1}, e.f: [1]}}",
        "two": "law: {ros__parameters: {k: 1}}\nplant: {ros__parameters: {k: 3}}",
        "unknown": "lav: {ros__parameters: {k: 2.0}}",
        "no parameters": "law: {k: 2.0}",
        "a list": "[1]",
        "no map": "law: 3",
        "empty": "law: {ros__parameters: {}}",
    }
    messages = []
    for name, text in cases.items():
        file = tmp_path / "p.yaml"
        file.write_text(text)
        messages.append(
            f"{name}: {answer(params_file.params_of, file, iter(['law', 'plant']))}".replace(str(tmp_path), "HERE")
        )
    messages.append(answer(params_file.params_of, tmp_path / "none", []).replace(str(tmp_path), "HERE"))
    check_expected("words_params", messages)


SAID = [
    "x",
    "x --mode container --realtime",
    "x --set a.k=[1, 2] --set b=3 --external law --external log --duration 0.5 --seed 0",
    "x --params-file /p/mine.yaml --label soft --domain 7 --out /o/out",
    "--like /r/run --mode inprocess --record-all",
    "--from /r/run@0.25 --set a.k=1 --duration 2",
]


def test_a_run_is_named_changed_and_repeated_as_expected(monkeypatch):
    """For each command: what it changes of the scenario, where the results are stored, and the words that repeat it."""
    monkeypatch.delenv("SOFTRIG_COMMAND", raising=False)
    messages = []
    for text in SAID:
        command = [w.replace("~", " ") for w in text.replace("[1, 2]", "[1,~2]").split()]
        options = parser().parse_args(["run", *command])
        messages.append(f"run {text}")
        messages.append(f"  changed: {run_options.changed_words(options)}")
        messages.append(f"  folder: {run_options.folder_name('x', options)}")
        messages.append(f"  again: {shlex.join(run_options.repeat(options))}")
        placement = run_options.placement_of(options)
        messages.append(
            f"  where: {placement}, domain {placement.domain}, wait {placement.wait}, restart {placement.restart}"
        )
    check_expected("words_again", messages)
    long = parser().parse_args(["run", "x", *["--set", f"a.k={'1' * 200}"]])
    # A shortened name does not end within a number.
    assert re.fullmatch(r"x-[0-9a-f]{8}", run_options.folder_name("x", long))


def test_the_effect_of_options_on_a_scenario_is_as_expected(tmp_path):
    """None, its length, seed and nodes; an impossible change is refused by name."""
    (tmp_path / "p.yaml").write_text("dc_motor_smc: {ros__parameters: {delta: 1.5, k: 70.0}}")
    messages = []
    for text in (
        "dc_motor_smc_b2",
        "dc_motor_smc_b2 --duration 2.5 --seed 4",
        "dc_motor_smc_b2 --external dc_motor_smc --seed 0",
        f"dc_motor_smc_b2 --params-file {tmp_path}/p.yaml --set dc_motor_smc.delta=3",
        "dc_motor_smc_b2 --external dc_motor_smcc",
        "dc_motor_smc_b2 --duration 0",
        "",
        "--like x y",
        "--like x --set a.k=1",
        "--like x --duration 0.0",
        "--from x@1 --params-file p",
        "--from x@1 --only a",
    ):
        result = answer(lambda text=text: run_options.scenario_of(parser().parse_args(["run", *text.split()])))
        if not result.startswith("refused"):
            scenario = run_options.scenario_of(parser().parse_args(["run", *text.split()]))
            law = scenario.nodes["dc_motor_smc"]
            result = f"{scenario.duration:g} s, seed {scenario.seed}, outside {law.external}, {dict(law.parameters)}"
        messages.append(f"{text} -> {result}".replace(str(tmp_path), "HERE"))
    check_expected("words_scenario", messages)


def test_a_command_of_a_later_version_does_not_end_the_process(monkeypatch):
    def recall(path, parse):
        return parse(["x", "--option-of-a-later-version"])

    monkeypatch.setattr("softrig_bringup.options.like.recall", recall)
    for words_of in (["--like", "r"], ["--from", "r@1"]):
        with pytest.raises(argparse.ArgumentError):
            run_options.scenario_of(parser().parse_args(["run", *words_of]))


def test_a_launch_passes_the_same_arguments_as_a_run():
    arguments = {name: default or "" for name, (default, _, _) in launched.ARGUMENTS.items()} | {"scenario": "x"}
    plain = launched._options(arguments)
    assert (plain.scenario, plain.mode, plain.realtime, plain.record_all) == ("x", "processes", True, False)
    assert (plain.duration, plain.seed, plain.params_file, plain.out, plain.external) == (None, None, None, None, [])
    more = {"mode": "lockstep", "place": "container", "duration": "1.5", "seed": "3", "params_file": "p", "out": "o",
            "external": "a b", "record": "all"}  # fmt: skip
    other = launched._options(arguments | more)
    assert (other.mode, other.realtime, other.record_all, other.duration, other.seed) == (
        "container",
        False,
        True,
        1.5,
        3,
    )
    assert (other.params_file, other.out, other.external) == (Path("p"), Path("o"), ["a", "b"])
    with pytest.raises(ScenarioError, match=r"argument --seed: expected a whole number from 0 to 9.22337e.18, got 'x'"):
        launched._options(arguments | {"seed": "x"})


def test_the_start_of_a_branch_is_written_as_the_command_of_the_first_run():
    recalled = SimpleNamespace(options=parser().parse_args(["run", "x", "--mode", "inprocess", "--seed", "2"]))
    for duration, words_of in ((None, ""), (3.0, " --duration 3.0")):
        options = SimpleNamespace(origin=(Path("r"), 0.5), recalled=recalled, duration=duration)
        assert run_options.begun(options) == {
            "run": "r",
            "at_s": 0.5,
            "command": f"run x --mode inprocess{words_of} --seed 2",
        }
    assert recalled.options.duration is None


def test_a_scenario_is_written_by_name_if_every_folder_finds_it(tmp_path, monkeypatch):
    (tmp_path / "mine.yaml").write_text("extends: dc_motor_smc_b2\ntitle: Mine\nvariants: {two: {title: Two}}\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SOFTRIG_SCENARIOS", str(tmp_path))
    assert repeating.scenario_word("dc_motor_smc_b2") == "dc_motor_smc_b2"
    assert repeating.scenario_word("mine") == str(tmp_path / "mine.yaml")
    assert repeating.scenario_word("mine.yaml") == str(tmp_path / "mine.yaml")
    assert repeating.scenario_word("mine_two") == "mine_two"
    assert repeating.scenario_word("none") == "none"


def test_a_command_begins_with_the_workspace_of_the_users_packages(tmp_path, monkeypatch):
    """Those that colcon has built there, or that --workspace named; none of the suite's own."""
    built, named, suite = tmp_path / "ws/install", tmp_path / "cache/prefix", tmp_path / "suite/install"
    for prefix, packages in (
        (built, ["rig_a"]),
        (named, ["rig_b"]),
        (suite, ["rig_c", "softrig_bringup"]),
        (tmp_path / "merged/rig_d", ["rig_d"]),
    ):
        index = prefix / "share/ament_index/resource_index/packages"
        index.mkdir(parents=True)
        for package in packages:
            (index / package).touch()
    for folder in (built, suite, tmp_path / "merged"):
        (folder / "local_setup.sh").touch()
    (named / "workspace").write_text(f"{tmp_path}/own\n")
    monkeypatch.setattr(repeating, "prefixes", lambda: [built, named, suite, tmp_path / "merged/rig_d"])
    repeating.workspace.cache_clear()
    monkeypatch.setenv("SOFTRIG_COMMAND", "/s/softrig")
    own = {"rig_a": tmp_path / "ws", "rig_b": tmp_path / "own", "rig_c": None, "rig_d": tmp_path, "rig_e": None}
    try:
        assert {name: repeating.workspace(name) for name in own} == own
        assert repeating.words(["rig_c", "rig_b", "rig_a"], "run") == [
            "/s/softrig",
            "--workspace",
            str(tmp_path / "own"),
            "run",
        ]
        monkeypatch.delenv("SOFTRIG_COMMAND")
        assert repeating.words(["rig_c"], "study", "x") == ["softrig", "study", "x"]
    finally:
        repeating.workspace.cache_clear()
