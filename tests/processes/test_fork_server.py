"""Nodes forked from a process that has done their imports are ordinary processes."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from conftest import differences, in_process, make_scenario, no_process_left, processes_of, until
from softrig_core import rig_of
from softrig_nodes import run_processes
from softrig_nodes.processes import fork_server, spawning
from softrig_nodes.processes.fork_server import start_node
from softrig_nodes.processes.placement import Listener

BASIC = {"plant": "plant", "source": "source", "gain": "gain"}
TOOLS = """
import os, sys, threading, time
def say():
    print(os.getcwd(), os.environ["ROS_DOMAIN_ID"], sys.argv[1:], "one", *{"LINES"} & {*os.environ})
def fail():
    sys.exit(3)
def sleep():
    time.sleep(1e3)
"""


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package of executables: returns its file, and a function that starts one and waits for its output file."""
    info = tmp_path / "tools-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: tools\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[console_scripts]\n" + "".join(f"{name} = tools:{name}\n" for name in ("say", "fail", "sleep"))
    )
    (tmp_path / "tools.py").write_text(TOOLS)
    monkeypatch.delenv("LINES", raising=False)
    variables = os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{os.environ['PYTHONPATH']}", "ROS_DOMAIN_ID": "7"}
    variables |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    monkeypatch.setattr(fork_server, "_server", None)

    def start(name, *arguments, **more):
        with (tmp_path / f"{name}.log").open("wb") as output:
            return start_node("tools", name, [f"/lib/tools/{name}", *arguments], variables | more, output.fileno())

    start.file, start.folder = tmp_path / "tools.py", tmp_path
    return start


