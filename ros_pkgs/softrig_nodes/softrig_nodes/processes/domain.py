"""A DDS domain that no other run on this host uses."""

from __future__ import annotations

import errno
import fcntl
import os
import socket
import stat
import struct
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from softrig_core.errors import RunError, ScenarioError
from softrig_core.kit.compiled import cache_folder

from .ports import BASE, GAIN, udp_ports
from .shared_memory import remove_leftovers

# Domain 0 is the default of every ROS session. Above 101 the ports of a domain lie in the range from which Linux
# chooses ephemeral ports, so another program may hold them.
DOMAINS = range(1, 101)
# Used when those are taken, beginning with the domains whose ports lie above the ephemeral range.
BEYOND = (*range(215, 232), *range(101, 215))
HIGHEST = 232  # the highest number that DDS allows
SIOCGIFFLAGS, IFF_UP = 0x8913, 1  # constants of Linux: <net/if.h>


@contextmanager
def free_domain(wanted: int | None = None) -> Iterator[int]:
    """Reserve a ROS_DOMAIN_ID for the length of a ``with`` block, across all processes of this host.

    A domain is taken while a process of this user holds the lock on its file in the user's cache folder, or a process
    of any user holds its name among the abstract sockets of the host. The operating system drops both when the process
    ends. A domain that any ROS session of this host uses is not chosen either: the session holds ports of that domain.

    The search starts at the process number, so that two successive runs rarely share a domain and see each other's dead
    nodes. It continues in `BEYOND` when all of `DOMAINS` are taken. Files that killed processes left in shared memory
    are removed, together with all ports of a domain without nodes, because a new node would use them unchecked (see
    `remove_leftovers`).

    Parameters
    ----------
    wanted : int, optional
        Reserve only this domain.

    Yields
    ------
    int
        `wanted`, or 1 to 231.

    Raises
    ------
    ScenarioError
        `wanted` is no domain.
    RunError
        `wanted`, or every domain, is taken; the error names the processes.

    Examples
    --------
    >>> with free_domain() as number:
    ...     1 <= number <= 231
    True
    """
    if wanted is not None and not 0 <= wanted <= HIGHEST:
        raise ScenarioError(f"domain {wanted}: expected 0 to {HIGHEST}")
    start = os.getpid()
    usual = [DOMAINS[(start + i) % len(DOMAINS)] for i in range(len(DOMAINS))]
    choice = [*usual, *BEYOND] if wanted is None else [wanted]
    # A requested domain is used even if ROS sessions of this host are in it; only another run excludes it.
    busy = set() if wanted is not None else inhabited()
    for number in choice:
        if number in busy:
            continue
        file = _open(number)
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as name:
                try:
                    # The file excludes processes that have joined the domain by `join_domain`. The name of the socket
                    # excludes other users, who have another cache folder.
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    name.bind(f"\0softrig-domain-{number}")
                except OSError as error:
                    if error.errno not in (errno.EWOULDBLOCK, errno.EADDRINUSE):
                        raise
                    continue
                remove_leftovers(number if wanted is None else None)
                yield number
        finally:
            os.close(file)
        return
    names = f"domain {wanted} is" if wanted is not None else f"all DDS domains {DOMAINS[0]} to {max(choice)} are"
    raise RunError(f"{names} in use by other runs on this host{holders(choice)}")


def holders(domains: Iterable[int]) -> str:
    """Describe in brackets the processes that use domains, as far as this user can see them; empty if none."""
    names = {f"@softrig-domain-{number}" for number in domains}
    with suppress(OSError):  # not Linux
        lines = [line.split() for line in Path("/proc/net/unix").read_text().splitlines()]
        sockets = {f"socket:[{fields[6]}]" for fields in lines if fields[-1] in names}
        counter: Counter[str] = Counter()
        for entry in _open_files() if sockets else ():
            with suppress(OSError):  # closed in the meantime
                if os.readlink(entry) in sockets:
                    process = entry.parents[1]
                    counter[f"process {process.name} ({(process / 'comm').read_text().strip()})"] += 1
        if hidden := len(sockets) - counter.total():
            counter["processes of other users"] += max(0, hidden)
        messages = [f"{count} by {owner}" for owner, count in counter.most_common(3) if count]
        return f" ({', '.join(messages)}{', ...' if len(counter) > len(messages) else ''})" if messages else ""
    return ""


def _open_files() -> Iterator[Path]:
    """Yield an entry of /proc for each file that the processes of this user have open."""
    for process in Path("/proc").glob("[0-9]*"):
        # The process may be another user's, or end while it is looked at; `glob` of Python 3.11 would end with it.
        with suppress(OSError):
            yield from (process / "fd").iterdir()


def join_domain(number: int) -> int:
    """Hold a domain together with others until this process ends, so that no run reserves it for itself.

    Returns
    -------
    int
        A file number; closing it releases the domain.

    Raises
    ------
    RunError
        A run has reserved it.
    """
    file = _open(number)
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(file)
        raise RunError(f"domain {number} is in use by a run on this host; set ROS_DOMAIN_ID to another") from None
    return file


def require_loopback() -> None:
    """Ensure that nodes of this host can find each other.

    Raises
    ------
    RunError
        The loopback interface is down: each node would wait for the others in vain.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        try:
            request = fcntl.ioctl(any_socket, SIOCGIFFLAGS, struct.pack("256s", b"lo"))
        except OSError:  # the file has another name here
            return
    if not struct.unpack_from("H", request, 16)[0] & IFF_UP:
        raise RunError("the loopback interface lo is down, and nodes find each other over it; `ip link set lo up`")


def inhabited() -> set[int]:
    """Return the domains with a DDS participant on this host: each uses UDP ports of its domain."""
    return {(port - BASE) // GAIN for port in udp_ports()}


def _open(number: int) -> int:
    # A link could lead to a file of another program, and opening a pipe would wait for its other end.
    try:
        path = cache_folder() / "domains" / f"{number}.lock"
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o600)
    except OSError as error:
        advice = "" if isinstance(error, PermissionError) else "; expected a plain file of this user"
        raise RunError(f"lock of domain {number}: {error.filename}: {error.strerror}{advice}") from None
    if not stat.S_ISREG(os.fstat(file).st_mode):
        os.close(file)
        raise RunError(f"lock of domain {number}: {path}: expected a plain file")
    return file
