"""Exported C against Python, call by call: the golden rows are Python's answers, the replay is compiled C."""

import ctypes
import json
import math
import re
import shutil
import subprocess
from graphlib import TopologicalSorter
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from conftest import few
from softrig_core import ScenarioError, jit, rig_of
from softrig_core.export import reader as reader_module
from softrig_core.export.check import BOARDS, FLAGS, TOOLS, replayed
from softrig_core.export.command import export_c, export_rig, main
from softrig_core.export.drawn import Raised, drawn_calls
from softrig_core.export.golden import golden_calls, member_of
from softrig_core.export.kinds import REAL, Table
from softrig_core.export.reader import Reader
from softrig_core.export.unit import Unit
from softrig_core.native.value import NotNative
from softrig_drives.dc_motor.sliding_mode import DcMotorSmc

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler (Debian: apt-get install gcc)")

NODES = {
    "a controller with reports": ("dc_motor_smc_b2", "dc_motor_smc"),
    "a plant with events": ("dc_motor_smc", "dc_motor_plant"),
    "complex numbers, tables of vectors": ("induction_dtc", "dtc_controller"),
    "fuzzy inference, functions called often": ("lsrm_fuzzy", "speed_controller"),
    "a plant with a compiled loop": ("lsrm_fuzzy", "lsrm_plant"),
    "an output that is silent at times, an absent input": ("dc_motor_fsfb", "step_buttons"),
    "states that are absent at first": ("rehab_impedance", "voltage_controller"),
    "what is None until the first message": ("dc_motor_fsfb", "fsfb_controller"),
    "a history that begins with the first message": ("pwa_delay_p3", "delay_line"),
    "a queue of messages, which grows": ("dc_motor_fsfb", "fieldbus_delay"),
    "random numbers": ("dc_motor_smc_b2", "dc_motor_plant"),
    "complex quotients": ("gupfc", "series_controller_1"),
    "a casadi function": ("induction_dtc", "im_plant"),
    "arrays that loops write": ("tcp_aqm_smc", "tcp_fluid"),
    "a tuple compared with what is None at first": ("tcp_aqm_smc_s3_change", "tcp_fluid"),
    "rows of complex arrays": ("gupfc", "gupfc_plant"),
    "answers that are kept at hand": ("pv_mppt", "shading_source"),
}


DAILY = {"a controller with reports", "random numbers"}
PARAMETERS = [
    pytest.param(*words, id=what, marks=() if what in DAILY else pytest.mark.long) for what, words in NODES.items()
]


@pytest.mark.parametrize(("scenario", "node"), PARAMETERS)
def test_c_has_the_bits_of_python(scenario, node, tmp_path):
    done = export_c(rig_of(scenario), node, tmp_path, rows=400, drawn=300)
    result = replayed(tmp_path, done.name)
    assert result.rows >= 600
    assert (result.differing, result.wrong_status) == (0, 0)
    assert result.same


def test_random_numbers_leave_no_branch_without_c(tmp_path):
    done = export_c(rig_of("induction_dtc"), "im_plant", tmp_path, rows=200, drawn=200)
    assert not done.discards
    result = replayed(tmp_path, done.name)
    assert result.same
    assert result.rows >= 400


def test_a_kept_answer_for_another_value_is_dropped_and_reported(tmp_path):
    patterns = [1000.0, 800.0, 600.0, 400.0, *[1000.0] * 4]
    overrides = {"shading_source.times": [0.0, 0.01], "shading_source.irradiance": patterns}
    done = export_c(rig_of("pv_mppt", overrides=overrides), "pv_plant", tmp_path, rows=60, drawn=50)
    assert done.discards == ("a value that _source is asked for later",)
    assert done.ends == "the rows end at 0.01 s: _source is asked for another value"
    result = replayed(tmp_path, done.name)
    assert result.same
    assert result.gave_up >= 1
    source = tmp_path / f"{done.name}.c"
    text = source.read_text()
    source.write_text(text.replace("if (SR_RARELY(!((v_conditions.f0", "if (false && (!((v_conditions.f0"))
    assert source.read_text() != text
    assert replayed(tmp_path, done.name).wrong_status >= 1


