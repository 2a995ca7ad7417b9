"""How a run that is stopped from outside ends: nodes leave, recordings are kept, the status names the signal."""

import fcntl
import itertools
import json
import mmap
import os
import re
import runpy
import select
import signal
import struct
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from conftest import PATIENCE, differences, in_process, make_scenario, no_process_left, processes_of, until
from softrig_bags.read import read_bag
from softrig_core import Signals, rig_of, run_inprocess
from softrig_nodes import run_processes
from softrig_nodes.processes import processes, shared_memory, spawning, stopping
from softrig_nodes.processes.children import end_left, read_status
from softrig_nodes.processes.domain import free_domain
from softrig_nodes.processes.executables import LOOPBACK, environment, find_executable
from softrig_nodes.processes.fork_server import start_node
from softrig_nodes.processes.placement import Listener, Placement
from softrig_nodes.processes.shared_memory import MADE, Ears, clear_ports, lacking, remove_leftovers
from softrig_nodes.processes.spawning import node_parameters, parameter_file
from softrig_nodes.processes.stopping import Stopped, stoppable
from softrig_nodes.seam import health

BASIC = {"plant": "plant", "source": "source", "gain": "gain"}


def test_a_signal_becomes_an_interrupt_once_and_the_handlers_are_restored():
    before = signal.getsignal(signal.SIGTERM)

    def stopped_twice():
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(5)
        finally:
            os.kill(os.getpid(), signal.SIGTERM)  # a second signal while the first one is handled

    with pytest.raises(Stopped) as caught, stoppable():
        stopped_twice()
    assert caught.value.number == signal.SIGTERM
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_signal_at_a_place_where_python_swallows_it_still_stops():
    class Swallows:
        def __del__(self):
            os.kill(os.getpid(), signal.SIGTERM)

    def strike(stopping):
        Swallows()
        stopping.check()

    with pytest.raises(Stopped) as caught, stoppable() as asked:
        strike(asked)
    assert caught.value.number == signal.SIGTERM


def test_a_second_signal_that_arrives_with_the_first_changes_nothing_and_prints_nothing(capfd):
    """Otherwise Python prints a traceback for a signal that its handler has caught and that is ignored by then."""

    def both(*numbers):
        # Both signals are pending when Python checks, so it calls their handlers by number.
        signal.pthread_sigmask(signal.SIG_BLOCK, stopping.SIGNALS)
        for number in numbers:
            # Another thread would receive the signal although this one blocks it.
            signal.pthread_kill(threading.get_ident(), number)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, stopping.SIGNALS)

    for first, second in itertools.combinations(stopping.SIGNALS, 2):
        with pytest.raises(Stopped) as caught, stoppable():
            both(first, second)
        assert caught.value.number in (first, second)
    assert "race" not in capfd.readouterr().err


def test_a_run_in_process_can_be_stopped():
    rig = rig_of(make_scenario(BASIC, 10.0))
    with pytest.raises(Stopped), stoppable():
        run_inprocess(rig, 0, None, lambda t: os.kill(os.getpid(), signal.SIGQUIT))


@pytest.mark.parametrize("ignored", [False, True])
def test_a_run_under_nohup_outlives_its_terminal(ignored):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN if ignored else signal.SIG_DFL)
    try:
        assert (signal.SIGHUP in runpy.run_path(stopping.__file__)["SIGNALS"]) is not ignored
    finally:
        signal.signal(signal.SIGHUP, before)


