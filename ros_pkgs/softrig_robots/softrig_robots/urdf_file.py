"""Reader of URDF: the table of its tags and attributes, and the joints and links that softrig reads from it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal
from functools import lru_cache
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from softrig_core.block.params import LARGEST
from softrig_core.kit.file_format import FileFormat, Use, number_of

from .urdf import check_inertia

_GIVEN: tuple[Use, str] = ("used", "")
_FRAME: dict[str, tuple[Use, str]] = {
    "@xyz": ("used", "translation, m; zero when absent"),
    "@rpy": ("used", "roll, pitch, yaw, rad; zero when absent"),
    "@quat_xyzw": ("used", "rotation as a quaternion; only in a file of version 1.1 or later"),
}
_MOVING = ("revolute", "continuous", "prismatic")
_KINDS = (*_MOVING, "fixed")

URDF = FileFormat(
    "URDF",
    "wiki.ros.org/urdf/XML, urdfdom 5 (versions 1.0 to 1.2)",
    {
        "robot@name": ("used", "title only"),
        "robot@version": ("used", "1.0, 1.1 or 1.2"),
        "link": _GIVEN,
        "link@name": ("used", "frame of the link"),
        "link@type": ("ignored", "URDF does not define its meaning"),
        "link/inertial": ("used", "a link without it is massless"),
        "link/inertial/origin": ("used", "centre of mass and axes of the inertia, in the link's frame"),
        **{f"link/inertial/origin{k}": v for k, v in _FRAME.items()},
        "link/inertial/mass": _GIVEN,
        "link/inertial/mass@value": ("used", "kg"),
        "link/inertial/inertia": _GIVEN,
        **{
            f"link/inertial/inertia@{k}": ("used", "kg m^2, about the centre of mass")
            for k in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        },
        "link/visual/**": ("used", "only by viewers, which receive the whole file"),
        "link/collision/**": ("ignored", "no contact is computed"),
        "link/contact/**": ("ignored", "no contact is computed"),
        "link/sensor/**": ("ignored", "no sensor is simulated"),
        "joint": _GIVEN,
        "joint@name": ("used", "parameter `joints`, channels of the messages"),
        "joint@type": ("used", f"{', '.join(_KINDS[:-1])} or fixed; floating, planar and others are refused"),
        "joint/parent": _GIVEN,
        "joint/parent@link": _GIVEN,
        "joint/child": _GIVEN,
        "joint/child@link": _GIVEN,
        "joint/origin": ("used", "joint frame in the frame of the parent link"),
        **{f"joint/origin{k}": v for k, v in _FRAME.items()},
        "joint/axis": ("used", "1 0 0 when absent"),
        "joint/axis@xyz": ("used", "direction; its length does not matter, but zero is refused"),
        "joint/dynamics": _GIVEN,
        "joint/dynamics@damping": ("used", "viscous friction, N m s/rad or N s/m"),
        "joint/dynamics@friction": ("used", "Coulomb friction, N m or N; `edge_speed` smooths its change of sign"),
        "joint/limit": ("used", "required for a revolute or prismatic joint"),
        "joint/limit@lower": ("used", "rad or m; parameter `limits`: reported when exceeded, or an end stop"),
        "joint/limit@upper": ("used", "rad or m; parameter `limits`: reported when exceeded, or an end stop"),
        "joint/limit@effort": ("used", "N m or N; parameter `limits`: reported when exceeded, or the drive saturates"),
        "joint/limit@velocity": ("used", "rad/s or m/s; reported when exceeded"),
        "joint/limit@acceleration": ("ignored", "a limit for motion planners"),
        "joint/limit@deceleration": ("ignored", "a limit for motion planners"),
        "joint/limit@jerk": ("ignored", "a limit for motion planners"),
        "joint/mimic": ("used", "the two joints move as one: a constraint of the dynamics"),
        "joint/mimic@joint": ("used", "joint that it follows"),
        "joint/mimic@multiplier": ("used", "1 when absent"),
        "joint/mimic@offset": ("used", "rad or m; 0 when absent"),
        "joint/calibration": ("ignored", "position of a reference switch, which no plant has"),
        **{
            f"joint/calibration@{k}": ("ignored", "position of a reference switch, which no plant has")
            for k in ("rising", "falling", "reference_position")
        },
        "joint/safety_controller": ("ignored", "gains of a controller; parameter `limits` sets end stops"),
        **{
            f"joint/safety_controller@{k}": ("ignored", "gains of a controller; parameter `limits` sets end stops")
            for k in ("soft_lower_limit", "soft_upper_limit", "k_position", "k_velocity")
        },
        "material/**": ("used", "only by viewers, which receive the whole file"),
        "transmission/**": ("ignored", "parameter `motors.gear` sets the gears"),
        "ros2_control/**": ("used", "only by ros2_control, which receives the whole file"),
        "disable_collisions/**": ("ignored", "no contact is computed"),
        "gazebo/**": ("ignored", "settings of another simulator"),
        "mujoco/**": ("ignored", "settings of another simulator"),
        "sensor/**": ("ignored", "no sensor is simulated"),
        "model_state/**": ("ignored", "parameters `position` and `velocity` set the state at t = 0"),
        "xacro/**": ("refused", "expand it first (`xacro robot.urdf.xacro > robot.urdf`)"),
        "loop_joint/**": ("refused", "a robot is a tree; closed loops are not supported"),
    },
)


class Mimic(NamedTuple):
    """q = multiplier * q of `joint` + offset; `joint` follows no other."""

    joint: str
    multiplier: float
    offset: float


class Joint(NamedTuple):
    """A moving joint; limits in rad, rad/s, N m (m, m/s, N for a prismatic one), infinite if there are none."""

    damping: float
    friction: float
    lower: float
    upper: float
    velocity: float
    effort: float
    mimic: Mimic | None
    is_linear: bool = False


@dataclass(frozen=True)
class Robot:
    """Data that softrig reads from a URDF in addition to the masses and frames, which pinocchio reads.

    Parameters
    ----------
    joints : mapping
        Moving joints by name, in the order of the file.
    notes : tuple of str
        What the file has that has no effect.
    """

    joints: Mapping[str, Joint]
    notes: tuple[str, ...]


@lru_cache(maxsize=16)
def read_robot(urdf: str, source: str = "the URDF") -> Robot:
    """Check a URDF against `URDF`, and read its moving joints.

    Parameters
    ----------
    urdf : str
        URDF text.
    source : str
        The file, for messages.

    Raises
    ------
    ValueError
        The text is not XML; a tag or attribute is unknown, refused or occurs twice; a value is not a number; a link is
        physically impossible; or the joints do not form a tree.
    """
    try:
        root = ElementTree.fromstring(urdf)
    except ElementTree.ParseError as error:
        raise ValueError(f"{source}: not a URDF: {error}") from None
    if root.tag != "robot":
        raise ValueError(f"{source}: not a URDF: its first tag is <{_name(root.tag)}>, expected <robot>")
    notes = URDF.check(_names(root), source)
    version = root.get("version", "1.0")
    if version not in ("1.0", "1.1", "1.2"):
        raise ValueError(f"{source}: robot@version is {version!r}, expected 1.0, 1.1 or 1.2")
    base = _check_tree(root, source)
    for frame in root.iter("origin"):
        _vector(frame, "xyz", 3, source)
        _vector(frame, "rpy", 3, source)
        if frame.get("quat_xyzw") is not None and version == "1.0":
            raise ValueError(f"{source}: origin@quat_xyzw needs <robot version='1.1'>; write rpy, or that version")
        _vector(frame, "quat_xyzw", 4, source)
    for link in root.iterfind("link"):
        if _check_body(link, f"{source}: link {link.get('name')}") and link.get("name") == base:
            notes.append(f"{source}: link/inertial of {base} is ignored: the base does not move")
    moving = [joint for joint in root.iterfind("joint") if joint.get("type") != "fixed"]
    joints = {str(joint.get("name")): _joint(joint, f"{source}: joint {joint.get('name')}") for joint in moving}
    return Robot({name: _followed(name, joints, source) for name in joints}, tuple(notes))


def _name(tag: str) -> str:
    """Write a name without its namespace; all of xacro's are `xacro`."""
    space, _, name = tag.rpartition("}")
    return "xacro" if space.endswith("xacro") else f"{space[1:]}:{name}" if space else name


