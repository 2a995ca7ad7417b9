"""Ports that a separate thread opens, so that a tick in real time never waits for them."""

from __future__ import annotations

import errno
import threading
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Any

QUICK = 1e-3  # s that a tick waits: most ports open within it


class Apart:
    """Opens a port: directly or, if `patient` is false, in a thread that runs while ticks are answered.

    Parameters
    ----------
    opened : callable
        Opens it.

    Attributes
    ----------
    patient : bool
        Whether the caller waits for it.
    busy : bool
        Whether it is being opened.
    """

    def __init__(self, opened: Callable[..., Any]) -> None:
        self._opened = opened
        self._jobs: SimpleQueue[tuple[Any, ...]] = SimpleQueue()
        self._ends: SimpleQueue[tuple[Any, Exception | None]] = SimpleQueue()
        self._begun = False
        self.patient, self.busy = True, False

    def __call__(self, *arguments: Any) -> Any:
        """Return the open line.

        Raises
        ------
        OSError
            It cannot be opened, or is not open yet.
        """
        if self.patient and not self.busy:
            return self._opened(*arguments)
        if not self.busy:
            if not self._begun:
                # It never ends by itself: Linux ends a simulator with the thread that began it.
                threading.Thread(target=self._work, daemon=True).start()
                self._begun = True
            self._jobs.put(arguments)
            self.busy = True
        try:
            result, error = self._ends.get(timeout=None if self.patient else QUICK)
        except Empty:
            raise OSError(errno.EINPROGRESS, "it is being opened") from None
        self.busy = False
        if error is not None:
            raise error
        return result

    def _work(self) -> None:
        while True:
            arguments = self._jobs.get()
            try:
                self._ends.put((self._opened(*arguments), None))
            except Exception as error:  # the next tick raises it, whatever it is
                self._ends.put((None, error))
