"""Run a process without rights: no network, only the files that it must read, and one folder to write to.

It uses namespaces of the kernel (namespaces(7)), which most systems allow to every user. If a system does not,
`confine` raises an error with the reason.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterable
from pathlib import Path

# This variable is set in the environment of a run whose FMUs came with a pack.
STRANGE = "SOFTRIG_CONFINED"
SCRATCH = "/tmp"
# These and the home hold keys, and the sockets of agents and of containers.
HIDDEN = (SCRATCH, "/var/tmp", "/run", "/dev/shm")
# of sched.h, sys/mount.h and linux/mount.h
_NEW = 0x00020000 | 0x04000000 | 0x08000000 | 0x10000000 | 0x40000000  # mounts, host name, IPC, user, network
_BIND, _REC, _PRIVATE, _NOSUID, _NODEV = 0x1000, 0x4000, 0x40000, 2, 4
# mount_setattr(2) has no wrapper in older C libraries; its number is the same on every architecture (Linux 5.12).
_SETATTR = 442
_RECURSIVE, _RDONLY, _ATTR_NOSUID, _ATTR_NODEV = 0x8000, 1, 2, 4
_CAPBSET_DROP, _NO_NEW_PRIVS = 24, 38  # constants of prctl
_CAPABILITIES = 0x20080522  # version of capset


def confine(keep: Iterable[str | Path] = ()) -> None:
    """Drop all rights of this process permanently. It must have one thread.

    Parameters
    ----------
    keep : iterable of path
        Files and folders in `HIDDEN` and in the home that stay readable, in addition to Python and its imports.

    Raises
    ------
    OSError
        The system does not allow it. The process may already have lost some rights and must end.
    """
    libc = ctypes.CDLL(None, use_errno=True)

    def call(name: str, *arguments: object) -> None:
        if getattr(libc, name)(*arguments):
            number = ctypes.get_errno()
            raise OSError(number, f"{name}: {os.strerror(number)}")

    def mount(source: str, target: str, kind: str, flags: int) -> None:
        words = [text.encode() for text in (source, target, kind)]
        call("mount", *words, ctypes.c_ulong(flags), None)

    def attributes(target: str, flags: int, add: int, remove: int) -> None:
        result = (ctypes.c_uint64 * 4)(add, remove, 0, 0)
        numbers = (ctypes.c_long(_SETATTR), ctypes.c_long(-100), target.encode(), ctypes.c_uint(flags))
        call("syscall", *numbers, result, ctypes.c_size_t(ctypes.sizeof(result)))

    user, group = os.getuid(), os.getgid()
    hidden, visible = _places([*keep, sys.prefix, sys.base_prefix, *sys.path])
    call("unshare", _NEW)
    for name, text in (("setgroups", "deny"), ("uid_map", f"{user} {user} 1"), ("gid_map", f"{group} {group} 1")):
        Path("/proc/self", name).write_text(text)
    mount("none", "/", "none", _REC | _PRIVATE)
    # The files are opened after `unshare`, because descriptors from before belong to other mounts.
    opened = {path: os.open(path, os.O_PATH) for path in visible}
    for target in hidden:
        mount("none", target, "tmpfs", _NOSUID | _NODEV)
    for path, descriptor in opened.items():
        if os.path.isdir(f"/proc/self/fd/{descriptor}"):
            os.makedirs(path, exist_ok=True)
        else:
            os.makedirs(os.path.dirname(path), exist_ok=True)
            Path(path).touch()
        mount(f"/proc/self/fd/{descriptor}", path, "none", _BIND | _REC)
        os.close(descriptor)
    # The owner of a device can write to it on a read-only mount too, so root gets no devices.
    attributes("/", _RECURSIVE, _RDONLY | _ATTR_NOSUID | (0 if user else _ATTR_NODEV), 0)
    attributes(SCRATCH, 0, 0, _RDONLY)
    os.chdir(SCRATCH)
    os.environ["TMPDIR"] = SCRATCH
    for capability in range(64):
        # The kernel refuses numbers of capabilities that it does not know, hence no check of the result.
        libc.prctl(_CAPBSET_DROP, capability, 0, 0, 0)
    call("prctl", _NO_NEW_PRIVS, 1, 0, 0, 0)
    call("capset", (ctypes.c_uint32 * 2)(_CAPABILITIES, 0), (ctypes.c_uint32 * 6)())


def _places(keep: Iterable[str | Path]) -> tuple[list[str], list[str]]:
    """Return the folders to hide, and their parts that stay visible."""
    wanted = sorted({os.path.realpath(p) for p in keep if str(p) and os.path.exists(p)})
    outer = [p for p in wanted if not any(p.startswith(f"{q}/") for q in wanted)]
    home = os.path.realpath(os.path.expanduser("~"))
    folders = [p for p in dict.fromkeys([*HIDDEN, home]) if os.path.isdir(p) and p != "/"]
    hidden = [p for p in folders if not any(p == q or p.startswith(f"{q}/") for q in [*outer, *folders] if q != p)]
    hidden = [p for p in hidden if p not in outer]
    return hidden, [p for p in outer if any(p.startswith(f"{q}/") for q in hidden)]


def forbidden() -> str:
    """Describe why a process cannot be confined on this machine; empty if it can."""
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        try:
            confine()
        except OSError as error:
            os.write(writing, str(error.strerror).encode()[:500])
        except BaseException as error:
            os.write(writing, repr(error).encode()[:500])
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as pipe:
        text = pipe.read().decode(errors="replace")
    os.waitpid(child, 0)
    return text
