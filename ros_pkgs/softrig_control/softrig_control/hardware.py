"""Plants as hardware for ros2_control: the tag in their URDF, and a URDF for an axis that has none."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

STATES = ("position", "velocity", "effort")


def hardware_tag(
    name: str, joints: Sequence[str], states: str, commands: str, interfaces: Sequence[str] = STATES
) -> list[str]:
    """Write the tag by which ros2_control drives a plant as hardware, over topics (topic_based_ros2_control).

    With a threshold below 0 every command is sent, not only those that differ from the state, because a plant treats
    silence as a stopped controller.

    Parameters
    ----------
    joints : sequence of str
        With the interfaces as state, effort as command; the same names in both messages.
    states, commands : str
        Topics of the plant's joint states and of its commands.
    interfaces : sequence of str, optional
        Fields of the joint states.
    """
    system = {"joint_states_topic": states, "joint_commands_topic": commands, "trigger_joint_command_threshold": "-1"}
    lines = [
        f'  <ros2_control name="{name}" type="system">',
        "    <hardware>",
        "      <plugin>topic_based_ros2_control/TopicBasedSystem</plugin>",
    ]
    lines += [f'      <param name="{key}">{value}</param>' for key, value in system.items()]
    lines.append("    </hardware>")
    for joint in joints:
        lines += [f'    <joint name="{joint}">', '      <command_interface name="effort"/>']
        lines += [f'      <state_interface name="{kind}"/>' for kind in interfaces]
        lines.append("    </joint>")
    return [*lines, "  </ros2_control>"]


def axis_urdf(
    name: str, joint: str, kind: Literal["continuous", "prismatic"], limit: tuple[float, float], tag: Sequence[str]
) -> str:
    """Write the URDF of one axis, turning about z or moving along x.

    Parameters
    ----------
    limit : tuple of 2 floats
        Largest effort and speed, in the units of its joint states; a prismatic joint has no ends.
    tag : sequence of str
        From `hardware_tag`.
    """
    # URDF requires ends for a prismatic joint, so they are put out of reach.
    ends = ' lower="-1e9" upper="1e9"' if kind == "prismatic" else ""
    lines = [
        '<?xml version="1.0"?>',
        f'<robot name="{name}">',
        '  <link name="base_link"/>',
        f'  <joint name="{joint}" type="{kind}">',
        '    <parent link="base_link"/>',
        f'    <child link="{joint}_link"/>',
        f'    <axis xyz="{"0 0 1" if kind == "continuous" else "1 0 0"}"/>',
        f'    <limit effort="{limit[0]!r}" velocity="{limit[1]!r}"{ends}/>',
        "  </joint>",
        f'  <link name="{joint}_link"/>',
        *tag,
        "</robot>",
        "",
    ]
    return "\n".join(lines)
