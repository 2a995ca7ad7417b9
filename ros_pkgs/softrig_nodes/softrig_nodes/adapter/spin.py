"""Runs the adapter of a ROS node until it has finished, failed or was stopped."""

from __future__ import annotations

import gc

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.task import Future
from softrig_core.errors import FAILURES, RunError, describe
from softrig_core.guard import print_for
from softrig_core.run.stuck import watched
from softrig_core.timebase import SECOND

from ..below import uses
from .adapter import Adapter


@watched()
def spin(node: Node, adapter: Adapter) -> int:
    """Run the executor until the node ends; return the exit status."""
    finished: Future[None] = Future()
    adapter.on_finished = lambda: None if finished.done() else finished.set_result(None)
    stopped = False
    try:
        executor = uses.executor()
        executor.add_node(node)
        # Objects of the start live to the end; frozen, they are not visited by the collections that happen during
        # ticks.
        gc.collect()
        gc.freeze()
        try:
            while rclpy.ok() and not finished.done():
                # Without a timeout this executor never delivers anything (rclpy 7.1).
                executor.spin_until_future_complete(finished, 5.0)
        finally:
            adapter.middleware.close()
        if adapter.state == "done":
            adapter.middleware.drain()
        stopped = not finished.done()
    except (KeyboardInterrupt, ExternalShutdownException):
        stopped = True
    # A controller or plant has failed; the executor has printed the traceback.
    except FAILURES as error:
        if rclpy.ok() or isinstance(error, RunError | OSError):
            adapter.error, adapter.state = failure(adapter, error), "failed"
        # A signal has shut the context down under a callback that was about to publish.
        else:
            stopped = True
    return conclude(adapter, stopped)


def failure(adapter: Adapter, error: BaseException) -> Exception:
    """Return the error that ends a run when a node's code has raised one."""
    if isinstance(error, RunError | OSError):
        return error
    return RunError(f"failed at t = {adapter.t / SECOND:.9g} s: {describe(error)}")


def conclude(adapter: Adapter, stopped: bool) -> int:
    """Store the node's recordings and how it ended; return the exit status."""
    if adapter.record.shard is not None:
        try:
            adapter.record.shard.close()
        except OSError as error:
            adapter.error, adapter.state = error, "failed"
    if stopped and adapter.state == "starting" and adapter.absent:
        print_for(adapter.middleware.name, f"stopped before it could begin: {'; '.join(adapter.absent)}")
    if stopped and adapter.state not in ("done", "failed"):
        adapter.left_early = True
        # A node that a person has stopped has not failed.
        adapter.state = "done"
    try:
        adapter.account.write_status()
    except OSError as error:
        adapter.error, adapter.state = adapter.error or error, "failed"
    if adapter.error is not None:
        print_for(adapter.middleware.name, adapter.error)
    return 3 if adapter.state == "failed" else 0
