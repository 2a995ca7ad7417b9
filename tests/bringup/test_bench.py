"""The benchmark of a checkout: its parts run and print their tables; peers that are missing or fail are reported."""

import dataclasses
import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from shutil import which
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
from bench import against, against_rows, beside, induction, machines, native, page, places, realtime, rectifier, systems
from bench.__main__ import PARTS, main
from softrig_core import ScenarioError, bits
from softrig_drives.induction_dtc.switching import VECTORS

ROOT = Path(__file__).parents[2]


@pytest.mark.long
def test_the_script_names_the_parts_from_anywhere(tmp_path):
    (tmp_path / "rich.py").write_text("raise SystemExit('a file of the current directory was run')")
    command = [ROOT / "scripts/softrig", "bench", "--help"]
    # The environment of a shell that has none of softrig's variables.
    unpinned = {name: value for name, value in os.environ.items() if name not in bits.PINS}
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=unpinned)
    # No warning about numpy, which was not loaded before softrig.
    assert (result.returncode, result.stderr) == (0, "")
    for name, part in PARTS.items():
        assert f"{name} " in result.stdout
        assert part.__doc__.splitlines()[0] in result.stdout


def test_an_unknown_part_is_reported(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["lop"])
    assert ended.value.code == 2
    assert "no part lop; there are loop, tick" in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.skipif(which("gcc") is None, reason="needs gcc")
@pytest.mark.parametrize("name", native.LOOPS)
def test_the_loop_in_c_gives_the_bits_of_native_code(name, monkeypatch):
    # Drop the code that this process has generated.
    monkeypatch.setattr("softrig_core.native.fitted._counts", {})
    assert all(ns > 0.0 for ns in native.rates(name, 2.0).values())


def test_benchmarks_are_not_installed_with_the_packages():
    """An installation has nodes and tools, and no measurements of this machine."""
    assert not [p for p in ROOT.glob("ros_pkgs/**/*bench*.py") if "__pycache__" not in p.parts]
    assert not [p for p in ROOT.glob("ros_pkgs/*/setup.cfg") if "bench" in p.read_text()]


def test_a_broken_run_in_real_time_does_not_affect_other_rows(capsys, monkeypatch):
    figures = {"ticks": 980, "missed_deadlines": 20, "late_ticks": 30, **dict.fromkeys(realtime.TIMES.values(), 0.01)}
    recording = SimpleNamespace(topics={"joint_states": SimpleNamespace(data=[b""] * 980)})

    def drive(rate, topic, duration, way):
        if (rate, topic) == (10_000, "torque_ref"):
            raise ScenarioError("it did not reach the end")
        return SimpleNamespace(status={"im_plant": figures}, recording=recording)

    monkeypatch.setattr(realtime, "drive", drive)
    monkeypatch.setattr(realtime, "_floor", lambda rate, duration: ["1.00%", "17", "60"])
    written = []
    monkeypatch.setattr(realtime, "write_tables", lambda page, tables, *about: written.append(tables))
    with pytest.raises(SystemExit, match="10,000 Hz, 10 s, torque_ref read: it did not reach the end"):
        main(["realtime", "--all", "--write"])
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if ",000" in line]
    assert len(rows) == 28
    assert rows[0] == ["2,000", "10", "nothing", "native", "2.00%", "3.00%", "10", "10", "10", "10", "100.00%"]
    assert rows[7] == ["10,000", "10", "torque_ref", "native", "broke"]
    assert [row[3] for row in rows[12:18]] == ["native", "thread", "bursts"] * 2
    assert rows[-1] == ["20,000", "10", "nothing", "none,", "in", "C", "1.00%", "17", "60"]
    ((mark, lines),) = written[0].items()
    assert (mark, len(lines), len(written)) == ("realtime", 29, 1)
    assert lines[1][:6] == ("2,000", "10", "nothing", "native", "2.00%", "3.00%")
    assert {len(line) for line in lines} == {11}
    capsys.readouterr()
    with pytest.raises(SystemExit):
        main(["realtime", "--rate", "2000"])
    assert "no row of 2000 Hz without --all" in capsys.readouterr().err


def test_tables_of_the_rectifier(capsys):
    rectifier.print_table(20)
    out = capsys.readouterr().out
    assert all(name in out for name in (*rectifier.LAWS, *rectifier.PLANTS))


