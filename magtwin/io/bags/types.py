"""Message types of ROS 2, flattened to leaves for `magtwin.io.bags.cdr`; definitions come from rosbags."""

from collections.abc import Mapping
from functools import cache
from typing import Any

from magtwin.errors import InputError, hint
from magtwin.io.bags.cdr import Leaf

_CODES = {"float64": "f8", "float32": "f4", "bool": "u1", "byte": "u1", "char": "u1", "string": "text"}
_CODES |= {f"{sign}int{8 * size}": f"{sign[:1] or 'i'}{size}" for sign in ("u", "") for size in (1, 2, 4, 8)}
TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
"""Types of stamps, one leaf of whole nanoseconds."""


@cache
def store_of(distribution: str) -> Any:
    """The message types of a distribution of ROS 2, a `rosbags.typesys.Typestore`; "latest" is the newest."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(
        Stores.LATEST if distribution == "latest" else Stores[f"ROS2_{distribution.upper()}"]
    )


@cache
def typestore() -> Any:
    """The message types of ROS 2 Humble and those that later distributions added."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)  # not that of `store_of`, which stays as it is
    newest = store_of("latest").fielddefs
    store.register({kind: defined for kind, defined in newest.items() if kind not in store.fielddefs})
    return store


@cache
def definition_of(kind: str, digest: str = "") -> tuple[str, str]:
    """The definition of a message type as text, and its REP 2011 hash.

    Args:
        kind: The type.
        digest: Hash of the wanted definition, as distributions may differ. Default: that of `typestore`.

    Raises:
        InputError: The type is unknown, or no distribution defines it with that hash.
    """
    fields_of(kind)
    for store in (typestore(), *map(store_of, ("jazzy", "latest"))):
        if kind in store.fielddefs and (own := store.hash_rihs01(kind)) == (digest or own):
            return store.generate_msgdef(kind, ros_version=2)[0], own
    raise InputError(f"{kind} is defined in another way than by ROS 2 (hash {digest[:19]}...)")


def fields_of(kind: str) -> list[tuple[str, Any]]:
    """Name and rosbags description of each field of a message type.

    Raises:
        InputError: The type is unknown.
    """
    known = typestore().fielddefs
    if kind not in known:
        raise InputError(f"unknown message type {kind!r}; {hint(kind, known)}")
    return known[kind][1]


def layout(kind: str, counts: Mapping[str, Any] | None = None) -> tuple[Leaf, ...]:
    """The leaves of a message type, in the order of its bytes.

    `geometry_msgs/msg/Point` and other structures of equal numbers are one leaf. A sequence of structures,
    such as `transforms` of a TFMessage, is a leaf with its length, and the leaves `transforms.0.header.stamp`
    and so on of each element.

    Args:
        kind: The type, such as `sensor_msgs/msg/Imu`.
        counts: Lengths of sequences of structures, by leaf name; other entries are ignored. A sequence
            without a length must be empty.

    Raises:
        InputError: The type is unknown.
    """
    plain = _layout(kind)
    return (
        tuple(_leaves(kind, "", counts)) if counts and any(leaf.kind == "none" for leaf in plain) else plain
    )


@cache
def _layout(kind: str) -> tuple[Leaf, ...]:
    return tuple(_leaves(kind, "", {}))


def _leaves(kind: str, prefix: str, counts: Mapping[str, Any]) -> list[Leaf]:
    from rosbags.interfaces import Nodetype

    leaves: list[Leaf] = []
    for name, (node, described) in fields_of(kind):
        name = f"{prefix}{name}"
        if node is Nodetype.BASE:
            leaves.append(Leaf(name, _CODES[described[0]]))
        elif node is Nodetype.NAME:
            leaves += _structure(described, name, counts)
        else:
            (inner, element), count = described
            if inner is Nodetype.BASE:
                fixed = count if node is Nodetype.ARRAY else None
                leaves.append(Leaf(name, _CODES[element[0]], fixed))
            elif node is Nodetype.SEQUENCE and name not in counts:
                leaves.append(Leaf(name, "none"))
            else:
                if node is Nodetype.SEQUENCE:
                    count = int(counts[name])
                    leaves.append(Leaf(name, "u4"))
                for k in range(count):
                    leaves += _structure(element, f"{name}.{k}", counts)
    return leaves


def _structure(kind: str, name: str, counts: Mapping[str, Any]) -> list[Leaf]:
    if kind in TIMES:
        return [Leaf(name, "time")]
    inner = _leaves(kind, f"{name}.", counts)
    same = {(leaf.kind, leaf.count) for leaf in inner}
    if (
        len(inner) > 1
        and len(same) == 1
        and inner[0].count == 1
        and inner[0].kind not in ("text", "none", "time")
    ):
        return [Leaf(name, inner[0].kind, len(inner))]
    return inner
