"""Types: the IDL of ROS 2 messages, for cyclonedds, from the one table of leaves.

A type is on the network under its DDS name, `sensor_msgs::msg::dds_::Imu_`, and with the structure that ROS
gives it, so that other programs of cyclonedds, which compare structures, match ours.
"""

from functools import cache
from typing import Any

from cyclonedds.idl import IdlStruct, make_idl_struct
from cyclonedds.idl import types as idl

from magtwin.io.bags.cdr import Leaf, leaves
from magtwin.io.bags.messages import TYPES

_NUMBERS = {
    "f8": idl.float64,
    "f4": idl.float32,
    "i8": idl.int64,
    "i4": idl.int32,
    "u4": idl.uint32,
    "u2": idl.uint16,
    "u1": idl.uint8,
    "i1": idl.int8,
}
_FLAGS = {"present": bool, "level": idl.byte}
"""Leaves of one byte that are no numbers in ROS."""

PARTED = ("tf2_msgs/msg/TFMessage", "diagnostic_msgs/msg/DiagnosticArray")
"""Types that are not in the table, as their parts have parts of their own."""

_STRUCTS = {
    "header": "std_msgs::msg::dds_::Header_",
    "position": "geometry_msgs::msg::dds_::Point_",
    "transform": "geometry_msgs::msg::dds_::Transform_",
    "layout": "std_msgs::msg::dds_::MultiArrayLayout_",
}
_AXES = {
    3: ("geometry_msgs::msg::dds_::Vector3_", "xyz"),
    4: ("geometry_msgs::msg::dds_::Quaternion_", "xyzw"),
}
"""Structures by the name of the member that holds one, and by the number of their parts."""


def dds_name(kind: str) -> str:
    """The name of a type on the network: `a/msg/B` is `a::msg::dds_::B_`."""
    package, space, name = kind.split("/")
    return f"{package}::{space}::dds_::{name}_"


def ros_name(dds: str) -> str:
    """The type of a name on the network, the reverse of `dds_name`; "" where it is none of ROS."""
    parts = dds.split("::")
    return f"{parts[0]}/{parts[1]}/{parts[3][:-1]}" if len(parts) == 4 and parts[2] == "dds_" else ""


@cache
def struct_of(kind: str) -> type[IdlStruct]:
    """The structure of a type of messages, whose samples are bytes: give its `DataWriter` what `raw` made."""
    struct = _whole(kind)

    def serialize(self: Any, buffer: Any = None, endianness: Any = None, use_version_2: Any = None) -> bytes:
        return bytes(self.cdr)

    def deserialize(cls: Any, data: bytes, has_header: bool = True, use_version_2: Any = None) -> Any:
        return raw(kind, data)

    struct.serialize = serialize  # type: ignore[method-assign]
    struct.deserialize = classmethod(deserialize)  # type: ignore[assignment]
    return struct


def raw(kind: str, data: bytes) -> Any:
    """A sample of a type that is these bytes."""
    sample = object.__new__(struct_of(kind))
    sample.cdr = data
    return sample


def _whole(kind: str) -> type[IdlStruct]:
    if kind == PARTED[0]:
        return _struct(
            dds_name(kind), {"transforms": idl.sequence[_part("geometry_msgs/msg/TransformStamped")]}
        )
    if kind == PARTED[1]:
        word = _struct("diagnostic_msgs::msg::dds_::KeyValue_", {"key": str, "value": str})
        texts = dict.fromkeys(("name", "message", "hardware_id"), str)
        status = _struct(
            "diagnostic_msgs::msg::dds_::DiagnosticStatus_",
            {"level": idl.byte, **texts, "values": idl.sequence[word]},
        )
        return _struct(dds_name(kind), {"header": _header(), "status": idl.sequence[status]})
    return _tree(dds_name(kind), [(leaf.name, leaf) for leaf in leaves(TYPES[kind])])


def _part(kind: str) -> type[IdlStruct]:
    return _tree(dds_name(kind), [(leaf.name, leaf) for leaf in leaves(TYPES[kind])])


def _header() -> type[IdlStruct]:
    return _tree(_STRUCTS["header"], [(leaf.name, leaf) for leaf in leaves("time stamp, text frame_id")])


def _tree(name: str, entries: list[tuple[str, Leaf]]) -> type[IdlStruct]:
    """A structure of members, whose dotted names are structures of their own."""
    members: dict[str, list[tuple[str, Leaf]]] = {}
    for dotted, leaf in entries:
        head, _, rest = dotted.partition(".")
        members.setdefault(head, []).append((rest, leaf))
    fields: dict[str, Any] = {}
    for head, inner in members.items():
        if inner[0][0]:
            held = _STRUCTS.get(head, f"geometry_msgs::msg::dds_::{_held(head, inner)}_")
            fields[head] = _tree(held, inner)
        else:
            fields[head] = _member(head, inner[0][1])
    return _struct(name, fields)


def _held(head: str, inner: list[tuple[str, Leaf]]) -> str:
    """What ROS calls a pose or twist: one with its covariance is another type."""
    word = head.capitalize()
    return f"{word}WithCovariance" if any(name == "covariance" for name, _ in inner) else word


def _member(head: str, leaf: Leaf) -> Any:
    if leaf.kind == "time":
        return _struct("builtin_interfaces::msg::dds_::Time_", {"sec": idl.int32, "nanosec": idl.uint32})
    if leaf.kind == "none":
        size = {"label": str, "size": idl.uint32, "stride": idl.uint32}
        return idl.sequence[_struct("std_msgs::msg::dds_::MultiArrayDimension_", size)]
    if leaf.kind == "text":
        return str if leaf.count else idl.sequence[str]
    number = _FLAGS.get(head, _NUMBERS[leaf.kind])
    if leaf.count is None:
        return idl.sequence[number]
    if leaf.count in _AXES:
        name, axes = _AXES[leaf.count]
        return _struct(_STRUCTS.get(head, name), dict.fromkeys(axes, number))
    return number if leaf.count == 1 else idl.array[number, leaf.count]


def _struct(typename: str, fields: dict[str, Any]) -> type[IdlStruct]:
    from cyclonedds.idl.annotations import final

    return final(make_idl_struct(typename.rpartition("::")[2], typename, fields))
