"""Blocks as ROS nodes: in lockstep or in real time, a process each or several in a container; whole rigs of them."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

import softrig_core as softrig_core

if TYPE_CHECKING:
    from .processes.placement import Listener as Listener, Placement as Placement
    from .processes.processes import Outcome as Outcome, run_processes as run_processes

# imported on first use, so that a node's process starts without the modules that start processes
_HOME = {"Listener": "placement", "Placement": "placement", "Outcome": "processes", "run_processes": "processes"}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".processes.{_HOME[name]}", __name__), name)
