"""Pause or slow down a run: the node of the clock stays at a tick, and all others wait for it.

A pause changes only when a tick runs, never its values: the numbers are those of a run without pauses. In real time
nodes do not wait for each other. There the clock of the rig is stopped (`node.realtime.stand`), and there is no pace.
"""

from __future__ import annotations

from collections.abc import Callable

from softrig_core.timebase import SECOND, Pace

from .middleware import Middleware, Timer
from .solving import BUSY, REPORT_EVERY
from .tick import TICK, TickWriter

LOOK = SECOND // 100  # ns between two looks at the wall clock: ticks come in bursts as long as this


class Hold:
    """Decides whether the node of the clock may continue.

    Parameters
    ----------
    held : bool
        Whether the run is paused at the start.
    pace : float
        Ratio of simulated to wall-clock time; 0: as fast as possible.
    paced : bool
        Whether a pace is possible: only in lockstep, where waiting nodes are also informed of it.

    Attributes
    ----------
    steps : int
        Steps that it may run while it is paused.
    waits : bool
        Whether a tick waits for the wall clock.
    """

    def __init__(self, held: bool = False, pace: float = 0.0, paced: bool = True) -> None:
        self.held, self.waits = held, False
        self._pace = Pace(pace)
        self._paced = paced
        self.steps = 0
        self._turn: Callable[[], object] | None = None
        self._publishing = False
        self._until = 0  # ns up to which the wall clock need not be asked
        self._timer: Timer | None = None

    @property
    def pace(self) -> float:
        """Return the present pace."""
        return self._pace.pace

    @property
    def has_pace(self) -> bool:
        """Return whether this node has a pace: it has the clock, runs in lockstep and has begun."""
        return self._turn is not None and self._paced

    def begin(self, middleware: Middleware, turn: Callable[[], object]) -> None:
        """Serve a node that owns the clock; `turn` resumes or stops its ticks."""
        self._turn, self._middleware = turn, middleware
        if self.held:
            self._keep_publishing()
        self.go_at(self.pace)

    def go_at(self, pace: float) -> bool:
        """Change the pace from now on; return whether this node has one."""
        if not self.has_pace:
            return False
        self._pace.change(pace, self._middleware.steady())
        self._until = 0
        if pace:
            self._keep_publishing()
            if self._timer is None:
                self._timer = self._middleware.timer(LOOK, self._retry)
            self._timer.again(LOOK)
        elif self._timer is not None:
            self._timer.cancel()
            # No timer fires any more that would run the tick that waits.
            self._middleware.post(self._retry)
        return True

    def _retry(self) -> None:
        """Try the tick again that waits for the wall clock."""
        if self.waits:
            self.waits = False
            assert self._turn is not None
            self._turn()

    def _keep_publishing(self) -> None:
        """Publish while the rig is paused or waits, so that the other nodes do not time out."""
        if self._publishing or not self._paced:
            return
        self._publishing = True
        header = TickWriter()(0, [self._middleware.full_name])
        publish = self._middleware.publisher(BUSY, TICK, lambda count: None)
        self._middleware.timer(
            round(REPORT_EVERY * SECOND), lambda: publish(header) if self.held or self.waits else None
        )

    def holds(self, t: int) -> bool:
        """Return whether the step from tick `t` (ns) to the next one has to wait; a single step is used up by it."""
        if self.held:
            self.steps -= (single := self.steps > 0)
            return not single
        if not self.pace or t < self._until:
            return False
        reached = self._pace.reach(self._middleware.steady(), t)
        self.waits = reached is None
        self._until = reached or 0
        return self.waits

    def ask(self, command: str, steps: int = 1) -> tuple[bool, str]:
        """Pause, resume or run steps; return whether that was possible, and the text of the answer."""
        if self._turn is None:
            return False, "this node has not begun"
        if command == "pause":
            self.held = True
            self._pace.stop(self._middleware.steady())
            self._keep_publishing()
        elif command == "step":
            if not self.held:
                return False, "the run is not paused; pause it first"
            self.steps += steps
            self._pace.begin()
        else:
            # `_until` is reset because the pace counts from the moment at which the run resumes.
            self.held, self.steps, self._until = False, 0, 0
            self._pace.go_on(self._middleware.steady())
        # The service call returns before the ticks go on.
        self._middleware.post(self._turn)
        return True, {"pause": "paused", "step": "one step"}.get(command, "goes on")
