"""State that a block keeps outside of x is named, wherever it is, and no verb's result depends on order or workers."""

from __future__ import annotations

import random
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
from softrig_bringup.falsify.definition import Falsification
from softrig_bringup.falsify.engine import falsify, prepare
from softrig_bringup.results.results import measure
from softrig_bringup.study.definition import Study
from softrig_bringup.study.engine import run_study
from softrig_bringup.verbs.check import Judged, judge
from softrig_core import Block, BlockParams, Rig, RunError, ScenarioError, param, scalars, simulate
from softrig_core.run import purity
from softrig_core.run.purity import check_pure

HERE = Path(__file__).parents[1] / "control" / "c_laws"
total = 0.0
seen: list[int] = []


@pytest.fixture(autouse=True)
def _nobody_has_passed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(purity, "_pure", set())


class Params(BlockParams):
    period: float = param(0.1, "period", "s", gt=0.0)


class State(NamedTuple):
    n: float


def by_global(law: Any, x: Any) -> float:
    global total
    total += 1.0
    return total


def by_list(law: Any, x: Any) -> float:
    seen.append(1)
    return float(len(seen))


def by_random(law: Any, x: Any) -> float:
    return random.random()


def by_attribute(law: Any, x: Any) -> float:
    law.helper[0] += 1.0
    return float(law.helper[0])


def closure() -> Any:
    count = 0.0

    def by_closure(law: Any, x: Any) -> float:
        nonlocal count
        count += 1.0
        return count

    return by_closure


def pure(law: Any, x: Any) -> float:
    return x.n + law.uniform(int(x.n))


def law_of(habit: Any, as_state: bool = False) -> type[Block[Any]]:
    class Law(Block[Params]):
        OUTPUTS = (scalars("u", "u", {"x": "1"}),)

        def setup(self) -> None:
            self.helper = [0.0]

        def first(self) -> State:
            return State(0.0)

        def update(self, x: State, t: int) -> Any:
            result = habit(self, x)
            return (State(result), {"u": (0.0,)}) if as_state else (State(x.n + 1.0), {"u": (result,)})

    return Law


@pytest.mark.parametrize("habit", [by_global, by_list, by_random, by_attribute, closure()], ids=lambda h: h.__name__)
@pytest.mark.parametrize("as_state", [False, True])
def test_an_impure_law_is_named_with_node_output_and_time(habit: Any, as_state: bool) -> None:
    what = r"its state n = \[[\d.]+\] and then \[[\d.]+\]" if as_state else r"u/x/position = [\d.]+ and then [\d.]+"
    rig = Rig.from_blocks({"bad": law_of(habit, as_state)()}, 1.0)
    with pytest.raises(RunError, match=rf"bad: the tick at t = 0 s, computed twice .* gives {what}; ") as result:
        check_pure(rig)
    assert result.value.node == "bad"
    # `check` and the generated tests of a new package run thorough checks.
    with pytest.raises(RunError, match=r"computed twice|in place"):
        simulate(rig, thorough=True)


def test_a_pure_law_passes_and_is_checked_once() -> None:
    made = law_of(pure)
    check_pure(Rig.from_blocks({"good": made()}, 1.0))
    assert made in {key[0] for key in purity._pure}
    assert simulate(Rig.from_blocks({"good": made()}, 1.0), thorough=True).error == ""


