"""A Fast DDS profile whose participant does not match its own writers with its own readers.

What two nodes of one container say to each other goes by memory; DDS would deliver it a second time. With the property
`fastdds.ignore_local_endpoints` the endpoints stay in the graph and are matched with other processes only.
"""

from __future__ import annotations

import os
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ...processes.executables import PROFILE

PROPERTY = "fastdds.ignore_local_endpoints"
VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
SPACE = "http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"


@contextmanager
def exclusive() -> Iterator[None]:
    """Within the block, new participants have the profile of the environment (ours without one) and the property."""
    given = os.environ.get(VARIABLE, str(PROFILE))
    with tempfile.TemporaryDirectory(prefix="softrig-") as folder:
        file = Path(folder) / "profile.xml"
        file.write_bytes(with_property(Path(given).read_bytes()))
        os.environ[VARIABLE] = str(file)
        try:
            yield
        finally:
            os.environ[VARIABLE] = given


def with_property(profile: bytes) -> bytes:
    """Give a profile file with the property in each of its participants.

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
    for participant in participants:
        at = participant
        for tag in ("rtps", "propertiesPolicy", "properties"):
            found = at.find(space + tag)
            at = ElementTree.SubElement(at, space + tag) if found is None else found
        entry = ElementTree.SubElement(at, f"{space}property")
        ElementTree.SubElement(entry, f"{space}name").text = PROPERTY
        ElementTree.SubElement(entry, f"{space}value").text = "true"
    return ElementTree.tostring(root, xml_declaration=True, encoding="UTF-8")
