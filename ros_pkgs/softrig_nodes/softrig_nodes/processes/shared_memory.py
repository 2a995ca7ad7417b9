"""Handle files that Fast DDS leaves in shared memory when a process is killed: 20 files and 2.4 MB for each."""

from __future__ import annotations

import fcntl
import math
import os
import re
import struct
import time
from contextlib import ExitStack, suppress
from pathlib import Path

from .ports import BASE, FLOWS, of_domain

FOLDER = Path("/dev/shm")
AGE = 2.0  # s; only some microseconds pass between the creation of a segment and its lock
# s: the same where nothing is known about the creator. On a busy host it may have no processor in the meantime, and a
# node whose port has been removed receives nothing.
ABANDONED = 60.0
# Number of looks within AGE. A host that keeps this process from looking also keeps the creator waiting, so looks are
# counted and not seconds.
LOOKS = 100
SIZE = 1_250_000  # bytes that the segments and ports of a node take
RECENT = 1e9  # s: a number that differs less from the present time is taken for a time
MADE = b"\2\0\0\0"  # first bytes of a segment whose creator has finished it (Boost.Interprocess)
FAST = ("fastrtps_", "fastdds_")  # names of Fast DDS 2 (Jazzy) and Fast DDS 3 (Kilted) begin so
PORT = re.compile(r"(?:fastrtps|fastdds)_port(\d+)")


def remove_leftovers(domain: int | None = None, folder: Path = FOLDER) -> int:
    """Remove the segments and ports whose owner is dead; return the number of removed files.

    This works like `fastdds shm clean`: an owner holds a lock on ``NAME_el`` (or, with others, on ``NAME_sl``), which
    the operating system drops when the process ends. Files of other users are kept. Ports of other domains are kept
    too: a test of the lock locks the port, and a node that starts at that moment could not open it. (If the port
    belongs to no domain, the node uses the next one.)

    A port whose creator was killed before it had finished is removed in any domain once it is old: a process that
    opens it would wait forever for the creator. (A node looks for younger ones in its domain, see `clear_ports`.)

    Parameters
    ----------
    domain : int, optional
        A ROS_DOMAIN_ID in which no node runs or starts: its ports are removed, even those that were never locked.
    """
    removed = 0
    files = {name for name in listed(folder) if name.startswith(FAST)}
    locked = {name[:-3] for name in files if name.endswith(("_el", "_sl"))}
    ports = {name: int(match[1]) for name in files | locked if (match := PORT.fullmatch(name))}
    stems = {s for s in locked if s not in ports}
    for name in ports:
        old = name in files and _older(folder / name, ABANDONED)
        # The file of a port of `FLOWS` is created before its lock, so a port without a lock may be one in the making.
        if (old and _unfinished(folder / name)) or (ports[name] in FLOWS and (name in locked or old)):
            stems.add(name)
    stems |= {name for name, number in ports.items() if domain is not None and number in of_domain(domain)}
    for stem in sorted(stems):
        locks = [p for p in (folder / f"{stem}_el", folder / f"{stem}_sl") if p.exists()]
        # The locks are held until the files are removed and are removed last, so that a node that starts now cannot use
        # the port in between.
        with ExitStack() as stack:
            if not all(_is_abandoned(lock, stack) for lock in locks):
                continue
            for path in (folder / stem, folder / f"sem.{stem}_mutex", *locks):
                with suppress(OSError):
                    path.unlink()
                    removed += 1
    return removed


def clear_ports(domain: int, folder: Path = FOLDER) -> None:
    """Remove ports whose creator was killed while it created them, so that no new node of a domain hangs at them.

    A creator needs some microseconds. It has the time `AGE` and, on a host where it waits for a processor, the time in
    which this process checks `LOOKS` times.

    Parameters
    ----------
    domain : int
        ROS_DOMAIN_ID; others may be in it.
    """
    counts: dict[tuple[str, int], int] = {}
    while True:
        unfinished = [path for path in map(Path, ports_of(domain, folder)) if _unfinished(path)]
        counts = {key: counts.get(key, 0) + 1 for key in ((p.name, _inode(p)) for p in unfinished)}
        for port in (
            folder / name for (name, inode), n in counts.items() if n > LOOKS and _inode(folder / name) == inode
        ):
            for path in (port, folder / f"sem.{port.name}_mutex"):
                with suppress(OSError):
                    path.unlink()
            if port.exists():
                # It belongs to another user, so waiting for it would not end.
                return
        if not unfinished:
            return
        time.sleep(AGE / LOOKS)


def numbers(folder: Path = FOLDER) -> set[int]:
    """Return the numbers of all ports that have a file, of any process."""
    return {int(match[1]) for name in listed(folder) if (match := PORT.match(name))}


def ports_of(domain: int, folder: Path = FOLDER) -> list[str]:
    """Return the paths of the ports at which nodes of a domain may listen.

    Some of them belong to no domain, so those of other domains are among these. Nodes that are not ours do not check
    their ports; a half-created one stops them, too.
    """
    of_participants, of_flows = of_domain(domain), range(FLOWS[0], BASE)
    ports = [(name, int(match[1])) for name in listed(folder) if "_port" in name and (match := PORT.fullmatch(name))]
    return [f"{folder}/{name}" for name, number in ports if number in of_participants or number in of_flows]


def listed(folder: Path) -> list[str]:
    """Return the names of the files of a folder; none if it does not exist."""
    return os.listdir(folder) if folder.is_dir() else []


