"""Settings that the machine would decide: pinned before numpy is loaded in every start, and stored with the results."""

import ast
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import few
from softrig_core import bits, needs
from softrig_core.solver import worker
from softrig_nodes.processes.executables import environment

PACKAGES = sorted(p for p in (Path(__file__).parents[2] / "ros_pkgs").glob("softrig_*"))
UNPINNED = {name: value for name, value in os.environ.items() if name not in bits.PINS}


def python(code, **variables):
    """The output of another process, started without pins."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=UNPINNED | variables)
    assert done.returncode == 0, done.stderr
    return done


@pytest.mark.parametrize("package", PACKAGES, ids=lambda p: p.name)
def test_each_package_begins_with_the_core(package):
    """A node first imports its package: what pins numpy's kernels must come before anything that loads numpy."""
    statements = ast.parse((package / package.name / "__init__.py").read_text()).body
    harmless = ("__future__", "importlib", "typing")  # these modules do not import numpy
    first = next(s for s in statements if not isinstance(s, ast.Expr) and getattr(s, "module", "") not in harmless)
    expected = "from .bits import pin" if package.name == "softrig_core" else "import softrig_core as softrig_core"
    assert ast.unparse(first) == expected


WIDE = """
import builtins, io, os
really = open
def pretended(file, *others, **more):  # a CPU with AVX-512, whatever this one is
    return io.StringIO("flags : avx2 avx512f") if file == "/proc/cpuinfo" else really(file, *others, **more)
builtins.open = pretended
"""
PINNED = "print({name: os.environ.get(name) for name in ('OPENBLAS_CORETYPE', 'NPY_DISABLE_CPU_FEATURES')} == " + (
    f"{bits.PINS})"
)
FOREIGN = """
import decimal, gc, json, locale, logging, multiprocessing, random, resource, signal, sys, threading, warnings
warnings.simplefilter("error")
def process():
    filters = [str(f) for f in warnings.filters if "numpy" not in str(f)]
    return dict(os.environ), filters, locale.setlocale(locale.LC_ALL), {
        s: signal.getsignal(s) for s in signal.valid_signals()}, logging.root.handlers[:], logging.root.level, (
        multiprocessing.get_start_method(allow_none=True), random.getstate(), str(decimal.getcontext()),
        gc.isenabled(), gc.get_threshold(), gc.get_freeze_count(), len(gc.callbacks), sys.excepthook, os.getcwd(),
        threading.active_count(), sys.getrecursionlimit(), sys.getswitchinterval(), os.sched_getaffinity(0),
        resource.getrlimit(resource.RLIMIT_NOFILE), sys.path[:], sys.meta_path[:])
def array():
    import numpy
    return numpy.geterr(), numpy.geterrcall(), str(numpy.get_printoptions()), str(numpy.random.get_state())
before = process()
if sys.argv[1] == "first":
    state = array()
import softrig_core, softrig_nodes, softrig_drives.dc_motor.plant, softrig_bags, softrig_bringup
assert process() == before
state = state if sys.argv[1] == "first" else array()
run = softrig_core.simulate("dc_motor_smc_b2", duration=0.1)
if sys.argv[1] == "after":
    softrig_core.kit.jit.our_numba()
assert (process(), array()) == (before, state)
print(json.dumps(run.kernels))
"""


@pytest.mark.parametrize("order", few(["first", "after"], 1))
def test_an_import_changes_nothing_in_the_process_of_a_user(order):
    command = [sys.executable, "-c", WIDE + FOREIGN, order]
    done = subprocess.run(command, capture_output=True, text=True, env=UNPINNED)
    assert (done.returncode, done.stderr) == (0, "")
    plain = "from softrig_core.bits import kernels; import json; print(json.dumps(kernels()))"
    # numpy's own choice holds, and the run records it.
    assert json.loads(done.stdout) == json.loads(python(plain).stdout)


def test_a_node_is_pinned_before_it_loads_numpy(tmp_path):
    marker = tmp_path / "share/ament_index/resource_index/packages/mine"
    marker.parent.mkdir(parents=True)
    node = tmp_path / "lib/mine/node"
    node.parent.mkdir(parents=True)
    node.write_text(f"{WIDE}\nimport softrig_drives, sys\nassert 'numpy' not in sys.modules\n{PINNED}")
    for is_node in (False, True):  # at first only a script in a folder called lib
        done = subprocess.run([sys.executable, node], capture_output=True, text=True, env=UNPINNED, check=True)
        assert done.stdout == f"{is_node}\n"
        marker.touch()


