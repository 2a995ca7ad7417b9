"""Live parameters of running nodes, set from outside as `ros2 param set` does."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient


def set_parameters(wanted: Mapping[str, Mapping[str, Any]], patience: float) -> list[str]:
    """Set parameters of running nodes, those of one node all or none.

    Parameters
    ----------
    wanted : mapping
        Values by node and name.
    patience : float
        How long to wait for each node, s.

    Returns
    -------
    list of str
        What went wrong, a line a node.
    """
    refusals = []
    rclpy.init(args=[])
    try:
        person = Node(f"softrig_set_{os.getpid()}")
        for node, values in wanted.items():
            client = AsyncParameterClient(person, node)
            limit = time.monotonic() + patience
            if not client.wait_for_services(timeout_sec=patience):
                refusals.append(f"no node {node} within {patience:g} s")
                continue
            answer = client.set_parameters_atomically([Parameter(name, value=v) for name, v in values.items()])
            rclpy.spin_until_future_complete(person, answer, timeout_sec=max(1.0, limit - time.monotonic()))
            result = answer.result() if answer.done() else None
            if result is None:
                refusals.append(f"{node} does not answer")
            elif not result.result.successful:
                refusals.append(f"{node} refuses {', '.join(values)}: {result.result.reason}")
    finally:
        rclpy.try_shutdown()
    return refusals
