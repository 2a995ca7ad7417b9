"""A container: several nodes of a rig in one process, each a real ROS node, with messages between them in memory.

    ros2 run softrig_nodes container PACKAGE EXECUTABLE [--ros-args ...] -- PACKAGE EXECUTABLE [--ros-args ...] ...

Each group between two ``--`` has the arguments of a `ros2 run`. The adapters are those of the node processes.
"""

from __future__ import annotations

import sys
import time
import traceback
from collections.abc import Sequence
from functools import partial
from typing import NoReturn

import rclpy
from rclpy.executors import Executor, ExternalShutdownException
from rclpy.node import Node
from softrig_core.errors import FAILURES, RunError
from softrig_core.guard import print_for, secure_streams
from softrig_core.interrupt import interrupt
from softrig_core.rig.installed import load_block
from softrig_core.rig.options import RunOptions
from softrig_core.run.stuck import watched
from softrig_core.timebase import SECOND

from .adapter.adapter import Adapter
from .adapter.spin import conclude, failure
from .below import uses
from .below.carrier import carrier
from .below.leave import leave
from .group import Group
from .main import make_adapter
from .ros.arguments import non_ros_arguments, plain_errors
from .ros.contained import ContainedMiddleware
from .ros.garbage import Garbage
from .ros.profile import joining
from .ros.ros import ServingNode
from .seam.exchange import Exchange

LOOK = 100_000_000  # ns: how long a busy container leaves DDS alone: a look takes as long as some ticks
SPIN = 300_000  # ns: a timer closer than this is waited for awake: to sleep and wake takes half as long
GRACE = 1.0  # s: time for the other nodes to report what they saw, after one has failed


