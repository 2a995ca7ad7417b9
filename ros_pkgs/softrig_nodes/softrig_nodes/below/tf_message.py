"""tf2_msgs/msg/TFMessage without an installed tf2_msgs: a type to publish and receive as bytes.

The package is not available as a wheel. The middleware needs the name of a type, the form of its members, its hash and
its description when a topic is offered. They are derived from those of geometry_msgs/msg/TransformStamped, of which
the message is a sequence. There is no message object, only bytes. The structures are those of ROS 2 Jazzy
(rosidl_runtime_c, rosidl_typesupport_introspection_c and rosidl_typesupport_fastrtps_cpp, message_type_support.h).
"""

from __future__ import annotations

import ctypes
from ctypes import (
    CFUNCTYPE,
    POINTER,
    Structure,
    addressof,
    c_bool,
    c_char_p,
    c_size_t,
    c_uint8,
    c_uint32,
    c_uint64,
    c_void_p,
)
from functools import cache
from typing import Any

TF = "tf2_msgs/msg/TFMessage"
SOURCE = b"geometry_msgs/TransformStamped[] transforms\n"
HASH = "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"  # RIHS01, of the description below
ELEMENT = b"geometry_msgs/msg/TransformStamped"
# Codes of a member that is a message (in introspection), and of an unbounded sequence of messages (in a description).
MESSAGE, MESSAGES = 18, 145

Find = CFUNCTYPE(c_void_p, c_void_p, c_char_p)
Get = CFUNCTYPE(c_void_p, c_void_p)


class Handle(Structure):
    """rosidl_message_type_support_t."""

    _fields_ = [
        ("identifier", c_void_p),
        ("data", c_void_p),
        ("find", Find),
        ("hash", Get),
        ("description", Get),
        ("sources", Get),
    ]


class Callbacks(Structure):
    """message_type_support_callbacks_t, of Fast CDR."""

    _fields_ = [("namespace", c_char_p), ("name", c_char_p), ("functions", c_void_p * 5)]


class Member(Structure):
    """rosidl_typesupport_introspection_c__MessageMember."""

    _fields_ = [
        ("name", c_char_p),
        ("type_id", c_uint8),
        ("string_bound", c_size_t),
        ("members", c_void_p),
        ("is_key", c_bool),
        ("is_array", c_bool),
        ("array_size", c_size_t),
        ("is_bounded", c_bool),
        ("offset", c_uint32),
        ("default", c_void_p),
        ("functions", c_void_p * 6),
    ]


class Members(Structure):
    """rosidl_typesupport_introspection_c__MessageMembers."""

    _fields_ = [
        ("namespace", c_char_p),
        ("name", c_char_p),
        ("count", c_uint32),
        ("size", c_size_t),
        ("has_key", c_bool),
        ("members", POINTER(Member)),
        ("functions", c_void_p * 2),
    ]


class Sequence(Structure):
    """A sequence of anything, such as rosidl_runtime_c__String of characters."""

    _fields_ = [("data", c_void_p), ("size", c_size_t), ("capacity", c_size_t)]


class Field(Structure):
    """rosidl_runtime_c__type_description__Field."""

    _fields_ = [
        ("name", Sequence),
        ("type_id", c_uint8),
        ("capacity", c_uint64),
        ("string_capacity", c_uint64),
        ("nested", Sequence),
        ("default", Sequence),
    ]


class Individual(Structure):
    """rosidl_runtime_c__type_description__IndividualTypeDescription."""

    _fields_ = [("name", Sequence), ("fields", Sequence)]


class Description(Structure):
    """rosidl_runtime_c__type_description__TypeDescription."""

    _fields_ = [("own", Individual), ("referenced", Sequence)]


class Source(Structure):
    """rosidl_runtime_c__type_description__TypeSource."""

    _fields_ = [("name", Sequence), ("encoding", Sequence), ("text", Sequence)]


class Hash(Structure):
    """rosidl_type_hash_t."""

    _fields_ = [("version", c_uint8), ("value", c_uint8 * 32)]


