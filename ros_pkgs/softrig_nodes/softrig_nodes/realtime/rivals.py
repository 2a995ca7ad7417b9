"""Of several writers on a topic: whether one alone speaks, the others being silent for too long."""

from __future__ import annotations


class Rivals:
    """Several writers on one topic, told apart by how each numbers its messages, without a gap.

    Who was killed stays matched until its lease is over, and neither it nor who takes its place is believed meanwhile.
    Where each message has the number after that before, they are all of one writer: another one that speaks repeats a
    number or leaves some out, except where both have sent equally many; then the next message shows it.

    Attributes
    ----------
    alone : bool
        Whether one has spoken alone for long enough to be believed. Once two of them have been heard it is never.
    """

    def __init__(self) -> None:
        self.change()

    def change(self) -> None:
        """Others write now."""
        self.alone = self._several = False
        self._last: int | None = None
        self._since = 0

    def hear(self, number: int | None, now: int, silence: int) -> None:
        """Receive the number of a message.

        Parameters
        ----------
        number : int or None
            As its writer counts; None where the middleware does not say.
        now : int
            Time, ns.
        silence : int
            ns after which who has said nothing counts no more.
        """
        last, self._last = self._last, number
        if number is None or (last is not None and number <= last):
            self._several = True
        # Either messages are lost or another publisher has published in between.
        elif last is None or number > last + 1:
            self._since = now
        self.alone = not self._several and now - self._since > silence
