"""Message types of ROS 2, flattened to leaves for `magtwin.io.bags.cdr`; definitions come from rosbags."""

from collections import ChainMap
from collections.abc import Mapping
from functools import cache
from typing import Any

from magtwin.errors import InputError, hint
from magtwin.io.bags.cdr import Leaf

_CODES = {"float64": "f8", "float32": "f4", "bool": "u1", "byte": "u1", "char": "u1", "string": "text"}
_CODES |= {f"{sign}int{8 * size}": f"{sign[:1] or 'i'}{size}" for sign in ("u", "") for size in (1, 2, 4, 8)}
TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
"""Types of stamps, one leaf of whole nanoseconds."""

MOST_TEXT, MOST_LEAVES, DEEPEST = 200_000, 20_000, 30  # Of a definition: characters, parts, depth


@cache
def store_of(distribution: str) -> Any:
    """The message types of a distribution of ROS 2, a `rosbags.typesys.Typestore`; "latest" is the newest."""
    from rosbags.typesys import Stores, get_typestore

    name = distribution.upper()
    return get_typestore(Stores[name if name == "LATEST" else f"ROS2_{name}"])


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

    `digest` is the hash of the wanted definition, as distributions may differ; by default that of
    `typestore`.
    """
    fields_of(kind)
    for store in (typestore(), *map(store_of, ("jazzy", "latest"))):
        if kind in store.fielddefs and (own := store.hash_rihs01(kind)) == (digest or own):
            return store.generate_msgdef(kind, ros_version=2)[0], own
    raise InputError(f"{kind} is defined in another way than by ROS 2 (hash {digest[:19]}...)")


def fields_of(kind: str) -> list[tuple[str, Any]]:
    """Name and rosbags description of each field of a message type."""
    known = typestore().fielddefs
    if kind not in known:
        raise InputError(f"unknown message type {kind!r}; {hint(kind, known)}")
    return known[kind][1]


class Types:
    """The message types of a bag: those of ROS, and others by the definitions that stand in the bag.

    A definition is data: rosbags parses it, and nothing is generated from it.
    """

    def __init__(self) -> None:
        self._texts: dict[tuple[str, bool], str] = {}
        self._leaves: dict[tuple[str, bool], tuple[Leaf, ...]] = {}

    def learn(self, kind: str, text: str, *, ros1: bool = False) -> None:
        """Keep the definition of a type, which is parsed when it is needed."""
        if len(text) <= MOST_TEXT:
            self._texts.setdefault((kind, ros1), text)

    def layout(
        self, kind: str, counts: Mapping[str, Any] | None = None, *, ros1: bool = False
    ) -> tuple[Leaf, ...]:
        """The leaves of a type, as `layout`; a type of ROS 1 is always that of the bag."""
        key = kind, ros1
        if key not in self._texts or (not ros1 and kind in typestore().fielddefs):
            return layout(kind, counts)
        if counts or key not in self._leaves:
            from rosbags.typesys import get_types_from_msg

            own = get_types_from_msg(self._texts[key], kind)
            known = own if ros1 else ChainMap(typestore().fielddefs, own)
            leaves = tuple(_leaves(kind, "", counts or {}, known))
            if counts:
                return leaves
            self._leaves[key] = leaves
        return self._leaves[key]


def layout(kind: str, counts: Mapping[str, Any] | None = None) -> tuple[Leaf, ...]:
    """The leaves of a message type, such as `sensor_msgs/msg/Imu`, in the order of its bytes.

    `geometry_msgs/msg/Point` and other structures of equal numbers are one leaf. A sequence of structures,
    such as `transforms` of a TFMessage, is a leaf with its length, and the leaves `transforms.0.header.stamp`
    and so on of each element. `counts` are lengths of such sequences by leaf name; others must be empty.
    """
    plain = _layout(kind)
    if not counts or all(leaf.kind != "none" for leaf in plain):
        return plain
    return tuple(_leaves(kind, "", counts, typestore().fielddefs))


@cache
def _layout(kind: str) -> tuple[Leaf, ...]:
    fields_of(kind)
    return tuple(_leaves(kind, "", {}, typestore().fielddefs))


def _leaves(kind: str, prefix: str, counts: Mapping[str, Any], known: Mapping[str, Any]) -> list[Leaf]:
    from rosbags.interfaces import Nodetype

    if prefix.count(".") > DEEPEST:
        raise InputError(f"{kind} is nested over {DEEPEST} deep; it is not read")
    leaves: list[Leaf] = []
    for name, (node, described) in known[kind][1]:
        name = f"{prefix}{name}"
        if node is Nodetype.BASE:
            leaves.append(Leaf(name, _CODES[described[0]]))
        elif node is Nodetype.NAME:
            leaves += _structure(described, name, counts, known)
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
                if len(leaves) + count > MOST_LEAVES:
                    raise InputError(f"{kind} has over {MOST_LEAVES:,} parts; it is not read")
                for k in range(count):
                    leaves += _structure(element, f"{name}.{k}", counts, known)
    return leaves


def _structure(kind: str, name: str, counts: Mapping[str, Any], known: Mapping[str, Any]) -> list[Leaf]:
    if kind in TIMES:
        return [Leaf(name, "time")]
    inner = _leaves(kind, f"{name}.", counts, known)
    same = {(leaf.kind, leaf.count) for leaf in inner}
    kind, count = same.pop() if len(inner) > 1 and len(same) == 1 else ("none", None)
    return [Leaf(name, kind, len(inner))] if count == 1 and kind not in ("text", "none", "time") else inner
