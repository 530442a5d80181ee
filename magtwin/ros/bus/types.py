"""Types: structures of ROS 2 messages for cyclonedds, made from the definitions of rosbags.

A type has the DDS name that ROS gives it, `sensor_msgs::msg::dds_::Imu_`, and the same structure, so that
other programs of cyclonedds, which compare structures, match ours.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

from cyclonedds.idl import IdlStruct, make_idl_struct
from cyclonedds.idl import types as idl
from cyclonedds.idl.annotations import final
from rosbags.interfaces import Nodetype

from magtwin.io.bags.types import fields_of

_BASES = {"bool": bool, "byte": idl.byte, "char": idl.uint8, "string": str}
_BASES |= {name: getattr(idl, name) for name in ("float32", "float64")}
_BASES |= {
    f"{sign}int{size}": getattr(idl, f"{sign}int{size}") for sign in ("u", "") for size in (8, 16, 32, 64)
}


def dds_name(kind: str) -> str:
    """The DDS name of a ROS type: `a/msg/B` is `a::msg::dds_::B_`."""
    package, space, name = kind.split("/")
    return f"{package}::{space}::dds_::{name}_"


def ros_name(dds: str) -> str:
    """The ROS type of a DDS name, the reverse of `dds_name`; "" if it is not a ROS type."""
    parts = dds.split("::")
    return f"{parts[0]}/{parts[1]}/{parts[3][:-1]}" if len(parts) == 4 and parts[2] == "dds_" else ""


@cache
def struct_of(kind: str, store: Any = None) -> type[IdlStruct]:
    """The structure of a message type, whose samples are bytes: `struct_of(kind).deserialize(data)`.

    Args:
        kind: The type.
        store: Typestore that defines it. Default: that of `magtwin.io.bags.types.fields_of`.
    """
    struct = _struct(kind, fields_of if store is None else lambda name: store.fielddefs[name][1])

    def serialize(self: Any, buffer: Any = None, endianness: Any = None, use_version_2: Any = None) -> bytes:
        return bytes(self.cdr)

    def deserialize(cls: Any, data: bytes, has_header: bool = True, use_version_2: Any = None) -> Any:
        sample: Any = object.__new__(cls)
        sample.cdr = data
        return sample

    struct.serialize = serialize  # type: ignore[method-assign]
    struct.deserialize = classmethod(deserialize)  # type: ignore[assignment]
    return struct


def _struct(kind: str, fields: Callable[[str], Any] = fields_of) -> type[IdlStruct]:
    name = dds_name(kind)
    members = {field: _member(described, fields) for field, described in fields(kind)}
    return final(make_idl_struct(name.rpartition("::")[2], name, members))


def _member(described: Any, fields: Callable[[str], Any]) -> Any:
    node, content = described
    if node is Nodetype.BASE:
        return _BASES[content[0]]
    if node is Nodetype.NAME:
        return _struct(content, fields)
    element, count = content
    if node is Nodetype.ARRAY:
        return idl.array[_member(element, fields), count]
    return idl.sequence[_member(element, fields)]
