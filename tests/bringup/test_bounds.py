"""Every expansion has a bound, and every number option a range: out-of-range values are refused in one line before the
run.
"""

import argparse
import ast
import math
import os
import time
from pathlib import Path

import pytest
from softrig_bringup.cli import main, make_parser
from softrig_bringup.options.grammar import settings, span, values
from softrig_bringup.study import RUNS
from softrig_bringup.study.definition import make_study
from softrig_bringup.study.draw import cases, count
from softrig_core import ScenarioError, load_scenario, rig_of
from softrig_core.command_line import Number
from softrig_core.scenario.references import fill, fill_parameters

HEAD = "title: x\nextends: dc_motor_smc_b2\n"


def doubled(n):
    """Each shared value is twice the previous one: 2^n values from n short lines."""
    return {"a0": "x"} | {f"a{k}": [f"$a{k - 1}", f"$a{k - 1}"] for k in range(1, n)}


@pytest.mark.parametrize(
    ("shared", "text"),
    [
        (doubled(41), "its $ references make more than 100000 values (by a40 -> a39 -> a38"),
        ({f"r{k}": f"$r{(k + 1) % 500}" for k in range(500)}, "make more than 200 values in each other (by r0 -> r1"),
        ({f"r{k}": f"$r{k + 1}" for k in range(500)} | {"r500": 1}, "make more than 200 values in each other"),
        ({f"r{k}": {"x": [f"$r{k + 1}"]} for k in range(90)} | {"r90": 1}, "make more than 200 values in each other"),
        ({"a": "$b", "b": "$a"}, "shared value a refers to itself: a -> b -> a"),
    ],
)
def test_references_are_bounded(shared, text):
    begun = time.process_time()
    last = next(name for name in (["a40"] if "a40" in shared else []) + list(shared))
    with pytest.raises(ScenarioError) as caught:
        fill({"x": f"${last}"}, shared)
    assert text in str(caught.value)
    assert time.process_time() - begun < 2.0


def test_references_within_the_bounds_are_filled_in():
    assert sum(1 for _ in _flat(fill("$a14", doubled(15)))) == 2**14
    chain = {f"r{k}": f"$r{k + 1}" for k in range(80)} | {"r80": 7}
    assert fill({"x": "$r0"}, chain) == {"x": 7}


def _flat(value):
    if isinstance(value, list):
        for each in value:
            yield from _flat(each)
    else:
        yield value


def test_a_run_of_41_short_lines_is_refused(tmp_path, capsys):
    lines = "\n".join(f"  a{k}: [$a{k - 1}, $a{k - 1}]" for k in range(1, 41))
    (tmp_path / "x.yaml").write_text(f"{HEAD}shared:\n  a0: 1\n{lines}\n  all: $a40\n")
    assert main(["run", str(tmp_path / "x.yaml"), "--mode", "inprocess"]) == 2
    assert "its $ references make more than 100000 values" in capsys.readouterr().err


def test_parameters_of_other_nodes_are_bounded(tmp_path):
    with pytest.raises(ScenarioError, match=r"\$n\.big: its \$ references make more than 100000 values"):
        fill_parameters(["$n.big"] * 11, lambda node, name: list(range(10_000)))
    assert len(fill_parameters(["$n.big"] * 10, lambda node, name: list(range(10_000)))) == 10
    node = "  n{k}: {{package: softrig_control, executable: reference_source, parameters: {{period: {p}}}}}\n"
    nodes = "".join(node.format(k=k, p=f"$n{(k + 1) % 500}.period") for k in range(500))
    (tmp_path / "ring.yaml").write_text(f"title: x\nsystem: x\nsource: x\nduration: 1.0\nnodes:\n{nodes}")
    with pytest.raises(ScenarioError, match="parameters refer to each other through 50 nodes, from n0 to n49"):
        rig_of(str(tmp_path / "ring.yaml"))


def test_scenarios_that_extend_each_other_are_bounded(tmp_path):
    for k in range(300):
        (tmp_path / f"s{k}.yaml").write_text(f"extends: s{k + 1}\n")
    with pytest.raises(ScenarioError, match="extends more than 50 scenarios, one the other: s0 -> s1 -> s2"):
        load_scenario(str(tmp_path / "s0.yaml"))


@pytest.mark.parametrize("text", ["0:1:1e-12", "0:1:1e-320", "0:1e400", "-1e400:1:1", "0:1:1e400", "0:1:0", "1:0:1"])
def test_a_grid_is_bounded(text):
    with pytest.raises(ScenarioError, match="with at least one and at most 10000 values"):
        values("x", text)


def test_a_grid_up_to_its_bound():
    assert len(values("x", "1:10000:1")) == 10_000
    with pytest.raises(ScenarioError, match=r"expected numbers below 1\.8e308"):
        span("x", "0..1e400")