@pytest.mark.long
def test_each_node_is_a_separate_process(tmp_path):
    seen = {}

    def progress(t):
        for pid, command in processes_of(tmp_path).items():
            status = dict(line.split(":\t", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
            seen[pid] = (status["Name"], int(status["PPid"]), os.getpgid(pid), command.split(b"\0"))
        if t and len(seen) == len(BASIC):
            raise KeyboardInterrupt

    outcome = run_processes(rig_of(make_scenario(BASIC, 1e4)), 0, tmp_path, listener=Listener(progress=progress))
    assert (outcome.error, outcome.stopped) == ("", signal.SIGINT)
    assert sorted(name for name, *_ in seen.values()) == ["gain", "plant", "source"]
    (server,) = {parent for _, parent, *_ in seen.values()}
    assert server == fork_server._server._process.pid  # the fork server has forked all nodes
    for pid, (name, _, group, command) in seen.items():
        assert group == pid
        assert command[0] == os.fsencode(sys.executable)
        assert command[1].endswith(f"faultrig/{name}".encode())
        assert b"__node:=" + name.encode() in command


def test_it_has_its_own_directory_environment_arguments_output_and_end(package, monkeypatch):
    monkeypatch.chdir(package.folder)
    assert package("say", LINES="7").wait(60) == 0
    assert package("say", "a b").wait(60) == 0  # nothing of the first process, with which the server started, is left
    assert (package.folder / "say.log").read_text() == f"{package.folder} 7 ['a b'] one\n"
    assert package("fail").wait(60) == 3
    sleeper = package("sleep")
    assert sleeper.poll() is None
    with pytest.raises(subprocess.TimeoutExpired):
        sleeper.wait(0.01)
    sleeper.kill()
    assert sleeper.wait(60) == sleeper.poll() == -signal.SIGKILL
    sleeper.kill()  # the process number is no longer in use


@pytest.mark.long
def test_an_edited_module_is_imported_again_and_running_nodes_continue(package):
    sleeper = package("sleep")
    assert package("say").wait(60) == 0
    package.file.write_text(TOOLS.replace('"one"', '"two, another"'))
    assert package("say").wait(60) == 0
    assert (package.folder / "say.log").read_text().endswith("two, another\n")
    assert sleeper.poll() is None  # the process is a child of the server that was replaced
    sleeper.kill()
    assert sleeper.wait(60) == -signal.SIGKILL


@pytest.mark.long
def test_with_a_thread_in_the_server_nodes_are_started_one_by_one(package, tmp_path):
    package.file.write_text(TOOLS + "threading.Thread(target=time.sleep, args=(1e3,), daemon=True).start()\n")
    assert package("say") is None


def test_a_server_that_dies_takes_its_nodes_along_and_the_next_node_has_another(package):
    sleeper = package("sleep")
    fork_server._server._process.kill()
    assert sleeper.wait(60) == -signal.SIGKILL
    assert package("say").wait(60) == 0


@pytest.mark.long
def test_an_answer_truncated_by_a_signal_is_not_taken_for_the_next(package, monkeypatch):
    fail, say = package("fail"), package("say")
    until(lambda: (package.folder / "say.log").read_text())
    server = fork_server._server

    class Struck(Exception):
        """As `Stopped`, raised from a signal handler."""

    class Link:
        def recv(self, size):
            raise Struck

        def __getattr__(self, name):
            return getattr(link, name)

    link = server._link
    monkeypatch.setattr(server, "_link", Link())
    with pytest.raises(Struck):
        fail.wait(60)
    monkeypatch.setattr(server, "_link", link)
    assert say.wait(60) == 0
    assert fail.wait(60) == 3


def test_a_node_has_its_own_status_although_another_had_its_process_id_before(monkeypatch):
    """Linux counts to 32,768 and begins again: a long set does so every quarter of an hour."""
    near_end, far_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ends = iter((signal.SIGKILL, 0))
    monkeypatch.setattr(fork_server, "_fork", lambda request, asleep: 7)
    monkeypatch.setattr(os, "waitpid", lambda pid, options: (pid, next(ends)))
    monkeypatch.setattr(os, "_exit", sys.exit)  # ends only this thread

    def ask(**request):
        near_end.send(json.dumps(request | {"number": 0}).encode())
        return json.loads(near_end.recv(1000))

    with far_end, ThreadPoolExecutor(1) as pool, near_end:
        pool.submit(fork_server.serve, far_end)
        for status in (-signal.SIGKILL, 0):
            assert ask(package="tools")["pid"] == 7
            assert [ask(status=7)["status"] for _ in range(2)] == [status] * 2


@pytest.mark.long
def test_a_node_ends_with_the_process_that_had_it_started(tmp_path):
    code = (
        "import os, sys; sys.path[:0] = ['tests']; from pathlib import Path; import conftest as c\n"
        "from softrig_core import rig_of, run_processes\n"
        "from softrig_nodes.processes.placement import Listener\n"
        f"rig = rig_of(c.make_scenario({BASIC!r}, 1e4))\n"
        f"run_processes(rig, 0, Path({str(tmp_path)!r}), listener=Listener(lambda t: t and os.kill(os.getpid(), 9)))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[2], timeout=120)
    assert done.returncode == -signal.SIGKILL
    until(lambda: no_process_left(tmp_path))


@pytest.mark.long
def test_without_a_server_the_run_is_the_same(monkeypatch, tmp_path):
    rig = rig_of(make_scenario(BASIC, 0.1))
    forked = run_processes(rig, 0, tmp_path / "a")
    monkeypatch.setattr(spawning, "start_node", lambda *_: None)
    started = run_processes(rig, 0, tmp_path / "b")
    assert forked.error == started.error == ""
    for name, topic in forked.recording.topics.items():
        assert topic.data == started.recording.topics[name].data


@pytest.mark.long
@pytest.mark.timeout(7200)
def test_many_runs_through_one_server_leave_no_file_open(tmp_path, monkeypatch):
    """Files are counted here and in the server; SOFTRIG_SERVER_RUNS sets the number of runs."""
    monkeypatch.setattr(fork_server, "_server", None)
    rig = rig_of(make_scenario(BASIC, 0.05, start_timeout=900.0))
    runs = int(os.environ.get("SOFTRIG_SERVER_RUNS", "40"))
    seen = []
    for k in range(runs):
        folder = tmp_path / str(k)
        outcome = run_processes(rig, k, folder)
        assert outcome.error == ""
        assert differences(in_process(rig, k), outcome.recording) == []
        shutil.rmtree(folder)
        seen.append([of(pid) for of in (opened, threads, memory) for pid in (os.getpid(), server())])
        print(k, *seen[-1], flush=True)
    (descriptors, its_descriptors, *their_threads, near_end, its) = zip(*seen[5:], strict=True)
    for counted in (descriptors, its_descriptors, *their_threads):
        assert max(counted) == counted[0]
    assert near_end[-1] - near_end[0] < 15 + 0.03 * runs  # MB; the server may grow by 15 MB and 0.03 MB for each run
    assert its[-1] - its[0] < 2


def server():
    return fork_server._server._process.pid


def opened(pid):
    return len(os.listdir(f"/proc/{pid}/fd"))


def threads(pid):
    return len(os.listdir(f"/proc/{pid}/task"))


def memory(pid):
    """Memory, MB."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
