"""A node's messages of t = 0, said again to readers that come late.

An outside node announces its endpoints one by one, and nobody knows which of our topics it is going to read. As long
as the rig stands at t = 0, who gets a new reader says its first message again; our nodes take it once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from .endpoint import Output
from .middleware import Message, Send


def repeat_first(outputs: Iterable[Output], may_repeat: Callable[[], bool]) -> None:
    """Have outputs keep their first message and publish it again when a reader comes.

    Parameters
    ----------
    outputs : iterable of Output
        Advertised ones, with stamps by which a reader knows what it has.
    may_repeat : callable
        Whether the node is still at its first tick.
    """
    for output in outputs:
        _keep(output, may_repeat)


def _keep(output: Output, may_repeat: Callable[[], bool]) -> None:
    send, send_any = output.send, output.send_any
    kept: list[tuple[Send, Message]] = []

    def first(say: Send) -> Send:
        def keep(message: Message) -> None:
            output.send, output.send_any = send, send_any
            kept.append((say, message))
            say(message)

        return keep

    def again() -> None:
        if kept and may_repeat():
            say, message = kept[0]
            say(message)

    output.send, output.send_any, output.joined = first(send), first(send_any), again