def test_leftovers_of_dead_processes_are_removed_and_those_of_living_ones_stay(tmp_path):
    names = ["fastrtps_00aa", "fastrtps_00aa_el", "fastrtps_port7411", "fastrtps_port7411_el",
             "sem.fastrtps_port7411_mutex", "fastrtps_00bb", "fastrtps_00bb_el", "fastrtps_00cc", "fastrtps_00cc_el",
             "fastrtps_port7661", "fastrtps_port7001", "sem.fastrtps_port7001_mutex", "other"]  # fmt: skip
    for name in names:
        # In other domains complete ports stay, and half-created ones are removed. Lock files are empty.
        (tmp_path / name).write_bytes(b"" if name.endswith("_el") else bytes(8) if "7001" in name else MADE)
        os.utime(tmp_path / name, (0, 0))
    (tmp_path / "fastrtps_port7002").touch()  # a port that is still being created
    # Ports created by a process that does not get the processor for a while.
    for name, begun in (("fastrtps_port7003", b""), ("fastrtps_port6300", MADE)):
        (tmp_path / name).write_bytes(begun)
        os.utime(tmp_path / name, (time.time() - 30.0,) * 2)
    os.utime(tmp_path / "fastrtps_00cc_el")  # a new file, which its owner may be about to lock
    lock = f"f = open('{tmp_path}/fastrtps_00bb_el'); fcntl.flock(f, fcntl.LOCK_EX)"
    code = f"import fcntl; {lock}; print(1, flush=True); input()"
    owner = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    owner.stdout.readline()
    # A complete port of another domain stays, because a node may be about to open it.
    assert remove_leftovers(folder=tmp_path) == 4
    assert remove_leftovers(0, tmp_path) == 3
    left = {"fastrtps_00bb", "fastrtps_00bb_el", "fastrtps_00cc", "fastrtps_00cc_el", "other"}
    left |= {f"fastrtps_port{number}" for number in (6300, 7002, 7003)}
    assert {p.name for p in tmp_path.iterdir()} == left | {"fastrtps_port7661"}
    owner.communicate(b"\n")
    assert remove_leftovers(1, tmp_path) == 3  # the domain has ended, so ports without a lock are removed as well
    left -= {"fastrtps_00bb", "fastrtps_00bb_el"}
    assert {p.name for p in tmp_path.iterdir()} == left
    os.utime(tmp_path / "fastrtps_port6300", (0, 0))
    assert remove_leftovers(folder=tmp_path) == 1


def test_a_node_waits_for_a_port_in_creation_and_removes_one_whose_creator_is_dead(tmp_path, monkeypatch):
    """A process that opens it would wait forever."""
    monkeypatch.setattr(shared_memory, "AGE", 0.5)
    ports = [tmp_path / f"fastrtps_port{7400 + 250 + k}" for k in range(4)]
    plain = tmp_path / "fastrtps_port7005"  # a port of another program, in any domain
    plain.touch()
    for port in ports:
        port.write_bytes(MADE)
    ports[0].write_bytes(b"")
    ports[1].write_bytes(bytes(8))
    os.utime(ports[1], (0, 0))
    threading.Timer(0.1, ports[0].write_bytes, [MADE]).start()
    other = tmp_path / "fastrtps_port7400"
    other.touch()
    clear_ports(1, tmp_path)
    assert ports[0].read_bytes() == MADE
    assert {p.name for p in tmp_path.iterdir()} == {p.name for p in (*ports, other)} - {ports[1].name}


def test_missing_room_in_shared_memory_is_reported(tmp_path, monkeypatch):
    assert lacking(4, tmp_path / "none") == f"{tmp_path}/none: No such file or directory"
    assert lacking(0, tmp_path) == ""
    assert lacking(10**12, tmp_path).startswith(f"{tmp_path} has ")
    # Root can write everywhere except on a read-only file system, which this simulates.
    monkeypatch.setattr(os, "access", lambda folder, mode: False)
    assert lacking(0, tmp_path) == f"{tmp_path} cannot be written"


SMALL = """mount -t tmpfs -o "$1" none /dev/shm || exit 77
shift
exec "$@"
"""


