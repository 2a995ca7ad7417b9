"""What is compared between two builds: commands, and pieces of code that both of them can run."""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

from softrig_core import ScenarioError

from . import native, reading

MILLION = 1_000_000
Values = tuple[float, ...]


@dataclass(frozen=True)
class Row:
    """A measurement in one checkout; some give several values.

    Parameters
    ----------
    measure : callable
        (checkout, scratch folder) -> values.
    parts : tuple of (str, str, str)
        Of each value: what is appended to the name of the row, its unit, and the target.
    rounds : int
        How often it is measured; before these once without counting, if `warm`.
    slow : bool
        Whether it runs only if asked for.
    """

    measure: Callable[[Path, Path], Values]
    parts: tuple[tuple[str, str, str], ...]
    rounds: int = 3
    warm: bool = True
    slow: bool = False


def plain() -> dict[str, str]:
    """Return the environment without the additions of this checkout's script."""
    ours = ("AMENT_", "PYTHON", "VIRTUAL_ENV", "SOFTRIG_", "_ROS_", "LD_PRELOAD", "OMP_", "OPENBLAS_", "NPY_")
    path = [p for p in os.environ["PATH"].split(os.pathsep) if p != f"{os.environ.get('VIRTUAL_ENV')}/bin"]
    kept = {name: value for name, value in os.environ.items() if not name.startswith(ours)}
    return kept | {"PATH": os.pathsep.join(path), "SOFTRIG_WORKSPACE": "none"}


def used(words: str, checkout: Path, folder: Path) -> Values:
    """Run a command of a checkout; return the CPU time of it and of its processes in s, and its peak memory in MB.

    Raises
    ------
    ScenarioError
        It failed; with the end of what it wrote.
    """
    place = Path(tempfile.mkdtemp(dir=folder))
    command = [str(checkout / "scripts/softrig"), *words.replace("OUT", str(place / "out")).split()]
    with tempfile.TemporaryFile("w+") as output:
        process = subprocess.Popen(command, cwd=folder, env=plain(), stdout=output, stderr=output)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        output.seek(0)
        if process.returncode not in (0, 1):  # status 1: a figure of a changed run is outside its limit
            raise ScenarioError(f"{' '.join(command)}: status {process.returncode}: {output.read()[-500:]}")
    return used.ru_utime + used.ru_stime, used.ru_maxrss / 1024


def cost(words: str, checkout: Path, folder: Path) -> Values:
    """Return the CPU time of a command in s."""
    return used(words, checkout, folder)[:1]


def peak(words: str, checkout: Path, folder: Path) -> Values:
    """Return the peak memory of a command in MB."""
    return used(words, checkout, folder)[1:]


def pictures(words: str, checkout: Path, folder: Path) -> Values:
    """Return the CPU time that a command needs beyond the same one without pictures, in s."""
    bare, whole = (cost(f"{words}{option}", checkout, folder)[0] for option in (" --no-plots", ""))
    return (whole - bare,)


def drawing(words: str, function: str, checkout: Path, folder: Path) -> Values:
    """Return the CPU time in s of the function by which a command draws, with the import of its module.

    Nothing else of the command is measured, so that a command without an option to leave the pictures out has a row.

    Parameters
    ----------
    words : str
        Of the command, as for `used`.
    function : str
        ``module.function`` of softrig_bringup.
    """
    module, _, name = function.rpartition(".")
    return ran(HEAD + DRAWING.format(f"softrig_bringup.{module}", name, words), checkout, folder)


def ran(code: str, checkout: Path, folder: Path) -> Values:
    """Run code in a fresh process of a checkout and return the numbers of the list that it prints.

    Raises
    ------
    ScenarioError
        It failed; with the end of what it wrote.
    """
    place = Path(tempfile.mkdtemp(dir=folder))
    command = [str(checkout / "scripts/softrig"), "python", "-c", code, str(place)]
    pinned = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")  # as set by `softrig`
    done = subprocess.run(command, cwd=folder, env=plain() | pinned, capture_output=True, text=True)
    if done.returncode:
        raise ScenarioError(f"{checkout}: status {done.returncode}: {done.stderr[-500:]}")
    return tuple(json.loads(done.stdout.splitlines()[-1]))


def read(code: str, checkout: Path, folder: Path) -> Values:
    """Run a reader of a million messages; CPU s and peak MB."""
    return ran(HEAD + code + READ.format(str(_bag(folder.parent))), checkout, folder)


@cache
def _bag(folder: Path) -> Path:
    """Write the bag that both checkouts read: they write the same bytes."""
    reading.make(folder / "million", MILLION, "none")
    return folder / "million"


