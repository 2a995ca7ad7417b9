"""Links: connections of a step to other processes and to recordings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

from .answer import Rows, parted

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from .step import Step


class Link:
    """Connection of a step to nodes outside the process; this base class delegates to the step's previous link.

    Parameters
    ----------
    step : Step
        Has this link from now on.

    Attributes
    ----------
    inner : Link or None
        The one that it had.
    """

    READS: ClassVar[bool] = True  # whether its `respond` gets the inputs
    add_row: Callable[[int, tuple[float, ...]], object] | None = None
    """Gets time (ns) and numbers of each answer in place of `send`, of a step that is plain; None: `send` does."""

    def __init__(self, step: Step) -> None:
        self.step, self.inner = step, step.link
        step.link = self

    def lacks(self, t: int) -> bool:
        """Return whether a message that tick `t` needs is missing; the step's values contain the arrived messages."""
        return self.inner is not None and self.inner.lacks(t)

    def respond(self, x: Any, t: int, **inputs: Any) -> Any:
        """Return the block's answer to a tick; an override may call the block differently or change the answer."""
        return (self.step.ask if self.inner is None else self.inner.respond)(x, t, **inputs)

    def settle(self) -> None:
        """Bring the state of the step up to date with all its ticks."""
        if self.inner is not None:
            self.inner.settle()

    def send(self, t: int, rows: Rows, numbers: tuple[float, ...]) -> None:
        """Publish the answer of a tick.

        Parameters
        ----------
        rows : tuple
            What each output publishes; None: nothing.
        numbers : tuple of float
            All numbers of a step that is plain, one output after another.
        """
        if self.inner is not None:
            self.inner.send(t, rows, numbers)

    def send_all(self, times: NDArray[np.int64], numbers: NDArray[np.float64], stamps: NDArray[np.int64]) -> None:
        """Publish the answers of many past ticks computed by native code; by default one by one.

        Parameters
        ----------
        times : array, shape (n,)
        numbers : array, shape (n, size)
            Of all outputs; after them, of each sporadic one, whether it publishes.
        stamps : array, shape (n, count)
            Of the delayed outputs.
        """
        step = self.step
        for t, row, late in zip(times.tolist(), numbers.tolist(), stamps.tolist(), strict=True):
            self.send(t, parted(step.outputs, row, late), tuple(row) if step.plain else ())
            self.over(t)

    def changed(self, t: int, values: Mapping[str, Any]) -> None:
        """Handle parameters that changed before tick `t`, by name."""
        if self.inner is not None:
            self.inner.changed(t, values)

    def over(self, t: int) -> None:
        """Handle the end of a tick, after a plant has advanced or another block has answered."""
        if self.inner is not None:
            self.inner.over(t)
