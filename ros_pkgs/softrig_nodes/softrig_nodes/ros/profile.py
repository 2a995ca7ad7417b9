"""Join a domain with a process-specific Fast DDS profile, derived from the given one.

Its ports are ones that no recently killed process used (see `processes.ports` for why). In a container its writers are
not matched with its own readers: messages between two nodes of one process are passed in memory, and DDS would deliver
them a second time. With the property `fastdds.ignore_local_endpoints` the endpoints stay in the graph and are matched
with other processes only.

Where shared memory has no room for a node, the profile has no transport by shared memory. Fast DDS falls back to UDP
only if it cannot create a segment. If the room ends between a segment and its ports, the node's peers write to ports
that do not exist and wait forever; if it ends at a semaphore, the node is killed by SIGBUS.
"""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache, partial
from tempfile import NamedTemporaryFile

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from softrig_core.kit.resource import prefixes

from ..processes.dead_locks import DeadLocks
from ..processes.executables import LOOPBACK, NO_MEMORY, PROFILE, given_profile, leased
from ..processes.ports import chosen
from ..processes.shared_memory import Ears, clear_ports, domain_id, lacking, numbers

PROPERTY = "fastdds.ignore_local_endpoints"
VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
(TRANSPORTS,) = NO_MEMORY
RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
STARTING = 8  # nodes that may start at the same moment and need space in shared memory
RENAMED = "FASTDDS_DEFAULT_PROFILES_FILE"  # name since Kilted, which warns at the old name
# elements of a writer's and a reader's times: in Fast DDS 2, in Fast DDS 3
TIMES = {
    "initialHeartbeatDelay": "initial_heartbeat_delay",
    "heartbeatPeriod": "heartbeat_period",
    "nackResponseDelay": "nack_response_delay",
    "nackSupressionDuration": "nack_supression_duration",
    "initialAcknackDelay": "initial_acknack_delay",
    "heartbeatResponseDelay": "heartbeat_response_delay",
}
SPACE = "http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"


@contextmanager
def joining(*, exclusive: bool = False, silence: float | None = None) -> Iterator[None]:
    """Prepare for a participant that starts within the block: remove damaged ports and write its profile.

    Parameters
    ----------
    exclusive : bool
        Whether its endpoints are matched with other processes only.
    silence : float, optional
        If no profile is given: others consider it dead only after more than this many s.

    Raises
    ------
    OSError
        The profile of the environment cannot be read.
    ValueError
        It is no XML, or has no participant.
    """
    clear_ports(domain_id())
    profile = given_profile()
    text = profile.read_bytes()
    if silence is not None and profile in (PROFILE, LOOPBACK):
        text = leased(text.decode(), silence).encode()
    with NamedTemporaryFile(prefix="softrig-", suffix=".xml") as file:
        changes = {RENAMED if third() else VARIABLE: file.name}
        if lacking(STARTING):
            changes |= NO_MEMORY
        memory = (os.environ | changes).get(TRANSPORTS) != NO_MEMORY[TRANSPORTS]
        # With LOCALHOST, rmw_fastrtps itself adds a transport by shared memory. The profile still allows no interface
        # but the loopback.
        if not memory and os.environ.get(RANGE) == "LOCALHOST":
            changes[RANGE] = "SYSTEM_DEFAULT"
        file.write(own_profile(text, exclusive=exclusive, memory=memory))
        file.flush()
        before = {name: os.environ.get(name) for name in (*changes, VARIABLE)}
        os.environ.pop(VARIABLE, None)
        os.environ |= changes
        try:
            yield
        # The file is gone after the block, and a run that this process starts later needs a profile of its own.
        finally:
            for name, value in before.items():
                if value is None:
                    os.environ.pop(name, None)
                else:
                    os.environ[name] = value


@cache
def third() -> bool:
    """Return whether this is Fast DDS 3, as of ROS 2 Kilted: its package has another name than before."""
    return any((prefix / "share" / "fastdds").is_dir() for prefix in prefixes())


def watch_ports(node: Node) -> None:
    """Mark the ports of a tool's node each second as alive, so that other processes do not remove them.

    Locks that killed processes held in ports of its domain are freed, too.
    """
    for check in (Ears().lost, partial(DeadLocks().release, domain_id())):
        node.create_timer(1.0, check, clock=Clock(clock_type=ClockType.STEADY_TIME))


def own_profile(profile: bytes, *, exclusive: bool = False, memory: bool = True) -> bytes:
    """Return a profile file with ports for its participants, unless the given profile names some.

    Parameters
    ----------
    profile : bytes
        A profile file of Fast DDS.
    exclusive : bool
        Add the property that matches endpoints with other processes only.
    memory : bool
        Keep the transports by shared memory.

    Raises
    ------
    ValueError
        No XML, or no participant in it.
    """
    try:
        root = ElementTree.fromstring(profile)
    except ElementTree.ParseError as error:
        raise ValueError(f"{VARIABLE}: not XML: {error}") from None
    space = f"{{{SPACE}}}" if root.tag.startswith("{") else ""
    ElementTree.register_namespace("", SPACE)
    participants = list(root.iter(f"{space}participant"))
    if not participants:
        raise ValueError(f"{VARIABLE}: no participant in the profile, expected one")
    if not memory:
        _without_memory(root, space)
    # Fast DDS 3 refuses the whole file if one element has its name of Fast DDS 2.
    if third():
        for element in root.iter():
            name = element.tag.removeprefix(space)
            element.tag = space + TIMES.get(name, name)
    for participant in participants:
        rtps = _within(participant, f"{space}rtps")
        if rtps.find(f"{space}port") is None:
            ports = ElementTree.SubElement(rtps, f"{space}port")
            for name, number in chosen(domain_id(), numbers()).items():
                ElementTree.SubElement(ports, space + name).text = str(number)
        if exclusive:
            properties = _within(_within(rtps, f"{space}propertiesPolicy"), f"{space}properties")
            entry = ElementTree.SubElement(properties, f"{space}property")
            ElementTree.SubElement(entry, f"{space}name").text = PROPERTY
            ElementTree.SubElement(entry, f"{space}value").text = "true"
    return ElementTree.tostring(root, xml_declaration=True, encoding="UTF-8")


def _without_memory(root: ElementTree.Element, space: str) -> None:
    """Remove the transports by shared memory, and where participants name them."""
    removed = set()
    for parent in root.iter(f"{space}transport_descriptors"):
        for entry in [e for e in parent if e.findtext(f"{space}type") == "SHM"]:
            removed.add(entry.findtext(f"{space}transport_id"))
            parent.remove(entry)
    for parent in root.iter(f"{space}userTransports"):
        for entry in [e for e in parent if e.text in removed]:
            parent.remove(entry)


def _within(element: ElementTree.Element, tag: str) -> ElementTree.Element:
    """Return the child of a tag, created if needed."""
    result = element.find(tag)
    return ElementTree.SubElement(element, tag) if result is None else result
