"""URDF text: written from a table of links, read from a file or a package."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree import ElementTree

from softrig_core import resource
from softrig_core.kit.file_format import UTF_16

Vector = tuple[float, float, float]
ENDLESS = "1e9"  # rad
_ENCODING = re.compile(rb"<\?xml[^>]*?encoding=(['\"])([A-Za-z0-9._-]+)\1")
# attributes that are a number or several
_NUMBERS = frozenset(
    ["xyz", "rpy", "quat_xyzw", "value", "ixx", "ixy", "ixz", "iyy", "iyz", "izz"]
    + ["damping", "friction", "lower", "upper", "effort", "velocity", "multiplier", "offset"]
)
_PHYSICS = ("inertial", "parent", "child", "origin", "axis", "limit", "dynamics", "mimic")


@dataclass(frozen=True)
class Link:
    """A moving link and the revolute joint that carries it.

    Parameters
    ----------
    name, joint : str
        Names of the link and of its joint.
    origin, rotation : tuple of 3 floats
        Joint frame in the parent link's frame: m, roll-pitch-yaw in rad.
    axis : tuple of 3 floats
        Joint axis in the joint frame.
    limits : tuple of 2 floats
        Range of the joint, rad.
    mass : float
        kg.
    center, turn : tuple of 3 floats
        Frame of the centre of mass in the link's frame: m, roll-pitch-yaw in rad.
    inertia : tuple of 3 floats
        Ixx, Iyy, Izz about the centre of mass in that frame, kg m^2; products of inertia are 0.
    tip : tuple of 3 floats
        Where the next joint or the tool sits; a viewer draws the link as a bar up to there.
    """

    name: str
    joint: str
    origin: Vector
    rotation: Vector
    axis: Vector
    limits: tuple[float, float]
    mass: float
    center: Vector
    turn: Vector
    inertia: Vector
    tip: Vector


def check_inertia(
    mass_name: str, mass: float, inertia_name: str, inertia: Sequence[float], slack: float | None = None
) -> None:
    """Refuse a body that cannot exist.

    Parameters
    ----------
    mass_name, inertia_name : str
        What the message calls the two.
    inertia : sequence of 3 floats
        Principal moments about the centre of mass, kg m^2.
    slack : float, optional
        Rounding error of the moments, kg m^2. With it, points and rods without thickness may exist, too.

    Raises
    ------
    ValueError
        Mass not positive, moments not positive, or one larger than the sum of the other two.
    """
    if not (mass > 0.0 or (slack is not None and mass == 0.0)):
        raise ValueError(f"{mass_name} = {mass:g} kg: expected a positive mass")
    low, middle, high = sorted(map(float, inertia))
    if not (low > 0.0 or (slack is not None and low >= -slack)):
        raise ValueError(f"{inertia_name} = {list(inertia)} kg m^2: expected a positive definite inertia")
    if high > (low + middle) * (1.0 + 1e-9) + (slack or 0.0):
        raise ValueError(
            f"{inertia_name} = {list(inertia)} kg m^2: no body has one moment larger than the sum of "
            "the other two (triangle inequality)"
        )


def robot_urdf(
    name: str,
    links: Sequence[Link],
    tip: str,
    origin: Vector,
    rotation: Vector = (0.0, 0.0, 0.0),
    hardware: Sequence[str] = (),
) -> str:
    """Write a serial robot as URDF.

    Parameters
    ----------
    links : sequence of Link
        From the base to the tip.
    tip : str
        Name of the frame at the end (tool, foot).
    origin, rotation : tuple of 3 floats
        That frame in the last link's frame: m, roll-pitch-yaw in rad.
    hardware : sequence of str
        Lines for ros2_control, from `softrig_control.hardware.hardware_tag`.
    """
    lines = ['<?xml version="1.0"?>', f'<robot name="{name}">', '  <link name="base_link"/>']
    parent = "base_link"
    for link in links:
        ixx, iyy, izz = link.inertia
        lines += [
            f'  <joint name="{link.joint}" type="revolute">',
            f'    <parent link="{parent}"/>',
            f'    <child link="{link.name}"/>',
            f"    {_origin(link.origin, link.rotation)}",
            f'    <axis xyz="{_text(link.axis)}"/>',
            f'    <limit lower="{link.limits[0]!r}" upper="{link.limits[1]!r}" effort="1000" velocity="100"/>',
            "  </joint>",
            f'  <link name="{link.name}">',
            "    <inertial>",
            f"      {_origin(link.center, link.turn)}",
            f'      <mass value="{link.mass!r}"/>',
            f'      <inertia ixx="{ixx!r}" ixy="0" ixz="0" iyy="{iyy!r}" iyz="0" izz="{izz!r}"/>',
            "    </inertial>",
            *_bar(link.tip),
            "  </link>",
        ]
        parent = link.name
    lines += [
        f'  <joint name="{tip}_mount" type="fixed">',
        f'    <parent link="{parent}"/>',
        f'    <child link="{tip}"/>',
        f"    {_origin(origin, rotation)}",
        "  </joint>",
        f'  <link name="{tip}">',
        # without it one reader (PyBullet) makes the tip 1 kg
        '    <inertial><mass value="0"/><inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/></inertial>',
        "  </link>",
        *hardware,
        "</robot>",
        "",
    ]
    return "\n".join(lines)


def _bar(tip: Vector) -> list[str]:
    """Return a thin box from the joint to the tip, stretched along the axes of the tip's position."""
    size = tuple(max(abs(x), 0.08) for x in tip)
    middle: Vector = (tip[0] / 2.0, tip[1] / 2.0, tip[2] / 2.0)
    return [
        "    <visual>",
        f"      {_origin(middle, (0.0, 0.0, 0.0))}",
        f'      <geometry><box size="{_text(size)}"/></geometry>',
        "    </visual>",
    ]


