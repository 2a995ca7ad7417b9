"""The message that a tick waits for on one topic."""

from __future__ import annotations

from collections import deque
from typing import Any

from ..model.schedule import Schedule
from .endpoint import Input

KEEP = object()  # a sporadic sender was silent: the value stays


class Pairing:
    """The awaited message of one topic.

    Parameters
    ----------
    topic : str
    schedule : Schedule
        Of the sender.
    sender : str
        Node name, for error messages.
    item : Input
        The port it feeds, or a stand-in that counts refusals of a /clock or acknowledgement.
    carries : bool
        Whether it feeds a port; a clock and an acknowledgement carry nothing but the stamp.
    earlier : bool
        Whether the awaited stamp is that of the last tick before ours: what a block has said about the end of the run.
    port : str
        Name of the sender's port if that is sporadic: silence is told by its acknowledgement.

    Attributes
    ----------
    want : int
        Awaited stamp, ns.
    have : bool
        Whether it is there.
    """

    def __init__(self, topic: str, schedule: Schedule, sender: str, item: Input, carries: bool = True,
                 earlier: bool = False, port: str = "") -> None:  # fmt: skip
        self.topic = topic
        self.schedule = schedule
        self.sender = sender
        self.item = item
        self.carries = carries
        self.earlier = earlier
        self.port = port
        self.want = schedule.before(0) if earlier else 0
        self.have = earlier
        self.holds = 0  # until this time the awaited message serves
        self.held = -1  # stamp of the value that is held
        self.stamp: int | None = None  # of the newest message of a sporadic sender
        self.received = 0  # by order: number of messages so far
        self.ahead: tuple[int, Any] | None = None
        self.between: tuple[int, Any] | None = None  # the newest message of a faster sender between two of our ticks
        self.excused = -1  # stamp of a refused message that was answered: a better one that follows is too late
        self.queue: deque[bytes] = deque()  # of a sporadic sender without stamps: messages and
        self.announced: deque[int] = deque()  # the ticks at which they were sent, as they come
