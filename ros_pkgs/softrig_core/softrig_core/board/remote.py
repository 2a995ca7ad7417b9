"""Common base of a line to a node on a CAN bus and one to a program on a PLC: the connection and the counters."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from ..errors import RunError, ScenarioError
from .apart import Apart
from .line import REOPEN, Counts, Missing


class RemoteLine(ABC):
    """Base of lines to a node that has its own parameters and keeps its state; it has the methods of a `Line`.

    Parameters
    ----------
    port : str
        Name of the port, for errors.
    opened : callable
        Opens a connection; raises OSError if that fails now, ScenarioError if it can never succeed.
    clock, sleep : callable
        Return the time in s, and sleep for a time in s.
    """

    joined: bool
    timeout: float

    def __init__(
        self, port: str, opened: Callable[..., Any], clock: Callable[[], float], sleep: Callable[[float], object]
    ) -> None:
        self.port, self.counts, self._opened = port, Counts(), Apart(opened)
        self.served: tuple[int, bytes, bytes] = (-1, b"", b"")
        self.accepted = b""
        self._clock, self._sleep = clock, sleep
        self._connection: Any = None
        self._tried, self._why = -math.inf, ""
        self._missing = Missing(self.counts)
        self._known = False  # whether the other side has been there before, in real time

    @abstractmethod
    def begin(self, params: bytes) -> None:
        """Begin a session with the next request; the other side has its own parameters, so `params` is empty."""

    def remarks(self) -> str:
        """Describe unusual events; empty if there were none."""
        return self.counts.remarks()

    def close(self) -> None:
        """Close the connection."""
        connection, self._connection = self._connection, None
        if connection is not None:
            # What was unplugged may raise any error.
            with suppress(Exception):
                self._shut(connection)

    @abstractmethod
    def _shut(self, connection: Any) -> None:
        """Close a connection."""

    def _connected(self, failed: str, *arguments: Any) -> bool:
        """Return whether there is a connection, after an attempt to open it; attempts are rare enough that they cost no
        time.

        Parameters
        ----------
        failed : str
            What an OSError means.
        given
            What `opened` gets.
        """
        if self._connection is not None:
            return True
        if self._clock() - self._tried < REOPEN and not self._opened.busy:
            return False
        again = self._tried > -math.inf
        try:
            self._connection = self._opened(*arguments)
        except OSError as error:
            self._why = f"{failed}: {error.strerror or error}"
            return False
        # Waiting does not help.
        except ScenarioError as error:
            raise RunError(str(error)) from None
        finally:
            # Counted from the end of the try, which may take as long as the other side does not answer.
            self._tried = self._clock()
        self.counts.reopened += again
        self._why = ""
        return True

    def _gone(self, why: str) -> None:
        """Close a lost connection; the run continues if the other side kept its power."""
        self._why = why
        self._tried = self._clock()
        self.close()

    def _returned(self) -> None:
        """Count that the other side has joined again, in real time."""
        self.counts.rejoined += self._known
        self._known = True

    def _lose(self, number: int, received: float) -> None:
        """Count a request as lost; a new session begins if nothing was received for longer than the timeout."""
        self._missing.add(number)
        # It may have restarted.
        if self._clock() - received > self.timeout:
            self.begin(b"")
