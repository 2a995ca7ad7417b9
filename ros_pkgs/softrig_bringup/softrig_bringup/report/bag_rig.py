"""The rig of a bag without its scenario: only its topics are known."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from softrig_bags.errors import BagError
from softrig_bags.read import BagSignals
from softrig_core import Block, BlockParams, Port, Rig


class _Column(Port):
    """A topic of a bag: its values have the names of the columns, whatever its message type."""

    @property
    def labels(self) -> tuple[str, ...]:  # type: ignore[override]
        """Names of the columns."""
        return self.channels


def rig_of_bag(path: Path, signals: BagSignals) -> Rig:
    """Create a rig that publishes the topics of a bag, without units.

    Parameters
    ----------
    path : Path
        The bag, for its name.

    Raises
    ------
    BagError
        No topic of it has a number.
    """
    columns = {topic: tuple(signals.table(topic).columns) for topic in signals.decodable}
    ports = tuple(
        _Column(f"topic_{i}", topic, "sensor_msgs/msg/JointState", names, ("position",), ("",) * len(names))
        for i, (topic, names) in enumerate(columns.items())
        if names and topic.strip("/") != "clock"  # every rig has /clock
    )
    if not ports:
        raise BagError(f"{path}: no topic with numbers that can be read, nothing to draw")

    class Bag(Block[BlockParams]):
        """Publishes the topics of the bag."""

        @classmethod
        def ports(cls, params: BlockParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
            """Return no inputs, and an output for each topic."""
            return (), ports

        def update(self, x: Any, t: int, **inputs: Any) -> tuple[Any, Mapping[str, Any]]:
            """Publish nothing: the bag is viewed and not run."""
            return x, {}

    return Rig.from_blocks({"bag": Bag()}, duration=1.0, name=path.stem, title=path.name)