def test_the_runs_of_a_study_are_bounded():
    def study(**keys):
        return make_study({"name": "s", "scenario": "dc_motor_smc_b2", "title": "s"} | keys)

    grid = {f"dc_motor_smc.{name}": list(range(1000)) for name in ("c", "delta", "kp")}
    for keys, number in (({"grid": grid}, "1e+09"), ({"grid": grid, "seeds": 1000}, "1e+12")):
        for work in (count, lambda s: next(cases(s))):
            with pytest.raises(ScenarioError, match=rf"s: {number.replace('+', '.')} runs, expected at most {RUNS}"):
                work(study(**keys))
    assert count(study(seeds=1000)) == 1000


# options --------------------------------------------------------------------------------------------------------------


def numbers():
    """Each number option of each verb: the words before it, and the option."""

    def within(parser, words):
        for action in parser._actions:
            if isinstance(action, argparse._SubParsersAction):
                for name, sub in action.choices.items():
                    yield from within(sub, [*words, name])
            elif action.option_strings and (action.type in (int, float) or isinstance(action.type, Number)):
                yield pytest.param(parser, action, id=" ".join([*words, action.option_strings[-1]]))

    yield from within(make_parser(), [])


@pytest.mark.parametrize(("parser", "option"), numbers())
def test_every_number_option_refuses_infinity_and_names_its_range(parser, option):
    assert isinstance(option.type, Number), "expected softrig_core.command_line.Number, which has a range"
    for text in ("inf", "-inf", "nan", "1e400", "x", ""):
        with pytest.raises(
            argparse.ArgumentTypeError, match=r"expected a (whole )?number (of at least|from) -?[0-9.e+-]+"
        ):
            option.type(text)
    assert math.isfinite(option.type.low)
    assert option.type.kind is int or math.isfinite(option.type.high), "a time beyond 1e9 s has no nanoseconds"


def test_no_command_line_reads_a_number_without_a_range():
    """Including those of other packages: bag, export, locate."""
    for file in sorted(Path(__file__).parents[2].glob("ros_pkgs/*/softrig_*/**/*.py")):
        if "add_argument" not in (source := file.read_text()):
            continue
        for call in ast.walk(ast.parse(source)):
            if isinstance(call, ast.Call) and getattr(call.func, "attr", "") == "add_argument":
                arguments = {word.arg: word.value for word in call.keywords}
                kind = getattr(arguments.get("type"), "id", "")
                assert kind not in ("int", "float") or "choices" in arguments, f"{file}:{call.lineno}: expected Number"


@pytest.mark.parametrize("value", ["1_000", "[1_000]", "[1, '2_0']", "'1_000'"])
def test_a_number_with_underscores_is_refused(value):
    """YAML 1.2 and ROS read it as text; pydantic alone reads 1000."""
    name = "times" if value[0] == "[" else "positions"
    setting = f"motor_reference.{name}={value if name == 'times' else f'[{value}]'}"
    with pytest.raises(ScenarioError, match=r"expected a number without underscores, (1000|20)"):
        rig_of(load_scenario("dc_motor_smc_b2", settings([setting], "dc_motor_smc_b2")))


@pytest.mark.parametrize("word", ["run@inf", "run@1_0", "run@-1", "run@nan", "run@2e9", "run@", "@1"])
def test_a_moment_is_a_time(word, capsys):
    assert main(["run", "--from", word]) == 2
    assert "expected RUN@T, the folder of a run and a time from 0 to 1e9 s" in capsys.readouterr().err


def test_a_continued_run_ends_after_its_start(capsys):
    assert main(["run", "--from", "a@5", "--duration", "3"]) == 2
    printed = capsys.readouterr().err
    assert "--from a@5 --duration 3: the run would end before the branch; expected a duration above 5 s" in printed


@pytest.mark.parametrize("words", [["run", "x", "--out"], ["study", "x", "--out"], ["bag", "export", "x", "--out"]])
def test_a_name_that_is_not_text_is_refused(words, capsys):
    assert main([*words, os.fsdecode(b"o\xffut")]) == 2
    assert r"'o\udcffut': expected a name that is text in UTF-8; rename it" in capsys.readouterr().err


def test_a_folder_whose_name_is_not_text_is_refused_before_the_run(tmp_path, monkeypatch, capsys):
    """The recorded command contains the whole path."""
    (folder := tmp_path / os.fsdecode(b"\xff")).mkdir()
    monkeypatch.chdir(folder)
    assert main(["run", "dc_motor_smc_b2", "--mode", "inprocess", "--duration", "0.02", "--out", "out"]) == 2
    assert "expected a name that is text in UTF-8" in capsys.readouterr().err
    assert not [*folder.iterdir()]