def of_c(checkout: Path, folder: Path) -> Values:
    """Return the times of the first and of a repeated recorded run, as multiples of C by hand."""
    return tuple(ns / _c() for ns in ran(HEAD + NATIVE, checkout, folder))


@cache
def _c() -> float:
    return native.rates("dc_motor_smc")["C by hand, recorded"]


HEAD = "import json, sys, time; from pathlib import Path\n"
READ = """
begin = time.process_time()
work(Path({!r}), Path(sys.argv[1], "out"))
spent = time.process_time() - begin
line = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(json.dumps([spent, int(line.split()[1]) / 1024]))
"""
READERS = {
    "signals": "from softrig_bags.read import signals\nwork = lambda bag, out: signals(bag)\n",
    # The function of the earlier build expects bags that are already read.
    "compare": """
from softrig_bags.compare import compare
from softrig_bags.read import signals
def work(bag, out):
    try:
        compare(bag, bag)
    except AttributeError:
        compare(signals(bag), signals(bag))
""",
    # The module of this function differs between the two builds.
    "export": "try:\n    from softrig_bags.export import export\nexcept ImportError:\n"
    "    from softrig_bags.read import export\nimport pyarrow.parquet\n"
    "work = lambda bag, out: export(bag, out, 'parquet')\n",
}
WRITE = """
from softrig_bags.write import write_bag
from softrig_core import Recording, rig_of, run_inprocess
rig = rig_of("induction_dtc", duration=2.0)
recording = Recording((topic, port.msgtype) for topic, port in rig.topics.items())
run_inprocess(rig, 1, recording, runs=10_000)
begin = time.process_time()
write_bag(Path(sys.argv[1], "bag"), recording)
spent = time.process_time() - begin
print(json.dumps([1e6 * spent / sum(len(topic.times) for topic in recording.topics.values())]))
"""
NATIVE = """
from softrig_core import Recording, load_scenario, rig_of, run_inprocess
def run(duration):
    given = load_scenario("dc_motor_smc")
    bare = dict.fromkeys(("figures", "expect", "requirements", "claims"), {}) | {"plots": (), "duration": duration}
    nodes = {name: node for name, node in given.nodes.items() if node.executable != "figures"}
    rig = rig_of(given.model_copy(update=bare | {"nodes": nodes}))
    recording = Recording((topic, port.msgtype) for topic, port in rig.topics.items())
    begin = time.process_time()
    run_inprocess(rig, 1, recording, runs=10_000)
    return (time.process_time() - begin) / rig.ticks * 1e9
run(0.5)  # loads the code
first = run(60.0)
print(json.dumps([first, min(run(60.0) for _ in range(5))]))
"""
WORKS = """
from softrig_bringup.study.draw import Case
from softrig_bringup.study.work import Work, run
from softrig_core.scenario.scenario import read_draft
def works(name, key, values, duration=None):
    draft = read_draft(name)
    return [Work(Case(k, name, "", {key: x}, 1), duration, runs=10_000, scenario=draft) for k, x in enumerate(values)]
"""
# What every command loads is not counted with the drawing modules.
DRAWING = """
import importlib
from softrig_core import Signals, load_scenario, rig_of, simulate
spent = -time.process_time()
module = importlib.import_module({0!r})
spent += time.process_time()
draw = module.{1}
def timed(*arguments, **options):
    global spent
    spent -= time.process_time()
    result = draw(*arguments, **options)
    spent += time.process_time()
    return result
module.{1} = timed
from softrig_bringup.cli import main
main({2!r}.replace("OUT", str(Path(sys.argv[1], "out"))).split())
print(json.dumps([spent]))
"""
# Workers of a study are forks of the process that has read it.
STUDY = """
from multiprocessing import get_context
def least(cases):
    def cpu(case):
        begin = time.process_time()
        run(case)
        return time.process_time() - begin
    return 1e3 * min(cpu(case) for case in cases)
studies = [works("induction_dtc", "im_plant.U_dc", [500.0 + 0.5 * k for k in range(120)], 2.0),
           works("dc_motor_smc", "dc_motor_smc.delta", [0.5 + 0.005 * k for k in range(120)])]
with get_context("fork").Pool(1) as pool:
    print(json.dumps(pool.map(least, studies)))
"""
# The first pass starts two workers; the second one measures.
WORKERS = """
import os, signal
from softrig_optim.sweep import Workers
def private(process):
    lines = Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()
    return sum(int(line.split()[1]) for line in lines if line.startswith("Private")) / 1024
cases = works("dc_motor_smc", "dc_motor_smc.delta", [0.5, 0.6], 0.5)
run(cases[0])
with Workers(2) as pool:
    times = [time.perf_counter()]
    for _ in range(2):
        pool.map(run, cases)
        times.append(time.perf_counter())
    lists = [file.read_text().split() for file in Path("/proc/self/task").glob("*/children")]
    children = [int(process) for one in lists for process in one]
    print(json.dumps([times[1] - times[0] - (times[2] - times[1]), max(map(private, children))]), flush=True)
    for process in children:  # the end of a pool is not measured
        os.kill(process, signal.SIGKILL)
    os._exit(0)
"""