@pytest.mark.long
@pytest.mark.parametrize("how", ["size=64k", "size=1300k", "size=2600k", "ro"])
def test_a_run_without_room_in_shared_memory_uses_udp_and_reports_it(how, tmp_path):
    command = [sys.executable, "-m", "softrig_bringup", "run", "dc_motor_smc", "--duration", "0.1", "--no-plots",
               "--mode", "processes", "--out", str(tmp_path / "run")]  # fmt: skip
    done = subprocess.run(["unshare", "-m", "sh", "-c", SMALL, "sh", how, *command], capture_output=True, text=True)
    if done.returncode in (1, 77) and ("unshare" in done.stderr or "mount" in done.stderr):
        pytest.skip("mounts are not permitted here")
    assert done.returncode == 0, done.stderr
    assert "/dev/shm " in done.stderr
    assert "messages use UDP" in done.stderr
    assert len(Signals(read_bag(tmp_path / "run/bag"))["motor/state/shaft/position"].x) == 1001


def test_a_port_whose_name_another_file_has_is_lost(tmp_path, monkeypatch):
    """The process that has mapped it receives nothing from those that open it by its name."""
    monkeypatch.setattr(Ears, "PATIENCE", 0.0)
    names = ("7661", "7661_el", "7662", "7662_el", "7663")
    port, lock, other, others, foreign = (tmp_path / f"fastrtps_port{name}" for name in names)
    for file in (port, other, foreign):
        file.write_bytes(bytes(8))
    with ExitStack() as opened:  # two ports of this process, as each node has
        for path in (port, other):
            opened.enter_context(mmap.mmap(opened.enter_context(path.open("r+b")).fileno(), 8))
        opened.enter_context(lock.open("w"))
        opened.enter_context(others.open("w"))
        ears = Ears()
        assert ears.lost() == ""
        foreign.unlink()  # removing the port of a peer is no loss
        assert ears.lost() == ""
        port.unlink()
        assert [ears.lost(), ears.lost()] == [port.name] * 2
        port.write_bytes(bytes(8))
        assert ears.lost() == port.name
        with port.open("r+b") as new, mmap.mmap(new.fileno(), 8):
            assert ears.lost() == ""  # Fast DDS opens a damaged port again, which repairs the loss
    assert Ears().lost() == ""


def test_a_process_marks_its_ports_as_alive(tmp_path):
    """Otherwise a process that opens an idle port waits for its reader, up to 20 s."""
    port, now = tmp_path / "fastrtps_port7661", time.time_ns() // 1_000_000
    # The head of a port is recognised by all its numbers, not only by that of the port.
    head = struct.pack("=4I", 7661, 1, 20_000, 6666)
    node = struct.pack("=qI2I", now - 30_000, 3, 0, 0) + head + struct.pack("=3I", 512, 1, 7)
    port.write_bytes(MADE + bytes(36) + head + bytes(16) + node + bytes(100))
    before = port.read_bytes()
    place = before.index(node)
    assert place % 8 == 0  # the compiler aligns this structure to 8 bytes
    with ExitStack() as opened:
        opened.enter_context(mmap.mmap(opened.enter_context(port.open("r+b")).fileno(), 8))
        opened.enter_context((tmp_path / "fastrtps_port7661_el").open("w"))
        ears = Ears()
        for _ in range(2):
            assert ears.lost() == ""
            after = port.read_bytes()
            assert (after[:place], after[place + 8 :]) == (before[:place], before[place + 8 :])
            assert now <= struct.unpack_from("=q", after, place)[0] <= time.time_ns() // 1_000_000
            port.write_bytes(before)
        # A file of another version of Fast DDS must not be changed.
        port.write_bytes(foreign := before.replace(head, bytes(16)))
        assert [Ears().lost(), port.read_bytes()] == ["", foreign]


def test_a_node_waits_until_its_reader_has_replaced_a_damaged_port(tmp_path, monkeypatch):
    """A reader checks its port after a third of the time that it may be silent, and on a busy host later."""
    third = int(re.search(r"<healthy_check_timeout_ms>(\d+)<", LOOPBACK.read_text())[1]) / 3e3
    assert third + 1.0 < Ears.PATIENCE
    clock = iter((0.0, 50.0, 55.0, *(55.0 + k for k in range(1, 20))))
    monkeypatch.setattr(time, "monotonic", lambda: next(clock))
    monkeypatch.setattr(shared_memory, "_own_ports", lambda: {tmp_path / "fastrtps_port7661"})
    ears = Ears()
    assert [ears.lost() for _ in range(12)] == [""] * 10 + ["fastrtps_port7661"] * 2


