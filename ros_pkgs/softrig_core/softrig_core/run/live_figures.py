"""The figures of a scenario while its rig runs, or together with hardware that publishes on the same topics."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import Any, Self

from pydantic import model_validator

from ..block.params import param
from ..block.port import Port
from ..errors import ScenarioError
from ..scenario.port_text import ports_of
from ..verdict.figures import Figure, figure_parameters, figures_in
from ..verdict.watch import Watch, WatchParams
from .expand import rig_of


class FiguresParams(WatchParams):
    """Whose figures; in a rig those of its scenario, at the period of its clock."""

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

    @model_validator(mode="after")
    def _fits(self) -> Self:
        try:
            figures_in(self.given()["figures"]), self.inputs()
        except ScenarioError as error:
            raise ValueError(str(error)) from None
        return self

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


@cache
def _of(scenario: str) -> dict[str, str]:
    return figure_parameters(rig_of(scenario))
