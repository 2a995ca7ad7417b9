"""The process that turns knobs and presses buttons for the pages: `softrig_nodes.ros.remote`."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any

from softrig_nodes.processes.executables import environment

from .control import Answer


class Remote:
    """Sends requests to the nodes of a rig, and passes their answers to the callers.

    Parameters
    ----------
    domain : int
        ROS_DOMAIN_ID.
    directory : Path
        Folder for logs.
    call : callable
        Called with a function that must run in the thread of the pages.
    """

    def __init__(self, domain: int, directory: Path, call: Callable[[Callable[[], object]], object]) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "softrig_nodes.ros.remote"],
            env=environment(domain, directory),
            text=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,  # in the process group of the page, so that both can be ended together
        )
        self._asked: dict[int, Answer] = {}
        self._numbers = count()
        self._call = call
        threading.Thread(target=self._listen, daemon=True).start()

    def ask(self, request: Mapping[str, Any], answered: Answer) -> None:
        """Send a request; `answered` is called with its success and the text of the answer."""
        number = next(self._numbers)
        self._asked[number] = answered
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps({"id": number, **request}) + "\n")
            self._process.stdin.flush()
        except OSError:
            del self._asked[number]
            answered(False, "the process that sends requests to the nodes has ended")

    def _listen(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            with suppress(ValueError):  # lines that a library prints are skipped
                content = json.loads(line)
                self._call(lambda content=content: self._asked.pop(content["id"])(content["ok"], content["reason"]))  # type: ignore[misc]

    def close(self) -> None:
        """End the process."""
        let_go(self._process, 2.0)


def let_go(process: subprocess.Popen[str], patience: float) -> None:
    """End a process that reads its standard input to the end; after `patience` s it is killed.

    If it is forced and leads a process group, the group ends, too: a page that is still starting has a separate
    process.
    """
    assert process.stdin is not None
    with suppress(OSError):
        process.stdin.close()
    try:
        process.wait(patience)
    except subprocess.TimeoutExpired:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.kill()
        process.wait()
