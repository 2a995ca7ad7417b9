"""What nodes, scenarios and links may declare, who must agree with whom, command lines and failures: each as expected
text.
"""

import cmath
import errno
import hashlib
import importlib.metadata
import json
import math
import os
import signal
import struct
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from expected_text import check_expected
from helpers import outcome
from softrig_core import Block, BlockParams, Plant, Rig, RunError, ScenarioError, bits, guard, param, scalars
from softrig_core.block.params import declarations
from softrig_core.command_line import Number, Parser, named, without_ros
from softrig_core.guard import guarded, naming, plain, print_line, quietly
from softrig_core.interrupt import Interrupt
from softrig_core.rig import code
from softrig_core.rig.agreement import agreed_values, agreeing, assumptions, require_agreement
from softrig_core.rig.installed import load_block, load_main
from softrig_core.rig.members import signal_units
from softrig_core.rig.options import InputLink, Links, RunOptions
from softrig_core.rig.package_check import check_entry_point, entry_points
from softrig_core.scenario.changes import ChangeEntry
from softrig_core.scenario.faults import FaultEntry
from softrig_core.scenario.scenario import FigureEntry, NodeEntry, PlotEntry, Scenario


def test_declarations_are_as_expected():
    lines = [
        f"run.{d.name} = {d.default!r}, {d.type.__name__}, {d.unit!r}, {d.lower} to {d.upper}{', live' * d.live}"
        for d in declarations(RunOptions)
    ]
    for model in (InputLink, Links, NodeEntry, FigureEntry, PlotEntry, ChangeEntry, FaultEntry, Scenario):
        how = model.model_config
        lines.append(f"{model.__name__}: unknown names are {how.get('extra')}, frozen {how.get('frozen', False)}")
        for name, field in model.model_fields.items():
            rules = ", ".join(
                str(rule).split(")")[0].rstrip("(") + ")" for rule in field.metadata if "Validator" not in str(rule)
            )
            default = "needed" if field.is_required() else repr(field.get_default(call_default_factory=True))
            lines.append(f"  {name} {default} {rules}".rstrip())
    lines += [
        f"run.{n} of {size}: {outcome(RunOptions, **{n: 'x' * size})[:40]}"
        for n in ("links", "changes", "status")
        for size in (10_001, 1 << 20, (1 << 20) + 1)
    ]
    lines += [
        f"run.{n} = {v}: {'no' if 'Error' in outcome(RunOptions, **{n: v}) else 'yes'}"
        for n, v in (
            ("timeout", 0.0),
            ("timeout", 1e6),
            ("timeout", 1.1e6),
            ("patience", 1.0),
            ("patience", 1.1),
            ("pace", 1e3),
            ("pace", 1001.0),
            ("seed", 2**63 - 1),
            ("seed", 2**63),
            ("epoch", 2**63 - 1),
            ("epoch", 2**63),
            ("mode", "other"),
            ("duration", 1e9),
            ("duration", 1.1e9),
        )
    ]
    check_expected("declared", lines)


# nodes that must agree ----------------------------------------------------------------------------------------------


class Agreement(BlockParams):
    mass: float = param(1.0, "a mass")
    row: tuple[float, ...] = param((1.0, 2.0), "a row")
    word: str = param("a", "a word")


class Speaks(Block[Agreement]):
    @classmethod
    def agreed(cls, params):
        return {"mass": params.mass, "row": params.row, "word": params.word}


class Assumes(Block[Agreement]):
    @classmethod
    def assumed(cls, params):
        return {"mass": params.mass, "other": 1.0}


def member(name, kind=Speaks, **values):
    return SimpleNamespace(name=name, block_class=kind, params=Agreement(**values))


