"""Fixtures: rigs made of the blocks in tests/rig_package, in-process and through real processes."""

import json
import os
import signal
import subprocess
import time
from base64 import b64decode
from contextlib import ExitStack, chdir, suppress
from pathlib import Path
from tempfile import TemporaryFile

import hypothesis
import pytest

pytest_plugins = ["forked"]

# A loaded machine is slow, which is no error of the code.
hypothesis.settings.register_profile(
    "any_speed", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("any_speed")
os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"  # rclpy then refuses an invalid field instead of publishing garbage
# A script that starts pytest in the background ignores SIGINT, and nodes would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
PATIENCE = 300.0  # s before a test fails; on a loaded machine nine nodes took 70 s to start
PACKAGE = Path(__file__).parent / "rig_package"
os.environ["AMENT_PREFIX_PATH"] = f"{PACKAGE}{os.pathsep}{os.environ.get('AMENT_PREFIX_PATH', '')}"
os.environ["PYTHONPATH"] = f"{PACKAGE / 'python'}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"

import sys  # noqa: E402

sys.path.insert(0, str(PACKAGE / "python"))

from softrig_core.bits import pin  # noqa: E402

# As on the command line, whose figures the tests expect. More threads of OpenBLAS would only wait for each other.
os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
pin()

from softrig_core import Recording, Scenario, Signals, rig_of, run_inprocess  # noqa: E402
from softrig_core.wire.recording import shard_topics  # noqa: E402
from softrig_nodes.processes.domain import free_domain  # noqa: E402
from softrig_nodes.processes.executables import environment, find_executable  # noqa: E402
from softrig_nodes.processes.fork_server import start_node  # noqa: E402
from softrig_nodes.processes.shared_memory import PORT  # noqa: E402

CLOCKS = {name: getattr(time, name) for name in ("monotonic", "perf_counter", "time", "time_ns", "sleep")}


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown():
    """Refuse a clock that a test leaves behind: threads of the next ones would wait forever."""
    yield
    assert {name: getattr(time, name) for name in CLOCKS} == CLOCKS


def pytest_terminal_summary(terminalreporter, config):
    """After the long set: the table of CONTRIBUTING.md, by folder."""
    if config.option.markexpr != "long":
        return
    rows = {}
    for outcome in ("passed", "failed", "error", "skipped"):
        for report in terminalreporter.stats.get(outcome, []):
            row = rows.setdefault("/".join(report.nodeid.split("/")[:2]), {"passed": 0, "other": 0, "seconds": 0.0})
            row["passed" if outcome == "passed" else "other"] += 1
            row["seconds"] += getattr(report, "duration", 0.0)  # the entry of a skipped file has no duration
    terminalreporter.write_line("| folder | passed | failed or skipped | minutes of a worker |\n|---|---|---|---|")
    for folder, row in sorted(rows.items()):
        terminalreporter.write_line(f"| `{folder}` | {row['passed']} | {row['other']} | {row['seconds'] / 60:.1f} |")


def few(values, most):
    """Return parameters of which `most`, spread evenly, are run daily, and the others in the long set."""
    values = list(values)
    daily = [k for k, value in enumerate(values) if not getattr(value, "marks", ())]
    kept = {daily[round(k * (len(daily) - 1) / max(1, most - 1))] for k in range(min(most, len(daily)))}
    for k in set(daily) - kept:
        value = values[k]
        parts = value.values if hasattr(value, "marks") else value if isinstance(value, tuple) else (value,)
        values[k] = pytest.param(*parts, marks=pytest.mark.long, id=getattr(value, "id", None))
    return values


def make_scenario(nodes, duration=1.0, **keys):
    """Scenario of faultrig blocks: node name -> executable, or -> dict with executable and more."""
    entries = {
        name: {"package": "faultrig", **({"executable": entry} if isinstance(entry, str) else entry)}
        for name, entry in nodes.items()
    }
    keys.setdefault("timeout", PATIENCE / 5)  # a late node on a loaded machine must not end the run
    return Scenario(name="test", title="test", system="lag", source="", duration=duration, nodes=entries, **keys)


def in_process(rig, seed=0):
    """Recording of an in-process run."""
    recording = Recording((t, p.msgtype) for t, p in rig.topics.items())
    run_inprocess(rig, seed, recording)
    return recording


def differences(a, b):
    """Topics whose messages differ in time or bytes."""
    return [n for n in a.topics if a.topics[n].times != b.topics[n].times or a.topics[n].data != b.topics[n].data]


@pytest.fixture
def lag_rig():
    """Plant, source and controller."""
    return rig_of(make_scenario({"plant": "plant", "source": "source", "gain": "gain"}))


# induction_dtc at 250 Hz in real time: two cores keep up, also beside a browser. Its figures are not judged.
SLOW_DRIVE = """nodes:
  im_plant: {parameters: {period: 0.004, substeps: 80, U_dc: 20.0}}
  dtc_controller: {parameters: {period: 0.004}}
  flux_monitor: {parameters: {period: 0.004}}
  speed_controller: {parameters: {period: 0.008}}
  speed_source: {parameters: {period: 0.008, times: [0.0, 2.9], velocities: [5.0, 5.0]}}
  load_source: {parameters: {period: 0.008}}
figures: {}
expect: {}
claims: {}
"""

# A process that presses the button of the plant by its service.
PRESS = """
import rclpy
from rclpy.node import Node
from std_srvs.srv import Trigger
rclpy.init()
node = Node("person")
client = node.create_client(Trigger, "plant/kick")
print("the person looks for the button", flush=True)
client.wait_for_service()
print("the person presses it and waits for the answer", flush=True)
rclpy.spin_until_future_complete(node, client.call_async(Trigger.Request()))
"""


def until(condition, what=str):
    """Wait for something that other processes do; a file that is not written yet, or whose process ends, is a no."""
    deadline = time.monotonic() + PATIENCE
    while True:
        with suppress(KeyError, IndexError, FileNotFoundError, ProcessLookupError):
            if result := condition():
                return result
        assert time.monotonic() < deadline, f"never happened: {what() if callable(what) else what}"
        time.sleep(0.02)


POINT = "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAAAAAA6fptVAAAACklEQVR4nGP4DwABAQEAsTj2FAAAAABJRU5ErkJggg=="


@pytest.fixture
def undrawn(monkeypatch):
    """Draw each picture as a white point, for tests of other things: existing files, links, tables."""

    def save(figure, where, **_):
        (where.write if hasattr(where, "write") else where.write_bytes)(b64decode(POINT))

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", save)


class Bench:
    """Real nodes in a separate domain, started one by one, each with a status file and a shard."""

    def __init__(self, directory, domain):
        self.directory = directory
        self.environment = environment(domain, directory)
        self.nodes = {}

    def start(self, name, executable, *arguments, package="faultrig"):
        command = [
            str(find_executable(package, executable)),
            "--ros-args",
            "-r",
            f"__node:={name}",
            "-p",
            f"run.status:={self.directory / name}.status",
            "-p",
            f"run.shard:={self.directory / name}.shard",
            *arguments,
        ]
        self.nodes[name] = start_node(package, executable, command, self.environment, 2)
        return self.nodes[name]

    def python(self, name, code):
        self.nodes[name] = subprocess.Popen([sys.executable, "-c", code], env=self.environment)
        return self.nodes[name]

    def kill(self, name):
        process = self.nodes.pop(name)
        process.kill()
        process.wait()

    def status(self, name):
        try:
            return json.loads((self.directory / f"{name}.status").read_text())
        except (FileNotFoundError, json.JSONDecodeError):
            return {}

    def wait(self, condition):
        until(condition, lambda: {n: self.status(n) for n in self.nodes})

    def ends(self, name):
        """Wait until a process has ended; return its exit status."""
        status = self.nodes[name].wait(PATIENCE)
        del self.nodes[name]
        return status

    def signal(self, name, signal):
        """What a node recorded: its outputs, and its inputs from outside."""
        shard = self.directory / f"{name}.shard"
        recording = Recording(shard_topics(shard).items())
        recording.read_shard(shard)
        return Signals(recording)[signal]


@pytest.fixture
def bench(tmp_path):
    with free_domain() as domain:
        bench = Bench(tmp_path, domain)
        try:
            yield bench
        finally:
            for name in list(bench.nodes):
                bench.kill(name)


def fork(stack, package, executable, command, variables, folder="."):
    """Start a process of the fork server, which saves its imports; `communicate` is as in subprocess.Popen."""
    output = stack.enter_context(TemporaryFile("w+"))  # noqa: SIM115
    with chdir(folder):
        process = start_node(package, executable, list(map(str, command)), variables, output.fileno())

    def communicate(timeout=None):
        process.wait(timeout)
        output.seek(0)
        return output.read(), None

    process.communicate = communicate
    return process


def replay(folder, bag, answered, node, *options):
    """Play a bag in lockstep into one real node (package, executable, arguments); return the player's status and
    output.

    Both come from the fork server.
    """
    with free_domain() as domain, ExitStack() as stack:
        variables = environment(domain, folder)

        def start(package, executable, *arguments):
            return fork(stack, package, executable, [find_executable(package, executable), *arguments], variables)

        process = start(*node)
        try:
            player = start(
                "softrig_bags", "player", bag, "--lockstep", *answered, *options, "--answers", folder / "answers"
            )
            return player.wait(PATIENCE), player.communicate()[0]
        finally:
            process.kill()
            process.wait()


def ears(process):
    """Ports in shared memory on which a process listens."""
    opened = {os.path.realpath(f) for f in Path(f"/proc/{process.pid}/fd").iterdir()}
    return {Path(f.removesuffix("_el")) for f in opened if f.endswith("_el") and PORT.search(f)}


def command_lines():
    """Command lines of all processes by pid, without those that end while they are read."""
    result = {}
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            result[int(entry.name)] = (entry / "cmdline").read_bytes()
    return result


def processes_of(directory):
    """Command lines, by pid, of the living processes of a run: they name the run's parameter files."""
    return {pid: command for pid, command in command_lines().items() if str(directory).encode() in command}


def no_process_left(directory):
    """Whether no process of the run is alive."""
    return not processes_of(directory)
