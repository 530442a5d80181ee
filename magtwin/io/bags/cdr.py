"""CDR: ROS 2 messages to bytes and back, all messages of a topic at once.

A message type is the sequence of leaves of its tree, see `magtwin.io.bags.types.layout`. A leaf is read or
written for all messages in one array operation. The offset of a leaf is an array too, so strings and
sequences may differ in length between messages. No more memory is allocated than the bytes of the messages
can fill.

The encoding is plain CDR, little endian, as rmw_fastrtps and rmw_cyclonedds write it: a header of four bytes,
then each number at a multiple of its size (OMG formal/2002-06-51, section 15.3).
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError

Bytes = NDArray[np.uint8]
Index = NDArray[np.int64]

HEADER = 4  # Bytes of the encapsulation header before the first leaf
MOST_TEXTS = 4096  # Largest number of strings in a sequence
MOST_PADDING = 64  # Largest array for sequences of unequal length, in bytes for each byte of the messages
NS = 10**9  # Nanoseconds in a second


@dataclass(frozen=True)
class Leaf:
    """A number, stamp or string of a message, or several of them in a row."""

    name: str  # Path in the message, such as `pose.position`
    # numpy code of a number; `time` for int32 seconds and uint32 nanoseconds; `text`; or `none` for a
    # sequence that must be empty
    kind: str
    count: int | None = 1  # How many in a row. None: a sequence, whose length stands in the message.


@dataclass(frozen=True, eq=False)
class Messages:
    """Messages of a topic in one buffer."""

    received: Index  # Time of receipt of each [ns], shape (M,)
    buffer: Bytes  # Bytes that hold all of them, shape (B,)
    start: Index  # Offset of each in the buffer, shape (M,)
    size: Index  # Bytes of each, shape (M,)
    packed: bool = False  # Whether they are of ROS 1: without a header of four bytes and without padding

    @classmethod
    def of(cls, received: Any, sizes: Any, content: bytes | bytearray, *, packed: bool = False) -> "Messages":
        """Messages whose bytes follow each other, sorted by time of receipt."""
        size, moments = np.array(sizes, np.int64), np.array(received, np.int64)
        start = np.cumsum(size) - size
        return cls(moments, np.frombuffer(content, np.uint8), start, size, packed).in_order()

    def __len__(self) -> int:
        return len(self.received)

    def in_order(self) -> "Messages":
        """The messages sorted by time of receipt."""
        if np.all(self.received[1:] >= self.received[:-1]):
            return self
        return self.take(np.argsort(self.received, kind="stable"))

    def take(self, rows: NDArray[np.intp]) -> "Messages":
        """Some of the messages, by index."""
        return replace(self, received=self.received[rows], start=self.start[rows], size=self.size[rows])


def encode(leaves: Sequence[Leaf], fields: Mapping[str, Any], rows: int, *, room: int = 0) -> Bytes:
    """Messages of equal size, one per row, shape (rows, room + size); `room` bytes of each are left free.

    `fields` are values by leaf name: an array of `rows` rows, or one value for all rows; stamps as int64
    [ns]; a string or a sequence of strings for all rows. Default: zero or empty.
    """
    numbers: list[tuple[int, str, NDArray[Any]]] = []
    texts: list[tuple[int, bytes]] = []
    at = 0

    def put(length: int, content: bytes = b"") -> None:
        nonlocal at
        texts.append((_aligned(at, 4), np.uint32(length).tobytes() + content))
        at = _aligned(at, 4) + 4 + len(content)

    for leaf in leaves:
        value = fields.get(leaf.name)
        if leaf.kind == "none":
            put(0)
            continue
        if leaf.kind == "text":
            words = ("" if value is None else value,) if leaf.count else tuple(value or ())
            if leaf.count is None:
                put(len(words))
            for encoded in (word.encode() + b"\0" for word in words):
                put(len(encoded), encoded)
            continue
        array = np.zeros((1, leaf.count or 0)) if value is None else np.asarray(value)
        count = leaf.count
        if count is None:
            count = array.shape[-1]
            put(count)
            if not count:
                continue
        kind, size = ("u4", 4) if leaf.kind == "time" else (leaf.kind, np.dtype(leaf.kind).itemsize)
        if leaf.kind == "time":
            stamp = np.asarray(array, np.int64).reshape(-1)
            array, count = np.stack([stamp // NS, stamp % NS], axis=1), 2
        elif array.ndim < 2:
            array = array.reshape(-1, count) if count > 1 and array.size == count else array.reshape(-1, 1)
        if array.shape[1] != count:
            raise ValueError(f"{leaf.name} has {count} numbers, not {array.shape[1]}")
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


def decode(leaves: Sequence[Leaf], messages: Messages, wanted: Iterable[str]) -> dict[str, Any]:
    """Values of the `wanted` leaves of messages, by name.

    Numbers have the shape (M,), or (M, n) for n in a row; sequences are padded with nan; stamps are int64
    [ns]; strings a list of M, and sequences of strings of M tuples. A message that is too short for its type,
    or has another encoding, is refused.
    """
    left, values_of = set(wanted), dict[str, Any]()
    head = 0 if messages.packed else HEADER
    raw = _Raw(messages.buffer, messages.start + head, messages.size - head, messages.packed)
    if np.any(raw.room < 0):
        raise InputError("a message of less than 4 bytes")
    first = messages.start
    if head and (np.any(messages.buffer[first + 1] != 1) or np.any(messages.buffer[first] != 0)):
        raise InputError("messages are not plain little-endian CDR")
    at = np.zeros(len(messages), np.int64)
    for leaf in leaves:
        if not left:
            break
        if leaf.kind == "text":
            values, at = _texts(leaf, raw, at, leaf.name in left)
        elif leaf.kind == "none":
            count, at = _numbers("u4", 1, raw, at)
            if np.any(count):
                raise InputError(f"sequence {leaf.name} is not empty, which is not supported")
            continue
        else:
            values, at = _leaf(leaf, raw, at, leaf.name in left)
        if leaf.name in left:
            values_of[leaf.name] = values
            left.discard(leaf.name)
    return values_of


class _Raw(NamedTuple):
    """Bytes of messages, without their headers."""

    buffer: Bytes
    body: Index  # Offset of the first leaf of each message
    room: Index  # Bytes of each from there on
    packed: bool

    def aligned(self, at: Any, size: int) -> Any:
        """Offsets from which a number of a size is stored."""
        return at if self.packed else _aligned(at, size)

    def rows(self, rows: NDArray[np.intp]) -> "_Raw":
        """Some of the messages."""
        return self._replace(body=self.body[rows], room=self.room[rows])


def _aligned(at: Any, size: int) -> Any:
    return (at + size - 1) & -size


def _numbers(kind: str, count: int, raw: _Raw, at: Index) -> tuple[Any, Index]:
    """`count` numbers of each message, shape (M, count), and the offset behind them."""
    dtype = np.dtype(kind).newbyteorder("<")
    at = raw.aligned(at, dtype.itemsize)
    need = dtype.itemsize * count
    if np.any(at + need > raw.room):
        raise InputError("a message ends before its last number")
    if not count or not len(at):
        return np.zeros((len(at), count), dtype), at
    shape = (len(raw.buffer) - need + 1, count)
    return np.ndarray(shape, dtype, raw.buffer, 0, (1, dtype.itemsize))[raw.body + at], at + need


def _leaf(leaf: Leaf, raw: _Raw, at: Index, wanted: bool) -> tuple[Any, Index]:
    """Numbers or stamps of a leaf, and the offset behind them."""
    if leaf.kind == "time":
        parts, at = _numbers("u4", 2, raw, at)
        return parts[:, 0].astype(np.int32).astype(np.int64) * NS + parts[:, 1], at
    if leaf.count is not None:
        values, at = _numbers(leaf.kind, leaf.count, raw, at)
        return (values[:, 0] if leaf.count == 1 else values), at
    counts, at = _numbers("u4", 1, raw, at)
    count, size = counts[:, 0].astype(np.int64), np.dtype(leaf.kind).itemsize
    begins = np.where(count > 0, raw.aligned(at, size), at)  # an empty sequence has no padding
    if np.any(begins + count * size > raw.room):
        raise InputError(f"a message ends before the end of its {leaf.name}")
    if not wanted or not np.any(count):
        return np.zeros((len(count), 0)), begins + count * size
    most = int(count.max())
    if np.all(count == most):
        return _numbers(leaf.kind, most, raw, at)
    if most * size * len(count) > MOST_PADDING * len(raw.buffer):
        raise InputError(f"lengths of {leaf.name} differ too much between messages")
    values = np.full((len(count), most), np.nan)
    for n in np.unique(count):
        rows = np.flatnonzero(count == n)
        values[rows, :n], _ = _numbers(leaf.kind, int(n), raw.rows(rows), at[rows])
    return values, begins + count * size


def _texts(leaf: Leaf, raw: _Raw, at: Index, wanted: bool) -> tuple[list[Any], Index]:
    """Strings of a leaf if wanted, and the offset behind them."""
    if leaf.count:
        begins, at = _text(leaf, raw, at)
        return _strings(raw.buffer, raw.body + begins, raw.body + at) if wanted else [], at
    counts, at = _numbers("u4", 1, raw, at)
    count = counts[:, 0].astype(np.int64)
    most = int(count.max(initial=0))
    if most > MOST_TEXTS or np.any(count * 4 > raw.room):
        raise InputError(f"{leaf.name} of a message has {most} strings")
    words: list[list[str]] = [[] for _ in count]
    for k in range(most):
        rows = np.flatnonzero(count > k)
        some = raw.rows(rows)
        begins, after = _text(leaf, some, at[rows])
        if wanted:
            found = _strings(raw.buffer, some.body + begins, some.body + after)
            for row, word in zip(rows, found, strict=True):
                words[row].append(word)
        at = at.copy()
        at[rows] = after
    return [tuple(w) for w in words], at


def _text(leaf: Leaf, raw: _Raw, at: Index) -> tuple[Index, Index]:
    """Offsets of a string and of the byte behind it."""
    lengths, at = _numbers("u4", 1, raw, at)
    after = at + lengths[:, 0].astype(np.int64)
    if np.any(after > raw.room):
        raise InputError(f"a message ends within its {leaf.name}")
    return at, after


def _strings(buffer: Bytes, first: Index, last: Index) -> list[str]:
    """Strings between offsets; equal ones are decoded once."""
    known: dict[bytes, str] = {}
    strings = []
    for a, b in zip(first.tolist(), last.tolist(), strict=True):
        raw = buffer[a:b].tobytes()
        if raw not in known:
            known[raw] = raw.rstrip(b"\0").decode(errors="replace")
        strings.append(known[raw])
    return strings
