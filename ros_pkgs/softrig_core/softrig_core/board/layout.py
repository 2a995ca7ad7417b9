"""The place of each value in the frames of a link, for Python and for the board's C."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from ..block.port import Port, Sample

# answer to a hello: status, digest, period in s as a fraction, bytes of a number, of values of a step, an answer and
# parameters; longest step so far, in ticks of the board's clock
HELLO = struct.Struct("<B16sqqBHHHI")
Settable = Mapping[str, type]  # parameters that a board takes: name to int or float


@dataclass(frozen=True)
class Layout:
    """The frames of one node.

    Parameters
    ----------
    settable : mapping of str to type
        Parameters that may be set on the board, in order.
    plant : bool
        Whether a step first moves the state on, from one time to another.
    single : bool
        The board's numbers are float.
    """

    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    settable: Settable
    plant: bool
    single: bool

    @cached_property
    def step(self) -> struct.Struct:
        """Times, then the inputs; of a plant, whether they count, first."""
        return struct.Struct("<" + ("Bqq" if self.plant else "q") + self._ports(self.inputs, "held"))

    @cached_property
    def answer(self) -> struct.Struct:
        """Status and outputs."""
        return struct.Struct("<B" + self._ports(self.outputs, "sporadic"))

    @cached_property
    def params(self) -> struct.Struct:
        """Parameters."""
        return struct.Struct("<" + "".join("q" if kind is int else self.real for kind in self.settable.values()))

    @property
    def real(self) -> str:
        """Return `struct`'s code of the board's numbers."""
        return "f" if self.single else "d"

    @property
    def room(self) -> int:
        """Bytes of the longest frame before its zero, checksum included."""
        return 5 + max(self.step.size, self.answer.size, self.params.size)

    def _ports(self, ports: Sequence[Port], flag: str) -> str:
        return "".join(
            ("B" if getattr(p, flag) else "") + ("q" if p.delayed else "") + f"{p.size}{self.real}" for p in ports
        )

    def numbers(self, inputs: Mapping[str, Any]) -> list[Any]:
        """Return the inputs of a tick in the order of a step."""
        result: list[Any] = []
        for port in self.inputs:
            value = inputs.get(port.name)
            if port.held:
                result.append(value is not None)
            if port.delayed:
                result.append(0 if value is None else value.stamp)
            if value is None:
                result += (0.0,) * port.size
            else:
                result += value.data if isinstance(value, Sample) else value
        return result

    def outputs_of(self, answer: Sequence[Any]) -> dict[str, Any]:
        """Return the value of each output in an unpacked answer."""
        result: dict[str, Any] = {}
        index = 1
        for port in self.outputs:
            published = True
            if port.sporadic:
                published = bool(answer[index])
                index += 1
            stamp = answer[index]
            index += port.delayed
            row = tuple(answer[index : index + port.size])
            index += port.size
            if published:
                result[port.name] = Sample(stamp, row) if port.delayed else row
        return result
