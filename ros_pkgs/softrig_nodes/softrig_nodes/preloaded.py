"""Load what every node needs before it is created: the fork server imports this module before it forks.

After Python's imports, loading the C libraries of message types takes half of the rest of a node's start.
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
    # A node that needs a missing type reports it itself.
    with suppress(ImportError):
        check_for_type_support(message_class(name))
with suppress(ImportError):
    from rclpy.experimental import events_executor  # noqa: F401