@pytest.mark.long
@pytest.mark.parametrize("part", ["rigs", "inprocess", "fault_location", "gupfc", "optimal_control"])
def test_parts_that_need_no_middleware_print_a_table(part, capsys):
    assert main([part]) == 0
    assert len(capsys.readouterr().out.splitlines()) > 3


@pytest.mark.long
def test_each_work_of_the_systems_has_a_row(capsys):
    assert main(["systems"]) == 0
    printed = capsys.readouterr().out
    assert [w.what for w in systems.works() if w.what not in printed] == []
    assert "yardstick: a million additions" in printed


def test_the_induction_motor_beside_its_peers(monkeypatch):
    tight = induction.PEERS["motulator-tight"]
    times = {"softrig natively, everything recorded": 0.5, tight: 2.0, "absent": None}
    monkeypatch.setattr(induction, "simulated_second", lambda python: times)
    monkeypatch.setattr(induction, "agreement", lambda python, seconds, name: 1e-9)
    assert induction.table()["induction"][1:] == [
        ("softrig natively, everything recorded", "0.5000", "1.0", ""),
        (tight, "2.0000", "4.0", "1.0e-09"),
        ("absent", "not installed", "", ""),
    ]


def test_drives_are_measured_beside_their_peer(monkeypatch, capsys):
    results = {"pmsm_foc": machines.Beside(0.01, 4.0, 1e-9, 2e-9)}
    monkeypatch.setattr(machines, "beside", lambda name, *_: results.get(name))
    assert main(["machines"]) == 0
    table = capsys.readouterr().out
    assert "400 x; apart by 1.0e-09 A and 2.0e-09 rad/s" in table
    assert "im_foc       motulator is not installed" in table


def test_the_duty_ratios_of_a_drive_are_those_of_its_periods():
    ratios, signals = machines.duty_ratios("pmsm_foc", 0.003)
    assert len(ratios["duties"]) == len(ratios["load"]) == 30
    assert ratios["duties"][5] == [signals[f"applied_duty/{leg}/effort"].x[6] for leg in "abc"]


@pytest.mark.long
@pytest.mark.parametrize(
    ("compare", "library", "package", "allowed"),
    [
        (beside.dc_motor, "python_control", "control", 1e-9),
        (beside.fmu, "fmpy", "fmpy", 1e-12),
        (beside.rectifier, "motulator_grid", "motulator", 1e-6),
    ],
)
def test_installed_libraries_end_where_our_rigs_do(compare, library, package, allowed):
    """Most of them come with the tests; the plants are implemented again in `beside_peers`."""
    pytest.importorskip(package)
    row = compare(library, allowed)
    assert row.apart < row.allowed


def test_a_peer_that_ends_elsewhere_is_an_error(monkeypatch):
    near = beside.Row("a", "work", 1.0, 2.0, 1e-10, 1e-9, "A")
    monkeypatch.setattr(beside, "version", lambda package: "7")
    known = beside.Peer(lambda *_: near, "b", "b {}, fast", "b", 1e-9)
    monkeypatch.setattr(beside, "ROWS", [known, known._replace(compare=lambda *_: None, name="c")])
    rows = beside.peers()["peers"][1:]
    assert rows[0] == ("`a`", "b 7, fast", "work", "1", "2", "2.0", "1.0e-10 A", "1e-09")
    assert rows[1][1:3] == ("c", "not installed")
    far = near._replace(apart=float("nan"))
    monkeypatch.setattr(beside, "ROWS", [known._replace(compare=lambda *_: far)])
    with pytest.raises(RuntimeError, match="b ends nan A from a, expected at most 1e-09"):
        beside.peers()