def _names(root: ElementTree.Element) -> Iterator[str]:
    """Yield the names in a file, as the table writes them.

    Raises
    ------
    ValueError
        An element that may occur once occurs twice.
    """
    yield from (f"robot@{_name(key)}" for key in root.attrib)
    stack = [(element, _name(element.tag)) for element in root]
    while stack:
        element, path = stack.pop()
        yield path
        if f"{path}/**" in URDF.table:
            continue
        yield from (f"{path}@{_name(key)}" for key in element.attrib)
        stack += [(child, f"{path}/{_name(child.tag)}") for child in element]
        single = [_name(child.tag) for child in element if child.tag not in ("visual", "collision")]
        if twice := next((tag for tag in single if single.count(tag) > 1), None):
            raise ValueError(f"{path} {element.get('name', '')}: <{twice}> occurs twice; remove one of the two")


def _check_tree(root: ElementTree.Element, source: str) -> str:
    """Check that joints and links make one tree, and return the name of its root link."""
    links = [str(link.get("name")) for link in root.iterfind("link")]
    parents: dict[str, str] = {}
    names: set[str] = set()
    if twice := next((name for name in links if links.count(name) > 1), None):
        raise ValueError(f"{source}: two links are called {twice!r}; rename one")
    for joint in root.iterfind("joint"):
        name, kind = joint.get("name"), joint.get("type")
        if not name or name in names:
            raise ValueError(f"{source}: a joint without a name, or two called {name!r}; give each a name of its own")
        names.add(name)
        if kind not in _KINDS:
            raise ValueError(f"{source}: joint {name} is of type {kind!r}, expected one of {', '.join(_KINDS)}")
        ends = [(tag, None if (end := joint.find(tag)) is None else end.get("link")) for tag in ("parent", "child")]
        for tag, link in ends:
            if link not in links:
                raise ValueError(f"{source}: joint {name}: {tag} link {link!r} is not a link of the file")
        child = str(ends[1][1])
        if child in parents:
            raise ValueError(
                f"{source}: link {child} is the child of two joints, {name} one of them; closed loops are not supported"
            )
        parents[child] = str(ends[0][1])
    bases = [name for name in links if name not in parents]
    if len(bases) != 1:
        text = ", ".join(bases) or "none, all in a circle"
        raise ValueError(f"{source}: expected one root link (the child of no joint), found {text}")
    return bases[0]