class Container:
    """The nodes of one process and their common loop."""

    def __init__(self) -> None:
        self.exchange = Exchange()
        self.nodes: list[Node] = []
        self.adapters: list[Adapter] = []
        self._middlewares: list[ContainedMiddleware] = []

    def add(self, group: Sequence[str]) -> None:
        """Create one node; `group` is its package, executable and ROS arguments."""
        package, executable, *arguments = group
        if stray := non_ros_arguments(group[1:]):
            raise RunError(f"unexpected argument {stray[0]!r}: expected PACKAGE EXECUTABLE [--ros-args ...]")
        with plain_errors():
            node = ServingNode(executable, cli_args=arguments, use_global_arguments=False)
        self.nodes.append(node)
        mode = uses.overrides(node).get("run.mode")
        # Only in real time do ticks have a time that publishing takes from them.
        carried = mode is None or mode.value != "lockstep"
        middleware = ContainedMiddleware(node, self.exchange, carrier() if carried else None)
        # Compilation takes seconds, in which a signal must be able to end the process.
        with interrupt.leaving(partial(leave, self.nodes, 0)):
            self._middlewares.append(middleware)
            self.adapters.append(make_adapter(node, load_block(package, executable), middleware))

    def connect(self) -> None:
        """Connect the nodes and start them; an error describes a mismatch."""
        # Native ticks are compiled here.
        with interrupt.leaving(partial(leave, self.nodes, 0)):
            for mode in ("lockstep", "realtime"):
                if alike := [a for a in self.adapters if a.options.mode == mode]:
                    Group(alike)
        for middleware in self._middlewares:
            middleware.report_ignored()

    @watched()
    def run(self) -> int:
        """Run until all nodes have finished, one has failed, or the process is stopped; returns the exit status."""
        executor = uses.executor()
        for node in self.nodes:
            executor.add_node(node)
        stopped = False
        try:
            stopped = not self._loop(executor)
            self.exchange.flush()
            for adapter in self.adapters:
                if adapter.state == "done":
                    adapter.middleware.drain()
        except (KeyboardInterrupt, ExternalShutdownException):
            stopped = True
        except FAILURES as error:
            if rclpy.ok():
                self._broke(error)
            # A signal has shut the context down while a node was about to publish, which is no error of the node.
            else:
                stopped = True
        return self._conclude(stopped)

    def _loop(self, executor: Executor) -> bool:
        """Run until the end; return False if the process was asked to stop."""
        exchange, garbage, limit = self.exchange, Garbage(), 0.0
        next_step = time.monotonic_ns() + LOOK
        while rclpy.ok():
            # External publishers are processed as soon as the loop has nothing to do, and otherwise now and then.
            # While another process publishes to this one, the executor must get its turn: only it receives such
            # messages.
            awake = 0 if exchange.listens else SPIN
            remaining = exchange.serve(time.monotonic_ns() + LOOK, awake)
            states = {a.state for a in self.adapters}
            if states <= {"done", "failed"}:
                return True
            if "failed" in states:
                # The others may have waited for the failed node and will then name it, or report the actual cause.
                limit = limit or time.monotonic() + GRACE
                if time.monotonic() > limit:
                    return True
            if time.monotonic_ns() >= next_step:
                garbage.step()
                next_step = time.monotonic_ns() + LOOK
            # It returns before the next timer is due, because waking up takes time; `serve` waits awake for the rest.
            executor.spin_once((remaining - SPIN // 2) / SECOND if remaining > SPIN else 0.0)
        return False

    def _broke(self, error: BaseException) -> None:
        """End the run with an error of the node whose code was running."""
        adapter = next((a for a in self.adapters if a.middleware.name == self.exchange.culprit()), None)
        if adapter is None:
            raise error
        traceback.print_exception(error)
        adapter.error, adapter.state = failure(adapter, error), "failed"

    def _conclude(self, stopped: bool) -> int:
        """Write the results of every node and name the nodes that failed."""
        for adapter in self.adapters:
            try:
                adapter.drive.settle()
            except OSError as error:
                adapter.error, adapter.state = adapter.error or error, "failed"
        failed = [a.middleware.name for a in self.adapters if a.state == "failed"]
        for adapter in self.adapters:
            if failed and adapter.state not in ("done", "failed"):
                adapter.error, adapter.state = RunError(f"stopped: {', '.join(failed)} has failed"), "failed"
                adapter.waits_for = failed
        return max(conclude(a, stopped) for a in self.adapters)


def main(args: Sequence[str] | None = None) -> NoReturn:
    """Start the nodes that the command line names; invalid parameters cause one line and exit status 2."""
    interrupt.install()
    secure_streams()
    arguments = list(sys.argv[1:] if args is None else args)
    groups = split(arguments)
    if not groups or groups[0][0].startswith("-") or {"-h", "--help"} & set(arguments):
        print(__doc__)
        leave([], 0 if {"-h", "--help"} & set(arguments) else 2)
    container = Container()
    source = "container"
    try:
        with joining(exclusive=True, silence=RunOptions().timeout):
            rclpy.init(args=[])
            interrupt.early = False
            if "fastrtps" not in (rmw := rclpy.get_rmw_implementation_identifier()):
                raise RunError(f"needs Fast DDS (RMW_IMPLEMENTATION=rmw_fastrtps_cpp), got {rmw}")
            for group in groups:
                source = " ".join(group[:2])
                if len(group) < 2:
                    raise RunError("expected PACKAGE EXECUTABLE [--ros-args ...]")
                container.add(group)
            source = "container"
            container.connect()
    except KeyboardInterrupt:
        leave(container.nodes, 0)
    # Every error of the start ends in one line that states what was wrong and where.
    except FAILURES as error:
        # A signal has shut the context down in the meantime, and the error is its consequence.
        if not interrupt.early and not rclpy.ok():
            leave(container.nodes, 0)
        name = container.nodes[-1].get_name() if len(container.nodes) > len(container.adapters) else source
        print_for(name, error)
        leave(container.nodes, 2)
    leave(container.nodes, container.run())


def split(arguments: Sequence[str]) -> list[list[str]]:
    """Cut a command line at each ``--``."""
    groups: list[list[str]] = [[]]
    for argument in arguments:
        if argument == "--":
            groups.append([])
        else:
            groups[-1].append(argument)
    return [g for g in groups if g]
