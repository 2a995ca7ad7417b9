"""The record of a node: the messages that it publishes, messages from outside, and changes of parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from softrig_core.block.port import CLOCK
from softrig_core.wire.cdr import Layout
from softrig_core.wire.parameter_event import encode
from softrig_core.wire.recording import ShardWriter, Sink, relative

from ..seam.endpoint import Output

if TYPE_CHECKING:
    from .adapter import Adapter

CLOCK_LAYOUT = Layout(CLOCK.msgtype)


class Record:
    """The record of a node, by numbers of its topics: outputs, inputs from outside (by their first reader), the clock.

    Parameters
    ----------
    owns_clock : bool
        Whether the node publishes /clock.
    sink : Sink or None
        Gets the messages in place of the file that the options name.

    Attributes
    ----------
    topics : list of (str, str)
        Name and type of each recorded topic.
    foreign : dict of str to int
        Number of each input that is recorded here.
    overheard : list of int
        Numbers of the topics of external nodes.
    clock : int
        Number of /clock.
    shard : ShardWriter or None
        The sink, if it is the file that the options name.
    add_row : callable or None
        Records an answer as its stamp and numbers, if the file supports that.
    """

    def __init__(self, node: Adapter, outputs: Sequence[Output], owns_clock: bool, sink: Sink | None) -> None:
        links, options, plain = node.links, node.options, node.step.plain
        inputs, resolve, of_rig = node.step.inputs, node.middleware.resolve, node.of_rig
        self.topics = [(relative(o.topic), o.port.msgtype) for o in outputs]
        records = links.records
        outside = [p for p in inputs if (p.name not in links.inputs if records is None else p.name in records)]
        if options.mode == "lockstep":
            # In lockstep `OverheardTopics` records these at their own times; the input must not record them a second
            # time.
            overheard = {of_rig(k.shape["topic"]) for k in links.overheard}
            outside = [p for p in outside if resolve(p.topic) not in overheard]
        self.foreign = {port.name: len(self.topics) + k for k, port in enumerate(outside)}
        self.topics += [(relative(resolve(p.topic)), p.msgtype) for p in outside]
        self.overheard = [len(self.topics) + k for k in range(len(links.overheard))]
        self.topics += [(relative(of_rig(k.shape["topic"])), k.shape["msgtype"]) for k in links.overheard]
        self.clock = len(self.topics)
        row = {o.number: o.layout for o in outputs} if plain else {}
        if links.owns_clock:
            self.topics.append((CLOCK.topic, CLOCK.msgtype))
            # /clock is published with each answer, so its message is made of the same row of numbers.
            if plain and owns_clock:
                row[self.clock] = CLOCK_LAYOUT
        wanted = options.shard and sink is None
        self.shard = ShardWriter(Path(options.shard), self.topics, row) if wanted else None
        self.sink = self.shard if sink is None else sink
        self.add_row = self.shard.add_row if self.shard is not None and row else None
        # An answer that is recorded by its numbers, or not at all, need not be encoded for the record.
        self.by_numbers = self.add_row is not None or self.sink is None or not row

    def change(self, stamp: int, node: str, values: Mapping[str, Any]) -> None:
        """Record changed parameters of a node with the stamp of the tick that uses them, ns."""
        if self.sink is not None:
            self.sink.note(stamp, encode(stamp, f"/{node}", values))
