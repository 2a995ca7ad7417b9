"""The fork server: a process that has done the imports of a node, and forks a new process for each requested node.

A node's imports take ten times as long as the rest of its start. Each forked process has its own pid, its name and
command line in /proc, its environment, working directory and log, and its own end, like any other. When it forks, the
server has no thread that could hold a lock, and has not used DDS. If that is not the case, the caller starts the
executable itself, with the same result.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import gc
import importlib.metadata
import json
import os
import select
import signal
import socket
import subprocess
import sys
import sysconfig
import threading
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from softrig_core.rig.installed import load_main

# Loaded here, because between fork and exec another thread may hold the lock of the loader.
LIBC = ctypes.CDLL(None)
PR_SET_PDEATHSIG, PR_SET_NAME = 1, 15
LARGEST = 100_000  # bytes of a request
# A process cannot enlarge the space that /proc shows as its command line, so the server is started with a long one.
ROOM = 8_000  # bytes for the command line of a node
# A node reads these variables when it starts, so they may differ from those of the server. All others may have been
# read before the fork; a server with other values of them is replaced.
OWN = (
    "ROS_DOMAIN_ID",
    "ROS_LOG_DIR",
    "ROS_AUTOMATIC_DISCOVERY_RANGE",
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    "NUMBA_DISABLE_INTEL_SVML",
    "SOFTRIG_SCENARIOS",
    "PYTEST_CURRENT_TEST",
    "COLUMNS",
    "LINES",
)
_LIBRARIES = tuple({sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")})


class Forked:
    """A process that the server has forked, with the interface of `subprocess.Popen`."""

    def __init__(self, pid: int, server: ForkServer) -> None:
        self.pid = pid
        self.returncode: int | None = None
        self._server = server
        # The number cannot belong to another process by now: the server waits for this one only in `status`.
        self._end = os.pidfd_open(pid)

    def poll(self) -> int | None:
        """Return the exit status, less than zero for a signal, or None while it runs."""
        return self._ended(0.0)

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end.

        Raises
        ------
        subprocess.TimeoutExpired
        """
        status = self._ended(timeout)
        if status is None:
            raise subprocess.TimeoutExpired(str(self.pid), timeout or 0.0)
        return status

    def _ended(self, timeout: float | None) -> int | None:
        if self.returncode is None and select.select([self._end], [], [], timeout)[0]:
            self.returncode = self._server.status(self.pid)
            os.close(self._end)
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Send a signal, unless it has ended."""
        if self.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._end, number)

    def terminate(self) -> None:
        """Send SIGTERM."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """Send SIGKILL."""
        self.send_signal(signal.SIGKILL)


class ForkServer:
    """A server of this process: it ends with this process, and its nodes with it.

    Parameters
    ----------
    variables : mapping
        Environment of its nodes, as far as it is not in `OWN`.
    """

    def __init__(self, variables: Mapping[str, str]) -> None:
        self._key = _key(variables)
        self._owner = os.getpid()
        self._lock = threading.Lock()
        self._asked = 0
        self._link, server_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with server_end:
            # The last argument reserves space for the command lines of the nodes. With -P modules in the working
            # directory cannot hide installed ones.
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", __name__, str(server_end.fileno()), "-" * ROOM],
                env=dict(variables),
                pass_fds=[server_end.fileno()],
                process_group=0,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )

    def start(
        self, package: str, executable: str, command: Sequence[str], variables: Mapping[str, str], output: int
    ) -> Forked | None:
        """Fork a node.

        Parameters
        ----------
        command : sequence of str
            The path of the executable and its arguments.
        variables : mapping
            Its environment.
        output : int
            File descriptor for what it prints.

        Returns
        -------
        Forked, or None
            None when this server cannot; then another one, or the executable by itself, can.
        """
        request = {
            "package": package,
            "executable": executable,
            "command": list(command),
            "variables": dict(variables),
            "directory": os.getcwd(),
        }
        answer = self._ask(request, output)
        return Forked(int(answer["pid"]), self) if "pid" in answer else None

    def serves(self, variables: Mapping[str, str]) -> bool:
        """Return whether the server belongs to this process and serves this environment."""
        return self._owner == os.getpid() and self._key == _key(variables)

    def status(self, pid: int) -> int:
        """Return the exit status of a process that has ended; that of the server if the server died before."""
        return int(self._ask({"status": pid}).get("status", -signal.SIGKILL))

    def __del__(self) -> None:
        """Stop the server when this object is released; its nodes hold a reference to it."""
        self._link.close()
        # A fork of the owner has a copy of this object, but the server is not its child.
        if os.getpid() == self._owner:
            self._process.kill()
            self._process.wait()

    def _ask(self, request: dict[str, Any], *descriptors: int) -> dict[str, Any]:
        with self._lock:
            self._asked += 1
            data = json.dumps(request | {"number": self._asked}).encode()
            if len(data) > LARGEST:
                return {}
            try:
                socket.send_fds(self._link, [data], descriptors)
                while text := self._link.recv(LARGEST):
                    answer: dict[str, Any] = json.loads(text)
                    # A signal may have interrupted an earlier request, whose answer is then still in the socket.
                    if answer["number"] == self._asked:
                        return answer
            except OSError:
                pass
            return {}  # the process has ended


_server: ForkServer | None = None
_choosing = threading.Lock()


def prepare(variables: Mapping[str, str]) -> ForkServer:
    """Return the server of this process for an environment; it is started if needed, without waiting for it."""
    global _server
    with _choosing:
        if _server is None or not _server.serves(variables):
            _server = ForkServer(variables)
        return _server


def forget() -> None:
    """Use a new server for the next node; the present one ends with its last node."""
    global _server
    _server = None


atexit.register(forget)


def start_node(
    package: str, executable: str, command: Sequence[str], variables: Mapping[str, str], output: int
) -> Forked | None:
    """Fork a node from the server of this process; see `ForkServer.start`.

    A server is replaced if its modules have been edited since it started.
    """
    # A server declines once a module has been edited since it was imported; a new server imports the new text.
    for _ in range(2):
        started = prepare(variables).start(package, executable, command, variables, output)
        if started is not None:
            return started
        forget()
    return None


def _key(variables: Mapping[str, str]) -> frozenset[tuple[str, str]]:
    return frozenset((k, v) for k, v in variables.items() if k not in OWN)


# ---- in the server ----


class _Edited:
    """Detects whether an imported module from outside Python's libraries has changed since."""

    def __init__(self) -> None:
        self._seen: dict[str, int] = {}
        self._scan()

    def __bool__(self) -> bool:
        before = dict(self._seen)
        self._scan()
        return any(self._seen[file] != written for file, written in before.items())

    def _scan(self) -> None:
        for module in list(sys.modules.values()):
            file = getattr(module, "__file__", None)
            if file and not file.startswith(_LIBRARIES):
                try:
                    self._seen[file] = os.stat(file).st_mtime_ns
                except OSError:
                    self._seen[file] = 0