def _origin(xyz: Vector, rpy: Vector) -> str:
    return f'<origin xyz="{_text(xyz)}" rpy="{_text(rpy)}"/>'


def _text(values: Sequence[float]) -> str:
    return " ".join(repr(round(float(v), 15) + 0.0) for v in values)  # + 0.0 turns -0.0 into 0.0


def read_urdf(source: str) -> str:
    """Read URDF text.

    Parameters
    ----------
    source : str
        A file name, or ``package://NAME/path/in/share`` of an installed package.

    Raises
    ------
    ValueError
        There is no such file or package (the message lists the places searched), or bytes do not match the file's
        encoding.
    """
    data = resource(source, "URDF file").read_bytes()
    declared = _ENCODING.match(data)
    if data.startswith(UTF_16):
        encoding = "utf-16"
    else:
        encoding = declared[2].decode() if declared else "utf-8-sig"
    try:
        text = data.decode(encoding)
    except (UnicodeDecodeError, LookupError):
        raise ValueError(f"{source}: its bytes are not {encoding}; name it in <?xml ... encoding=...?>") from None
    return re.sub(r"^(<\?xml[^>]*?)\s+encoding=(['\"]).*?\2", r"\1", text)  # a text has no encoding any more


def root_link(urdf: str) -> str:
    """Return the name of the link without a parent: the frame of all poses.

    Parameters
    ----------
    urdf : str
        URDF text.
    """
    robot = ElementTree.fromstring(urdf)
    children = {child.get("link") for child in robot.iterfind("joint/child")}
    return next((str(link.get("name")) for link in robot.iterfind("link") if link.get("name") not in children), "")


def for_pinocchio(urdf: str) -> str:
    """Return a URDF as pinocchio should read it.

    Continuous joints become revolute ones without an end, whose one coordinate is the angle: pinocchio gives them
    cosine and sine instead, and no message carries those. An inertial of zero is removed: adding it to the link before
    would move that link's centre of mass by a rounding error. So is what softrig ignores, which pinocchio might refuse.
    Numbers are written as Python does: urdfdom takes no space or plus sign at some of them, and then drops the whole
    inertial with a line on the terminal.

    Parameters
    ----------
    urdf : str
        URDF text.
    """
    robot = ElementTree.fromstring(urdf)
    for element in [child for child in robot if child.tag not in ("link", "joint")]:
        robot.remove(element)
    for element in robot:
        for child in [child for child in element if child.tag not in _PHYSICS]:
            element.remove(child)
    for joint in robot.iterfind("joint[@type='continuous']"):
        joint.set("type", "revolute")
        limit = joint.find("limit")
        if limit is None:
            limit = ElementTree.SubElement(joint, "limit")
        for key in ("effort", "velocity"):
            limit.set(key, limit.get(key, ENDLESS))
        limit.set("lower", f"-{ENDLESS}")
        limit.set("upper", ENDLESS)
    for element in robot.iter():
        for key in _NUMBERS & element.attrib.keys():
            element.set(key, " ".join(repr(float(word)) for word in element.attrib[key].split()))
    for limit in robot.iterfind("joint/limit"):  # urdfdom takes no infinity
        for key, text in limit.attrib.items():
            if math.isinf(float(text)):
                limit.set(key, ENDLESS if float(text) > 0.0 else f"-{ENDLESS}")
    for link in robot.iterfind("link"):
        inertial = link.find("inertial")
        tags = [] if inertial is None else [*inertial.iterfind("mass"), *inertial.iterfind("inertia")]
        if inertial is not None and not any(float(x) for tag in tags for x in tag.attrib.values()):
            link.remove(inertial)
    return ElementTree.tostring(robot, encoding="unicode")
