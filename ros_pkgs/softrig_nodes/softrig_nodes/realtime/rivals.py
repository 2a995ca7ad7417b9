"""Detect whether only one of several publishers of a topic still publishes."""

from __future__ import annotations


class Rivals:
    """Distinguishes several writers on one topic by the consecutive numbers of each writer's messages.

    A killed writer stays matched until its lease is over. Until then neither its messages nor those of its replacement
    are accepted. If the numbers of all messages are consecutive, they come from one writer. A message of another one
    repeats a number or skips some, unless both have sent equally many; then the next message shows it.

    Attributes
    ----------
    alone : bool
        Whether one writer has published alone for long enough to be accepted. Once messages of two writers were
        received, it stays false until `change`.
    """

    def __init__(self) -> None:
        self.change()

    def change(self) -> None:
        """Restart the detection, because the set of writers has changed."""
        self.alone = self._several = False
        self._last: int | None = None
        self._since = 0

    def receive(self, number: int | None, now: int, silence: int) -> None:
        """Receive the number of a message.

        Parameters
        ----------
        number : int or None
            Number by its writer's count; None if the middleware does not provide it.
        now : int
            Time, ns.
        silence : int
            ns after which a silent writer is ignored.
        """
        last, self._last = self._last, number
        if number is None or (last is not None and number <= last):
            self._several = True
        # Either messages are lost or another publisher has published in between.
        elif last is None or number > last + 1:
            self._since = now
        self.alone = not self._several and now - self._since > silence
