"""Reserving a DDS domain."""

import os
import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from softrig_core import RunError, ScenarioError
from softrig_core.kit import compiled
from softrig_nodes import run_processes
from softrig_nodes.processes import domain
from softrig_nodes.processes.domain import free_domain

HOLD = """
import sys
from softrig_nodes.processes.domain import free_domain
with free_domain() as d:
    print(d, flush=True)
    sys.stdin.readline()
"""


def test_two_reservations_differ_and_the_first_becomes_free_again():
    with free_domain() as first:
        with free_domain() as second:
            assert first != second
        with free_domain() as again:
            assert again == second


@pytest.mark.parametrize("home", ["ours", "its own"])
def test_another_process_holds_its_domain_until_it_dies(home, tmp_path, monkeypatch):
    """Two suites that ran together, each with its own home, chose one domain at the same moment."""
    other_environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)} if home == "its own" else None
    command = [sys.executable, "-c", HOLD]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=other_environment) as child:
        number = int(child.stdout.readline())
        with free_domain() as free:
            assert free != number
        with pytest.raises(RunError, match=f"domain {number} is in use"), free_domain(number):
            pass
        monkeypatch.setattr(domain, "DOMAINS", range(number, number + 1))
        monkeypatch.setattr(domain, "BEYOND", ())
        with pytest.raises(RunError, match="in use"), free_domain():
            pass
        child.kill()
        child.wait()
    with free_domain() as free:
        assert free == number


def test_if_all_are_taken_a_higher_one_is_used_and_the_holders_are_named(monkeypatch):
    """Any process may hold the hundred names."""
    with free_domain() as first, free_domain() as second:
        monkeypatch.setattr(domain, "DOMAINS", range(first, first + 1))
        with free_domain() as other:
            assert 101 <= other <= 231
        monkeypatch.setattr(domain, "BEYOND", (second,))
        comm = Path("/proc/self/comm").read_text().strip()
        with pytest.raises(RunError, match=re.escape(f"(2 by process {os.getpid()} ({comm}))")), free_domain():
            pass
        assert domain.holders([first]) == f" (1 by process {os.getpid()} ({comm}))"
    assert domain.holders([first]) == ""


def test_holders_are_named_while_other_processes_end(monkeypatch):
    def gone(real):
        def look(path="."):
            if re.fullmatch(r"/proc/\d+/fd", str(path)) and str(path) != f"/proc/{os.getpid()}/fd":
                raise ProcessLookupError
            return real(path)

        return look

    for name in ("listdir", "scandir"):
        monkeypatch.setattr(os, name, gone(getattr(os, name)))
    with free_domain() as number:
        assert f"1 by process {os.getpid()} (" in domain.holders([number])


def test_a_wanted_domain_is_reserved_too():
    with free_domain() as first:
        with pytest.raises(RunError, match=f"domain {first} is in use"), free_domain(first):
            pass
        with free_domain(first % 100 + 101) as second:
            assert second == first % 100 + 101
    with pytest.raises(ScenarioError, match="domain 233: expected 0 to 232"), free_domain(233):
        pass


def test_the_locks_belong_to_the_user_and_are_not_links_or_pipes(tmp_path, monkeypatch):
    """In the temporary directory any user could put a link to a file, or a pipe that blocks forever."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("TMPDIR", "/nowhere")
    monkeypatch.setattr(domain, "DOMAINS", range(7, 8))
    lock = tmp_path / "softrig/domains/7.lock"
    with free_domain():
        assert lock.is_file()
    for make in (lambda: lock.symlink_to(tmp_path / "target"), lambda: os.mkfifo(lock)):
        lock.unlink()
        make()
        with pytest.raises(RunError, match=r"7\.lock: .*expected a plain file"), free_domain():
            pass
        assert not (tmp_path / "target").exists()


def test_without_a_home_the_locks_are_in_a_private_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc/nowhere")
    monkeypatch.setattr(compiled, "TEMPORARY", tmp_path)
    own = tmp_path / f"softrig-{os.getuid()}"
    with free_domain() as number:
        assert (own / f"domains/{number}.lock").is_file()
    own.chmod(0o777)
    with pytest.raises(RunError, match=f"{own}: expected a folder that only this user may write into"), free_domain():
        pass


def test_a_domain_with_a_ros_session_is_not_chosen(monkeypatch):
    """A participant of another process, here represented by the port that it would hold."""
    with free_domain() as number:
        pass
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as participant:
        participant.bind(("127.0.0.1", 7400 + 250 * number + 10))
        assert number in domain.inhabited()
        monkeypatch.setattr(domain, "DOMAINS", range(number, number + 1))
        monkeypatch.setattr(domain, "BEYOND", ())
        with pytest.raises(RunError, match="in use"), free_domain():
            pass
        # A domain that is requested by number is used even if a session is in it.
        with free_domain(number) as wanted:
            assert wanted == number
    assert number not in domain.inhabited()


def test_a_host_without_loopback_is_reported_immediately(monkeypatch, tmp_path, lag_rig):
    code = "from softrig_nodes.processes.domain import require_loopback; require_loopback()"
    if subprocess.run(["unshare", "-rn", "true"], capture_output=True).returncode:
        pytest.skip("network namespaces are not permitted here")
    done = subprocess.run(["unshare", "-rn", sys.executable, "-c", code], capture_output=True, text=True)
    assert "RunError: the loopback interface lo is down" in done.stderr
    domain.require_loopback()

    def down():
        raise RunError("lo is down")

    monkeypatch.setattr("softrig_nodes.processes.processes.require_loopback", down)
    with pytest.raises(RunError, match="lo is down"):
        run_processes(lag_rig, 0, tmp_path)


def test_launches_share_a_domain_and_no_run_chooses_it():
    with free_domain() as number, pytest.raises(RunError, match="is in use by a run"):
        domain.join_domain(number)
    first, second = domain.join_domain(number), domain.join_domain(number)
    with pytest.raises(RunError, match="in use"), free_domain(number):
        pass
    os.close(first)
    os.close(second)
    with free_domain(number):
        pass
