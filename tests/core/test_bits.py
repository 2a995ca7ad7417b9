"""What the machine decides: pinned before numpy is loaded, however a rig starts, and known by its results."""

import ast
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import pytest
from softrig_core import bits

PACKAGES = sorted(p for p in (Path(__file__).parents[2] / "ros_pkgs").glob("softrig_*"))
UNPINNED = {name: value for name, value in os.environ.items() if name not in bits.PINS}


def python(code, **variables):
    """What another process says, started without pins."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=UNPINNED | variables)
    assert done.returncode == 0, done.stderr
    return done


@pytest.mark.parametrize("package", PACKAGES, ids=lambda p: p.name)
def test_each_package_pins_before_it_imports_anything_else(package):
    statements = ast.parse((package / package.name / "__init__.py").read_text()).body
    harmless = ("__future__", "importlib", "typing")  # nothing of numpy in them
    first = next(s for s in statements if not isinstance(s, ast.Expr) and getattr(s, "module", "") not in harmless)
    if package.name == "softrig_core":
        stop = next(k for k, s in enumerate(statements) if ast.unparse(s) == "pin()")
        assert all(
            getattr(s, "module", "") in ("__future__", "importlib", "typing", "bits", "interrupt", "needs")
            or ast.unparse(s) == "quiet_imports()"
            for s in statements[1:stop]
        )
    else:
        assert ast.unparse(first) == "import softrig_core as softrig_core"


@pytest.mark.parametrize("module", ["softrig_drives.dc_motor.plant", "softrig_core.block.codec"])
def test_numpy_is_loaded_with_the_kernels_of_avx2(module):
    """However the first import is made: by the entry point of a node, a study's worker, a user's script."""
    code = f"import {module}, numpy; from softrig_core import bits; print(bits.blas_core(), bits.simd_level())"
    seen = python(code).stdout.split()
    assert not {"SkylakeX", "X86_V4", "AVX512_ICL"} & set(seen)
    if bits.cpu_has_avx512():
        assert seen[0] in ("Haswell", "X86_V2")  # another BLAS than OpenBLAS has no name
        assert "X86_V3" in seen


def test_what_the_user_has_set_stays():
    chosen = {bits.CORE: "Prescott", "NPY_ENABLE_CPU_FEATURES": "X86_V2"}
    environ = dict(chosen)
    bits.pin(environ, wider=True)
    assert environ == chosen  # numpy refuses to start with both of its variables
    environ = {}
    bits.pin(environ, wider=True)
    assert environ == bits.PINS
    environ = {}
    bits.pin(environ, wider=False)
    assert environ == {}  # OpenBLAS takes the word of a pin even where the CPU cannot do it


@pytest.mark.parametrize(("flags", "wide"), [("fpu avx2 fma", False), ("fpu avx2 avx512f fma", True), (None, False)])
def test_the_cpu_is_asked_once(tmp_path, flags, wide):
    file = tmp_path / "cpuinfo"
    if flags is not None:
        file.write_text(f"processor\t: 0\nflags\t\t: {flags}\nbugs\t\t: avx512f\n\nprocessor\t: 1\n")
    assert bits.cpu_has_avx512(str(file)) == wide


@pytest.mark.skipif(not bits.cpu_has_avx512(), reason="numpy chooses nothing wider on this CPU")
def test_numpy_before_softrig_is_said_once():
    said = python("import numpy, softrig_core, softrig_drives.dc_motor.plant").stderr
    assert said.count("numpy was loaded before softrig") == 1
    assert "SkylakeX" in said
    assert python("import numpy, softrig_core", **bits.PINS).stderr == ""
    assert python("import softrig_core, numpy, softrig_drives").stderr == ""


@pytest.mark.parametrize(
    ("core", "level", "given", "said"),
    [
        ("SkylakeX", "X86_V2 X86_V3 X86_V4", {}, ("OpenBLAS SkylakeX", "numpy X86_V2 X86_V3 X86_V4")),
        ("Haswell", "X86_V2 X86_V3", {}, ()),
        ("", "X86_V2 X86_V3 X86_V4", {}, ("(numpy X86_V2 X86_V3 X86_V4)",)),
        ("SkylakeX", "X86_V2 X86_V3", {bits.CORE: "SkylakeX"}, ()),
    ],
)
def test_what_was_chosen_before_is_compared(monkeypatch, core, level, given, said):
    monkeypatch.setattr(bits, "blas_core", lambda: core)
    monkeypatch.setattr(bits, "simd_level", lambda: level)
    text = bits.too_late(dict.fromkeys(bits.PINS) | given)
    assert bool(text) == bool(said)
    assert all(part in text for part in said)


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
    python(SINES, **features)  # the rule of test_bit_rule.py lets plants and laws use them


def test_the_digest_tells_another_math_library(monkeypatch):
    found = bits.math_digest.__wrapped__
    assert found() == found() == bits.math_digest()
    assert all(low < high for low, high in bits.FUNCTIONS.values())  # its arguments differ
    exact, calls = math.log1p, []

    def nearly(x):
        calls.append(x)
        value = exact(x)
        return math.nextafter(value, 9.0) if len(calls) == 500 else value  # one argument in a thousand, one last digit

    monkeypatch.setattr(math, "log1p", nearly)
    assert found() != bits.math_digest()
    assert len(calls) == bits.ARGUMENTS


def test_a_worker_process_inherits_the_pins():
    code = (
        "import softrig_core, os, json, subprocess, sys\n"
        "print(subprocess.run([sys.executable, '-c', 'import os, json; print(json.dumps(dict(os.environ)))'],"
        "                     capture_output=True, text=True).stdout)"
    )
    there = json.loads(python(code).stdout)
    expected = bits.PINS if bits.cpu_has_avx512() else {}
    assert {name: there.get(name) for name in expected} == expected