def serve(link: socket.socket) -> Callable[[], Any]:
    """Answer requests until the link is closed; return only in a forked process, with its work."""
    # Entry points name what nodes import, because this module itself must not depend on ROS.
    for point in importlib.metadata.entry_points(group="softrig_preloaded"):
        # The node imports it again and then reports the error itself.
        with contextlib.suppress(Exception):
            point.load()
    edited = _Edited()
    # These are listeners of rclpy's tracing (lttng). They wait on a futex and hold no lock, so a fork is safe.
    asleep = _threads()
    ended: dict[int, int] = {}
    while True:
        data, descriptors, _, _ = socket.recv_fds(link, LARGEST, 1)
        if not data:
            os._exit(0)
        request = json.loads(data)
        if "status" in request:
            # A signal may cut off the answer, so a status may be requested again; a process is waited for only once.
            if (pid := request["status"]) not in ended:
                ended[pid] = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
            answer: dict[str, Any] = {"status": ended[pid]}
        else:
            pid = 0 if edited else _fork(request, asleep)
            if pid == os.getpid():
                return lambda: _become(link, request, descriptors[0])
            # An earlier process may have had this number.
            ended.pop(pid, None)
            answer = {"pid": pid} if pid else {}
            for descriptor in descriptors:
                os.close(descriptor)
        link.send(json.dumps(answer | {"number": request["number"]}).encode())


def _threads() -> set[str]:
    return set(os.listdir("/proc/self/task"))


def _fork(request: Mapping[str, Any], asleep: set[str]) -> int:
    """Import the modules of the node and fork; return 0 if that is impossible, its own pid in the new process."""
    with contextlib.suppress(Exception):
        load_main(request["package"], request["executable"])
    # The import may have started a thread. It may hold a lock, which nothing would release in the new process.
    if not _threads() <= asleep:
        return 0
    # Otherwise the first search for cycles in the new process would write to, and so copy, every shared page.
    gc.freeze()
    parent = os.getpid()
    with warnings.catch_warnings():
        # Python warns of a fork beside any other thread, even beside those of `asleep`.
        warnings.simplefilter("ignore")
        pid = os.fork()
    if pid == 0:
        LIBC.prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        # The parent may have died before `prctl`, and then no signal comes.
        if os.getppid() != parent:
            os._exit(0)
        os.setpgid(0, 0)
        return os.getpid()
    return pid


def _become(link: socket.socket, request: Mapping[str, Any], output: int) -> Any:
    """Become the requested node."""
    link.close()
    os.dup2(output, 1)
    os.dup2(output, 2)
    os.close(output)
    gc.unfreeze()
    os.environ.clear()
    os.environ.update(request["variables"])
    os.chdir(request["directory"])
    sys.argv = list(request["command"])
    sys.orig_argv = [sys.executable, *sys.argv]
    _call_itself(sys.orig_argv)
    return load_main(request["package"], request["executable"])()


def _call_itself(command: Sequence[str]) -> None:
    """Set the name of the process in /proc, which ps and kill show."""
    LIBC.prctl(PR_SET_NAME, os.fsencode(Path(command[1]).name))
    fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
    begin, end = int(fields[45]), int(fields[46])  # arg_start and arg_end of proc(5)
    # Without the reserved space, or where the kernel does not show it, there is nothing to write into.
    if end - begin > ROOM:
        text = b"\0".join(map(os.fsencode, command))[: end - begin - 1]
        ctypes.memmove(begin, text.ljust(end - begin, b"\0"), end - begin)


if __name__ == "__main__":
    sys.exit(serve(socket.socket(fileno=int(sys.argv[1])))())