def test_a_late_change_in_a_module_variable_is_found_after_the_run() -> None:
    def late(law: Any, x: Any) -> float:
        global total
        if x.n > 5.0:
            total += 1.0
        return 0.0

    class Late(law_of(late)):  # type: ignore[misc]
        def update(self, x: State, t: int) -> Any:
            global total
            total += float(t > 500_000_000 and x.n > purity.TICKS)
            return State(x.n + 1.0), {"u": (0.0,)}

    with pytest.raises(RunError, match=r"law: its ticks change total in place"):
        simulate(Rig.from_blocks({"law": Late()}, 5.0), thorough=True)


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.long)])
def test_a_study_finds_effects_only_after_the_first_ticks(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, workers: int
) -> None:
    """A counter of calls in another module, which the check does not reach: rows depend on their order."""
    from softrig_drives.dc_motor.pid import DcMotorPid

    once = DcMotorPid.update
    monkeypatch.setitem(sys.modules, "counter", SimpleNamespace(calls=0))

    def update(self: Any, x: Any, t: int, **inputs: Any) -> Any:
        x, result = once(self, x, t, **inputs)
        import counter  # type: ignore[import-not-found]

        counter.calls += 1
        late = counter.calls if counter.calls > 60 else 0
        return x, {"command": (result["command"][0] * (1.0 - 1e-3 * late),)}

    monkeypatch.setattr(purity, "is_foreign", lambda of: True)
    study = Study(name="s", title="", scenario="dc_motor_smc_b4", duration=0.5,
                  grid={"dc_motor_plant.R": [0.3 + 0.02 * k for k in range(8)]})  # fmt: skip
    assert len(list(run_study(study, tmp_path / "pure", workers=workers).rows())) == 8
    monkeypatch.setattr(DcMotorPid, "update", update)
    with pytest.raises(RunError, match=r"run 7, computed again .*/effort = .* in a second run"):
        run_study(study, tmp_path / "impure", workers=workers)


LAWS = """
import itertools, os, random
from collections import deque
import numpy as np
from softrig_drives.dc_motor.pid import DcMotorPid
import habits_helper
from random import random as drawn

total, kept, SEEN, buffer, counter = 0.0, [], {}, np.zeros(1), itertools.count()

def closure():
    n = 0.0
    def again():
        nonlocal n
        n += 1.0
        return n
    return again

def by_global(law):
    global total
    total += 1.0
    return total

def by_list(law):
    kept.append(1)
    return len(kept)

def by_cache(law):
    return SEEN.setdefault(len(SEEN), len(SEEN))

def by_buffer(law):
    buffer[0] += 1.0
    return buffer[0]

def by_attribute(law):
    law.helper.append(1.0)
    return len(law.helper)

def by_class(law):
    Helper.n += 1
    return Helper.n

def by_default(law, mine=[]):
    mine.append(1)
    return len(mine)

def by_function(law):
    by_function.n = getattr(by_function, "n", 0) + 1
    return by_function.n

def by_helper(law):
    return habits_helper.count()

def by_library(law):
    os.environ["HABIT"] = str(int(os.environ.get("HABIT", "0")) + 1)
    return int(os.environ["HABIT"])

class Helper:
    n = 0

HABITS = {"global": by_global, "list": by_list, "cache": by_cache, "buffer": by_buffer, "attribute": by_attribute,
          "class": by_class, "default": by_default, "function": by_function, "helper": by_helper,
          "library": by_library,
          "closure": (lambda f: lambda law: f())(closure()), "iterator": lambda law: next(counter),
          "random": lambda law: random.random(), "drawn": lambda law: drawn(), "numpy": lambda law: np.random.rand()}

def law(habit):
    class Law(DcMotorPid):
        def setup(self):
            super().setup()
            self.helper = []

        def update(self, x, t, **inputs):
            x, found = super().update(x, t, **inputs)
            late = float(habit(self)) if t > 250_000_000 else 0.0  # after the ticks that are computed twice
            return x, {"command": (found["command"][0] * (1.0 - 5e-3 * late),)}
    Law.__module__ = __name__
    return Law
"""
LATE = {
    "global": "total",
    "list": "kept",
    "cache": "SEEN",
    "buffer": "buffer",
    "attribute": r"self\.helper",
    "class": r"Helper\.n",
    "default": "a default of by_default",
    "function": r"by_function\.n",
    "helper": "number",
    "closure": "n",
    "iterator": "counter",
    "random": "random",
    "drawn": "drawn",
    "numpy": r"np\.random",
}
DAILY = {"closure", "buffer", "helper", "random"}


