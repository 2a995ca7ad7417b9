"""What a start may load: a verb does not import modules that it does not use."""

import os
import subprocess
import sys

from conftest import PACKAGE
from softrig_bringup.cli import FOREIGN, SCRIPT, VERBS

HEAVY = ("rosbags.typesys.stores", "matplotlib", "pandas", "pyarrow", "bokeh", "scipy.stats", "scipy.optimize", "rclpy")
RUN = ["run", "dc_motor_smc_b2", "--mode", "inprocess", "--duration", "0.05", "--out", "r"]
NONE = ("numpy", "pydantic", "yaml", "rich", "importlib.metadata", "inspect")
SCENARIO = "{title: t, system: s, duration: 1.0, nodes: {source: {package: faultrig, executable: source}}}"


def started(calls, heavy, folder, **variables):
    """Run verbs in a separate process and return how many modules it has loaded at the end, none of them heavy."""
    code = f"""
import sys
from softrig_bringup.cli import main
for words in {calls!r}:
    try:
        status = main(words)
    except SystemExit as end:
        status = end.code
    assert not status, (words, status)
found = [n for n in sys.modules if any(n == h or n.startswith(h + ".") for h in {HEAVY + heavy!r})]
assert not found, found[:9]
print(len(sys.modules), file=sys.stderr)
"""
    command = [sys.executable, "-P", "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, env=os.environ | variables)
    assert done.returncode == 0, done.stderr[-2000:]
    return int(done.stderr.split()[-1])


def test_a_start_loads_only_what_it_needs(tmp_path):
    assert started([RUN, ["bag", "info", "r/bag"]], ("ssl", "numpy.ma"), tmp_path) <= 750
    # The report of a run with pictures is made without the rig; numpy and pydantic read the bag and the figures.
    assert started([["report", "r"]], ("ssl", "numpy.ma", "softrig_core.rig", "softrig_core.block"), tmp_path) <= 440


def test_help_of_any_verb_loads_no_library(tmp_path):
    verbs = VERBS - SCRIPT.keys() - {words.split()[0] for words in FOREIGN}
    assert started([["--help"], *([verb, "--help"] for verb in sorted(verbs))], NONE, tmp_path) <= 135


def test_a_list_of_unchanged_scenarios_loads_none_of_them(tmp_path):
    (tmp_path / "a.yaml").write_text(SCENARIO)
    places = {"SOFTRIG_SCENARIOS": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path), "AMENT_PREFIX_PATH": str(PACKAGE)}
    assert 300 < started([["list"]], ("numba", "softrig_core.native"), tmp_path, **places) <= 470
    assert started([["list"]], NONE, tmp_path, **places) <= 160


def test_native_code_loads_neither_scipy_nor_coverage():
    """numba imports both where they are installed; functions of the user still have scipy's BLAS."""
    code = """
import sys
from softrig_core.kit.jit import our_numba
numba = our_numba()
found = {"scipy", "coverage"} & sys.modules.keys()
assert not found, found
from numba.np import arraymath
import scipy
assert arraymath._HAVE_BLAS
"""
    subprocess.run([sys.executable, "-P", "-c", code], check=True)
