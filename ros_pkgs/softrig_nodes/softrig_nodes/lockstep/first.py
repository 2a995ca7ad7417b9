"""A node's messages of t = 0, published again for late subscribers.

An outside node announces its endpoints one by one, and it is not known which of our topics it will subscribe to. As
long as the rig is at t = 0, a node that gets a new reader publishes its first message again. Our nodes use it once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from ..seam.endpoint import Output


def repeat_first(outputs: Iterable[Output], may_repeat: Callable[[], bool]) -> None:
    """Keep the first message of outputs and publish it again when a subscriber appears.

    Parameters
    ----------
    outputs : iterable of Output
        Advertised outputs whose messages have stamps, by which a reader detects a repetition.
    may_repeat : callable
        Whether the node is still at its first tick.
    """
    for output in outputs:
        _keep(output, may_repeat)


def _keep(output: Output, may_repeat: Callable[[], bool]) -> None:
    send = output.send
    stored: list[tuple[int, tuple[float, ...]]] = []

    def first(mark: int, values: tuple[float, ...]) -> None:
        # Only the first message is kept; later ticks shall not pay for this function.
        output.send = send
        stored.append((mark, values))
        send(mark, values)

    def again() -> None:
        if stored and may_repeat():
            send(*stored[0])

    output.send, output.joined = first, again