def test_nodes_agree_within_the_last_digits():
    lines = []
    for values in (
        {},
        {"mass": 1.0 + 0.9e-12},
        {"mass": 1.0 + 1.1e-12},
        {"mass": 1},
        {"row": (1.0, 2.0 + 1e-13)},
        {"row": (1.0,)},
        {"row": (2.0, 1.0)},
        {"word": "b"},
        {"word": "x" * 100},
        {"word": "x" * 101},
        {"mass": 1.23456789012345678},
    ):
        short = {k: v if len(str(v)) < 50 else "much" for k, v in values.items()}
        lines.append(
            f"{short}: {outcome(require_agreement, 'here', [member('one'), member('two', **values), member('three')])}"
        )
    zero = [member("one", mass=0.0), member("two", mass=0.9e-300)]
    lines.append(f"nearly zero: {outcome(require_agreement, 'here', zero)}")
    lines.append(f"not zero: {outcome(require_agreement, 'here', [zero[0], member('two', mass=1.2e-300)])}")
    some = [member("one", mass=3.0), member("two", Assumes), member("three", Assumes, mass=3.0)]
    lines += [f"assumed: {line}" for line in assumptions(some)]
    reported = agreed_values([member("one"), member("two", mass=2.0)])
    lines.append(f"agreed_values: {reported}")
    for arguments, agreed in (
        ({}, {"m": "mass"}),
        ({"m": 1.0}, {"m": "mass"}),
        ({"m": 1.5}, {"m": "mass"}),
        ({}, {"m": "none"}),
        ({"m": 5}, {"m": "none"}),
        ({"k": 1}, {}),
    ):
        lines.append(f"{arguments} with {agreed}: {outcome(agreeing, reported, arguments, agreed)}")
        assert "n" not in arguments
    check_expected("agreement", lines)


class Sends(Plant[BlockParams]):
    OUTPUTS = (scalars("state", "state", {"x": "m", "y": "1"}),)

    def outputs(self, x, t):
        return {"state": (0.0, 0.0)}

    def advance(self, x, t):
        return x


class Hands(Block[BlockParams]):
    INPUTS = (scalars("state", "state", {"x": "", "y": ""}),)
    OUTPUTS = (scalars("copy", "copy", {"x": "", "y": ""}),)

    def update(self, x, t, *, state):
        return x, {"copy": state}


def test_units_are_those_of_the_sender():
    rig = Rig.from_blocks({"sends": Sends(), "hands": Hands()}, 0.1, plots=[{"title": "t", "signals": {"copy/x": "a"}}])
    assert signal_units(rig) == {
        "state/x/position": "m",
        "state/y/position": "",
        "copy/x/position": "m",
        "copy/y/position": "",
    }
    assert [list(p.signals) for p in rig.scenario.plots] == [["copy/x/position"]]
    other = rig.with_plots((PlotEntry(title="u", signals={"state/y": "b"}),))
    assert [(p.title, p.signals) for p in other.scenario.plots] == [("u", {"state/y/position": "b"})]
    assert rig.scenario.plots[0].title == "t"


# what a package offers ------------------------------------------------------------------------------------------------


class Needs(BlockParams):
    much: float = param(..., "no default")


class NoDefaults(Block[Needs]):
    pass


class Twice(Block[BlockParams]):
    INPUTS = (scalars("a", "t", {"x": ""}),)
    OUTPUTS = (scalars("a", "u", {"x": ""}), scalars("a", "v", {"x": ""}))


class Same(Block[BlockParams]):
    OUTPUTS = (scalars("b", "u", {"x": ""}), scalars("a", "u", {"x": ""}))


class Random(Sends):
    count = 0

    def outputs(self, x, t):
        Random.count += 1
        return {"state": (float(Random.count), 0.0)}


class Wrong(Sends):
    def outputs(self, x, t):
        return {"state": (math.nan, 0.0)}


def test_the_executables_of_a_package_are_tried_with_their_defaults(monkeypatch):
    def point(target):
        return SimpleNamespace(name="it", value="m:it", load=lambda: target)

    def main(kind):
        return type("Main", (), {"block": kind, "__call__": lambda self: 0})()

    lines = [
        f"{name}: {outcome(check_entry_point, point(target))}"
        for name, target in {
            "a number": 5,
            "a function": len,
            **{k.__name__: main(k) for k in (Sends, Hands, NoDefaults, Twice, Same, Random, Wrong)},
        }.items()
    ]
    check_expected("package_check", [line.replace("NaN", "nan") for line in lines])
    groups = ("console_scripts", "other", "softrig_figures")
    points = [importlib.metadata.EntryPoint(f"e{k}", "m:f", group) for k, group in enumerate(groups)]
    monkeypatch.setattr(importlib.metadata, "distribution", lambda package: SimpleNamespace(entry_points=points))
    assert [p.name for p in entry_points("some")] == ["e0", "e2"]


