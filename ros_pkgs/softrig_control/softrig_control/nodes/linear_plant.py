"""A linear plant given by its transfer function."""

from __future__ import annotations

from typing import NamedTuple

from softrig_core import BlockParams, Plant, Port, Values, param

from ..discretise import matmul
from ..transfer import sample_transfer_function
from .signal_name import signal_port


class LinearPlantParams(BlockParams):
    """Transfer function num(s)/den(s) and the names of its two signals."""

    period: float = param(0.00083, "sampling period T, also of the zero-order hold", "s", gt=0.0, le=10.0)
    num: tuple[float, ...] = param(
        (2.8286, 2.8286 * 175100.0), "numerator, highest power of s first", min_length=1, max_length=50
    )
    den: tuple[float, ...] = param(
        (1.0, 51.17 + 125.7, 51.17 * 125.7), "denominator, highest power of s first", min_length=2, max_length=50
    )
    command: str = param("command/u/effort", "input signal, topic/channel/field")
    command_unit: str = param("V", "its unit")
    output: str = param("output/v_dc/position", "output signal, topic/channel/field")
    output_unit: str = param("V", "its unit")

    def _check(self) -> None:
        sample_transfer_function(self.num, self.den, self.period)
        self.signals()

    def signals(self) -> tuple[Port, Port]:
        """Return the ports (command, output)."""
        return (
            signal_port("command", self.command, self.command_unit),
            signal_port("output", self.output, self.output_unit),
        )


class State(NamedTuple):
    """x1, x2, ... of the controllable form."""

    x: tuple[float, ...]


class LinearPlant(Plant[LinearPlantParams]):
    """x' = A x + B u, y = C x from num(s)/den(s), from rest, sampled exactly by `sample_transfer_function`.

    The default is the transfer function (19) of Radmanesh and Saeidi (IECO, 2020) from the drop V' to the DC voltage
    of their rectifier, 2.8286 (s + 175100)/((s + 51.17)(s + 125.7)).
    """

    @classmethod
    def ports(cls, params: LinearPlantParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Declare one input and one output."""
        command, output = params.signals()
        return (command,), (output,)

    def setup(self) -> None:
        """Sample."""
        self._a, self._b, self._c = sample_transfer_function(self.p.num, self.p.den, self.p.period)

    def first(self) -> State:
        """Begin at rest."""
        return State((0.0,) * len(self._a))

    def outputs(self, x: State, t: int) -> Values:
        """Return y."""
        return {"output": matmul((self._c,), tuple([(xi,) for xi in x.x]))[0]}

    def advance(self, x: State, t: int, *, command: tuple[float, ...]) -> State:
        """Hold u over one period."""
        moved = matmul(self._a, tuple([(xi,) for xi in x.x]))
        return State(tuple([xi[0] + b[0] * command[0] for xi, b in zip(moved, self._b, strict=True)]))