@pytest.fixture
def laws(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A user's package with a law of each impure kind, and a scenario of each."""
    place = tmp_path / "place"
    info = place / "habits-0.1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: habits\nVersion: 0.1\n")
    kinds = [*LATE, "library"]
    (info / "entry_points.txt").write_text(
        "[console_scripts]\n" + "".join(f"by_{kind} = habits:Law_{kind}.main\n" for kind in kinds)
    )
    (place / "habits.py").write_text(LAWS + "".join(f"Law_{kind} = law(HABITS[{kind!r}])\n" for kind in kinds))
    (place / "habits_helper.py").write_text(
        "number = 0\ndef count():\n    global number\n    number += 1\n    return number\n"
    )
    for kind in kinds:
        (place / f"{kind}.yaml").write_text(
            "extends: dc_motor_smc_b4\nduration: 0.5\n"
            f"nodes:\n  dc_motor_pid: {{package: habits, executable: by_{kind}}}\n"
            "expect: {overshoot: at most 50}\n"
        )
    monkeypatch.syspath_prepend(str(place))
    for name in ("habits", "habits_helper"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return place


def each_verb(place: Path, kind: str, workers: int, order: int = 1) -> dict[str, str]:
    """Return the reports of study, falsify, check and results about a law."""
    scenario, messages = str(place / f"{kind}.yaml"), {}
    grid = {"dc_motor_plant.R": [0.3, 0.4][::order]}
    over = {"dc_motor_plant.R": "0.3..0.5"}
    task = Falsification(name="f", scenario=scenario, requirements=("overshoot",), over=over, strict=True, budget=4)
    out = place / f"{kind}_{workers}_{order}"

    def refused(verb: str, run: Any) -> None:
        try:
            run()
        except (RunError, ScenarioError) as error:
            messages[verb] = str(error)

    (out / "falsify").mkdir(parents=True)
    study = Study(name="s", title="", scenario=scenario, grid=grid)
    refused("study", lambda: run_study(study, out / "study", workers=workers))
    refused("falsify", lambda: falsify(task, prepare(task), out / "falsify", workers=workers))
    messages["check"] = judge(Judged(kind, scenario, ""))["error"]
    messages["results"] = measure((scenario, None)).error
    return messages


@pytest.mark.parametrize(
    ("kind", "workers", "order"),
    [
        pytest.param(kind, workers, order, marks=() if (kind in DAILY and workers == order) else pytest.mark.long)
        for kind in LATE
        for workers in (1, 2)
        for order in (1, -1)
    ],
)
def test_state_that_a_law_keeps_after_its_first_ticks_is_named_by_every_verb(
    laws: Path, kind: str, workers: int, order: int
) -> None:
    text = each_verb(laws, kind, workers, order)
    message = r"(\w: run \d, computed again after all others: )?dc_motor_pid: its ticks change ([\w.]+, )?"
    message += rf"{LATE[kind]} in place \(Law\)"
    assert all(re.match(message, text[verb]) for verb in ("study", "falsify", "check", "results")), text


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.long)])
def test_state_in_a_library_is_named_with_both_values(
    laws: Path, monkeypatch: pytest.MonkeyPatch, workers: int
) -> None:
    """No variable of the author's shows it, so only a repeated run does."""
    monkeypatch.setenv("HABIT", "0")
    text = each_verb(laws, "library", workers)
    second = r"dc_motor_pid: motor/command/armature/effort = [\d.-]+ at t = 0.26 s, and [\d.-]+ in a second run"
    assert re.match(r"s: run 1, computed again after all others: " + second, text["study"])
    assert re.match(r"f: run 3, computed again after all others: " + second, text["falsify"])
    assert re.match(second, text["check"])
    assert re.match(second, text["results"])


SCENARIO = """
title: a law in C
system: dc_motor
source: a test
extends: dc_motor_smc_b4
duration: 0.3
nodes:
  dc_motor_pid:
    package: softrig_control
    executable: c_controller
    parameters:
      period: 0.01
      sources: [{here}/pi.c]
      header: {here}/pi.h
      flags: [-DFAULT=STATIC]
      trajectories: [motor/reference]
      inputs:
        - motor/reference/shaft/velocity [rad/s] = reference
        - motor/state/shaft/velocity [rad/s] = speed
      outputs:
        - motor/command/armature/effort [V] = voltage
      values:
        - kp [V s/rad] = 0.5
        - ki [V/rad] = 2.0
        - limit [V] = 12
        - period [s] = 0.01
figures:
  peak_current: {{arguments: {{signal: motor/sensors/current_a/position}}}}
"""


