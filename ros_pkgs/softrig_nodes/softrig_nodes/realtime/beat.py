"""Real-time ticks of nodes in one process that subscribe only to each other: all due nodes run in order at each tick.

They need not wait for messages: the outputs of each node are in the inputs of the others before these run, as in an
in-process run.
"""

from __future__ import annotations

from collections.abc import Sequence

from softrig_core.block.schedule import Plan
from softrig_core.block.step import Step
from softrig_core.timebase import SECOND

from .live import Live
from .native import EVERY, Native
from .realtime import SOON, Realtime, newest

BEHIND = SECOND // 20  # ns; a beat that is further behind skips ticks


class Beat:
    """Triggers the ticks of several nodes by one timer.

    Parameters
    ----------
    drives : sequence of Realtime
        Plants first, then each after those that it reads, which are all among them.
    commands : sequence of (step, Live, plant)
        Commands of the plants: the step that publishes each, its row and the plant that reads it.
    native : Native
        Runs ticks of these drives while nothing needs Python.
    """

    def __init__(
        self, drives: Sequence[Realtime], commands: Sequence[tuple[Step, Live, Realtime]], native: Native
    ) -> None:
        self._drives, self._commands = drives, commands
        plan = Plan(d.node.schedule for d in drives)
        self._grid = plan.clock
        self._members = [(d, plan.every(d.node.schedule)) for d in drives]
        self._number = -1
        self._timer = drives[0].node.middleware.timer(SOON, self._tick)
        self._timer.cancel()
        self._native = native
        for drive in drives:
            drive.follow(self._begin, self._tick)
            drive.before_reading = self._settle

    def _begin(self) -> None:
        """Start the timer when all nodes run."""
        if all(d.node.state == "running" for d in self._drives):
            self._timer.again(SOON)

    def _tick(self) -> None:
        """Answer with the nodes that are due; late ones answer first, with the values up to their tick."""
        first, grid, native = self._drives[0], self._grid, self._native
        if native.active:
            if native.check():
                return
            self._follow_native()
            if self._goes_native():
                return
        if first.node.state != "running" and not any(d.node.state == "running" for d in self._drives):
            self._timer.cancel()
            return
        now, epoch = first.clock(), first.node.epoch
        t = newest(self._timer, grid, now - epoch)
        number = grid.tick(t)
        # The timer may fire a little early, when the newest tick has already been answered.
        if number <= self._number:
            return
        # Ticks that are made up for in order have the numbers that they would have had in time.
        if t - grid.time(self._number + 1) <= BEHIND:
            for k in range(self._number + 1, number):
                self._answer(k, grid.time(k), first.clock())
                if self._goes_native():
                    return
        else:
            for drive in self._drives:
                schedule = drive.node.schedule
                # Nodes that were due since the last beat answer before this tick, as their readers would have their
                # values by now.
                if (due := schedule.held(t)) < t:
                    drive.tick(schedule.tick(due), due, now)
        self._answer(number, t, first.clock())
        self._goes_native()

    def _goes_native(self) -> bool:
        """Leave the next ticks to native code, if nothing is in the way."""
        if not self._native.begins(self._number + 1):
            return False
        self._timer.again(EVERY, EVERY)
        return True

    def _settle(self) -> None:
        """End native ticks, so that the steps have their newest state."""
        if self._native.active:
            self._native.end()
            self._follow_native()
            self._timer.again(SOON)

    def _follow_native(self) -> None:
        """Continue after native ticks."""
        self._number, now = self._native.reached - 1, self._drives[0].clock()
        for _, command, _ in self._commands:
            command.fed(now)

    def _answer(self, number: int, t: int, now: int) -> None:
        """Answer with the nodes that are due at a tick."""
        self._number = number
        for drive, every in self._members:
            if number % every == 0:
                drive.tick(number // every, t, now)
        # The commands have been passed in memory, so the watchdogs and the round trips of the plants are updated here.
        now = self._drives[0].clock()
        for law, command, plant in self._commands:
            if law.t == t:
                command.fed(now)
                plant.commanded(plant.node.epoch + t, now)