def test_an_executable_belongs_to_its_entry_point_group(monkeypatch):
    """A figure function of the same package does not."""
    points = [
        importlib.metadata.EntryPoint("run", "math:sin", "console_scripts"),
        importlib.metadata.EntryPoint("peak", "math:cos", "softrig_figures"),
        importlib.metadata.EntryPoint("odd", "no_such_module_of_test:f", "console_scripts"),
    ]
    result = SimpleNamespace(entry_points=importlib.metadata.EntryPoints(points))
    monkeypatch.setattr(importlib.metadata, "distribution", lambda package: result)
    assert (load_main("some", "run"), load_main("some", "peak"), load_main("some", "none")) == (math.sin, None, None)
    for executable, reported in (
        ("run", "some/run is a tool, not the node of a block"),
        ("peak", "package some has no executable 'peak'; it has odd, run"),
        ("odds", "package some has no executable 'odds' (did you mean 'odd'?); it has odd, run"),
        ("odd", "some/odd cannot be loaded: ModuleNotFoundError: No module named 'no_such_module_of_test'"),
    ):
        with pytest.raises(ScenarioError) as error:
            load_block("some", executable)
        assert str(error.value).partition(" (/")[0] == reported


def test_a_fingerprint_covers_the_files_except_generated_ones(tmp_path, monkeypatch):
    folder = tmp_path / "some_rig_package"
    (folder / "deep").mkdir(parents=True)
    files = {
        "__init__.py": b"import softrig_other_of_test\nimport numpy\n",
        "deep/a.py": b"x = 1\n",
        "table.csv": b"1,2\n",
    }
    for name, content in files.items():
        (folder / name).write_bytes(content)
    other = tmp_path / "softrig_other_of_test"
    other.mkdir()
    (other / "__init__.py").write_bytes(b"    from some_rig_package import x\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    kind = type("Own", (Block,), {"__module__": "some_rig_package.deep.a"})

    def now():
        code._package.cache_clear()
        return code._package("some_rig_package")

    result = code.fingerprints([kind])
    assert list(result) == ["softrig_core", "softrig_other_of_test", "some_rig_package"]
    digest = hashlib.sha256()
    for name in sorted(files):
        digest.update(f"some_rig_package/{name}\0{len(files[name])}\0".encode() + files[name])
    assert result["some_rig_package"] == digest.hexdigest()[:12]
    for built in ("__pycache__/a.cpython.pyc", "deep/a.so", "deep/a.nbi", "b.nbc"):
        (folder / built).parent.mkdir(exist_ok=True)
        (folder / built).write_bytes(b"built")
        assert now() == (result["some_rig_package"], ("softrig_other_of_test",))
    (folder / "deep/new.txt").write_bytes(b"")
    assert now()[0] != result["some_rig_package"]
    typed = type("Typed", (Block,), {"__module__": "__main__"})
    assert code.fingerprints([typed])["__main__.Typed"] == "unknown"
    assert set(code.fingerprints([typed], ["some_rig_package.deep", "json", "none_of_this"])) >= {
        "some_rig_package",
        "__main__.Typed",
    }
    now()


# the bits of a machine ------------------------------------------------------------------------------------------------


def test_the_digest_is_that_of_the_functions_listed_here():
    """Bags contain the digest: if it changed, earlier bags would count as recorded on another machine."""
    intervals = {
        "sin": (-40, 40),
        "cos": (-40, 40),
        "tan": (-10, 10),
        "asin": (-1, 1),
        "acos": (-1, 1),
        "tanh": (-3, 3),
        "exp": (-30, 30),
        "expm1": (-2, 2),
        "log": (0, 3),
        "log2": (0, 3),
        "log10": (0, 3),
        "log1p": (-0.9, 2),
    }
    at = [k * 0.6180339887498949 % 1.0 for k in range(1, 1001)]
    back = at[::-1]
    plane = [complex(4.0 * u - 2.0, 4.0 * v - 2.0) for u, v in zip(at, back, strict=True)]
    values = [getattr(math, name)(low + (high - low) * u) for name, (low, high) in intervals.items() for u in at]
    values += [getattr(cmath, name)(z) for name in ("exp", "sqrt", "sinh", "cosh", "atanh") for z in plane]
    values += [math.pow(9.0 * u, 8.0 * v - 4.0) for u, v in zip(at, back, strict=True)]
    values += [math.atan2(u - 0.5, v - 0.5) for u, v in zip(at, back, strict=True)]
    values += [math.hypot(u, v) for u, v in zip(at, back, strict=True)] + [abs(z) for z in plane]
    values += [z * w for z, w in zip(plane, plane[::-1], strict=True)]
    values += [z / w for z, w in zip(plane, plane[::-1], strict=True)]
    packed = b"".join(struct.pack("<dd", z.real, z.imag) for z in values)
    assert bits.math_digest.__wrapped__() == hashlib.sha256(packed).hexdigest()[:12]
    pins = {"OPENBLAS_CORETYPE": "Haswell", "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR"}
    assert pins == bits.PINS


# command lines --------------------------------------------------------------------------------------------------------


def test_each_error_on_a_command_line_is_one_line():
    parser = Parser(prog="softrig run", add_help=False)
    parser.add_argument("name")
    parser.add_argument("--seed", type=Number(int, 0, 9))
    parser.add_argument("--pace", type=Number(float, 0.5))
    parser.add_argument("--mode", choices=["one", "other"])
    lines = []
    for words in (
        "a --seed 3",
        "a --seed 9",
        "a --seed 10",
        "a --seed -1",
        "a --seed 1.5",
        "a --pace 0.5",
        "a --pace 0.4",
        "a --pace -1e-3",
        "a --pace inf",
        "a --pace nan",
        "a --pace x",
        "a b",
        "a b=c",
        "a --sed 3",
        "a --sed=3",
        "a --mode onne",
        "a --mode other",
        "",
        "a --seed",
    ):
        result = outcome(parser.parse_args, words.split())
        lines.append(f"{words}: {result.partition(';')[0] if 'Error' in result else result}")
    lines.append(outcome(Parser(prog="softrig", add_help=False).parse_args, ["x"]))
    lines += [f"{text}: {outcome(named, text, '--set', 'VALUE')}" for text in ("a=1", "a=", "=1", "a", "a=b=c")]
    for words in ("a b", "--ros-args -r x:=y", "a --ros-args -r x -- b", "a -- b", "--ros-args -- --ros-args x"):
        lines.append(f"{words}: {without_ros(words.split())}")
    check_expected("command_line", lines)


class Full:
    """A standard output that cannot be written to."""

    closed = False

    def flush(self):
        raise OSError(errno.ENOSPC, "no space")

    def fileno(self):
        raise ValueError("none")


def test_each_failure_has_its_line_and_status(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr("softrig_core.guard.secure_streams", lambda: None)
    monkeypatch.setattr("softrig_core.guard.keep_traceback", lambda folder=None: "FILE")
    lines = []

    def fails(error, cause=None):
        def work():
            raise error from cause

        return work

    stopped = KeyboardInterrupt()
    stopped.number = 15
    logged = ZeroDivisionError("with a log")
    logged.log = "LOG"
    for error in (
        ScenarioError("bad input"),
        RunError("it broke"),
        BrokenPipeError(),
        FileNotFoundError(2, "none", "a.txt"),
        PermissionError(13, "not ours", "a.txt"),
        OSError(errno.ENAMETOOLONG, "too long", "a"),
        OSError(errno.ENOSPC, "no space", "a"),
        OSError("no number"),
        KeyboardInterrupt(),
        stopped,
        MemoryError(),
        ModuleNotFoundError("no rclpy", name="rclpy.node"),
        ModuleNotFoundError("no x", name="x"),
        ModuleNotFoundError("no name"),
        ImportError("x: failed to map segment from shared object"),
        ImportError("else"),
        ValueError("odd"),
        logged,
        RunError("x" * 1000),
        RunError("x" * 1001),
        RunError("two\nlines\x1b[31m"),
    ):
        status = guarded(fails(error))
        printed = capsys.readouterr().err
        lines.append(f"{type(error).__name__}: {status} {printed if len(printed) < 300 else len(printed)}".rstrip())
    lines.append(
        f"of a package: {guarded(fails(ScenarioError('bad'), ValueError()))} {capsys.readouterr().err}".rstrip()
    )
    lines += [f"done: {guarded(lambda: 0)}, other: {guarded(lambda: 1)}"]
    monkeypatch.setattr(sys, "stdout", Full())
    lines.append(f"full: {guarded(lambda: 0)} {capsys.readouterr().err}".rstrip())
    monkeypatch.undo()
    missing = tmp_path / "gone"
    missing.mkdir()
    monkeypatch.chdir(missing)
    missing.rmdir()
    lines.append(f"no directory: {guarded(lambda: 0)} {capsys.readouterr().err}".rstrip())
    check_expected("failures", lines)


def test_streams_words_and_silence_are_as_expected(monkeypatch, capsys, tmp_path):
    with pytest.raises(OSError, match="x") as error, naming(tmp_path):
        raise OSError(5, "x")
    assert error.value.filename == str(tmp_path)
    with pytest.raises(OSError, match="x") as error, naming(tmp_path):
        raise OSError(5, "x", "own")
    assert error.value.filename == "own"
    assert not guard.is_quiet()
    with quietly():
        print("nobody reads this")
        assert guard.is_quiet()
        print_line("this somebody does")
    assert not guard.is_quiet()
    out, err = capsys.readouterr()
    assert (out, err) == ("", "softrig: this somebody does\n")
    assert plain("a\tb\nc\x00\x1b\x7f\u2028\u202eä") == "a\tb\nc\\x00\\x1b\\x7f\\u2028\\u202eä"
    with quietly(), pytest.raises(KeyError):
        raise KeyError
    assert not guard.is_quiet()
    monkeypatch.setattr(sys, "stdin", None)
    guard.secure_streams()
    assert sys.stdin.read() == ""
    sys.stdin.close()
    try:
        raise ValueError("kept")
    except ValueError:
        name = guard.keep_traceback(tmp_path / "new")
    kept = Path(name).read_text()
    assert os.path.dirname(name) == str(tmp_path / "new")
    assert kept.splitlines()[-1] == "ValueError: kept"
    (tmp_path / "file").write_text("")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert os.path.dirname(guard.keep_traceback(tmp_path / "file" / "below")) == str(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "none"))
    assert guard.keep_traceback().startswith("no file: ")
    assert json.dumps(guard.LINE) == "1000"


def test_a_third_interrupt_ends_the_process(monkeypatch):
    """Immediately if nothing has been done yet; during long work, by the signal that ends it."""
    asked = []

    def leave(status):
        raise SystemExit(status)

    monkeypatch.setattr("softrig_core.interrupt.os._exit", leave)
    handler = Interrupt()
    with pytest.raises(SystemExit) as ended:
        handler(2, None)
    assert ended.value.code == 0
    handler = Interrupt()
    handler.early = False
    with handler.leaving(lambda: asked.append("leave")):
        handler(2, None)
    handler(2, None)
    assert asked == ["leave"]
    with pytest.raises(SystemExit) as ended, handler.leaving(lambda: asked.append("leave")):
        handler(15, None)
    assert (ended.value.code, asked) == (128 + 15, ["leave"])
    installed = []
    monkeypatch.setattr("softrig_core.interrupt.signal.signal", lambda number, what: installed.append((number, what)))
    monkeypatch.delenv("SOFTRIG_PARENT", raising=False)
    for current, takes in ((signal.default_int_handler, True), (handler, False), (signal.SIG_IGN, False)):
        monkeypatch.setattr("softrig_core.interrupt.signal.getsignal", lambda number, current=current: current)
        installed.clear()
        handler.install()
        assert installed == [(signal.SIGINT, handler)] * takes


def test_output_that_a_full_disk_refused_is_not_tried_again_at_exit(monkeypatch):
    with open("/dev/full", "w") as full:
        full.write("text")
        monkeypatch.setattr(sys, "stdout", full)
        with pytest.raises(OSError, match="No space left"):
            guard._flush()
        assert os.readlink(f"/proc/self/fd/{full.fileno()}") == os.devnull
        full.flush()