COMPILERS = {  # all must compute the same bits; the last one aborts on undefined behaviour
    "clang -O0": ("clang", "-O0"),
    "clang -O2": ("clang", "-O2"),
    "clang -O3": ("clang", "-O3"),
    "gcc -O0": ("gcc", "-O0"),
    "gcc -O3": ("gcc", "-O3"),
    "gcc, sanitizers": ("gcc", "-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"),
}
OTHERS = ("a controller with reports", "complex numbers, tables of vectors", "random numbers",
          "fuzzy inference, functions called often", "a queue of messages, which grows", "arrays that loops write",
          "a casadi function")  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("what", OTHERS)
def test_other_compilers_give_no_warning_and_the_same_bits(what, tmp_path):
    if not all(map(shutil.which, ("gcc", "clang"))):
        pytest.skip("needs gcc and clang (Debian: apt-get install gcc clang)")
    done = export_c(rig_of(NODES[what][0]), NODES[what][1], tmp_path, rows=400, drawn=300)
    sources = [f"{done.name}_replay.c", f"{done.name}.c", *json.loads(done.files[f"{done.name}.json"])["sources"]]
    warned = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off"]
    for name, compiler in COMPILERS.items():
        subprocess.run([*compiler, *warned, "-o", "replay", *sources, "-lm"], cwd=tmp_path, check=True)
        ran = subprocess.run(["./replay"], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert ran.returncode == 0, (name, ran.stdout[-500:], ran.stderr[-1000:])
        assert json.loads(ran.stdout)["rows"] >= 600


def rows_of(a, x):
    b = np.zeros_like(a)
    b[0, :] = a[1, :]
    b[1, :] = x
    like = np.empty_like(a[:, 0])
    like[0], like[1] = b[0, 2], b[1, 0]
    third = b[0] / 3.0
    return third[0] + third[1] * like[0] + like[1]


def floors(a, x):
    return math.floor(x) + a[0, 0]


LEVELS = (0.5, -0.25, 1e-3, 7.0, 3.0, -0.0)


@jit
def level(levels, k):
    return levels[k] / levels[3]


def constant_tuples(a, x):
    return level(LEVELS, int(abs(x)) % 6) + LEVELS[2] + (2.0 if LEVELS[5] == 0.0 else x)


def views(a, x):
    w = a.copy()
    remaining = w[1:]
    remaining[0, 0] = x
    w[:1] = -x
    other = w[1:2].copy()
    other[0, 1] = 3.0
    return w[1, 0] + w[0, 2] * remaining[0, 1] + other[0, 1] * w[1, 1]


def nested(a, x):
    total = 0.0
    for _ in range(2):
        for _ in range(3):
            total = 0.5 * total + x + a[0, 1]
    return total


def strided(a, x):
    column = a[:, 0]
    return column[0]


SMALL = (rows_of, floors, constant_tuples, views, nested)
FUNCTIONS = """
#include "softrig_c.h"
#include <string.h>
typedef struct { bool discarded; } t;
"""


def test_small_functions_have_the_bits_of_python(tmp_path):
    table = Table(REAL, (2, 3))
    unit = Unit("t", Reader, {}, {}, [], {})
    names = [unit.call(f, (table, REAL), (None, None), False).name for f in SMALL]
    body = "{{ t s = {{ false }}; return {name}(&s, a, x); }}"
    calls = "".join(f"double f{k}(double *a, double x) {body.format(name=n)}\n" for k, n in enumerate(names))
    parts = [FUNCTIONS, *unit.typedefs, *unit.tables.values(), *unit.functions, calls]
    (tmp_path / "f.c").write_text("\n".join(parts))
    shutil.copy(Path(reader_module.__file__).with_name("softrig_c.h"), tmp_path)
    subprocess.run(["cc", *FLAGS, "-shared", "-fPIC", "-o", "f.so", "f.c", "-lm"], cwd=tmp_path, check=True)
    library = ctypes.CDLL(str(tmp_path / "f.so"))
    a = np.array([[1.5, 2.0, 0.1], [0.7, -3.3, 1e-3]])
    for k, function in enumerate(SMALL):
        own = library[f"f{k}"]
        own.restype, own.argtypes = ctypes.c_double, [ctypes.c_void_p, ctypes.c_double]
        for x in (0.0, -0.0, 0.5, -0.5, 2.0**53 + 2, -3.0, 3.999999, -(2.0**52) - 0.5, 4e18, -4e18):
            assert own(a.ctypes.data, x).hex() == float(function(a, x)).hex(), (function, x)
    with pytest.raises(NotNative, match=r"test_export_c\.strided, line \d+: an array .* not contiguous"):
        unit.call(strided, (table, REAL), (None, None), False)


RIGS = [
    ("dc_motor_smc_faults", {"dc_motor_metrics"}),  # random numbers, a fault, and nodes of other periods
    *(
        pytest.param(*rig, marks=pytest.mark.long)
        for rig in (("dc_motor_fsfb", {"axis_metrics"}), ("induction_dtc", {"flux_monitor"}), ("pwa_delay_p3", set()))
    ),
]


@pytest.mark.parametrize(("scenario", "left"), RIGS)
def test_a_rig_in_c_publishes_the_bits_of_the_run(scenario, left, tmp_path):
    done, without = export_rig(rig_of(scenario), tmp_path, rows=200)
    result = replayed(tmp_path, done.name)
    assert result.rows == 200
    assert result.same
    assert without.keys() >= left
    assert max(scale for _, scale in result.errors) > 0.0
    if shutil.which("c++"):
        included = f'#include "{done.name}.h"\n'
        command = ["c++", "-Wall", "-Wextra", "-Werror", "-fsyntax-only", "-x", "c++", "-"]
        subprocess.run(command, input=included, text=True, cwd=tmp_path, check=True)
    source = (tmp_path / f"{done.name}.c").read_text()
    assert "= s->" in source
    wrong = source.replace("k * INT64_C(", "(k + 1) * INT64_C(", 1)
    (tmp_path / f"{done.name}.c").write_text(wrong)
    assert not replayed(tmp_path, done.name).same


def test_a_rig_whose_plant_has_no_c_is_refused(tmp_path):
    with pytest.raises(ScenarioError, match=r"fleet.*cannot be exported as C"):
        export_rig(rig_of("economic_dispatch_wood"), tmp_path, rows=3)
    assert not list(tmp_path.iterdir())


CHANGES = """
extends: dc_motor_smc_b2
changes:
  - at: 0.5
    set: {dc_motor_smc.delta: 0.5}
  - at: 1.0
    set: {dc_motor_smc.delta: 0.9, dc_motor_smc.k_per_ref: 1.1}
"""


def test_live_changes_are_replayed_by_setting_parameters(tmp_path):
    file = tmp_path / "dc_motor_changes.yaml"
    file.write_text(CHANGES)
    done = export_c(rig_of(str(file)), "dc_motor_smc", tmp_path, rows=200, drawn=50)
    rows = tmp_path / f"{done.name}_rows.txt"
    lines = rows.read_text().splitlines()
    assert [k for k, line in enumerate(lines) if line.startswith("set")] == [51, 102]
    assert replayed(tmp_path, done.name).same
    rows.write_text("\n".join(line for line in lines if not line.startswith("set")) + "\n")
    assert replayed(tmp_path, done.name).differing > 50


def test_a_state_continues_under_other_gains_as_in_python(tmp_path):
    file = tmp_path / "pid_changes.yaml"
    changes = [{"at": at, "set": {"dc_motor_pid.kp": kp}} for at, kp in ((0.02, 0.9), (0.03, 0.2))]
    file.write_text(json.dumps({"extends": "dc_motor_smc_a3", "changes": changes}))
    done = export_c(rig_of(str(file)), "dc_motor_pid", tmp_path, rows=600, drawn=30)
    assert not done.ends
    assert replayed(tmp_path, done.name).same
    source = tmp_path / f"{done.name}.c"
    text = source.read_text()
    source.write_text(re.sub(r"(?<=s->x\.f0 = )r;(?=[^}]*}[^}]*}[^}]*known)", "x;", text, count=1))
    assert source.read_text() != text
    assert replayed(tmp_path, done.name).differing > 10  # the wrong assignment makes the voltage jump


class Remembered(NamedTuple):
    last: float = 0.0


class Differing(DcMotorSmc):
    """A law whose own state lacks what the inherited `go_on` replaces."""

    def first(self):
        return Remembered()

    def update(self, x, t, **inputs):
        w = inputs["state"][0]
        return Remembered(w), {"command": (self.p.k_per_ref * (x.last - w),), "surface": (0.0,)}


def test_a_parameter_whose_change_python_refuses_is_compiled_in(tmp_path):
    rig = rig_of("dc_motor_smc_b2", classes={"dc_motor_smc": Differing})
    done = export_c(rig, "dc_motor_smc", tmp_path, rows=50, drawn=30)
    assert not done.settable
    assert replayed(tmp_path, done.name).same


@pytest.fixture(scope="module")
def law(tmp_path_factory):
    folder = tmp_path_factory.mktemp("law")
    rig = rig_of("dc_motor_smc_b2")
    return rig, folder, export_c(rig, "dc_motor_smc", folder, rows=200, drawn=300)


def test_the_replay_notices_a_changed_law(law, tmp_path):
    _, folder, done = law
    for file in folder.iterdir():
        text = file.read_text()
        (tmp_path / file.name).write_text(text.replace(" - p_w)", " + p_w)") if file.name == f"{done.name}.c" else text)
    assert (tmp_path / f"{done.name}.c").read_text() != (folder / f"{done.name}.c").read_text()
    assert replayed(tmp_path, done.name).differing > 100


def test_random_inputs_contain_errors_of_python(law):
    rig, _, _ = law
    member = member_of(rig, "dc_motor_smc")
    golden = golden_calls(rig, "dc_motor_smc", 1, 100)
    calls = [c for one in drawn_calls(member, member.block(1), golden, 300, 1) for c in one]
    assert any(isinstance(c, Raised) for c in calls)


MAIN = """
#include "dc_motor_smc.h"
#include <stdio.h>
#include <string.h>
int main(void)
{
    dc_motor_smc node, before;
    dc_motor_smc_params params = DC_MOTOR_SMC_PARAMS;
    dc_motor_smc_in in = { .state = { 5 }, .sensors = { 0, 0.1 }, .has_reference = true, .reference = { 10 } };
    dc_motor_smc_out out;
    dc_motor_smc_init(&node, NULL);
    int status = dc_motor_smc_step(&node, &in, &out, 0);
    printf("%d %.17g", status, out.command[0]);
    before = node;
    in.state[0] = SR_NAN;
    status = dc_motor_smc_step(&node, &in, &out, 10000000);
    printf(" %d %.17g %d", status, out.command[0], memcmp(&node.x, &before.x, sizeof node.x) == 0);
    params.delta *= 2;
    dc_motor_smc_init(&node, &params);
    in.state[0] = 5;
    status = dc_motor_smc_step(&node, &in, &out, 0);
    printf(" %d %.17g\\n", status, out.command[0]);
    return 0;
}
"""


def test_an_error_keeps_the_state_and_returns_the_safe_value_and_parameters_can_be_set(law, tmp_path):
    rig, folder, done = law
    assert "delta" in done.settable
    for file in folder.iterdir():
        shutil.copy(file, tmp_path)
    (tmp_path / "main.c").write_text(MAIN)
    command = ["cc", *FLAGS, "-o", "main", "main.c", "dc_motor_smc.c", "-lm"]
    subprocess.run(command, cwd=tmp_path, check=True)
    words = subprocess.run(["./main"], cwd=tmp_path, check=True, capture_output=True, text=True).stdout.split()

    def python(delta):
        block = member_of(rig_of("dc_motor_smc_b2", overrides={"dc_motor_smc.delta": delta}), "dc_motor_smc").block(1)
        inputs = {"state": (5.0,), "sensors": (0.0, 0.1), "reference": (10.0,)}
        return block.update(block.first(), 0, **inputs)[1]["command"][0]

    delta = member_of(rig, "dc_motor_smc").block(1).p.delta
    assert words[0] == "0"
    assert float(words[1]) == python(delta)
    assert words[2:5] == ["1", "0", "1"]
    assert float(words[6]) == python(2 * delta) != python(delta)


@pytest.mark.parametrize("board", few(BOARDS, 1))
def test_a_board_has_the_bits_of_python(law, board, tmp_path):
    if not all(map(shutil.which, ("arm-none-eabi-gcc", "qemu-system-arm"))):
        pytest.skip(f"needs {TOOLS}")
    _, folder, done = law
    for file in folder.iterdir():
        shutil.copy(file, tmp_path)
    result = replayed(tmp_path, done.name, board)
    assert result.same
    assert result.rows >= 500
    assert 500 < result.flash < 8000


def test_files_describe_themselves_and_are_reproducible(law, tmp_path):
    rig, folder, done = law
    again = export_c(rig, "dc_motor_smc", tmp_path, rows=200, drawn=300)
    assert again.files == done.files
    about = json.loads((folder / "dc_motor_smc.json").read_text())
    assert about["period_s"] == [1, 100]
    assert [p["topic"] for p in about["ports"]] == [
        "motor/state",
        "motor/sensors",
        "motor/reference",
        "motor/command",
        "motor/surface",
    ]
    assert about["digest"] in done.files["dc_motor_smc.h"]
    assert {"malloc", "alloca", "longjmp"}.isdisjoint(done.files["dc_motor_smc.c"].split())


def calls(text):
    """Each function of a C text, with the names that it calls."""
    function = r"^(?:static )?[\w* ]*?\b(\w+)\([^;{]*\)\n\{\n(.*?)^\}$"
    parts = re.findall(function, text, re.DOTALL | re.MULTILINE)
    return {head: set(re.findall(r"\b(\w+)\(", body)) for head, body in parts}


def test_there_is_no_recursion_no_dynamic_memory_and_no_compiler_warning(law):
    _, folder, done = law
    text = done.files[f"{done.name}.c"]
    graph = calls(text)
    assert {f"{done.name}_step", f"{done.name}_init"} <= graph.keys()
    order = list(TopologicalSorter({f: {c for c in own if c in graph} for f, own in graph.items()}).static_order())
    assert order[-1] in graph  # a recursion would raise a CycleError
    assert not {"malloc", "calloc", "realloc", "free", "alloca", "setjmp"} & set().union(*graph.values())
    assert not re.search(r"\b(while|goto|do) *\(|\bfor \(;;\)", text)  # the head of each loop has its bound
    warnings = ["-Wall", "-Wextra", "-Wconversion", "-pedantic", "-std=c99", "-Werror", "-fsyntax-only"]
    subprocess.run(["cc", *warnings, f"{done.name}.c", f"{done.name}_main.c"], cwd=folder, check=True)


@pytest.mark.parametrize(
    ("scenario", "node", "words"),
    [
        ("dc_motor_smc_b2", "dc_motor_smcc", ["dc_motor_smcc", "did you mean", "dc_motor_smc"]),
        (
            "gupfc_s5",
            "pulse_generator",
            ["cannot be exported as C", "PulseGenerator, line 32: ", "gupfc.pulses.gates, line"],
        ),
        ("economic_dispatch", "dispatch_solver", ["cannot be exported as C", "DispatchSolver, line", "it is a solver"]),
    ],
)
def test_a_construct_without_c_is_refused_with_its_reason(scenario, node, words, tmp_path):
    with pytest.raises(ScenarioError) as caught:
        export_c(rig_of(scenario), node, tmp_path, rows=50, drawn=50)
    assert all(word in str(caught.value) for word in words)
    assert not list(tmp_path.iterdir())


def test_the_verb_checks_in_both_precisions(tmp_path, capsys):
    assert main(["dc_motor_smc_b2", "dc_motor_smc", "--out", str(tmp_path / "d"), "--check"]) == 0
    assert "the bits of Python" in capsys.readouterr().out
    assert main(["dc_motor_smc_b2", "dc_motor_smc", "--real", "float", "--out", str(tmp_path / "f"), "--check"]) == 0
    out = capsys.readouterr().out
    assert "in single precision" in out
    assert "#define SR_FLOAT" in (tmp_path / "f" / "dc_motor_smc.h").read_text()
