"""A block with its present state: the code that runs a block holds the state; the block itself has none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

from .block import Block, Level, Reports, note
from .params import BlockParams
from .scene import Marker


@runtime_checkable
class Steered(Protocol):
    """A block with a parameter that something in the run changes, such as the button of a fault."""

    def params(self, x: Any) -> BlockParams:
        """Return the present parameters; `p` has the initial ones."""


class Kept(NamedTuple):
    """A stored state of a block: all that determines its future."""

    params: BlockParams
    x: Any
    tables: Mapping[str, Any]
    """By attribute, see `RunningBlock.TABLES`."""

    values: Mapping[str, Any]
    """See `RunningBlock.VALUES`."""


class RunningBlock:
    """A block and its state.

    Parameters
    ----------
    block : Block
        A seeded block in its initial state.

    Attributes
    ----------
    x : named tuple
        The state of the block.
    reports : dict of str to (Level, str, int)
        Reports from ticks that were kept, by key: level, newest text, count.
    anew : set of str
        Keys of reports to be logged again.
    """

    # all that changes besides x and the parameters: the only list of it
    # Other objects hold references to these dicts and sets, so `load` changes them in place.
    TABLES: ClassVar[tuple[str, ...]] = ("reports", "anew")
    # These are immutable, so `load` replaces them.
    VALUES: ClassVar[tuple[str, ...]] = ()

    x: Any

    def __init__(self, block: Block) -> None:
        self.reports: Reports = {}
        self.anew: set[str] = set()
        self.block, self.x = block, block.pop_first()
        self.store_reports()

    @property
    def params(self) -> BlockParams:
        """The block's present parameters."""
        return self.block.params(self.x) if isinstance(self.block, Steered) else self.block.p

    def store_reports(self) -> None:
        """Store the block's reports of a tick that counts."""
        for event in self.block.events:
            self.note(*event)
        self.drop()

    def note(self, level: Level | None, key: str, text: str, anew: bool = False) -> None:
        """Store and count a report; it is logged if its key is new or `anew` is set.

        A report without a level withdraws the earlier report under its key.
        """
        note(self.reports, level, key, text)
        if anew:
            self.anew.add(key)

    def drop(self) -> None:
        """Discard the reports of a discarded tick."""
        self.block.events.clear()

    def change(self, params: BlockParams) -> None:
        """Continue with other parameters."""
        before = self.params
        self.block.change(params)
        self.x = self.block.go_on(self.x, before)

    def status(self) -> Mapping[str, tuple[float, str]]:
        """Return the figures of an observer, see `Observer.status`."""
        return self.block.status(self.x)  # type: ignore[attr-defined, no-any-return]

    def health(self) -> Mapping[str, str]:
        """Return the entries of /diagnostics, see `Block.health`."""
        return self.block.health(self.x)

    def markers(self) -> Sequence[Marker]:
        """Return markers to display, see `Block.markers`."""
        return self.block.markers(self.x)

    def save(self) -> Kept:
        """Return all that changes, as it is now."""
        return Kept(
            self.block.p,
            self.block.save(self.x),
            {name: copy(getattr(self, name)) for name in self.TABLES},
            {name: getattr(self, name) for name in self.VALUES},
        )

    def load(self, stored: Kept) -> None:
        """Restore what `save` returned; any number of times."""
        # A change calls `setup`, which may take long, so equal parameters are not set again.
        if self.block.p is not stored.params:
            self.block.change(stored.params)
        self.x = self.block.load(stored.x)
        for name, table in stored.tables.items():
            present = getattr(self, name)
            present.clear()
            present.update(table)
        for name, value in stored.values.items():
            setattr(self, name, value)
        self.drop()


class ByHand(RunningBlock):
    """A block that a person or a test steps, without a rig.

    Examples
    --------
    >>> pid = ByHand(Pid(kp=2.0))
    >>> pid.update(0, state=(1.0,), reference=(3.0,))["command"]
    (4.0,)
    >>> pid.x.integral
    0.0
    """

    def reset(self, seed: int) -> None:
        """Restore the first state, with the random numbers of a seed."""
        self.block.reset(seed)
        self.reports.clear()
        self.anew.clear()
        self.x = self.block.pop_first()

    def update(self, t: int, /, **inputs: Any) -> Any:
        """Answer a tick; return the values."""
        return self._keep(self.block.update(self.x, t, **inputs))

    def finish(self, t: int, /, **inputs: Any) -> Any:
        """Answer the last tick."""
        return self._keep(self.block.finish(self.x, t, **inputs))  # type: ignore[attr-defined]

    def refused(self, t: int) -> Any:
        """Answer a tick at which an input was rejected; return the values."""
        return self._keep(self.block.refused(self.x, t))

    def outputs(self, t: int) -> Any:
        """Return the outputs of a plant."""
        result = self.block.outputs(self.x, t)  # type: ignore[attr-defined]
        self.store_reports()
        return result

    def advance(self, t: int, /, **inputs: Any) -> None:
        """Move a plant one period on."""
        self.x = self.block.advance(self.x, t, **inputs)  # type: ignore[attr-defined]
        self.store_reports()

    def _keep(self, answer: tuple[Any, Any]) -> Any:
        self.x, result = answer
        self.store_reports()
        return result