@pytest.mark.long
@pytest.mark.parametrize(
    ("source", "needs", "package", "name"),
    [
        ("pi.c", "cc", "gcc", "integral"),
        ("static.cpp", "c++", "g++", r"law\(\)::one"),
        ("static.f90", "gfortran", "gfortran", "integral"),
        ("static.rs", "rustc", "rustc", "static::INTEGRAL;"),
    ],
)
def test_results_of_a_law_with_static_variables_do_not_depend_on_order_or_workers(
    source: str, needs: str, package: str, name: str, tmp_path: Path
) -> None:
    if shutil.which(needs) is None:
        pytest.skip(f"needs {needs}: apt-get install {package}")
    how = f"sources: [{HERE / source}]"
    if needs == "rustc":
        how = f"library: {tmp_path / 'liblaw.so'}"
        subprocess.run([needs, "-O", HERE / source, "-o", tmp_path / "liblaw.so"], check=True, capture_output=True)
    scenario = tmp_path / "static.yaml"
    text = SCENARIO.format(here=HERE).replace(f"sources: [{HERE}/pi.c]", how)
    scenario.write_text(text + "expect: {peak_current: at most 50}\n")
    values = [0.3, 0.5, 0.4]
    rows = []
    for k, (order, workers) in enumerate([(values, 1), (values[::-1], 1), (values, 2)]):
        parameters = {
            "name": "s",
            "title": "",
            "scenario": str(scenario),
            "grid": {"dc_motor_plant.R": order},
            "figures": ["peak_current"],
        }
        log = run_study(Study.model_validate(parameters), tmp_path / f"s{k}", workers=workers)
        rows.append({row["overrides"]["dc_motor_plant.R"]: row["figures"] for row in log.rows()})
        assert not any(row["error"] for row in log.rows())
    assert rows[0] == rows[1] == rows[2]
    assert len({repr(row) for row in rows[0].values()}) == len(values)
    outcomes = []
    for workers in (1, 2):
        (folder := tmp_path / f"f{workers}").mkdir()
        task = Falsification(
            name="f", scenario=str(scenario), requirements=("peak_current",), over={"dc_motor_plant.R": "0.3..0.5"},
            strict=True, budget=4,
        )  # fmt: skip
        outcomes.append(falsify(task, prepare(task), folder, workers=workers).worst)
    assert outcomes[0] == outcomes[1]
    assert None not in outcomes[0].values()
    reported = judge(Judged("static", str(scenario), ""))
    assert re.search(f"keeps state outside of pi: {name}", "".join(reported["notes"]))


def test_check_study_and_falsify_refuse_an_impure_law_before_any_row(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from softrig_drives.dc_motor.pid import DcMotorPid

    once = DcMotorPid.update

    def update(self: Any, x: Any, t: int, **inputs: Any) -> Any:
        x, result = once(self, x, t, **inputs)
        return x, {"command": (result["command"][0] + by_global(self, x) * 1e-9,)}

    monkeypatch.setattr(DcMotorPid, "update", update)
    message = r"dc_motor_pid: the tick at t = 0 s, computed twice .* gives motor/command/armature/effort = "
    for workers in (1, 2):
        study = Study(name="s", title="", scenario="dc_motor_smc_b4", grid={"dc_motor_plant.R": [0.3, 0.4]})
        with pytest.raises(RunError, match=message):
            run_study(study, tmp_path / f"s{workers}", workers=workers)
    assert not (tmp_path / "s1" / "rows.jsonl").exists()
    assert re.search(message, judge(Judged("dc_motor_smc_b4", "dc_motor_smc_b4", ""))["error"])
    bound = tmp_path / "bound.yaml"
    bound.write_text("extends: dc_motor_smc_b4\nexpect: {overshoot: at most 50}\n")
    over = {"dc_motor_plant.R": "0.3..0.5"}
    with pytest.raises(RunError, match=message):
        prepare(Falsification(name="f", scenario=str(bound), requirements=("overshoot",), over=over))