def _number(
    element: ElementTree.Element, key: str, source: str, default: float | None = None, most: float = LARGEST
) -> float:
    text = element.get(key)
    value = number_of(str(default) if text is None else text)
    if math.isnan(value):
        raise ValueError(f"{source}: {element.tag}@{key} is {text!r}, expected a number")
    if most < abs(value) < math.inf:
        raise ValueError(f"{source}: {element.tag}@{key} is {text!r}, expected at most {most:g} in magnitude")
    return value


def _vector(element: ElementTree.Element, key: str, size: int, source: str) -> tuple[float, ...]:
    text = element.get(key)
    if text is None:
        return ()
    values = tuple(map(number_of, text.split()))
    if len(values) != size or not all(map(math.isfinite, values)):
        raise ValueError(f"{source}: {element.tag}@{key} is {text!r}, expected {size} numbers")
    if max(map(abs, values)) > LARGEST:
        raise ValueError(f"{source}: {element.tag}@{key} is {text!r}, expected at most {LARGEST:g} in magnitude")
    return values


def _check_body(link: ElementTree.Element, source: str) -> bool:
    """Check mass and inertia of a link, and return whether it has any.

    The triangle inequality is checked within what the last written decimal leaves open: a disc whose moments are
    rounded to six decimals fails it otherwise.
    """
    inertial = link.find("inertial")
    if inertial is None:
        return False
    mass, inertia = inertial.find("mass"), inertial.find("inertia")
    if mass is None or inertia is None:
        raise ValueError(f"{source}: <inertial> needs <mass> and <inertia>")
    m = _number(mass, "value", source)
    xx, yy, zz, xy, xz, yz = (_number(inertia, f"i{k}", source) for k in ("xx", "yy", "zz", "xy", "xz", "yz"))
    if not all(map(math.isfinite, (m, xx, yy, zz, xy, xz, yz))):
        raise ValueError(f"{source}: mass and inertia must be finite")
    if m == xx == yy == zz == xy == xz == yz == 0.0:
        return False
    moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]).tolist()
    decimals = [Decimal(str(inertia.get(f"i{k}")).strip()).as_tuple().exponent for k in ("xx", "yy", "zz")]
    last = 10.0 ** min(int(k) for k in decimals)
    slack = min(1.5 * last, 0.05 * max(map(abs, moments)))
    check_inertia(f"{source}: mass", m, f"{source}: inertia", moments, slack)
    return True


