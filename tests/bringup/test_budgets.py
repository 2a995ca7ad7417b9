"""What a start may load: a verb does not import modules that it does not use."""

import os
import subprocess
import sys
from pathlib import Path

from conftest import PACKAGE
from softrig_bringup.cli import FOREIGN, SCRIPT, VERBS, main

ROOT = Path(__file__).parents[2]
# Libraries that no verb below needs.
HEAVY = (
    "asyncio", "bokeh", "casadi", "llvmlite", "matplotlib", "numba", "numpy.f2py", "optuna", "pandas", "pinocchio",
    "rclpy", "rosbags.typesys.stores", "scipy", "unittest",
)  # fmt: skip
RIG = ("softrig_core.rig", "softrig_core.block")
POOLS = ("multiprocessing", "concurrent.futures")
TABLES = ("pyarrow", "numpy.ma", *POOLS)
BAGS = ("sqlite3", "rosbags.rosbag2", "ruamel")  # of storages that are not read, and of bags that are written
B2 = "dc_motor_smc_b2"
RUN = ["run", B2, "--mode", "inprocess", "--duration", "0.05", "--out"]
STUDY = ["study", B2, "--duration", "0.05", "--workers", "1", "--grid", "dc_motor_smc.delta=1,5"]
FALSIFY = ["falsify", "dc_motor_smc_faults", "--strict", "--over", "dc_motor_plant.R=0.9..1.3", "--budget", "2"]
PLOT = ["draw", "plot", "r", "motor/state/shaft/velocity", "--format", "png", "--out", "plots"]
NONE = ("numpy", "pydantic", "yaml", "rich", "importlib.metadata", "inspect")
SCENARIO = "{title: t, system: s, duration: 1.0, nodes: {source: {package: faultrig, executable: source}}}"
# Verbs in the order of what they load: the words, modules that must not be loaded beside `HEAVY`, and the largest
# numbers of modules in all and of softrig's own. CPython 3.11 loads up to fourteen more of its own library than 3.13.
BUDGETS = (
    (["bag", "info", "r/bag"], (*RIG, *TABLES, *BAGS, "pydantic", "softrig_bringup.run"), 320, 62),
    (["bag", "compare", "r/bag", "r/bag"], (*RIG, *TABLES, *BAGS, "pydantic"), 325, 67),
    (["report", "r"], (*RIG, *TABLES, *BAGS, "pydantic"), 375, 97),
    (["draw", "layouts", B2, "--out", "layouts"], (*TABLES, *BAGS), 525, 175),
    (["check", B2], (*TABLES, *BAGS), 580, 215),
    (["new", "my_rig"], (*TABLES, *BAGS), 590, 220),
    (["list", "--signals", B2], (*TABLES, *BAGS), 595, 225),
    (["export", "c", B2, "dc_motor_smc", "--out", "c"], (*TABLES, *BAGS), 610, 240),
    (["steady", "dc_motor_fsfb"], (*TABLES, *BAGS), 680, 260),
    (["view", "r"], (*TABLES, *BAGS), 735, 310),
    (["pack", "r", "--out", "pack.zip"], (*TABLES, *BAGS[:2]), 775, 320),
    (["run", *RUN[1:], "again"], (*TABLES, *BAGS[:2]), 830, 320),
    ([*FALSIFY, "--workers", "1", "--out", "f"], ("pyarrow", "numpy.ma", POOLS[1], *BAGS[:2]), 850, 335),
    (STUDY, ("rosbags.typesys",), 880, 345),
    (["bag", "export", "r/bag", "--out", "tables"], (), 885, 346),
    (PLOT, (), 1100, 350),
)
NEEDED = {"plot": ("matplotlib", "unittest")}  # of `HEAVY`, by a word of the verb that needs them


def started(calls, folder, **variables):
    """Run verbs in a separate process; return after each how many modules there are, how many of them are softrig's.

    Parameters
    ----------
    calls : list of (list of str, tuple of str)
        Words of a verb, and modules that must not be there after it.
    """
    code = f"""
import sys
from types import SimpleNamespace
from softrig_bringup.cli import main
for words, heavy in {calls!r}:
    if words == ["view", "r"]:  # what is measured ends where the page begins
        sys.modules["softrig_bringup.view.serve"] = SimpleNamespace(serve=lambda *_: None)
    try:
        status = main(words)
    except SystemExit as end:
        status = end.code
    assert status in (0, 1), (words, status)
    found = [n for n in sys.modules if any(n == h or n.startswith(h + ".") for h in heavy)]
    assert not found, (words, found[:9])
    print("loaded", len(sys.modules), sum(n.startswith("softrig_") for n in sys.modules), file=sys.stderr)
"""
    command = [sys.executable, "-P", "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, env=os.environ | variables)
    assert done.returncode == 0, done.stderr[-2000:]
    return [[*map(int, line.split()[1:])] for line in done.stderr.splitlines() if line.startswith("loaded ")]


def test_a_verb_loads_only_what_it_needs(tmp_path):
    assert main([*RUN, str(tmp_path / "r"), "--quiet"]) == 0
    calls = []
    for words, heavy, *_ in BUDGETS:
        needed = [library for word in words for library in NEEDED.get(word, ())]
        calls.append((words, (*heavy, *(library for library in HEAVY if library not in needed))))
    loaded = started(calls, tmp_path)
    for (words, _, most, own), (modules, softrigs) in zip(BUDGETS, loaded, strict=True):
        assert modules <= most, (words, modules)
        assert softrigs <= own, (words, softrigs)


def test_help_of_any_verb_loads_no_library(tmp_path):
    verbs = VERBS - SCRIPT.keys() - {words.split()[0] for words in FOREIGN}
    # scripts/softrig caches the help text until a file of these folders is newer.
    kept = ("softrig_core", "kit", "softrig_bringup", "options", "pack", "study", "verbs")
    rooms = [f.parent for f in ROOT.glob("ros_pkgs/*/softrig_*/**/__init__.py") if f.parent.name not in kept]
    others = tuple(".".join(room.relative_to(ROOT).parts[2:]) for room in rooms)
    calls = [(words, NONE + others) for words in (["--help"], *([verb, "--help"] for verb in sorted(verbs)))]
    assert started(calls, tmp_path)[-1][0] <= 135


def test_a_list_of_unchanged_scenarios_loads_none_of_them(tmp_path):
    (tmp_path / "a.yaml").write_text(SCENARIO)
    places = {"SOFTRIG_SCENARIOS": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path), "AMENT_PREFIX_PATH": str(PACKAGE)}
    first, again = (started([(["list"], (*HEAVY, *heavy))], tmp_path, **places)[0][0] for heavy in (TABLES, NONE))
    assert 300 < first <= 470
    assert again <= 160


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