B2 = "dc_motor_smc_b2"
FALSIFY = "falsify induction_dtc --duration 2 --requirement tracks --requirement flux_band --over im_plant.R_s=3.5..3.9"
STUDY_400 = "study induction_dtc --duration 2 --draw im_plant.U_dc=500..560 --draws 400 --out OUT"
CPU, MB = "CPU s", "MB"


def _command(words: str, target: str, **how: int | bool) -> Row:
    return Row(partial(cost, words), (("", CPU, target),), **how)  # type: ignore[arg-type]


def _drawing(words: str, function: str) -> Row:
    return Row(partial(drawing, words, function), (("", CPU, "0.3"),), rounds=1, warm=False)


# `made` is the result of `PREPARED`, and OUT a new path. A target without a unit is relative to the earlier build.
PREPARED = f"run {B2} --mode inprocess --out made"
ROWS = {
    "list": _command("list", "0.5"),
    "help": _command("--help", "0.5"),
    "bag info": _command("bag info made/bag", "0.5"),
    "bag compare": _command("bag compare made/bag made/bag", "0.5"),
    "run in process, 25 s of dc_motor_smc_b2, report and pictures": _command(
        f"run {B2} --mode inprocess --out OUT", "0.3"
    ),
    "run through processes, 0.01 s": _command(f"run {B2} --mode processes --duration 0.01 --out OUT", "0.5"),
    "run in a container, 20 s of induction_dtc": _command(
        "run induction_dtc --mode container --duration 20 --out OUT", "0.5", rounds=1
    ),
    "report": _command("report made", "0.5"),
    "study, 2 runs": _command(f"study {B2} --grid dc_motor_smc.delta=1,5 --out OUT", "0.5"),
    "study, 400 runs of 2 s of induction_dtc": _command(STUDY_400, "0.45", rounds=1),
    "falsify, 100 runs of 2 s of induction_dtc": _command(f"{FALSIFY} --budget 100 --out OUT", "0.3", rounds=1),
    "pictures of falsify": Row(
        partial(pictures, f"{FALSIFY} --budget 2 --out OUT"), (("", CPU, "0.3"),), rounds=1
    ),
    "pictures of a study, 2 runs": _drawing(
        f"study {B2} --grid dc_motor_smc.delta=1,5 --workers 1 --out OUT", "study.pictures.draw_study"
    ),
    "pictures of results, economic_dispatch": _drawing(
        "results economic_dispatch --workers 1 --out OUT", "plots.pictures.plot_run"
    ),
    "pictures of a run, at the end of run and view": _drawing(
        f"run {B2} --mode inprocess --duration 5 --out OUT", "plots.pictures.plot_run"
    ),
    "writing bags, a message of induction_dtc": Row(partial(ran, HEAD + WRITE), (("", "CPU us", "0.4"),)),
    **{
        f"{name} of a million JointState": Row(
            partial(read, code), (("", CPU, "0.2"), (", peak", MB, "200 MB")), rounds=1, warm=False
        )
        for name, code in READERS.items()
    },
    "one run of a study": Row(
        partial(ran, HEAD + WORKS + STUDY),
        ((" of induction_dtc, 2 s", "CPU ms", "0.45"), (" of dc_motor_smc, 3 s", "CPU ms", "0.5")),
    ),
    "two workers": Row(
        partial(ran, HEAD + WORKS + WORKERS), ((", start", "wall s", "0.1 s"), (", private memory of one", MB, "35 MB"))
    ),
    "native, recorded, dc_motor_smc": Row(
        of_c, ((", first run, fresh pages", "of C", "2.5 of C"), (", repeated", "of C", "2.5 of C"))
    ),
    "run in process, 120 s of induction_dtc": Row(
        partial(peak, "run induction_dtc --mode inprocess --duration 120 --out OUT"),
        ((", peak memory", MB, "300 MB"),),
        rounds=1,
        warm=False,
        slow=True,
    ),
}  # fmt: skip