def test_the_command_line_and_its_processes_are_pinned(tmp_path, monkeypatch):
    assert (
        python(f"{WIDE}\nimport sys, softrig_bringup.cli\nassert 'numpy' not in sys.modules\n{PINNED}").stdout
        == "True\n"
    )
    for name in bits.PINS:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(bits, "cpu_has_avx512", lambda: True)
    assert environment(1, tmp_path).items() >= bits.PINS.items()
    started = []
    monkeypatch.setattr(subprocess, "Popen", lambda command, env, **_: started.append(env) or 1 / 0)
    with pytest.raises(ZeroDivisionError):  # the stand-in raises this instead of starting a process
        worker._Process("module", "name", None)
    assert started[0].items() >= bits.PINS.items()


def test_a_wheels_prefix_is_found_and_joined_where_processes_start(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    environ = {"AMENT_PREFIX_PATH": "/a:/b"}
    assert needs.prefixes(environ) == ["/a", "/b"]  # the prefix has no wheel yet
    (tmp_path / "share/ament_index/resource_index/packages").mkdir(parents=True)
    (tmp_path / "share/ament_index/resource_index/packages/softrig_core").touch()
    assert needs.prefixes({}) == [str(tmp_path)]
    assert needs.prefixes({"AMENT_PREFIX_PATH": f"{tmp_path}:/a"}) == [str(tmp_path), "/a"]
    needs.join_prefix(environ)
    assert environ == {"AMENT_PREFIX_PATH": f"/a:/b:{tmp_path}"}
    monkeypatch.setenv("AMENT_PREFIX_PATH", "/a")
    assert environment(1, tmp_path)["AMENT_PREFIX_PATH"] == f"/a:{tmp_path}"
    assert os.environ["AMENT_PREFIX_PATH"] == "/a"


def test_settings_of_the_user_stay():
    chosen = {bits.CORE: "Prescott", "NPY_ENABLE_CPU_FEATURES": "X86_V2"}
    environ = dict(chosen)
    bits.pin(environ, wider=True)
    assert environ == chosen  # numpy does not start if both of its variables are set
    environ = {}
    bits.pin(environ, wider=True)
    assert environ == bits.PINS
    environ = {}
    bits.pin(environ, wider=False)
    assert environ == {}  # OpenBLAS obeys a pin even if the CPU lacks the instructions


@pytest.mark.parametrize(("flags", "wide"), [("fpu avx2 fma", False), ("fpu avx2 avx512f fma", True), (None, False)])
def test_the_cpu_is_asked_once(tmp_path, flags, wide):
    file = tmp_path / "cpuinfo"
    if flags is not None:
        file.write_text(f"processor\t: 0\nflags\t\t: {flags}\nbugs\t\t: avx512f\n\nprocessor\t: 1\n")
    assert bits.cpu_has_avx512(str(file)) == wide


SINES = """
import math, numpy as np
x = np.random.default_rng(2).normal(size=3000) * 50.0
for function, exact in ((np.sin, math.sin), (np.cos, math.cos)):
    assert function(x).tolist() == [exact(v) for v in x.tolist()]
assert np.hypot(x, x[::-1]).tolist() == [abs(complex(a, b)) for a, b in zip(x.tolist(), x[::-1].tolist())]
"""


@pytest.mark.parametrize(
    "features", [{"NPY_ENABLE_CPU_FEATURES": "X86_V2"}, {}, {bits.SIMD: ""}], ids=["baseline", "usual", "all"]
)
def test_sines_and_hypot_of_arrays_are_the_c_librarys_at_every_level(features):
    python(SINES, **features)  # the rule of test_bit_rule.py relies on this


def test_the_digest_distinguishes_another_math_library(monkeypatch):
    result = bits.math_digest.__wrapped__
    assert result() == result() == bits.math_digest()
    # Each function is computed at different arguments.
    assert all(low < high for low, high in bits.FUNCTIONS.values())
    exact, calls = math.log1p, []

    def nearly(x):
        calls.append(x)
        value = exact(x)
        # One argument in a thousand gives another last digit.
        return math.nextafter(value, 9.0) if len(calls) == 500 else value

    monkeypatch.setattr(math, "log1p", nearly)
    assert result() != bits.math_digest()
    assert len(calls) == bits.ARGUMENTS
