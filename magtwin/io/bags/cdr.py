"""CDR: ROS 2 messages to bytes and back, all messages of a topic at once.

A message type is written as the leaves of its tree in order, `f8[3] pose.position` for a Point: numpy's
codes for numbers, `time` for a stamp, `text` for a string, `[n]` for n of them, `[]` for a sequence. All
messages are read and written leaf by leaf, by whole arrays: where a leaf stands is an array too, so strings
and sequences may differ from message to message. Nothing is allocated that the bytes at hand do not fill.

Plain CDR, little endian, as rmw_fastrtps and rmw_cyclonedds write it: a header of four bytes, then each
number at a multiple of its size (OMG formal/2002-06-51, section 15.3).
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError

Bytes = NDArray[np.uint8]
Index = NDArray[np.int64]

HEADER = 4
"""Bytes before the first leaf, which tell the encoding."""

MOST_TEXTS = 4096
"""Most strings of a sequence that are read."""

MOST_PADDING = 64
"""Bytes that sequences of unequal length may be filled up to, for each byte of the messages."""

NS = 10**9
"""Nanoseconds in a second."""

_LEAF = re.compile(r"(f8|f4|i8|i4|u4|u2|u1|i1|time|text|none)(?:\[(\d*)\])? ([\w.]+)")


@dataclass(frozen=True)
class Leaf:
    """A number, a stamp or a string in a message, or some of them in a row."""

    name: str
    """Where it stands, such as `pose.position`."""

    kind: str
    """numpy's code of a number; `time`, int32 seconds and uint32 nanoseconds; `text`; `none`, a sequence of
    something that must be empty."""

    count: int | None = 1
    """How many in a row; none for a sequence, which tells it itself."""


@dataclass(frozen=True, eq=False)
class Messages:
    """Messages of a topic, as they lie in a buffer."""

    received: Index
    """When each was received [ns], shape (M,)."""

    buffer: Bytes
    """Bytes in which all of them lie, shape (B,)."""

    start: Index
    """Where each begins, shape (M,)."""

    size: Index
    """How many bytes each has, shape (M,)."""

    def __len__(self) -> int:
        return len(self.received)

    def in_order(self) -> "Messages":
        """The same messages as they were received."""
        if np.all(self.received[1:] >= self.received[:-1]):
            return self
        order = np.argsort(self.received, kind="stable")
        return Messages(self.received[order], self.buffer, self.start[order], self.size[order])


@lru_cache(maxsize=64)
def leaves(text: str) -> tuple[Leaf, ...]:
    """The leaves that a text names, `f8[3] pose.position, text frame_id`."""
    found = []
    for word in text.split(", "):
        match = _LEAF.fullmatch(word)
        if match is None:
            raise ValueError(f"no leaf: {word!r}")
        kind, count, name = match.groups()
        found.append(Leaf(name, kind, 1 if count is None else int(count) if count else None))
    return tuple(found)


def encode(form: Sequence[Leaf], fields: Mapping[str, Any], rows: int, *, room: int = 0) -> Bytes:
    """Messages of equal size, a row each, shape (rows, room + size).

    Args:
        form: Leaves of their type.
        fields: By name of the leaf what it holds: an array of `rows` rows or a single value for all; stamps
            as int64 [ns]; a string, or a sequence of them, for all. What is not named holds 0 or nothing.
        rows: How many.
        room: Bytes to leave free at the beginning of each row.
    """
    numbers: list[tuple[int, str, NDArray[Any]]] = []
    texts: list[tuple[int, bytes]] = []
    at = 0
    for leaf in form:
        value = fields.get(leaf.name)
        if leaf.kind == "none":
            at = _aligned(at, 4) + 4
            continue
        if leaf.kind == "text":
            words = ("" if value is None else value,) if leaf.count else tuple(value or ())
            if leaf.count is None:
                at = _aligned(at, 4)
                texts.append((at, np.uint32(len(words)).tobytes()))
                at += 4
            for word in words:
                encoded = word.encode() + b"\0"
                at = _aligned(at, 4)
                texts.append((at, np.uint32(len(encoded)).tobytes() + encoded))
                at += 4 + len(encoded)
            continue
        array = np.zeros((1, leaf.count or 0)) if value is None else np.asarray(value)
        count = leaf.count
        if count is None:
            count = array.shape[-1]
            at = _aligned(at, 4)
            texts.append((at, np.uint32(count).tobytes()))
            at += 4
            if not count:
                continue
        kind, size = ("u4", 4) if leaf.kind == "time" else (leaf.kind, np.dtype(leaf.kind).itemsize)
        if leaf.kind == "time":
            stamp = np.asarray(array, np.int64).reshape(-1)
            array, count = np.stack([stamp // NS, stamp % NS], axis=1), 2
        elif array.ndim < 2:
            array = array.reshape(-1, count) if count > 1 and array.size == count else array.reshape(-1, 1)
        at = _aligned(at, size)
        numbers.append((at, kind, array))
        at += size * count
    out = np.zeros((rows, room + HEADER + at), np.uint8)
    body = room + HEADER
    out[:, room + 1] = 1  # little endian
    for where, content in texts:
        out[:, body + where : body + where + len(content)] = np.frombuffer(content, np.uint8)
    for where, kind, array in numbers:
        dtype = np.dtype(kind).newbyteorder("<")
        shape = (rows, array.shape[1])
        if rows:
            np.ndarray(shape, dtype, out, body + where, (out.shape[1], dtype.itemsize))[...] = array
    return out


def decode(form: Sequence[Leaf], messages: Messages, wanted: Iterable[str]) -> dict[str, Any]:
    """What stands in some leaves of messages.

    Args:
        form: Leaves of their type.
        messages: The messages.
        wanted: Names of the leaves.

    Returns:
        By name: numbers of shape (M,), (M, n) for n in a row, of sequences filled up with nan; stamps as
        int64 [ns]; of a string a list of M, of a sequence of strings a list of M tuples.

    Raises:
        InputError: A message is too short for what it should hold, or is encoded otherwise.
    """
    left, found = set(wanted), {}
    body, room = messages.start + HEADER, messages.size - HEADER
    if len(room) and room.min() < 0:
        raise InputError("a message of less than 4 bytes")
    head = messages.buffer[messages.start + 1] if len(room) else np.ones(0)
    if np.any(head != 1) or np.any(messages.buffer[messages.start] != 0):
        raise InputError("messages are not plain little-endian CDR")
    at = np.zeros(len(messages), np.int64)
    for leaf in form:
        if not left:
            break
        if leaf.kind == "text":
            values, at = _texts(leaf, messages.buffer, body, room, at, leaf.name in left)
        elif leaf.kind == "none":
            count, at = _numbers("u4", 1, messages.buffer, body, room, at)
            if np.any(count):
                raise InputError(f"{leaf.name} is not empty")
            continue
        else:
            values, at = _leaf(leaf, messages.buffer, body, room, at, leaf.name in left)
        if leaf.name in left:
            found[leaf.name] = values
            left.discard(leaf.name)
    return found


def _aligned(at: Any, size: int) -> Any:
    return (at + size - 1) & -size


def _numbers(kind: str, count: int, buffer: Bytes, body: Index, room: Index, at: Index) -> tuple[Any, Index]:
    """`count` numbers of each message, shape (M, count), and where what follows them stands."""
    dtype = np.dtype(kind).newbyteorder("<")
    at = _aligned(at, dtype.itemsize)
    need = dtype.itemsize * count
    if np.any(at + need > room):
        raise InputError("a message ends before its last number")
    if not count or not len(at):
        return np.zeros((len(at), count), dtype), at
    windows = np.ndarray((len(buffer) - need + 1, count), dtype, buffer, 0, (1, dtype.itemsize))
    return windows[body + at], at + need


def _leaf(leaf: Leaf, buffer: Bytes, body: Index, room: Index, at: Index, wanted: bool) -> tuple[Any, Index]:
    """Numbers or stamps of a leaf, and where what follows them stands."""
    if leaf.kind == "time":
        parts, at = _numbers("u4", 2, buffer, body, room, at)
        return parts[:, 0].astype(np.int32).astype(np.int64) * NS + parts[:, 1], at
    if leaf.count is not None:
        values, at = _numbers(leaf.kind, leaf.count, buffer, body, room, at)
        return (values[:, 0] if leaf.count == 1 else values), at
    counts, at = _numbers("u4", 1, buffer, body, room, at)
    count, size = counts[:, 0].astype(np.int64), np.dtype(leaf.kind).itemsize
    begins = np.where(count > 0, _aligned(at, size), at)  # an empty sequence has no padding
    if np.any(begins + count * size > room):
        raise InputError(f"a message ends before the end of its {leaf.name}")
    if not wanted or not np.any(count):
        return np.zeros((len(count), 0)), begins + count * size
    most = int(count.max())
    if np.all(count == most):
        return _numbers(leaf.kind, most, buffer, body, room, at)
    if most * size * len(count) > MOST_PADDING * len(buffer):
        raise InputError(f"{leaf.name} is too unequally long")
    values = np.full((len(count), most), np.nan)
    for n in np.unique(count):
        rows = np.flatnonzero(count == n)
        values[rows, :n], _ = _numbers(leaf.kind, int(n), buffer, body[rows], room[rows], at[rows])
    return values, begins + count * size


def _texts(
    leaf: Leaf, buffer: Bytes, body: Index, room: Index, at: Index, wanted: bool
) -> tuple[list[Any], Index]:
    """Strings of a leaf, where they are wanted, and where what follows them stands."""
    if leaf.count:
        begins, at = _text(leaf, buffer, body, room, at)
        return _said(buffer, body + begins, body + at) if wanted else [], at
    counts, at = _numbers("u4", 1, buffer, body, room, at)
    count = counts[:, 0].astype(np.int64)
    most = int(count.max(initial=0))
    if most > MOST_TEXTS or np.any(count * 4 > room):
        raise InputError(f"{leaf.name} of a message has {most} strings")
    words: list[list[str]] = [[] for _ in count]
    for k in range(most):
        rows = np.flatnonzero(count > k)
        begins, after = _text(leaf, buffer, body[rows], room[rows], at[rows])
        if wanted:
            for row, word in zip(rows, _said(buffer, body[rows] + begins, body[rows] + after), strict=True):
                words[row].append(word)
        at = at.copy()
        at[rows] = after
    return [tuple(w) for w in words], at


def _text(leaf: Leaf, buffer: Bytes, body: Index, room: Index, at: Index) -> tuple[Index, Index]:
    """Where a string begins, and where what follows it stands."""
    lengths, at = _numbers("u4", 1, buffer, body, room, at)
    after = at + lengths[:, 0].astype(np.int64)
    if np.any(after > room):
        raise InputError(f"a message ends within its {leaf.name}")
    return at, after


def _said(buffer: Bytes, first: Index, last: Index) -> list[str]:
    """Strings between positions; equal ones are decoded once."""
    known: dict[bytes, str] = {}
    said = []
    for a, b in zip(first.tolist(), last.tolist(), strict=True):
        raw = buffer[a:b].tobytes()
        if raw not in known:
            known[raw] = raw.rstrip(b"\0").decode(errors="replace")
        said.append(known[raw])
    return said