def test_a_table_is_written_between_its_marks_with_its_conditions(monkeypatch, tmp_path, capsys):
    """Marks, line and table replace what was there; a part without a page, and a page without the mark, are refused."""
    lab = tmp_path / "lab.md"
    lab.write_text("# Lab\n<!-- bench: peers -->\nold\n<!-- end -->\nkept\n<!-- bench: other -->\n<!-- end -->\n")
    for module in (page, realtime):
        monkeypatch.setattr(module, "ROOT", tmp_path)
    monkeypatch.setattr(page, "_commit", lambda: "c0ffee12")
    monkeypatch.setitem(sys.modules["bench.__main__"].PAGES, "peers", page.Page(lab, "CPU time, warm."))
    part = Mock(return_value={"peers": [("a", "b"), ("1", "2")]}, __doc__="About.")
    monkeypatch.setitem(PARTS, "peers", part)
    assert main(["peers"]) == 0
    assert "old" in lab.read_text()  # without --write the page stays as it is
    assert main(["peers", "--write"]) == 0
    head, mark, line, blank, *rest = lab.read_text().splitlines()
    assert (head, mark, blank) == ("# Lab", "<!-- bench: peers -->", "")
    assert re.fullmatch(
        r"Written by `scripts/softrig bench peers --write` on \d{4}-\d\d-\d\d \d\d:\d\d UTC at c0ffee12; "
        r"\d+ cores of .+; load [\d.]+ at the begin and [\d.]+ at the end\. CPU time, warm\.",
        line,
    )
    assert rest == ["| a | b |", "| --- | --- |", "| 1 | 2 |", "<!-- end -->", "kept", "<!-- bench: other -->",
                    "<!-- end -->"]  # fmt: skip
    with pytest.raises(ValueError, match="has 0 parts `<!-- bench: none -->`, expected one"):
        page.write(page.Page(lab, ""), {"none": [("a",)]}, "", page.Begin.now())
    with pytest.raises(SystemExit):
        main(["environment", "--write"])
    assert "--write: environment has no page; peers" in capsys.readouterr().err


MARKS = {"reading": ["reading none", "reading zstd"], "native": ["native loops", "native core", "native rigs"]}


def test_each_page_has_the_marks_of_its_part():
    for part, known in sys.modules["bench.__main__"].PAGES.items():
        for mark in MARKS.get(part, [part]):
            assert known.path.read_text().count(f"<!-- bench: {mark} -->\n") == 1, mark


@pytest.mark.skipif(find_spec("motulator") is None, reason="motulator is not installed")
def test_drives_are_those_of_motulator():
    for name in machines.MACHINES:
        result = machines.beside(name, sys.executable, 0.05)
        assert max(result.current, result.speed) < 1e-8


def test_a_peer_that_is_missing_or_fails_is_reported(tmp_path):
    assert [tuple(map(int, v)) for v in VECTORS] == induction.LEGS
    for name, command in (("bare", f'exec {sys.executable} -I -S "$@"'), ("broken", "echo 'no such case' >&2; exit 2")):
        python = tmp_path / name
        python.write_text(f"#!/bin/sh\n{command}\n")
        python.chmod(0o755)
    assert induction.peer("motulator", [1] * 20, str(tmp_path / "bare")) is None
    with pytest.raises(RuntimeError, match="motulator: no such case"):
        induction.peer("motulator", [1] * 20, str(tmp_path / "broken"))


@pytest.mark.skipif(find_spec("motulator") is None, reason="motulator is not installed")
def test_the_peer_integrates_the_same_voltage():
    result = induction.peer("motulator", [1] * 20)
    assert result["psi_alpha"] == pytest.approx(540 * 2 / 3 * 5e-5 * result["periods"], rel=0.01)


def test_a_commit_is_compared_in_turn_and_a_missing_one_is_refused(capsys, monkeypatch, tmp_path):
    assert main(["against", "nowhere"]) == 2
    assert "bench against 'nowhere': no such commit" in capsys.readouterr().err
    ran = []

    def measure(checkout, folder):
        ran.append((checkout.name, folder.name))
        return 4.0 * len(ran), {tmp_path.name: 40.0, ROOT.name: 10.0}[checkout.name]

    monkeypatch.setattr(against, "cost", lambda words, checkout, folder: ran.append((checkout.name, words)))
    row = against_rows.Row(measure, ((", CPU", "s", "0.5"), (", peak", "MB", "20 MB")), rounds=2)
    monkeypatch.setitem(against.ROWS, "x", row)
    result = against.compared(tmp_path, ["x"])
    turns = [(tmp_path.name, "before"), (ROOT.name, "now")]
    assert ran == [(name, against.PREPARED) for name, _ in turns] + 3 * turns
    # The first round warms up and is not counted.
    assert result == {"x": ([(20.0, 40.0), (28.0, 40.0)], [(24.0, 10.0), (32.0, 10.0)])}
    expected = ("x, CPU", "s", "24", "28", "1.17", "0.5"), ("x, peak", "MB", "40", "10", "0.25", "20 MB")
    assert tuple(against.rows(result)) == expected
    assert len(against.compared(tmp_path, ["x"], 1)["x"][0]) == 1
    assert [*map(against.three, (3379.6, 273.6, 0.2794))] == ["3,380", "274", "0.279"]


