"""Message objects, imported when a node needs them: classes by name, diagnostics, parameter descriptors."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

from .block import Level
from .cdr import SECOND
from .params import Declaration


def message_class(msgtype: str) -> Any:
    """Import ``package/msg/Type``."""
    package, kind, name = msgtype.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)


def diagnostic_array(stamp: int, name: str, level: Level, text: str, values: Mapping[str, str]) -> Any:
    """Make a diagnostic_msgs/DiagnosticArray with one status."""
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

    array = DiagnosticArray()
    array.header.stamp.sec, array.header.stamp.nanosec = stamp // SECOND, stamp % SECOND
    pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
    array.status = [DiagnosticStatus(level=bytes([level]), name=name, message=text, values=pairs)]
    return array


def range_descriptor(declaration: Declaration) -> Any:
    """Make the rcl_interfaces/ParameterDescriptor of a parameter: read-only, described, with its range."""
    from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

    unit = f" [{declaration.unit}]" if declaration.unit else ""
    descriptor = ParameterDescriptor(description=declaration.doc + unit, read_only=True, dynamic_typing=True)
    bounded = declaration.lower is not None or declaration.upper is not None
    if bounded and declaration.type is float:
        low = declaration.lower if declaration.lower is not None else -1.7e308
        high = declaration.upper if declaration.upper is not None else 1.7e308
        descriptor.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high))]
    elif bounded and declaration.type is int:
        low = int(declaration.lower) if declaration.lower is not None else -(2**62)
        high = int(declaration.upper) if declaration.upper is not None else 2**62
        descriptor.integer_range = [IntegerRange(from_value=low, to_value=high)]
    return descriptor