class _Type:
    """The type support; all that it points to lives as long as the process."""

    def __init__(self, element: Handle) -> None:
        self._kept: list[Any] = [element]
        hashed = self._keep(Hash(1, (c_uint8 * 32)(*bytes.fromhex(HASH))))
        description, sources = self._keep(self._description(element)), self._keep(self._sources(element))
        get = [self._giving(value) for value in (hashed, description, sources)]
        fast, introspected = (
            element.find(addressof(element), f"rosidl_typesupport_{kind}".encode())
            for kind in ("fastrtps_c", "introspection_c")
        )
        if not fast or not introspected:
            raise ImportError(f"{TF}: tf2_msgs is not installed, and the middleware is not Fast DDS")
        hashes = {
            b"rosidl_typesupport_fastrtps_c": (fast, self._callbacks(Handle.from_address(fast))),
            b"rosidl_typesupport_introspection_c": (introspected, self._members(introspected)),
        }
        results: dict[bytes, int] = {}
        find = self._keep(Find(lambda handle, identifier: results.get(identifier)))
        for identifier, (source, data) in hashes.items():
            # the pointer of the identifier, not its text, is compared
            handle = Handle(Handle.from_address(source).identifier, addressof(data), find, *get)
            results[identifier] = addressof(self._keep(handle))
        self.handle = self._keep(Handle(element.identifier, None, find, *get))

    def _keep(self, value: Any) -> Any:
        self._kept.append(value)
        return value

    def _giving(self, value: Any) -> Any:
        address = addressof(value)
        return self._keep(Get(lambda handle: address))

    def _text(self, text: bytes) -> Sequence:
        data = self._keep(ctypes.create_string_buffer(text))
        return Sequence(addressof(data), len(text), len(text) + 1)

    def _row(self, kind: Any, items: list[Any]) -> Sequence:
        data = self._keep((kind * len(items))(*items))
        return Sequence(addressof(data), len(items), len(items))

    def _callbacks(self, element: Handle) -> Callbacks:
        """Return the element's callbacks except for the names: how large a message may become has no bound."""
        callbacks = Callbacks.from_address(element.data or 0)
        return self._keep(Callbacks(b"tf2_msgs::msg", b"TFMessage", callbacks.functions))  # type: ignore[no-any-return]

    def _members(self, element: int) -> Members:
        member = self._keep(Member(b"transforms", MESSAGE, 0, element, is_array=True))
        return self._keep(  # type: ignore[no-any-return]
            Members(b"tf2_msgs__msg", b"TFMessage", 1, ctypes.sizeof(Sequence), False, ctypes.pointer(member))
        )

    def _description(self, element: Handle) -> Description:
        description = Description.from_address(element.description(addressof(element)))
        first = ctypes.cast(description.referenced.data, POINTER(Individual))
        referenced = [description.own, *(first[i] for i in range(description.referenced.size))]
        referenced.sort(key=lambda individual: ctypes.string_at(individual.name.data, individual.name.size))
        field = Field(self._text(b"transforms"), MESSAGES, 0, 0, self._text(ELEMENT), self._text(b""))
        tf_message = Individual(self._text(TF.encode()), self._row(Field, [field]))
        return Description(tf_message, self._row(Individual, referenced))

    def _sources(self, element: Handle) -> Sequence:
        sources = Sequence.from_address(element.sources(addressof(element)))
        first = ctypes.cast(sources.data, POINTER(Source))
        tf_source = Source(self._text(TF.encode()), self._text(b"msg"), self._text(SOURCE))
        return self._row(Source, [tf_source, *(first[i] for i in range(sources.size))])


def _bytes_only(*_: Any) -> Any:
    raise TypeError(f"{TF} without tf2_msgs: only bytes are published and taken")


@cache
def tf_class() -> Any:
    """Return a class that rclpy accepts as tf2_msgs/msg/TFMessage in publishers and subscriptions of bytes.

    Raises
    ------
    ImportError
        There is no Fast DDS.
    """
    from geometry_msgs.msg import TransformStamped
    from rclpy.type_support import check_for_type_support

    check_for_type_support(TransformStamped)
    pointer = ctypes.pythonapi.PyCapsule_GetPointer
    pointer.restype, pointer.argtypes = c_void_p, [ctypes.py_object, c_char_p]
    capsule = ctypes.pythonapi.PyCapsule_New
    capsule.restype, capsule.argtypes = ctypes.py_object, [c_void_p, c_char_p, c_void_p]
    named = ctypes.pythonapi.PyCapsule_GetName
    named.restype, named.argtypes = c_char_p, [ctypes.py_object]
    support_class = type(TransformStamped)._TYPE_SUPPORT
    name = named(support_class)
    support = _Type(Handle.from_address(pointer(support_class, name)))
    metaclass = type(
        "Metaclass_TFMessage",
        (type,),
        {
            # whose pointers the capsule holds
            "_support": support,
            "_name": name,
            "_TYPE_SUPPORT": capsule(addressof(support.handle), name, None),
            "_CREATE_ROS_MESSAGE": _bytes_only,
            "_CONVERT_FROM_PY": _bytes_only,
            "_CONVERT_TO_PY": _bytes_only,
            "_DESTROY_ROS_MESSAGE": _bytes_only,
        },
    )
    return metaclass("TFMessage", (), {"__doc__": "Stands for the message; has no fields."})