def test_rows_are_chosen_by_name_slow_ones_only_so_and_written(capsys, monkeypatch, tmp_path):
    lab = tmp_path / "lab.md"
    marks = "".join(f"<!-- bench: {mark} -->\n<!-- end -->\n" for mark in ("rows", "slow", "default"))
    lab.write_text(marks)
    for module in (page, realtime):
        monkeypatch.setattr(module, "ROOT", tmp_path)
    monkeypatch.setattr(page, "_commit", lambda: "c0ffee12")
    monkeypatch.setattr(against, "PAGE", page.Page(lab, "CPU."))
    monkeypatch.setattr(against, "built", lambda commit: tmp_path)
    monkeypatch.setattr(against, "compared", lambda other, names, rounds: dict.fromkeys(names, ([(2.0,)], [(1.0,)])))
    one = against_rows.Row(lambda *_: (1.0,), (("", "s", ""),))
    monkeypatch.setattr(against, "ROWS", {"quick": one, "long": dataclasses.replace(one, slow=True)})
    assert main(["against", "abc", "--write"]) == 0
    assert main(["against", "abc", "lo", "--write"]) == 0
    text = lab.read_text()
    assert text.count("| quick | s | 2 | 1 | 0.50 |  |") == text.count("| long | s | 2 | 1 | 0.50 |  |") == 1
    assert "Written by `scripts/softrig bench against abc lo --write`" in text
    with pytest.raises(SystemExit):
        main(["against", "abc", "other"])
    assert "no row begins with other; there are quick; long" in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.parametrize("name", ["pictures of a run", "writing bags", "one run of a study", "two workers"])
def test_code_that_both_builds_run_gives_a_number_for_each_part(name, tmp_path):
    row = next(row for known, row in against.ROWS.items() if known.startswith(name))
    values = row.measure(ROOT, tmp_path)
    assert len(values) == len(row.parts)
    assert all(value > 0.0 for value in values)


def test_the_page_has_a_place_for_each_table_of_a_comparison():
    text = against.PAGE.path.read_text()
    assert [m for m in ("rows", "slow", *against.MODES) if f"<!-- bench: {m} -->" not in text] == []


def test_whole_runs_are_compared_by_their_least_times_without_the_compiling_round(monkeypatch, tmp_path):
    costs = iter([9.0, 8.0, 4.0, 3.0, 5.0, 1.0])
    monkeypatch.setattr(against, "whole", lambda place, name, settings: next(costs))
    assert against.run_rows((tmp_path, ROOT), ["gupfc"], "default", 2) == [("gupfc", "4.000", "1.000", "0.25")]


def test_functions_that_state_a_part_of_a_tick_are_counted_and_calls_of_its_owner_are_not(tmp_path):
    room = tmp_path / "softrig_core" / "softrig_core" / "block"
    room.mkdir(parents=True)
    (room / "schedule.py").write_text(
        'def stride(all):\n    "Say which gcd(1, 2) it is."\n    return math.gcd(*all)  # p.sporadic\n'
        "class Plan:\n    def due(self, k):\n        return k % self.every == 0\n"
        "def asks(plan, k):\n    return plan.due(k)\n"
    )
    result = places.places(tmp_path)
    assert {kind: names for kind, names in result.items() if names} == {
        "greatest common divisor of the periods": ["schedule.stride"],
        "which nodes are due": ["schedule.due"],
    }


@pytest.mark.long
def test_each_part_of_a_tick_is_found_and_the_divisor_has_one_place():
    result = places.places()
    assert [kind for kind, names in result.items() if not names] == []
    assert result["greatest common divisor of the periods"] == ["schedule.__init__"]
