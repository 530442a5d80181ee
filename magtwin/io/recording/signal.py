"""Signal: the decoded messages of one topic."""

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.io.bags.bag import Bag
from magtwin.io.bags.cdr import Index, Leaf, Messages, decode
from magtwin.io.bags.topics import PATH_KIND, Topic
from magtwin.io.recording.roles import reads_of
from magtwin.io.recording.timeline import WRONG, Order, in_order

STAMPS = {"header.stamp": 1, "stamp": 1, "timestamp": 1000}
"""Leaves that are the stamp of a message, and their nanoseconds per unit; PX4 counts microseconds."""


class Signal(NamedTuple):
    """The decoded messages of a topic."""

    name: str  # Name of the topic in the bag
    topic: Topic
    kind: str  # Message type
    messages: Messages
    fields: dict[str, Any]  # Values by leaf name
    stamps: NDArray[np.int64] | None  # Stamps of the messages [ns], shape (M,). None: they have none.
    broken: int = 0  # How many messages were left out, as they end too early or have another encoding

    @property
    def received(self) -> Index:
        """Times of receipt [ns], shape (M,)."""
        return self.messages.received

    def columns(self) -> dict[str, NDArray[Any]]:
        """The columns that the topic gives, one row a message."""
        return self.topic.read(self.kind, self.fields)

    def in_order(self, ns: Index, where: Path) -> tuple["Signal", Order]:
        """The messages in the order of their times [ns], as `magtwin.io.recording.timeline.in_order`."""
        order = in_order(ns, self.received, where, self.name)
        if len(order.rows) == len(ns) and (np.diff(order.rows) == 1).all():
            return self, order
        return self.take(order.rows), order

    def take(self, rows: NDArray[np.intp]) -> "Signal":
        """Some of the messages."""
        fields = {
            name: values[rows] if isinstance(values, np.ndarray) else [values[row] for row in rows]
            for name, values in self.fields.items()
        }
        stamps = None if self.stamps is None else self.stamps[rows]
        return self._replace(messages=self.messages.take(rows), fields=fields, stamps=stamps)


def read_signal(bag: Bag, name: str, topic: Topic, messages: Messages) -> Signal:
    """The messages of a topic of a bag, decoded for a role. A few that cannot be decoded are left out."""
    if bag.kinds[name] == PATH_KIND:
        return _of_path(bag, name, topic, messages)
    topic, leaves = reads_of(topic, bag, name), _layout(bag, name, messages)
    known = {leaf.name: leaf.kind for leaf in leaves}
    stamp = next((leaf for leaf in STAMPS if known.get(leaf) in ("time", "u8")), None)
    wanted = [*topic.leaves(bag.kinds[name]), *([stamp] if stamp else [])]
    try:
        fields, broken = decode(leaves, messages, wanted), 0
    except InputError as error:
        sound = _decodable(leaves, messages, wanted)
        broken = len(messages) - len(sound)
        if broken > max(1, WRONG * len(messages)):
            raise InputError(f"{bag.path}: topic {name}: {error}") from error
        messages = messages.take(sound)
        fields = decode(leaves, messages, wanted)
    stamps = fields.pop(stamp).astype(np.int64) * STAMPS[stamp] if stamp else None
    # A single stamp of 0 is the first moment of a simulation; many mean that there are no stamps.
    if stamps is not None and np.count_nonzero(stamps == 0) > max(1, WRONG * len(stamps)):
        stamps = None
    return Signal(name, topic, bag.kinds[name], messages, fields, stamps, broken)


def _of_path(bag: Bag, name: str, topic: Topic, messages: Messages) -> Signal:
    """The poses of the last message of a path, by their stamps; refused if these are those of a plan."""
    last = messages.take(np.array([len(messages) - 1]))
    (count,) = decode((*_until(bag.layout(name), "poses"), Leaf("poses", "u4")), last, ["poses"])["poses"]
    leaves = bag.layout(name, {"poses": count})
    parts = ("header.stamp", "pose.position", "pose.orientation")
    every = decode(leaves, last, [f"poses.{k}.{part}" for k in range(count) for part in parts])
    stamps, p, q = (
        np.concatenate([np.zeros((0, *shape), kind), *(every[f"poses.{k}.{part}"] for k in range(count))])
        for part, shape, kind in zip(parts, ((), (3,), (4,)), (np.int64, float, float), strict=True)
    )
    if 2 * len(np.unique(stamps)) <= count + 1:
        raise InputError(
            f"{bag.path}: topic {name} is a path whose poses have no stamps of their own, as that of a plan; "
            "choose another topic with --pose-topic"
        )
    each = replace(last.take(np.zeros(count, np.intp)), received=stamps)
    return Signal(name, topic, PATH_KIND, each, {"poses.position": p, "poses.orientation": q}, stamps)


def _until(leaves: tuple[Leaf, ...], name: str) -> tuple[Leaf, ...]:
    """The leaves before one."""
    return leaves[: [leaf.name for leaf in leaves].index(name)]


def _layout(bag: Bag, name: str, messages: Messages) -> tuple[Leaf, ...]:
    """The leaves of a topic's messages, which may begin with structures, as the dimensions of an array."""
    leaves = bag.layout(name)
    if leaves[0].kind != "none" or not len(messages):
        return leaves
    first, rows = leaves[0].name, np.zeros(1, np.intp)
    return bag.layout(name, {first: decode([Leaf(first, "u4")], messages.take(rows), [first])[first][0]})


def _decodable(leaves: tuple[Leaf, ...], messages: Messages, wanted: list[str]) -> NDArray[np.intp]:
    """Which messages can be decoded; the search ends when too many cannot."""
    waiting, sound, broken = [np.arange(len(messages))], list[NDArray[np.intp]](), 0
    while waiting:
        rows = waiting.pop()
        try:
            decode(leaves, messages.take(rows), wanted)
            sound.append(rows)
        except InputError:
            if len(rows) > 1:
                waiting += np.array_split(rows, 2)
            elif (broken := broken + 1) > max(1, WRONG * len(messages)):
                break
    return np.sort(np.concatenate([np.zeros(0, np.intp), *sound]))
