"""Locks in ports of shared memory whose owners are dead."""

import ctypes
import mmap
import os
import signal
import struct
import subprocess
import sys
import time
from contextlib import ExitStack

import pytest
from softrig_nodes.processes import dead_locks
from softrig_nodes.processes.dead_locks import MUTEXES, SHARED, DeadLocks
from softrig_nodes.processes.ports import of_domain

PLACE, DOMAIN = 256, 7
LIBC = ctypes.CDLL(None)


def port(folder, number, prefix="fastrtps", kind=SHARED):
    """A port in shared memory as Fast DDS lays it out, its two mutexes unlocked."""
    path = folder / f"{prefix}_port{number}"
    segment = bytearray(52_400)
    struct.pack_into("=qIIIIIIIII", segment, PLACE, time.time_ns() // 10**6, 1, 2, 3, number, 1, 20_000, 6_666, 512, 1)
    for offset in MUTEXES:
        struct.pack_into("=i", segment, PLACE + offset + 16, kind)
    path.write_bytes(segment)
    return path


def locked(path, offset, *, dies):
    """Lock a mutex of a port in another process, which is a zombie at once or lives on; return its pid."""
    ready, write_end = os.pipe()
    if not (pid := os.fork()):
        with path.open("r+b") as file:
            segment = mmap.mmap(file.fileno(), 0)
            LIBC.pthread_mutex_lock(ctypes.byref(ctypes.c_char.from_buffer(segment, PLACE + offset)))
        os.write(write_end, b"1")
        while not dies:
            signal.pause()
        os._exit(0)
    os.read(ready, 1)
    os.close(ready)
    os.close(write_end)
    if dies:
        os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)
    return pid


def free(path, offset):
    """Whether a mutex can be locked; it is unlocked again."""
    with path.open("r+b") as file, mmap.mmap(file.fileno(), 0) as segment:
        mutex = ctypes.c_char.from_buffer(segment, PLACE + offset)
        result = LIBC.pthread_mutex_trylock(ctypes.byref(mutex)) == 0
        if result:
            LIBC.pthread_mutex_unlock(ctypes.byref(mutex))
        del mutex
    return result


@pytest.fixture
def looks(tmp_path, monkeypatch):
    """Look again and again, without a pause; return how many mutexes were unlocked."""
    monkeypatch.setattr(dead_locks, "BETWEEN", 0.0)
    locks = DeadLocks(tmp_path)
    return lambda: locks.release(DOMAIN)


@pytest.mark.parametrize("prefix", ["fastrtps", "fastdds"])
@pytest.mark.parametrize("offset", MUTEXES)
def test_a_lock_of_a_dead_process_is_freed_at_the_second_look(looks, tmp_path, prefix, offset):
    path = port(tmp_path, of_domain(DOMAIN)[11], prefix)
    assert looks() == 0
    pid = locked(path, offset, dies=True)
    assert not free(path, offset)
    assert [looks(), looks(), looks()] == [0, 1, 0]  # a dead process that its parent has not waited for holds no lock
    assert free(path, offset)
    os.waitpid(pid, 0)
    os.waitpid(locked(path, offset, dies=True), 0)
    assert [looks(), looks(), looks()] == [0, 1, 0]


def test_locks_of_the_living_and_those_of_others_stay(looks, tmp_path):
    number = of_domain(DOMAIN)[11]
    owned_port = port(tmp_path, number)
    strange = port(tmp_path, number + 2, kind=0)  # a lock file of another layout
    other = port(tmp_path, of_domain(DOMAIN + 1)[11])
    cut = tmp_path / f"fastrtps_port{number + 4}"
    cut.write_bytes(owned_port.read_bytes()[:300])
    (tmp_path / f"fastrtps_port{number + 6}").symlink_to(owned_port)
    pids = [locked(owned_port, MUTEXES[1], dies=False)]
    pids += [locked(path, MUTEXES[0], dies=True) for path in (strange, other)]
    try:
        assert [looks() for _ in range(4)] == [0] * 4
        assert not any((free(owned_port, MUTEXES[1]), free(strange, MUTEXES[0]), free(other, MUTEXES[0])))
    finally:
        os.kill(pids[0], signal.SIGKILL)
        for pid in pids:
            os.waitpid(pid, 0)
    assert [looks(), looks()] == [0, 1]


def test_checks_in_quick_succession_are_one_check(tmp_path):
    path = port(tmp_path, of_domain(DOMAIN)[11])
    os.waitpid(locked(path, MUTEXES[1], dies=True), 0)
    locks = DeadLocks(tmp_path)
    assert [locks.release(DOMAIN) for _ in range(3)] == [0, 0, 0]
    assert not free(path, MUTEXES[1])


READER = """
import sys, rclpy
from softrig_nodes.ros.profile import joining
from std_msgs.msg import String
with joining():
    rclpy.init()
node = rclpy.create_node("reader")
node.create_subscription(String, "words", lambda message: None, 10)
print("ready", flush=True)
sys.stdin.read()
"""


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:This process")  # Python warns about a fork while threads of Fast DDS run
def test_a_writer_to_a_dead_reader_that_held_its_port_continues(tmp_path):
    """Without `DeadLocks` each message to it takes 1 s, until its lease ends."""
    import rclpy
    from conftest import ears
    from rclpy.context import Context
    from softrig_nodes.processes.domain import free_domain
    from softrig_nodes.processes.executables import environment
    from std_msgs.msg import String

    with ExitStack() as stack:
        domain = stack.enter_context(free_domain())
        variables = environment(domain, tmp_path)
        stack.enter_context(pytest.MonkeyPatch.context()).setattr(os, "environ", variables)
        reader = subprocess.Popen([sys.executable, "-c", READER], env=variables, stdin=-1, stdout=-1)
        reader.stdout.readline()
        ports = [path for path in ears(reader) if int(path.name.partition("_port")[2]) in of_domain(domain)]
        assert ports
        context = Context()
        rclpy.init(context=context, domain_id=domain)
        node = rclpy.create_node("writer", context=context)
        publisher = node.create_publisher(String, "words", 10)
        while not publisher.get_subscription_count():
            time.sleep(0.02)
        reader.kill()
        reader.wait()
        for path in ports:
            os.waitpid(locked(path, MUTEXES[1], dies=True), 0)
        began = time.monotonic()
        publisher.publish(String(data="x"))
        first = time.monotonic() - began
        locks = DeadLocks()
        while not locks.release(domain):
            assert time.monotonic() < began + 10.0
            time.sleep(0.02)
        began = time.monotonic()
        for _ in range(20):
            publisher.publish(String(data="x"))
        after = time.monotonic() - began
        assert first > 0.5
        assert after < 0.5 * first
        rclpy.shutdown(context=context)


def test_a_port_that_is_removed_while_it_is_read_ends_no_run(tmp_path, monkeypatch):
    path = port(tmp_path, of_domain(DOMAIN)[0])
    open_file = os.open

    def removed_at_once(name, *options):
        file = open_file(name, *options)
        path.unlink()
        return file

    monkeypatch.setattr(dead_locks.os, "open", removed_at_once)
    assert DeadLocks(tmp_path).release(DOMAIN) == 0
    assert not path.exists()
