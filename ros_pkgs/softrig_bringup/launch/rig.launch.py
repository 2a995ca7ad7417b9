"""Start the nodes of a scenario: ``ros2 launch softrig_bringup rig.launch.py scenario:=dc_motor_smc``.

The scenario files, the changes and the end of `softrig run`; here the nodes are those of the launch, on its domain.
They have one t = 0 and one end; a node that fails ends the launch, with status 1. ``--show-args`` lists what it takes.
SIGTERM, as systemd sends it, ends it as Ctrl-C does.
"""

import signal
import sys
from functools import partial

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.events import Shutdown as Ending
from launch.substitutions import LaunchConfiguration
from launch.utilities.signal_management import AsyncSafeSignalManager
from launch_ros.actions import Node
from softrig_bringup.launched import ARGUMENTS, begin, strange
from softrig_nodes.below.uses import signal_manager


def generate_launch_description():
    arguments = []
    for name, (default, choices, description) in ARGUMENTS.items():
        options = {"choices": list(choices)} if choices else {}
        arguments.append(DeclareLaunchArgument(name, default_value=default, description=description, **options))
    return LaunchDescription([*arguments, OpaqueFunction(function=_nodes)])


def _ended(launched, event, context):
    """Launch goes on without a node that has failed; what an event handler raises ends it, with status 1."""
    wrong = launched.ended(event.process_name, event.returncode, context.is_shutdown)
    if wrong:
        raise RuntimeError(wrong)


def _end_in_order(context, launched):
    """SIGTERM kills launch itself (3.4), and its own handler for it would leave the processes and cancel the rest."""
    manager = signal_manager(AsyncSafeSignalManager)
    if manager is not None:
        ending = Ending(reason="SIGTERM", due_to_sigint=False)

        def end(number):
            launched.sent = signal.SIGTERM
            context.emit_event_sync(ending)

        manager.handle(signal.SIGTERM, end)
        signal.signal(signal.SIGTERM, lambda number, frame: None)  # the process manager gets the signal, too


def _nodes(context):
    if reported := strange(sys.argv):
        raise RuntimeError(reported)
    launched = begin({name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS})
    _end_in_order(context, launched)
    at_end = {"rig": partial(_ended, launched), "viewer": Shutdown(reason="the viewer is closed")}
    # launch_ros itself has no empty lists, and a container names its nodes in its arguments
    return [
        Node(
            package=p.package,
            executable=p.executable,
            name=p.name or None,
            namespace=p.namespace or None,
            output="screen",
            on_exit=at_end[p.kind],
            arguments=p.arguments,
            parameters=p.parameters,
            remappings=p.remappings,
            additional_env=p.variables,
        )
        for p in launched.processes
    ]
