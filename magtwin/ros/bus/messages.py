"""Messages: one live message in CDR and back.

Fields are named by leaf, as in `magtwin.io.bags.types.layout`: `pose.position`, `header.stamp`,
`transforms.0.child_frame_id`. Messages are encoded as those of a bag. `magtwin.io.bags.cdr` is made for whole
columns; to decode one message, or to encode a long list of poses, rosbags is seven times as fast.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from magtwin.errors import InputError, hint
from magtwin.io.bags.cdr import NS, encode
from magtwin.io.bags.types import fields_of, layout, typestore


def to_bytes(kind: str, fields: Mapping[str, Any]) -> bytes:
    """One message in CDR.

    Args:
        kind: Its type, such as `sensor_msgs/msg/Imu`.
        fields: Values by leaf name, also arrays of one row; stamps in whole nanoseconds. A sequence of
            structures is given by its length (`transforms`), and its elements by their number
            (`transforms.0.child_frame_id`). Default: zero or empty.

    Raises:
        InputError: The type or a field is unknown, or a value has the wrong size.
    """
    leaves = layout(kind, fields)
    known = {leaf.name for leaf in leaves}
    if unknown := fields.keys() - known:
        name = min(unknown)
        raise InputError(f"{kind} has no field {name!r}; {hint(name, known)}")
    try:
        return encode(leaves, fields, 1).tobytes()
    except (TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{kind}: a field has a value that it cannot have: {error}") from error


def poses_bytes(kind: str, stamp_ns: int, frame: str, poses: ArrayLike) -> bytes:
    """A PoseArray, or a Path whose poses have the stamp of the path.

    Args:
        kind: Its type.
        stamp_ns: Stamp [ns].
        frame: Frame of the poses.
        poses: x, y, z [m] and orientation xyzw, shape (N, 7).
    """
    types = typestore().types
    header, time = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]
    names = ("PoseStamped", "Pose", "Point", "Quaternion")
    stamped, pose, point, quaternion = (types[f"geometry_msgs/msg/{name}"] for name in names)
    head = header(time(*divmod(int(stamp_ns), NS)), frame)
    table = np.asarray(poses, float).reshape(-1, 7).tolist()
    made = [pose(point(*row[:3]), quaternion(*row[3:])) for row in table]
    made = [stamped(head, each) for each in made] if kind == "nav_msgs/msg/Path" else made
    whole = types[kind](head, made)
    return bytes(typestore().serialize_cdr(whole, kind, little_endian=True))


def content_of(kind: str, data: bytes) -> Any:
    """A message as an object of rosbags, with an attribute for each field.

    Raises:
        InputError: The type is unknown, or the message has another length or is not plain CDR.
    """
    from rosbags.serde import SerdeError

    fields_of(kind)
    try:
        return typestore().deserialize_cdr(data, kind)
    except SerdeError as error:
        raise InputError(f"a message is no {kind}: {error}") from error


def leaf_of(content: Any, name: str) -> Any:
    """A leaf of a message: a number, array or text; a stamp in whole nanoseconds; the length of a sequence.

    Raises:
        InputError: A sequence has no such element, or the type has no such field.
    """
    part = content
    try:
        for step in name.split("."):
            part = part[int(step)] if step.isdigit() else getattr(part, step)
    except (AttributeError, IndexError, TypeError) as error:
        raise InputError(f"a {content.__msgtype__} has no field {name!r}: {error}") from error
    kind = getattr(part, "__msgtype__", "")
    if kind.startswith("builtin_interfaces/"):
        return part.sec * NS + part.nanosec
    if kind:  # of numbers alone, such as a point
        return np.array([getattr(part, field) for field, _ in fields_of(kind)])
    return len(part) if isinstance(part, list) and not (part and isinstance(part[0], str)) else part
