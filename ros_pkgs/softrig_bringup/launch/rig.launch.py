"""Start the nodes of a scenario: ``ros2 launch softrig_bringup rig.launch.py scenario:=dc_motor_smc``.

The same scenario files as `softrig run`; here the nodes run for themselves, without bag and metrics. They have one
t = 0 and one end; a node that fails ends the launch, with status 1.
"""

import atexit
import os
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description():
    arguments = [
        DeclareLaunchArgument("scenario", description="name of a scenario or path of its YAML file"),
        DeclareLaunchArgument(
            "mode",
            default_value="realtime",
            choices=["realtime", "lockstep"],
            description="against the wall clock, or tick by tick",
        ),
        DeclareLaunchArgument(
            "place",
            default_value="processes",
            choices=["processes", "container"],
            description="a process for each node, or one for all",
        ),
        DeclareLaunchArgument(
            "wait_for",
            default_value="",
            description="names of recorders that are to have all from t = 0 and do not ask for it, as rosbag2_recorder",
        ),
        DeclareLaunchArgument("seed", default_value="", description="instead of the scenario's"),
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=_nodes)])


def _ended(event, context):
    """Launch goes on without a node that has failed; what an event handler raises ends it, with status 1."""
    if event.returncode and not context.is_shutdown:
        raise RuntimeError(f"{event.process_name} ended with status {event.returncode}")


def _nodes(context):
    from softrig_core import Rig, load_scenario
    from softrig_core.rig.domain import join_domain
    from softrig_core.rig.starting import container_arguments, groups, node_parameters, parameter_file, placed

    def value(name):
        return LaunchConfiguration(name).perform(context)

    scenario = load_scenario(value("scenario"))
    rig = Rig.from_scenario(scenario)
    seed = int(value("seed") or scenario.seed)
    join_domain(int(os.environ.get("ROS_DOMAIN_ID") or 0))  # so that no run chooses it
    folder = Path(mkdtemp(prefix="softrig-launch-"))  # launch_ros itself has no empty lists
    atexit.register(rmtree, folder, ignore_errors=True)
    found = []
    for group in groups(rig, placed(rig, value("place"))):
        given = {
            m.name: node_parameters(rig, m, seed, value("mode"), recorders=value("wait_for").split()) for m in group
        }
        if len(group) > 1:
            found.append(Node(package="softrig_core", executable="container", output="screen", on_exit=_ended,
                              arguments=container_arguments(group, given, folder)))  # fmt: skip
            continue
        m = group[0]
        file = parameter_file(m, given[m.name], folder)
        found.append(Node(package=m.package, executable=m.executable, name=m.name, output="screen", on_exit=_ended,
                          remappings=list(m.remap.items()), parameters=[str(file)]))  # fmt: skip
    return found