def _joint(joint: ElementTree.Element, source: str) -> Joint:
    axis = joint.find("axis")
    if axis is not None and not any(_vector(axis, "xyz", 3, source) or (1.0,)):
        raise ValueError(f"{source}: axis@xyz is 0 0 0, expected a direction")
    dynamics = joint.find("dynamics")
    damping = friction = 0.0
    if dynamics is not None:
        damping, friction = (_number(dynamics, key, source, 0.0) for key in ("damping", "friction"))
    if not (0.0 <= damping < math.inf and 0.0 <= friction < math.inf):
        raise ValueError(
            f"{source}: dynamics has damping {damping:g} and friction {friction:g}, expected no negative values"
        )
    lower, upper, velocity, effort = _limits(joint, source)
    return Joint(
        damping, friction, lower, upper, velocity, effort, _mimic(joint, source), joint.get("type") == "prismatic"
    )


def _limits(joint: ElementTree.Element, source: str) -> tuple[float, float, float, float]:
    limit, endless = joint.find("limit"), joint.get("type") == "continuous"
    if limit is None:
        if not endless:
            raise ValueError(f"{source}: a {joint.get('type')} joint needs <limit>; an endless one is continuous")
        return -math.inf, math.inf, math.inf, math.inf
    # Exporters write 1e16 or 1e300 for a missing limit, so these may be larger than any quantity.
    velocity, effort = (
        _number(limit, key, source, math.inf if endless else None, most=math.inf) for key in ("velocity", "effort")
    )
    lower, upper = (_number(limit, key, source, 0.0, most=math.inf) for key in ("lower", "upper"))
    if endless:
        lower, upper = -math.inf, math.inf
    if lower > upper or velocity < 0.0 or effort < 0.0:
        raise ValueError(
            f"{source}: limit has lower {lower:g}, upper {upper:g}, velocity {velocity:g}, effort {effort:g}: expected "
            "lower <= upper, and no negative velocity or effort"
        )
    return lower, upper, velocity, effort


def _mimic(joint: ElementTree.Element, source: str) -> Mimic | None:
    mimic = joint.find("mimic")
    if mimic is None:
        return None
    multiplier, offset = _number(mimic, "multiplier", source, 1.0), _number(mimic, "offset", source, 0.0)
    if not (math.isfinite(multiplier) and math.isfinite(offset)):
        raise ValueError(f"{source}: mimic@multiplier and mimic@offset must be finite")
    return Mimic(mimic.get("joint", ""), multiplier, offset)


def _followed(name: str, joints: Mapping[str, Joint], source: str) -> Joint:
    """Resolve chains of mimic joints: each then follows a joint that is not a mimic."""
    joint, multiplier, offset, via = joints[name], 1.0, 0.0, [name]
    mimic = joint.mimic
    while mimic is not None:
        if mimic.joint not in joints:
            raise ValueError(
                f"{source}: joint {via[-1]} mimics {mimic.joint!r}, which is not a moving joint of the file"
            )
        if mimic.joint in via:
            raise ValueError(f"{source}: joints {', '.join(via)} mimic each other in a circle")
        multiplier, offset = multiplier * mimic.multiplier, multiplier * mimic.offset + offset
        via.append(mimic.joint)
        mimic = joints[mimic.joint].mimic
    return joint if len(via) == 1 else joint._replace(mimic=Mimic(via[-1], multiplier, offset))
