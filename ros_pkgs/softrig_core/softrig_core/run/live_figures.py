"""The figures of a scenario while its rig runs, or together with hardware that publishes on the same topics.

If a run is recorded completely in this process, no reader needs the figures before its end. The node then stores
nothing while the run is under way, because that would be a second copy of the recording. The figures are measured from
the recording.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..block.held import RunningBlock
from ..block.params import param
from ..block.port import Port
from ..errors import ScenarioError
from ..rig.members import Member
from ..scenario.port_text import ports_of
from ..timebase import SECOND
from ..verdict.figures import Figure, figure_parameters, figures_in
from ..verdict.watch import Recent, Watch, WatchParams, status_of
from ..wire.signals import Signal, Signals
from .expand import rig_of


class FiguresParams(WatchParams):
    """Parameters of the figures: which ones; in a rig those of its scenario, at the period of its clock."""

    scenario: str = param("", "started by hand: the scenario whose figures these are, by name or file")
    figures: str = param(
        '[{"name": "mean", "function": "mean", "arguments": {"signal": "state/x/position"}, "unit": "m", "scale": 1}]',
        "without a scenario: what is measured, in JSON",
    )
    ports: str = param(
        '[{"name": "state", "topic": "state", "msgtype": "sensor_msgs/msg/JointState", "channels": ["x"],'
        ' "fields": ["position"], "units": ["m"]}]',
        "and the topics that it is on, each as a port",
    )

    def _check(self) -> None:
        try:
            figures_in(self.given()["figures"]), self.inputs()
        except ScenarioError as error:
            raise ValueError(str(error)) from None

    def given(self) -> dict[str, str]:
        """Return the figures and the ports as text."""
        return _of(self.scenario) if self.scenario else {"figures": self.figures, "ports": self.ports}

    def inputs(self) -> tuple[Port, ...]:
        """Return the ports that the text describes."""
        return ports_of(self.given()["ports"])


class Figures(Watch[FiguresParams]):
    """The figures of a scenario, measured from the messages so far, each as soon as there are samples of it.

    A figure with `since` refers to the newest step of its reference and starts again with the next one. The times of
    other figures count from the first tick. If the period is longer than that of a topic, messages in between are
    missed.
    """

    @classmethod
    def ports(cls, params: FiguresParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Return the ports; the node only subscribes."""
        return params.inputs(), ()

    def setup(self) -> None:
        """Find the figure functions."""
        super().setup()
        self._figures = figures_in(self.p.given()["figures"])

    def figures(self, x: Any) -> Iterable[Figure]:
        """Return the figures of the scenario."""
        return self._figures


# The parameters of a node ask several times, and each answer wires a whole rig.
@cache
def _of(scenario: str) -> dict[str, str]:
    return figure_parameters(rig_of(scenario))


def is_recorded(member: Member) -> bool:
    """Return whether the recording of a run in process has all messages that a node of figures would receive."""
    declared, _ = member.block_class.ports(member.params)
    links = [(port, link) for port in member.inputs if (link := member.links.get(port.name)) is not None]
    return (
        member.block_class is Figures
        and not member.external
        and not member.changes
        # A node that is slower than the clock misses messages that a recording has.
        and member.schedule.every == 1
        and [p.topic for p in declared] == [p.topic for p in member.inputs]
        and all(p.labels == k.port.labels and not k.port.delayed and not k.port.partial for p, k in links)
    )


class Measured(RunningBlock):
    """A node of figures that a completely recorded run did without, see `is_recorded`.

    Parameters
    ----------
    seed : int
        Rig seed.
    signals : callable
        Returns the signals of the run.
    native : (int, str)
        See `Step`.
    """

    def __init__(
        self, member: Member, seed: int, signals: Callable[[], Signals], native: tuple[int, str] = (0, "")
    ) -> None:
        super().__init__(member.block(seed))
        self._member, self._signals, self.native = member, signals, native

    def status(self) -> Mapping[str, tuple[float, str]]:
        """Return the figures that the node would have at the end of the run."""
        assert isinstance(self.block, Figures)
        assert self._member.schedule.last is not None
        since = self._member.schedule.last - round(self.block.p.window * SECOND)
        return status_of(self.block.figures(self.x), _Newest(self._signals(), self._member.inputs, since / SECOND))


class _Newest(Recent):
    """The signals of some ports from a time on, in s."""

    def __init__(self, signals: Signals, ports: Iterable[Port], since: float) -> None:
        super().__init__(ports)
        self._signals, self._since = signals, since

    def _times(self) -> Iterator[tuple[str, NDArray[np.float64]]]:
        return ((topic, t) for topic in self.ports if (t := self._signals.table(topic).t).size)

    @property
    def end(self) -> float:
        """See `Recent`."""
        return max(float(t[-1]) for _, t in self._times())

    @property
    def forgot(self) -> set[str]:
        """See `Recent`."""
        return {topic for topic, t in self._times() if t[0] < self._since}

    def __getitem__(self, name: str) -> Signal:
        self.place(name)
        t, x = self._signals[name]
        first = int(np.searchsorted(t, self._since))
        return Signal(t[first:], x[first:])
