"""What every node needs before it is made, loaded by being imported: the fork server does that before it forks.

Half of what is left of a node's start after Python's imports are the C libraries of message types.
"""

from __future__ import annotations

from contextlib import suppress

from rclpy.type_support import check_for_type_support
from softrig_core.wire.types import TYPES

from . import container, main  # noqa: F401
from .adapter import spin  # noqa: F401
from .ros.messages import message_class

# of each node of rclpy's, and of ours
OWN = (
    "rcl_interfaces/msg/ParameterEvent",
    "type_description_interfaces/srv/GetTypeDescription",
    "diagnostic_msgs/msg/DiagnosticArray",
    "std_srvs/srv/Trigger",
    *(
        f"rcl_interfaces/srv/{name}"
        for name in (
            "DescribeParameters",
            "GetParameterTypes",
            "GetParameters",
            "ListParameters",
            "SetParameters",
            "SetParametersAtomically",
        )
    ),
)

for name in (*TYPES, *OWN):
    with suppress(ImportError):  # whoever needs it says so
        check_for_type_support(message_class(name))
with suppress(ImportError):
    from rclpy.experimental import events_executor  # noqa: F401