def lacking(processes: int, folder: Path = FOLDER) -> str:
    """Describe why messages of this number of nodes will not all use shared memory; empty if they will."""
    try:
        left = os.statvfs(folder)
    except OSError as error:
        return f"{folder}: {error.strerror}"
    if not os.access(folder, os.W_OK):
        return f"{folder} cannot be written"
    # Fast DDS falls back to UDP only if it cannot create its segment. If the space ends later, peers wait forever for
    # messages to ports that do not exist, or a node is killed by SIGBUS.
    free, needed = left.f_bavail * left.f_frsize, processes * SIZE
    return "" if free >= needed else f"{folder} has {free / 1e6:.1f} MB left, {processes} nodes take {needed / 1e6:.1f}"


def domain_id() -> int:
    """Return the ROS_DOMAIN_ID of the environment; rcl refuses an invalid one."""
    text = os.environ.get("ROS_DOMAIN_ID", "")
    return int(text) if text.isdecimal() else 0


class Ears:
    """The ports of this process, through which it receives messages of others in shared memory.

    A port is identified by its name. If its file was replaced or removed, only processes that had opened it before
    still write to it.

    Fast DDS judges after 20 s (see fastdds_loopback.xml) whether a port still has a reader. A waiting reader becomes
    active every third of this time. A process that opens the port between a judgement and the reader's next activity
    cannot know whether the reader is alive. It waits for a third of the time as well and sends nothing in the
    meantime. One of six late nodes received nothing for 6.7 s, and its peers, whose lease is shorter, dropped it. So
    a process that checks its ports writes the time of the check into them, and Fast DDS does not judge them.
    """

    # s, of which a pause between two checks, when the host has no time for this process, counts as one at most: Fast
    # DDS itself replaces a damaged port when its reader runs (see fastdds_loopback.xml)
    PATIENCE = 10.0

    def __init__(self) -> None:
        self._good: dict[Path, int] = {}  # inodes
        self._since: dict[Path, float] = {}
        self._checked_at, self._time = -math.inf, 0.0
        self._places: dict[tuple[Path, int], int] = {}

    def lost(self) -> str:
        """Name a port of this process that another process has taken; empty if none."""
        if self._good and not self._since and all(_inode(path) == inode for path, inode in self._good.items()):
            self._judge()
            return ""
        try:
            paths, mapped = _own_ports(), _mapped()
        except OSError:  # not Linux
            return ""
        self._good = {path: inode for path in paths if (inode := _inode(path)) in mapped.get(path, ())}
        self._judge()
        now = time.monotonic()
        self._time += min(now - self._checked_at, 1.0)
        self._checked_at = now
        self._since = {path: self._since.get(path, self._time) for path in paths - self._good.keys()}
        return next((path.name for path, since in self._since.items() if self._time - since >= self.PATIENCE), "")

    def _judge(self) -> None:
        """Mark each sound port of this process as checked just now, as Fast DDS does."""
        for path, inode in self._good.items():
            with suppress(OSError), path.open("r+b", buffering=0) as file:
                if (offset := self._places.get((path, inode))) is None:
                    offset = self._places[path, inode] = judged(file.read(), path)
                if offset >= 0 and os.fstat(file.fileno()).st_ino == inode:
                    os.pwrite(file.fileno(), struct.pack("=q", time.time_ns() // 1_000_000), offset)


def judged(segment: bytes, path: Path) -> int:
    """Return where a port stores the time (ms) of the last check of its readers; -1 if this cannot be found.

    In Fast DDS 2.14 and 3.2 (`SharedMemGlobal::PortNode`) the number of the port, its readers, the time after which it
    is judged and a third of that time are stored 20 bytes further on.
    """
    number = struct.pack("=I", int(path.name.partition("_port")[2]))
    for result in re.finditer(re.escape(number), segment):
        offset = result.start() - 20
        if offset < 0 or offset % 8 or offset + 36 > len(segment):
            continue
        (last,) = struct.unpack_from("=q", segment, offset)
        limit, third = struct.unpack_from("=2I", segment, offset + 28)
        if limit and third == limit // 3 and abs(time.time() - last / 1e3) < RECENT:
            return offset
    return -1


def _inode(path: Path) -> int:
    try:
        return path.stat().st_ino
    except OSError:
        return 0


def _own_ports() -> set[Path]:
    """Return the ports on which this process holds the subscriber's lock."""
    result = set()
    for entry in Path("/proc/self/fd").iterdir():
        with suppress(OSError):
            target = os.readlink(entry).removesuffix(" (deleted)")
            if target.endswith("_el") and PORT.search(target):
                result.add(Path(target.removesuffix("_el")))
    return result


def _mapped() -> dict[Path, set[int]]:
    """Return the inodes of the ports that this process has mapped, by the names they had."""
    result: dict[Path, set[int]] = {}
    for line in Path("/proc/self/maps").read_text().splitlines():
        if PORT.search(line):
            *_, inode, name = line.removesuffix(" (deleted)").split(maxsplit=5)
            result.setdefault(Path(name), set()).add(int(inode))
    return result


def _older(path: Path, age: float) -> bool:
    """Return whether a file has existed for more than some seconds."""
    try:
        return time.time() - path.stat().st_mtime >= age
    except OSError:
        return False


def _unfinished(path: Path) -> bool:
    """Return whether the creator of a segment has not finished it."""
    try:
        with path.open("rb") as file:
            return file.read(len(MADE)) != MADE
    except OSError:
        return False


def _is_abandoned(lock: Path, stack: ExitStack) -> bool:
    """Return whether a lock file is old and not locked; if so, this process locks it until `stack` ends."""
    try:
        if not _older(lock, AGE):
            return False
        file = os.open(lock, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
        stack.callback(os.close, file)
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