def test_ctrl_c_cannot_be_swallowed_while_a_node_starts():
    """For example by a module that is being imported: the node would then wait for its peers."""
    # A shell that runs the tests in the background ignores SIGINT, and children inherit that.
    code = (
        "import os, signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from softrig_core.interrupt import interrupt; interrupt.install()\n"
        "try: os.kill(os.getpid(), signal.SIGINT)\n"
        "except BaseException: pass\n"
        "print('alive')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    late = code.replace("interrupt.install()", "interrupt.install(); interrupt.early = False")
    assert subprocess.run([sys.executable, "-c", late], capture_output=True, text=True).stdout == "alive\n"
    leaving = late.replace("try: os", "try:\n  with interrupt.leaving(lambda: os._exit(7)): os")
    assert subprocess.run([sys.executable, "-c", leaving], capture_output=True, text=True).returncode == 7


SLOW = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
import softrig_core
{import_}
def main():
    try: import slow
    except KeyboardInterrupt: print("told")
main()
"""


@pytest.mark.parametrize(("where", "reported"), [("import slow", ""), ("", "told\n")])
def test_ctrl_c_while_an_executable_imports_ends_it_silently(where, reported, tmp_path):
    """A running program that imports something more answers as Python does."""
    (tmp_path / "slow.py").write_text("import os, signal; os.kill(os.getpid(), signal.SIGINT)")
    (tmp_path / "share/ament_index/resource_index/packages").mkdir(parents=True)
    (tmp_path / "share/ament_index/resource_index/packages/mine").touch()
    script = tmp_path / "lib" / "mine" / "node"
    script.parent.mkdir(parents=True)
    script.write_text(SLOW.format(import_=where))
    variables = os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{os.environ['PYTHONPATH']}"}
    done = subprocess.run([sys.executable, script], env=variables, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, reported, "")


def test_no_process_takes_a_port_while_it_is_removed(tmp_path, monkeypatch):
    lock = tmp_path / "fastrtps_port7411_el"
    for path in (tmp_path / "fastrtps_port7411", tmp_path / "sem.fastrtps_port7411_mutex", lock):
        path.touch()
        os.utime(path, (0, 0))
    removed, unlink = [], Path.unlink

    def contested(path):
        with lock.open() as file, pytest.raises(BlockingIOError):
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        removed.append(path.name)
        unlink(path)

    monkeypatch.setattr(Path, "unlink", contested)
    assert remove_leftovers(0, tmp_path) == 3
    assert removed == ["fastrtps_port7411", "sem.fastrtps_port7411_mutex", "fastrtps_port7411_el"]


@pytest.mark.processes
@pytest.mark.parametrize("mode", ["lockstep", pytest.param("realtime", marks=pytest.mark.long)])
def test_an_interrupted_run_returns_its_recording(mode, tmp_path):
    rig = rig_of(make_scenario(BASIC, 1e4))

    def progress(t):
        if t > 100_000_000:
            os.kill(os.getpid(), signal.SIGTERM)

    outcome = run_processes(rig, 0, tmp_path, Placement(clock=mode), Listener(progress=progress))
    assert (outcome.error, outcome.stopped) == ("", signal.SIGTERM)
    assert len(outcome.recording.topics["lag/state"].times) > 10
    assert all("Traceback" not in log.read_text() for log in tmp_path.glob("*.log"))


@pytest.mark.processes
@pytest.mark.parametrize("forked", [True, False])
def test_a_signal_during_the_fork_of_a_node_stops_the_run_without_a_traceback(forked, monkeypatch, tmp_path):
    strikes = [signal.SIGINT]

    def strike(*_):
        if strikes:
            os.kill(os.getpid(), strikes.pop())

    if forked:
        open_ = os.pidfd_open
        monkeypatch.setattr(os, "pidfd_open", lambda pid: strike() or open_(pid))
    else:
        monkeypatch.setattr(spawning, "start_node", lambda *_: None)
        # The hook raises within `fork`, whose traceback must not be printed.
        os.register_at_fork(after_in_parent=strike)
    outcome = run_processes(rig_of(make_scenario(BASIC, 1e4)), 0, tmp_path)
    assert (outcome.error, outcome.stopped) == ("", signal.SIGINT)
    assert no_process_left(tmp_path)


def test_what_code_of_a_node_has_started_and_left_ends_with_the_run():
    process = subprocess.Popen(["sh", "-c", "sleep 1000 & echo $!"], stdout=subprocess.PIPE, text=True, process_group=0)
    left = os.pidfd_open(int(process.stdout.readline()))
    process.wait(PATIENCE)
    end_left([SimpleNamespace(process=process)])
    assert select.select([left], [], [], PATIENCE)[0] == [left]
    os.close(left)
    process.stdout.close()


@pytest.mark.processes
@pytest.mark.parametrize("containers", [pytest.param((), marks=pytest.mark.long), [("plant", "source", "gain")]])
def test_nodes_whose_processes_are_stopped_end_the_run_by_name(containers, tmp_path):
    # At full speed, native code would end the run before the signal arrives.
    placement = Placement(containers=containers, pace=100.0)
    rig = rig_of(make_scenario(BASIC, 1e4, timeout=2.0))

    def progress(t):
        if t > 100_000_000:
            for pid, command in processes_of(tmp_path).items():
                if b"__node:=plant" in command:
                    os.kill(pid, signal.SIGSTOP)

    outcome = run_processes(rig, 0, tmp_path, placement, Listener(progress=progress))
    held = "plant, source, gain" if containers else "plant"
    assert outcome.error.startswith(f"node {held}: its process is stopped (SIGSTOP)")
    assert len(outcome.recording.topics["lag/state"].times) > 10


@pytest.mark.processes
@pytest.mark.long
@pytest.mark.parametrize("held", ["plant", "source", "gain"])
@pytest.mark.parametrize("seconds", [4.5, 9.0, 13.0])
def test_a_node_that_is_stopped_for_less_than_the_timeout_is_waited_for(held, seconds, tmp_path):
    """No other node considers it dead in the meantime, and no message to it is lost."""
    rig, strikes = rig_of(make_scenario(BASIC, 150.0, timeout=10.0)), [seconds]

    def progress(t):
        if t > 100_000_000 and strikes:
            (pid,) = [p for p, command in processes_of(tmp_path).items() if f"__node:={held}".encode() in command]
            os.kill(pid, signal.SIGSTOP)
            threading.Timer(strikes.pop(), go_on, [pid]).start()

    def go_on(pid):
        with suppress(ProcessLookupError):  # the run may not have waited for this process
            os.kill(pid, signal.SIGCONT)

    outcome = run_processes(rig, 0, tmp_path, Placement(), Listener(progress=progress))
    if seconds < 10:
        assert outcome.error == ""
        assert differences(in_process(rig), outcome.recording) == []
    else:
        assert outcome.error.startswith(f"node {held}: its process is stopped (SIGSTOP)")


@pytest.mark.processes
def test_a_run_without_a_tick_reports_it(tmp_path, monkeypatch):
    """In real time it may end immediately by the clocks of its nodes."""
    gathered = processes.gathered

    def without_ticks(*which):
        recording, status = gathered(*which)
        return recording, {name: state | {"ticks": 0} for name, state in status.items()}

    monkeypatch.setattr(processes, "gathered", without_ticks)
    outcome = run_processes(rig_of(make_scenario(BASIC, 0.1)), 0, tmp_path, Placement(), Listener())
    assert outcome.error == "all nodes have ended, and none of them has answered a tick"


@pytest.mark.long
@pytest.mark.processes
@pytest.mark.parametrize(
    ("number", "status"),
    [
        (signal.SIGINT, 130),
        *(
            pytest.param(*row, marks=pytest.mark.long)
            for row in ((signal.SIGHUP, 129), (signal.SIGQUIT, 131), (signal.SIGTERM, 143))
        ),
    ],
)
def test_a_stopped_run_has_bag_and_metrics_and_its_status(number, status, tmp_path):
    out = tmp_path / "run"
    command = [
        sys.executable,
        "-m",
        "softrig_bringup",
        "run",
        "dc_motor_smc",
        "--duration",
        "500",
        "--out",
        str(out),
        "--no-plots",
    ]
    received = partial(signal.signal, signal.SIGHUP, signal.SIG_DFL)  # under nohup the tests themselves ignore SIGHUP
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, preexec_fn=received)

    def runs():
        assert process.poll() is None, process.stderr.read()
        return any(shard.stat().st_size > 20_000 for shard in (out / "log").glob("*.shard"))

    until(runs)
    process.send_signal(number)
    _, printed = process.communicate(timeout=PATIENCE)
    assert process.returncode == status, printed
    name = signal.Signals(number).name
    content = json.loads((out / "metrics.json").read_text())
    assert content["stopped"].startswith(f"stopped by {name} at t = ")
    assert content["stopped"] in printed
    assert content["metrics"]
    assert list((out / "bag").glob("*.mcap"))


@pytest.mark.processes
@pytest.mark.parametrize("mode", ["lockstep", pytest.param("realtime", marks=pytest.mark.long)])
def test_ctrl_c_once_or_twice_ends_every_node_in_order(mode, tmp_path):
    """As a launch sends it, and as `timeout -s INT`, which sends it to the group as well."""
    rig = rig_of(make_scenario(BASIC, 1e4))
    with free_domain() as domain:
        running = []
        for member in rig.members:
            file = parameter_file(
                member,
                node_parameters(rig, member, 0, mode) | {"run.status": str(tmp_path / f"{member.name}.status")},
                tmp_path,
            )
            command = [
                str(find_executable(member.package, member.executable)),
                "--ros-args",
                "-r",
                f"__node:={member.name}",
                "--params-file",
                str(file),
            ]
            with (tmp_path / f"{member.name}.log").open("wb") as log:
                running.append(
                    start_node(member.package, member.executable, command, environment(domain, tmp_path), log.fileno())
                )
        until(lambda: read_status(tmp_path / "plant.status").get("t", 0) > 10**8)
        for process in running:
            process.send_signal(signal.SIGINT)
        if mode == "realtime":
            for process in running:
                process.send_signal(signal.SIGINT)
        assert [process.wait(PATIENCE) for process in running] == [0, 0, 0]
    text = "".join((tmp_path / f"{member.name}.log").read_text() for member in rig.members)
    assert not any(word in text for word in ("Traceback", "FATAL", "terminate called"))


@pytest.mark.parametrize("exchanged", [True, False])
def test_a_status_file_is_never_read_half_written(exchanged, tmp_path, monkeypatch):
    """A process that has opened the file before it is rewritten reads its old content, complete; also if names cannot
    be exchanged.
    """
    if not exchanged:
        monkeypatch.setattr(health, "_renameat2", lambda *_: -1)
    path = tmp_path / "plant.status"
    assert read_status(path) == {}
    status = health.StatusFile(str(path))
    for t in range(3):
        status.write({"t": t, "text": "x" * 9000 * t})
        with path.open() as opened:
            status.write({"t": -t})
            assert json.load(opened) == {"t": t, "text": "x" * 9000 * t}
        assert read_status(path) == {"t": -t}
        assert [p.name for p in tmp_path.iterdir()] == ["plant.status"]
