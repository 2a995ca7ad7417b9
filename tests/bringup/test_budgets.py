"""What a start may load: a verb that a person waits for does not import what it does not use."""

import subprocess
import sys

import pytest

HEAVY = ("rosbags.typesys.stores", "matplotlib", "pandas", "pyarrow", "bokeh", "scipy.stats", "scipy.optimize", "rclpy")
RUN = ["run", "dc_motor_smc_b2", "--mode", "inprocess", "--duration", "0.05", "--out", "r"]


@pytest.mark.parametrize(
    ("calls", "modules", "more"),
    [
        ([["--help"]], 165, ("numpy", "pydantic", "numba")),
        ([["list"]], 470, ("numba", "softrig_core.native")),
        ([RUN, ["bag", "info", "r/bag"], ["report", "r"]], 780, ()),
    ],
)
def test_a_start_loads_what_it_needs(calls, modules, more, tmp_path):
    code = f"""
import sys
from softrig_bringup.cli import main
for words in {calls!r}:
    try:
        status = main(words)
    except SystemExit as end:
        status = end.code
    assert not status, (words, status)
found = [n for n in sys.modules if any(n == h or n.startswith(h + ".") for h in {HEAVY + more!r})]
assert not found, found[:9]
print(len(sys.modules), file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-2000:]
    assert int(done.stderr.split()[-1]) <= modules, done.stderr[-200:]
