"""Parser of the message definitions stored in bags: from .msg and .idl texts to fields in wire order."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from typing import Any

from rosbags.interfaces import Nodetype

from .idl import IdlError, IdlReader
from .topics import is_known, typestore

#: Constants (none of them kept) and fields by type, each field a name and a description as of rosbags' type stores.
Types = dict[str, tuple[Any, list[tuple[str, Any]]]]
_DELIMITER = re.compile(r"^={20,}[ \t]*$", re.MULTILINE)
_LINE = re.compile(
    r"(?P<type>[A-Za-z]\w*(?:/\w+)*)(?:<=(?P<bound>\d+))?(?P<array>\[(?P<most><=)?(?P<count>\d*)\])?\s+(?P<name>\w+)"
    r"\s*(?P<constant>=)?"
)
PRIMITIVES = {
    "bool", "byte", "char", "octet", "wchar", "float32", "float64", "int8", "uint8", "int16", "uint16", "int32",
    "uint32", "int64", "uint64", "string", "wstring",
}  # fmt: skip
_SHORT = {
    "Header": "std_msgs/msg/Header",
    "time": "builtin_interfaces/msg/Time",
    "duration": "builtin_interfaces/msg/Duration",
}
#: Distributions by the version of a bag's metadata that they wrote, before bags carried definitions.
_OLD = {1: "foxy", 2: "foxy", 3: "foxy", 4: "foxy", 5: "humble", 6: "humble"}


class UnknownType(Exception):
    """A type has no definition in the bag or in softrig, or its definition cannot be read; the text names the case."""


def types_of(msgtype: str, text: str, language: str) -> Types:
    """Read the definition of a message type and of all types that it contains.

    Parameters
    ----------
    msgtype : str
        ``package/msg/Type``.
    text : str
        As stored in a bag: lines of ``=`` separate the parts of several types; each part begins with ``MSG: name`` or
        ``IDL: name``.
    language : str
        ``ros2msg`` or ``ros2idl``, for a part without such a heading.

    Raises
    ------
    UnknownType
        The text cannot be read, or the language is unknown.
    """
    if language not in ("ros2msg", "ros2idl"):
        raise UnknownType(f"its definition is in {language or 'no language'}, expected ros2msg or ros2idl")
    result: Types = {}
    text = text.replace("\r\n", "\n").replace("\r", "\n").replace("\ufeff", "")
    for section in _DELIMITER.split(text):
        kind, name, body = language, msgtype, section.strip("\n")
        head, _, remaining = body.partition("\n")
        if head[:5] in ("MSG: ", "IDL: "):
            kind, name, body = "ros2msg" if head[0] == "M" else "ros2idl", full_type(head[5:].strip()), remaining
        if not body.strip() and head[:5] not in ("MSG: ", "IDL: ") and msgtype in result:
            continue
        if kind == "ros2idl":
            if body.strip():
                result |= _of_idl(name, body)
        elif name not in result:
            result[name] = [], _of_msg(name, body)
    return result


def full_type(name: str, owner: str = "") -> str:
    """Return the whole name of a type, ``package/msg/Type``, of one that is written shorter."""
    if name in _SHORT:
        return _SHORT[name]
    package, _, remaining = name.partition("/")
    if not remaining:
        return f"{owner.rpartition('/')[0]}/{name}" if owner else name
    return name if "/" in remaining else f"{package}/msg/{remaining}"


def _of_idl(name: str, text: str) -> Types:
    try:
        return {struct: ([], fields) for struct, fields in IdlReader(text).structs.items()}
    except IdlError as error:
        raise UnknownType(f"the definition of {name} cannot be read: {error}") from error


def _of_msg(owner: str, text: str) -> list[tuple[str, Any]]:
    fields = []
    for line in text.split("\n"):
        line = line.strip()
        if not line or line[0] in "#@":
            continue
        match = _LINE.match(line)
        if match is None:
            raise UnknownType(f"the definition of {owner} cannot be read: {line[:80]!r}")
        if match["constant"]:
            continue
        kind: Any = (Nodetype.BASE, (match["type"], int(match["bound"] or 0)))
        if match["type"] not in PRIMITIVES:
            kind = (Nodetype.NAME, full_type(match["type"], owner))
        if match["array"] is not None:
            fixed = match["count"] and not match["most"]
            kind = (Nodetype.ARRAY if fixed else Nodetype.SEQUENCE, (kind, int(match["count"] or 0)))
        fields.append((match["name"], kind))
    return fields


def complete(msgtype: str, defined: Mapping[str, Any], distribution: str = "") -> Types:
    """Return a type and all types in it; types that the bag does not define are those of this installation.

    Parameters
    ----------
    defined : mapping
        What the bag defines, from `types_of`.
    distribution : str
        ROS distribution that wrote the bag: its definitions count before those of this one.

    Raises
    ------
    UnknownType
        One of them is defined neither there nor here.
    """
    result: Types = {}
    waiting = [msgtype]
    while waiting:
        name = waiting.pop()
        if name in result:
            continue
        definition = defined.get(name) or _known(name, distribution)
        if definition is None:
            context = "" if name == msgtype else f", which is in {msgtype}"
            raise UnknownType(f"no definition of {name}{context}, in the bag or here")
        result[name] = definition
        for _, description in definition[1]:
            kind, detail = description
            while kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
                kind, detail = detail[0]
            if kind == Nodetype.NAME:
                waiting.append(detail)
    return result


def _known(name: str, distribution: str) -> Any:
    if distribution and name in (old := _old_types(distribution)):
        return old[name]
    return typestore().fielddefs[name] if is_known(name) else None


@cache
def _old_types(distribution: str) -> Mapping[str, Any]:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores[f"ROS2_{distribution.upper()}"]).fielddefs


def distribution_of(name: str, version: int) -> str:
    """Return the ROS distribution whose definitions a bag without any follows; empty for this one.

    Parameters
    ----------
    name : str
        As stored in the bag, often empty.
    version : int
        Of the bag's metadata; 0 if unknown.
    """
    if name == "jazzy":
        return ""
    if name:
        from rosbags.typesys import Stores

        if f"ROS2_{name.upper()}" in Stores.__members__:
            return name
    return _OLD.get(version, "")
