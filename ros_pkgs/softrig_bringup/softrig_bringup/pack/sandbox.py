"""Run foreign code in bubblewrap if it is installed: no network, no home folder, one writable folder.

Everything else is read-only. Other processes are invisible. The terminal is not accessible; the output of the run is
passed through pipes.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import IO

from softrig_core import ScenarioError
from softrig_core.guard import plain, print_line
from softrig_core.kit.compiled import cache_folder
from softrig_core.scenario.scenario_file import scenario_folders

from .packed import digest_of

# Set in the environment inside, so that the run there does not start a sandbox of its own.
VARIABLE = "SOFTRIG_SANDBOX"
_HIDDEN = ("/tmp", "/var/tmp", "/run")
_PASSED = re.compile(
    r"PATH|HOME|LANG|LC_\w+|TZ|TERM|COLUMNS|VIRTUAL_ENV|AMENT_PREFIX_PATH|LD_LIBRARY_PATH|XDG_CACHE_HOME"
    r"|(?:SOFTRIG|PYTHON|ROS|RMW|OMP|OPENBLAS|NUMBA|MKL)\w*"
)
# These options need the network or a file elsewhere, which a sandbox has not.
_OUTSIDE = ("view", "junit", "domain", "connect", "scheduler")


def inside() -> bool:
    """Return whether this process runs in a sandbox of ours."""
    return os.environ.get(VARIABLE) == "1"


def source_of(options: argparse.Namespace) -> Path | None:
    """Return the pack that --like or --from names; None without either."""
    origin = getattr(options, "origin", None)
    source: Path | None = options.like if origin is None else origin[0]
    return source


def command(options: argparse.Namespace) -> list[str] | None:
    """Return the command that repeats this call in bubblewrap; None if bubblewrap is missing or does not work.

    Parameters
    ----------
    options : argparse.Namespace
        Command line of the verb `run` or `study` that `words` are a part of.
    """
    if (program := shutil.which("bwrap")) is None:
        print_line("no bubblewrap here (Debian: apt-get install bubblewrap): the code runs with all your rights")
        return None
    asked = [f"--{name}" if name != "view" else name for name in _OUTSIDE if getattr(options, name, None)]
    if asked:
        print_line(f"not in bubblewrap, for {', '.join(asked)}: the code runs with all your rights")
        return None
    out = _results(options)
    begin = [program, *_rights(out, options)]
    tried = subprocess.run([*begin, "--", sys.executable, "-c", ""], capture_output=True, text=True, check=False)
    if tried.returncode:
        why = " ".join(tried.stderr.split()) or f"status {tried.returncode}"
        print_line(f"bubblewrap does not work here ({why}): the code runs with all your rights")
        return None
    print_line("it runs in bubblewrap: no network, no home, nothing to write but its results")
    words = list(options.words) if options.out is not None else [*options.words, "--out", str(out)]
    trust = [] if options.trust else ["--trust"]
    return [*begin, "--", sys.executable, "-P", "-m", "softrig_bringup", *words, *trust]


def _results(options: argparse.Namespace) -> Path:
    """Create and return the folder for the results; a new one, unless it is named."""
    if options.out is not None:
        out: Path = options.out.absolute()
    else:
        source = source_of(options)
        assert source is not None
        name = re.sub(r"[^A-Za-z0-9_.=+-]+", "_", source.name.partition(".")[0])[:100]
        first = Path("runs", f"{name}-again").absolute()
        candidates = (first if n == 1 else first.with_name(f"{first.name}-{n}") for n in range(1, 10_000))
        out = next(path for path in candidates if not path.exists())
    if out.exists() and not out.is_dir():
        raise ScenarioError(f"--out {out} is a file, expected a folder for the results")
    out.mkdir(parents=True, exist_ok=True)
    return out


def _rights(out: Path, options: argparse.Namespace) -> Iterator[str]:
    """Describe the rights of the sandbox."""
    cwd = os.getcwd()
    hidden = [folder for folder in dict.fromkeys([*_HIDDEN, os.path.expanduser("~")]) if folder != "/"]
    yield from ("--die-with-parent", "--unshare-all", "--cap-drop", "ALL", "--ro-bind", "/", "/")
    yield from ("--dev", "/dev", "--proc", "/proc", "--ro-bind-try", "/dev/null", "/dev/tty")
    for folder in hidden:
        if os.path.isdir(folder):
            yield from ("--tmpfs", folder)
    source = source_of(options)
    assert source is not None
    for path in _read(source.absolute(), hidden):
        yield from ("--ro-bind", path, path)
    yield from ("--dir", cwd, "--bind", str(out), str(out), "--chdir", cwd)
    # Compiled code is executed, so a pack gets a cache of its own, which no run outside of a sandbox uses.
    cache = cache_folder() / "packs" / f"{digest_of(source)[:32]}-cache"
    cache.mkdir(parents=True, exist_ok=True)
    yield from ("--bind", str(cache), str(cache))
    yield from ("--clearenv", "--setenv", VARIABLE, "1", "--setenv", "XDG_CACHE_HOME", str(cache))
    for name, value in os.environ.items():
        if _PASSED.fullmatch(name) and name not in (VARIABLE, "XDG_CACHE_HOME"):
            yield from ("--setenv", name, value)


def _read(source: Path, hidden: Iterable[str]) -> list[str]:
    """List the readable files in hidden folders: Python, imports, scenarios, the pack and its signature."""
    command_folder = os.path.dirname(os.path.dirname(os.environ.get("SOFTRIG_COMMAND", "")))
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    paths = [sys.prefix, sys.base_prefix, *sys.path, command_folder, *prefixes, str(source), f"{source}.sig"]
    # The cache of packs is left out, because a pack is unpacked again inside, into its own cache.
    paths += [str(folder) for folder in scenario_folders() if not folder.is_relative_to(cache_folder() / "packs")]
    readable = sorted({p for p in paths if p and os.path.exists(p)} | {os.path.realpath(p) for p in paths if p})
    below = [p for p in readable if os.path.exists(p) and any(p.startswith(f"{h}/") for h in hidden)]
    return [p for p in below if not any(p.startswith(f"{q}/") for q in below)]


def run(words: list[str]) -> int:
    """Run a command and print its lines without terminal control characters; return its exit status."""
    process = subprocess.Popen(
        words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        errors="replace", process_group=0,
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stderr is not None
    readers = [
        threading.Thread(target=_shown, args=pair)
        for pair in ((process.stdout, sys.stdout), (process.stderr, sys.stderr))
    ]

    def stop(number: int, _: FrameType | None) -> None:
        # bubblewrap does not pass signals on. The run in it must receive them, so that it ends in order and writes its
        # bag.
        with suppress(OSError):
            for child in _below(process.pid):
                os.kill(child, number)

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        for reader in readers:
            reader.start()
        for reader in readers:
            reader.join()
        status = process.wait()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if process.poll() is None:
            process.kill()
            process.wait()
    return status if status >= 0 else 128 - status


def _below(pid: int) -> list[int]:
    """Return the first process that is not bubblewrap: one outside and one inside the sandbox precede it."""
    result = [pid]
    while result and all(Path(f"/proc/{p}/comm").read_text().strip() == "bwrap" for p in result):
        result = [int(c) for p in result for c in Path(f"/proc/{p}/task/{p}/children").read_text().split()]
    return result


def _shown(source: IO[str], into: IO[str]) -> None:
    for line in source:
        into.write(plain(line))
        into.flush()
