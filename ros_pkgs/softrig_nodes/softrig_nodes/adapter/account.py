"""The account of a node: reports and rejected messages in the log, and its status file."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from softrig_core.block.block import Level
from softrig_core.timebase import SECOND

from ..processes.guests import HINT, UNSEEN
from ..seam.endpoint import Input
from ..seam.health import StatusFile, figures, peak_memory
from ..seam.middleware import other_types

if TYPE_CHECKING:
    from .adapter import Adapter

CHECK_EVERY = 4  # watches from one check whether messages can arrive (by their types, and at all) to the next
PAUSED = "paused"  # key of a report
WATCH_PERIOD = SECOND // 4  # ns: progress check, status file, flush of the shard


class Account:
    """The log and the status file of a node.

    Attributes
    ----------
    watches : int
        Number of calls of `watch`.
    """

    def __init__(self, node: Adapter) -> None:
        self._node = node
        self.watches = 0
        self._since = node.middleware.steady()
        self._logged: set[str] = set()
        self._paused = False
        self._file = StatusFile(node.options.status)
        self._figures: dict[str, Any] = {}  # figures of a node that has ended, computed once

    def refuse(self, item: Input, reason: str) -> None:
        """Count a bad message and log it once; it never reaches the block."""
        item.refused += 1
        if item.last_refusal != reason:
            item.last_refusal = reason
            # The rest of the reason has numbers: with them each wrong stamp would be logged.
            kind = reason.split()[0]
            self._log_once(f"{item.port.topic}: {kind}", Level.ERROR, f"refused on {item.port.topic}: {reason}")

    def watch(self) -> None:
        """Log new reports, check for reasons to end the run, write the status; called every `WATCH_PERIOD`."""
        node = self._node
        if node.record.shard is not None:
            node.record.shard.flush()
        if node.hold.held is not self._paused:
            self._paused = node.hold.held
            text = f"paused at t = {node.t / SECOND:.9g} s, until ~/resume or ~/step of {node.middleware.full_name}"
            node.step.note(Level.OK if self._paused else None, PAUSED, text)
        # A report that was made again after its cause had gone is to be logged again.
        self._logged -= node.step.anew
        node.step.anew.clear()
        for key, (level, text, _) in node.step.reports.items():
            self._log_once(key, level, text)
        node.drive.progress()
        if self.watches % CHECK_EVERY == 0:
            self._notice_types()
            self._notice_unseen()
            if (why := node.middleware.deaf()) and node.state in ("starting", "running"):
                node.fail(why)
        self.watches += 1
        if self.watches % node.drive.status_every == 0 or node.state != "running":
            self.write_status()

    def write_status(self) -> None:
        """Write the status file, if one is requested."""
        if self._node.options.status:
            self._file.write(self.status())

    def status(self) -> dict[str, Any]:
        """Describe its state, rejected messages and, while an outside node is missing, the publishers of all topics."""
        node = self._node
        refused = {i.port.topic: [i.refused, i.last_refusal] for i in node.inputs + node.paces if i.refused}
        status: dict[str, Any] = {
            "state": node.state,
            "t": node.t,
            "ticks": node.ticks,
            "error": str(node.error) if node.error else "",
            "waits_for": node.waits_for,
            "lacking": node.lacking,
            "epoch": node.epoch,
            "refused": refused,
            "reports": {key: [int(level), text, n] for key, (level, text, n) in node.step.reports.items()},
            "busy": node.drive.busy(),
            "held": node.hold.held,
            "pace": node.hold.pace,
            "cpu_s": round(time.process_time(), 3),
            "prompt": node.middleware.prompt,
            "processor": node.middleware.processor,
        }
        if node.left_early:
            status["left_early"] = True
        status |= node.drive.counts()
        # When the node is done ROS may have been shut down, and the graph cannot be read.
        if node.lacking and node.state != "done":
            status["published"] = {
                t: [[p.msgtype, p.full_name] for p in node.middleware.publishers(t)] for t in node.middleware.topics()
            }
        # These take longer than a tick, so they wait until no tick is under way.
        if node.state != "running":
            status |= {"peak_memory_mb": peak_memory()} | node.drive.statistics()
        if node.state == "done":
            self._figures = self._figures or figures(node.step)
            status |= self._figures
        return status

    def _log_once(self, key: str, level: Level, text: str) -> None:
        if key not in self._logged:
            self._logged.add(key)
            self._node.middleware.log(level, text)

    def _notice_unseen(self) -> None:
        """Log which external node the start waits for; under a launch no other process reports it."""
        node = self._node
        if node.state == "starting" and node.lacking and node.middleware.steady() - self._since > UNSEEN:
            topics = ", ".join(node.lacking)
            text = f"waits for the external node of {topics}: not seen for {UNSEEN:g} s; {HINT}"
            self._log_once("unseen", Level.WARN, text)

    def _notice_types(self) -> None:
        """Report a topic that is published with another type: its messages never arrive."""
        node = self._node
        for item in node.inputs:
            key = f"type of {item.port.topic}"
            if item.publishers or item.received_any or key in node.step.reports:
                continue
            types = other_types(node.middleware, item.port)
            if types:
                text = f"{item.port.topic} exists with type {types}, expected {item.port.msgtype}"
                node.step.note(Level.ERROR, key, text)
                self._log_once(key, Level.ERROR, text)
