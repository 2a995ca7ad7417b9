"""A node that replays a recorded run's external inputs, each at the tick at which the run used it."""

from __future__ import annotations

import json
import math
from bisect import bisect_right
from collections.abc import Iterable, Mapping
from dataclasses import fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from softrig_core import Block, BlockParams, Port, Recording, Sample, param, to_ns
from softrig_core.block.codec import Decoder
from softrig_core.block.port import Refused
from softrig_core.kit.file_format import json_of

from .files.reader import BagReader
from .read import read_bag


def written(port: Port) -> str:
    """Describe a port as JSON, without values that are defaults."""
    results = {f.name: getattr(port, f.name) for f in fields(Port)}
    return json.dumps({name: value for name, value in results.items() if value not in ((), "", False)})


def port_of(text: str) -> Port:
    """Create an output that publishes what a port has read; `text` is from `written`."""
    results = {name: _tuples(value) for name, value in json_of(text).items()}
    return replace(Port(**results), held=False, partial=False, sporadic=True)


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


class TapeParams(BlockParams):
    """Parameters of a tape: the bag, and the part of it that is replayed."""

    bag: str = param("", "bag of a run")
    until: float = param(0.0, "what came from this time on is left out; 0: nothing is", "s", ge=0.0)
    inputs: tuple[str, ...] = param((), "ports of the nodes that read it, as JSON; see `written`")

    def _check(self) -> None:
        for text in self.inputs:
            try:
                port_of(text)
            except (ValueError, TypeError, KeyError, AttributeError) as error:
                raise ValueError(f"inputs: {text[:80]!r} is not a port: {error}") from None


@lru_cache(maxsize=2)
def _loaded(bag: str) -> tuple[Recording, int]:
    """Return the recording, and the time from which its stamps count, ns."""
    with BagReader(Path(bag)) as reader:
        epoch = int(reader.custom_data.get("epoch", "0"))
    return read_bag(Path(bag)), epoch


class State(NamedTuple):
    """Number of messages that are published on each topic."""

    published: tuple[int, ...]


class Tape(Block[TapeParams]):
    """Publishes the newest message of each topic in the bag up to a tick, if it was not published before.

    A run records an external message at the tick that uses it. Published at that tick, the message has the same effect
    again. Messages that the reader rejected in the recorded run are left out. Channels that a message does not name
    keep their values. No parameter may change while the node runs, because it replays a record.
    """

    @classmethod
    def ports(cls, params: TapeParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Declare one output for each port that reads the bag."""
        return (), tuple(port_of(text) for text in params.inputs)

    def setup(self) -> None:
        """Read the bag."""
        self._rows = {}
        for text in self.p.inputs:
            port = port_of(text)
            self._rows[port.name] = list(self._read(Port(**{n: _tuples(v) for n, v in json_of(text).items()})))

    def _read(self, port: Port) -> Iterable[tuple[int, Any]]:
        """Return (ns from t = 0, values) of each message that a port accepts."""
        recording, epoch = _loaded(self.p.bag)
        topic = recording.topics[port.topic]
        decode = Decoder(port)
        until = to_ns(self.p.until) or math.inf
        for t, data in zip(topic.times, topic.data, strict=True):
            if t - epoch >= until:
                break
            try:
                stamp, values = decode(data)
            # The reader refused this message in the recorded run too, so it has no effect to repeat.
            except Refused:
                continue
            # Channels that a partial message does not name keep these values in the next one.
            decode.kept = values
            yield t - epoch, Sample(stamp - epoch, values) if port.delayed else values

    def first(self) -> State:
        """Return the empty state: nothing has been published yet."""
        return State((0,) * len(self._rows))

    def update(self, x: State, t: int, **inputs: Any) -> tuple[State, Mapping[str, Any]]:
        """Publish the newest message at this tick that has not been published."""
        results, messages = {}, []
        for (name, rows), before in zip(self._rows.items(), x.published, strict=True):
            k = bisect_right(rows, t, before, key=lambda row: row[0])
            messages.append(k)
            if k > before:
                results[name] = rows[k - 1][1]
        return State(tuple(messages)) if results else x, results
