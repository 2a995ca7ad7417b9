"""A DDS domain that no other run of softrig on this host uses."""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import RunError

DOMAINS = range(1, 101)  # 0 is everybody's default; above 101 the ports of Linux' ephemeral range begin


@contextmanager
def free_domain() -> Iterator[int]:
    """Reserve a ROS_DOMAIN_ID for the length of a ``with`` block, across all processes of this host.

    A domain is taken while some process holds the lock on its file in the temporary directory; the operating
    system drops the lock of a dead process. The search starts at the process number, so that two runs in a row
    seldom share a domain and see each other's ghosts.

    Yields
    ------
    int
        1 to 100.

    Raises
    ------
    RunError
        All domains are taken.

    Examples
    --------
    >>> with free_domain() as domain:
    ...     1 <= domain <= 100
    True
    """
    start = os.getpid()
    for i in range(len(DOMAINS)):
        domain = DOMAINS[(start + i) % len(DOMAINS)]
        file = _open(Path(tempfile.gettempdir()) / f"softrig-domain-{domain}.lock")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(file)
            continue
        try:
            yield domain
        finally:
            os.close(file)
        return
    raise RunError(f"all DDS domains {DOMAINS[0]} to {DOMAINS[-1]} are in use on this host")


def _open(path: Path) -> int:
    try:
        return os.open(path, os.O_RDONLY)  # another user's file may be locked, though not opened with O_CREAT
    except FileNotFoundError:
        return os.open(path, os.O_RDONLY | os.O_CREAT, 0o644)
