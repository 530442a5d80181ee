"""MCAP: the storage of rosbag2 that Foxglove made, written and read by whole arrays.

A file is records one after the other: opcode, length, content. Messages lie in chunks, compressed, each
followed by an index of its messages by channel; a summary at the end says where all of it is. What a chunk
holds is readable without the summary, so a file that was cut short is, up to its last whole chunk.
Specification: https://mcap.dev/spec.
"""

import struct
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import pyarrow as pa

from magtwin.errors import InputError
from magtwin.io.bags.bag import ROOM, Batch, Connection, Heard, in_time
from magtwin.io.bags.cdr import Bytes, Index, Messages

MAGIC = b"\x89MCAP0\r\n"

CHUNK = 1 << 20
"""Bytes of a chunk before compression, about."""

LARGEST_CHUNK = 1 << 30
"""Bytes of the largest chunk that is read."""

MOST_RATIO = 1000
"""Most bytes that a chunk may hold for each one that it has in the file, beside those of `SPARE`."""

SPARE = 1 << 26
"""Bytes that all chunks of a file together may hold beyond `MOST_RATIO`: blank images shrink to nothing."""

LEVEL = 1
"""Of zstd's compression."""

_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _INDEX, _CHUNK_INDEX = range(1, 9)
_STATISTICS, _METADATA, _METADATA_INDEX, _SUMMARY_OFFSET, _DATA_END = range(0x0B, 0x10)
_HEAD = struct.Struct("<BQ")


def _text(word: str) -> bytes:
    raw = word.encode()
    return struct.pack("<I", len(raw)) + raw


def _map(entries: Mapping[str, str]) -> bytes:
    raw = b"".join(_text(key) + _text(value) for key, value in entries.items())
    return struct.pack("<I", len(raw)) + raw


def _record(opcode: int, content: bytes) -> bytes:
    return _HEAD.pack(opcode, len(content)) + content


class McapWriter:
    """An MCAP file that grows; whatever has been flushed stays readable."""

    def __init__(self, path: Path, library: str) -> None:
        self._file: BinaryIO = open(path, "xb")  # noqa: SIM115
        self._put(MAGIC + _record(_HEADER, _text("ros2") + _text(library)))
        self._schemas: dict[str, bytes] = {}
        self._channels: dict[int, bytes] = {}
        self._pending = b""  # schemas and channels that the next chunk tells of
        self._chunks: list[bytes] = []
        self._metadata: list[bytes] = []
        self._counts: dict[int, int] = {}
        self._span = (2**63 - 1, 0)

    def add(self, connections: Iterable[Connection]) -> None:
        """Tell of topics."""
        for c in connections:
            if c.kind not in self._schemas:
                schema = struct.pack("<H", len(self._schemas) + 1)
                schema += _text(c.kind) + _text("ros2msg") + _text(c.definition)
                self._schemas[c.kind] = _record(_SCHEMA, schema)
                self._pending += self._schemas[c.kind]
            number = list(self._schemas).index(c.kind) + 1
            about = {"offered_qos_profiles": c.offered, "topic_type_hash": c.digest}
            channel = struct.pack("<HH", c.id, number) + _text(c.topic) + _text("cdr")
            self._channels[c.id] = _record(_CHANNEL, channel + _map(about))
            self._pending += self._channels[c.id]
            self._counts[c.id] = 0

    def note(self, name: str, entries: Mapping[str, str]) -> None:
        """Write a record of metadata."""
        record = _record(_METADATA, _text(name) + _map(entries))
        self._metadata.append(struct.pack("<QQ", self._file.tell(), len(record)) + _text(name))
        self._put(record)

    def write(self, batches: Sequence[Batch]) -> None:
        """Write messages, in the order of their times."""
        codec = pa.Codec("zstd", compression_level=LEVEL)
        with ThreadPoolExecutor(2) as pool:
            chunks = pool.map(lambda chunk: (chunk, *_compressed(chunk.content, codec)), self._cut(batches))
            for chunk, raw, crc in chunks:
                self._put_chunk(chunk, raw, crc)

    def flush(self) -> None:
        """Hand everything to the system: it outlives this process."""
        self._file.flush()

    def close(self) -> None:
        """Write the summary; the file is whole then."""
        self._put(self._pending)  # topics without a message: the summary may only repeat the data section
        self._put(_record(_DATA_END, struct.pack("<I", 0)))
        start = self._file.tell()
        first, last = self._span if any(self._counts.values()) else (0, 0)
        counts = b"".join(struct.pack("<HQ", *item) for item in self._counts.items())
        statistics = struct.pack(
            "<QHIIIIQQI",
            *(sum(self._counts.values()), len(self._schemas), len(self._channels), 0),
            *(len(self._metadata), len(self._chunks), first, last, len(counts)),
        )
        groups: list[tuple[int, list[bytes]]] = [
            (_SCHEMA, list(self._schemas.values())),
            (_CHANNEL, list(self._channels.values())),
            (_CHUNK_INDEX, [_record(_CHUNK_INDEX, c) for c in self._chunks]),
            (_METADATA_INDEX, [_record(_METADATA_INDEX, m) for m in self._metadata]),
            (_STATISTICS, [_record(_STATISTICS, statistics + counts)]),
        ]
        offsets = b""
        for opcode, records in groups:
            if records:
                place = struct.pack("<BQQ", opcode, self._file.tell(), sum(map(len, records)))
                offsets += _record(_SUMMARY_OFFSET, place)
                self._put(b"".join(records))
        offsets_start = self._file.tell()
        self._put(offsets + _record(_FOOTER, struct.pack("<QQI", start, offsets_start, 0)) + MAGIC)
        self._file.close()

    def abort(self) -> None:
        """Leave the file as it is."""
        self._file.close()

    def _put(self, raw: Any) -> None:
        self._file.write(raw)

    def _cut(self, batches: Sequence[Batch]) -> Iterator["_Chunk"]:
        """Messages in chunks, in the order of their times."""
        batches = [batch for batch in batches if len(batch.received)]
        for batch in batches:
            _fill_heads(batch)
        times, which = in_time(batches)
        sizes = np.array([b.rows.shape[1] for b in batches], np.int64)[which]
        ends = np.cumsum(sizes)
        done = [0] * len(batches)
        first = 0
        while first < len(times):
            before = int(ends[first - 1]) if first else 0
            last = max(first + 1, int(np.searchsorted(ends, before + CHUNK, side="right")))
            pending, self._pending = self._pending, b""
            content = np.empty(len(pending) + int(ends[last - 1]) - before, np.uint8)
            content[: len(pending)] = np.frombuffer(pending, np.uint8)
            offsets = ends[first:last] - sizes[first:last] - before + len(pending)
            parts: dict[int, list[Any]] = {}
            for k, batch in enumerate(batches):
                mine = offsets[which[first:last] == k]
                if len(mine):
                    rows = batch.rows[done[k] : done[k] + len(mine)]
                    _scatter(rows, content, mine)
                    stamps = batch.received[done[k] : done[k] + len(mine)]
                    parts.setdefault(batch.connection.id, []).append(np.stack([stamps, mine], axis=1))
                    done[k] += len(mine)
            index = {channel: _sorted(np.concatenate(part).astype("<u8")) for channel, part in parts.items()}
            yield _Chunk(int(times[first]), int(times[last - 1]), content, index)
            first = last

    def _put_chunk(self, chunk: "_Chunk", raw: Any, crc: int) -> None:
        begin = self._file.tell()
        head = struct.pack("<QQQI", chunk.first, chunk.last, len(chunk.content), crc)
        head += _text("zstd") + struct.pack("<Q", len(raw))
        self._put(_HEAD.pack(_CHUNK, len(head) + len(raw)) + head)
        self._put(raw)
        length = self._file.tell() - begin
        places, index = b"", b""
        for channel, entries in chunk.places.items():
            places += struct.pack("<HQ", channel, begin + length + len(index))
            index += _record(_INDEX, struct.pack("<HI", channel, entries.nbytes) + entries.tobytes())
            self._counts[channel] += len(entries)
        self._put(index)
        self._span = (min(self._span[0], chunk.first), max(self._span[1], chunk.last))
        self._chunks.append(
            struct.pack("<QQQQI", chunk.first, chunk.last, begin, length, len(places))
            + places
            + struct.pack("<Q", len(index))
            + _text("zstd")
            + struct.pack("<QQ", len(raw), len(chunk.content))
        )


class _Chunk(NamedTuple):
    """Messages that are compressed together."""

    first: int
    last: int
    content: Bytes
    places: dict[int, Any]
    """By channel: time and place of each message, shape (M, 2)."""


def _compressed(content: Bytes, codec: Any) -> tuple[Any, int]:
    return codec.compress(content), zlib.crc32(content.data)


def _fill_heads(batch: Batch) -> None:
    """Make each row a record: opcode, length, channel, sequence, and the time twice."""
    count, width = batch.rows.shape
    heads = np.zeros(
        count,
        np.dtype({"names": list("olcstp"), "formats": ["u1", "<u8", "<u2", "<u4", "<u8", "<u8"]}),
    )
    heads["o"], heads["l"], heads["c"] = _MESSAGE, width - 9, batch.connection.id
    heads["t"] = heads["p"] = batch.received
    batch.rows[:, :ROOM] = heads.view(np.uint8).reshape(count, ROOM)


def _sorted(entries: Any) -> Any:
    """Entries of a message index, (time, offset), in the order of their offsets."""
    return entries[np.argsort(entries[:, 1], kind="stable")]


def _scatter(rows: Bytes, out: Bytes, at: Index) -> None:
    """Put each row of (M, S) where it is to stand in `out`."""
    size = rows.shape[1]
    places = np.ndarray((len(out) - size + 1,), f"V{size}", out, 0, (1,))
    places[at] = rows.view(f"V{size}")[:, 0]


class McapReader:
    """An MCAP file: its topics, its metadata, and its messages on demand.

    Attributes:
        topics: Its channels.
        notes: Records of metadata by name; of several of one name the last.
        whole: Whether it has its end.
        unindexed: How many messages read so far are in a chunk and not in its index, by channel.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: BinaryIO = open(path, "rb")  # noqa: SIM115
        self._size = path.stat().st_size
        self.notes: dict[str, dict[str, str]] = {}
        self.whole = False
        self.unindexed: dict[int, int] = {}
        self._spare = SPARE
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, tuple[int, str, str]] = {}
        self._chunks: list[tuple[int, int, dict[int, Any]]] = []
        self._loose: dict[int, list[tuple[int, int, int]]] = {}
        try:
            if self._file.read(len(MAGIC)) != MAGIC:
                raise InputError("it does not begin as MCAP does")
            self._scan()
            if self._chunks and not self.whole:
                self._chunks[-1][2].clear()  # its index may lack what was not written any more
            if self._chunks and not (self.whole and self._channels):
                self._learn()
        except BaseException:
            self.close()
            raise
        self.topics = [
            Heard(number, topic, self._schemas.get(schema, ""), encoding)
            for number, (schema, topic, encoding) in self._channels.items()
        ]

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def messages(self, ids: Collection[int]) -> dict[int, Messages]:
        """The messages of some topics, as they were received."""
        parts: dict[int, list[tuple[Index, Index, Index]]] = {number: [] for number in ids}
        buffers: list[Bytes] = []
        base, self._spare = 0, SPARE
        self.unindexed |= dict.fromkeys(ids, 0)
        for number, loose in self._loose.items():
            if number in parts:
                received, starts, sizes = (np.array(a, np.int64) for a in zip(*loose, strict=True))
                raw = b"".join(self._at(int(a), int(n)) for a, n in zip(starts, sizes, strict=True))
                parts[number].append((received, base + np.cumsum(sizes) - sizes, sizes))
                buffers.append(np.frombuffer(raw, np.uint8))
                base += len(raw)
        for place, length, index in self._chunks:
            if index and parts.keys().isdisjoint(index):
                continue
            content = self._content(place, length)
            if content is None:
                continue
            if index:
                found_here, lacking = _indexed(content, index, parts, self._tell)
                for number, count in lacking.items():
                    self.unindexed[number] += count
            else:
                found_here = _walked(content, parts, self._tell)
            for number, (received, start, size) in found_here.items():
                parts[number].append((received, base + start, size))
            if found_here:
                buffers.append(content)
                base += len(content)
        buffer = np.concatenate(buffers) if buffers else np.zeros(0, np.uint8)
        none = np.zeros(0, np.int64)
        joined = {}
        for number, found in parts.items():
            columns = [np.concatenate(c) for c in zip(*found, strict=True)] if found else [none] * 3
            joined[number] = Messages(columns[0], buffer, columns[1], columns[2]).in_order()
        return joined

    def _at(self, place: int, length: int) -> bytes:
        self._file.seek(place)
        return self._file.read(length)

    def _scan(self) -> None:
        """Go from record to record, over what chunks hold."""
        at = len(MAGIC)
        while at + _HEAD.size <= self._size:
            self._file.seek(at)
            opcode, length = _HEAD.unpack(self._file.read(_HEAD.size))
            body = at + _HEAD.size
            if body + length > self._size:
                return
            if opcode == _CHUNK:
                self._chunks.append((body, length, {}))
            elif opcode == _MESSAGE and length >= ROOM - _HEAD.size:
                channel, _, received = struct.unpack("<HIQ", self._file.read(14))
                head = ROOM - _HEAD.size
                self._loose.setdefault(channel, []).append((received, body + head, length - head))
            elif opcode == _INDEX and self._chunks and length >= 6:
                content = self._file.read(length)
                count = struct.unpack_from("<I", content, 2)[0] // 16
                if 6 + 16 * count == length:
                    entries = np.frombuffer(content, "<u8", 2 * count, 6).reshape(-1, 2)
                    index, channel = self._chunks[-1][2], struct.unpack_from("<H", content)[0]
                    index[channel] = (
                        np.concatenate([index[channel], entries]) if channel in index else entries
                    )
            elif opcode in (_SCHEMA, _CHANNEL, _METADATA):
                self._tell(opcode, self._file.read(length))
            elif opcode == _FOOTER:
                self._file.seek(body + length)
                self.whole = self._file.read(len(MAGIC)) == MAGIC
                return
            at = body + length

    def _tell(self, opcode: int, content: bytes) -> None:
        """Learn from a record what schemas, channels and metadata there are."""
        words = _Words(content)
        if opcode == _SCHEMA:
            number = words.number("<H")
            self._schemas[number] = words.text()
        elif opcode == _CHANNEL:
            number, schema = words.number("<H"), words.number("<H")
            self._channels[number] = (schema, words.text(), words.text())
        elif opcode == _METADATA:
            name = words.text()
            self.notes[name] = words.entries()

    def _learn(self) -> None:
        """Learn of channels from the chunks themselves, where no summary tells."""
        for place, length, _ in self._chunks:
            content = self._content(place, length)
            if content is not None:
                _walked(content, (), self._tell)

    def _content(self, place: int, length: int) -> Bytes | None:
        """What a chunk holds; none of the last one of a file that was cut short, if it is damaged."""
        words = _Words(self._at(place, length))
        words.number("<QQ")
        size, crc, codec, stored = words.number("<Q"), words.number("<I"), words.text(), words.number("<Q")
        raw = words.rest()
        most = min(LARGEST_CHUNK, self._spare + MOST_RATIO * len(raw))
        if stored != len(raw) or size > most or codec not in ("", "zstd", "lz4"):
            raise InputError(
                f"a chunk of {size} bytes, {codec[:8] or 'not'} compressed to {stored}, cannot be"
            )
        self._spare -= max(0, size - MOST_RATIO * len(raw))
        try:
            content = pa.Codec(codec).decompress(raw, size) if codec else raw
        except (pa.ArrowException, OSError, ValueError) as error:
            raise InputError(f"a damaged chunk ({str(error).splitlines()[0]})") from error
        array = np.frombuffer(content, np.uint8)
        if len(array) != size or (crc and zlib.crc32(array.data) != crc):
            raise InputError("a damaged chunk (its checksum is another)")
        return array


class _Words:
    """The words of a record, read one after the other and never past its end."""

    def __init__(self, content: bytes) -> None:
        self._content, self._at = content, 0

    def number(self, form: str) -> Any:
        """A number, or the last of several."""
        size = struct.calcsize(form)
        return struct.unpack(form, self._take(size))[-1]

    def text(self) -> str:
        """A string."""
        return self._take(self.number("<I")).decode(errors="replace")

    def entries(self) -> dict[str, str]:
        """A map."""
        inner = _Words(self._take(self.number("<I")))
        found = {}
        while inner._at < len(inner._content):
            key = inner.text()
            found[key] = inner.text()
        return found

    def rest(self) -> bytes:
        """All that is left."""
        return self._take(len(self._content) - self._at)

    def _take(self, size: int) -> bytes:
        if self._at + size > len(self._content):
            raise InputError("a record ends within its content")
        self._at += size
        return self._content[self._at - size : self._at]


Found = dict[int, tuple[Index, Index, Index]]
"""By channel: times [ns], places and sizes of messages, each of shape (M,)."""


def _indexed(
    content: Bytes, index: Mapping[int, Any], wanted: Collection[int], tell: Any
) -> tuple[Found, dict[int, int]]:
    """Messages of wanted channels by the chunk's index, and how many the index lacks by channel.

    Bytes of the chunk that no entry of the index covers are read record by record, so a message that the
    index lacks is read too.
    """
    found: Found = {}
    begins, ends = [np.array([len(content)])], [np.zeros(1, np.int64)]
    for channel, entries in index.items():
        if not len(entries):
            continue
        if int(entries[:, 1].max()) + ROOM > len(content):
            raise InputError("the index of a chunk points outside of it")
        at = np.unique(entries[:, 1]).astype(np.int64)
        lengths = _look("<u8", content, at + 1)
        right = (content[at] == _MESSAGE) & (_look("<u2", content, at + 9) == channel)
        if not right.all() or np.any(lengths < ROOM - 9) or np.any(lengths > len(content)):
            raise InputError("the index of a chunk points at what is no message")
        sizes = lengths.astype(np.int64) - (ROOM - 9)
        if np.any(at + ROOM + sizes > len(content)):
            raise InputError("a message ends outside of its chunk")
        begins.append(at)
        ends.append(at + ROOM + sizes)
        if channel in wanted:
            found[channel] = (_look("<u8", content, at + 15).astype(np.int64), at + ROOM, sizes)
    begin = np.concatenate(begins)
    order = np.argsort(begin)
    after, before = begin[order], np.concatenate([[0], np.concatenate(ends)[order][:-1]])
    if np.any(before > after):
        raise InputError("the index of a chunk points at messages that overlap")
    lacking: dict[int, int] = {}
    for gap in np.flatnonzero(before < after):
        first = int(before[gap])
        for channel, columns in _walked(content[first : int(after[gap])], wanted, tell).items():
            more = (columns[0], columns[1] + first, columns[2])
            lacking[channel] = lacking.get(channel, 0) + len(more[0])
            known = found.get(channel, (np.zeros(0, np.int64),) * 3)
            received, start, size = (np.concatenate(pair) for pair in zip(known, more, strict=True))
            rank = np.argsort(start)
            found[channel] = (received[rank], start[rank], size[rank])
    return found, lacking


def _look(kind: str, content: Bytes, at: Index) -> Any:
    size = np.dtype(kind).itemsize
    return np.ndarray((len(content) - size + 1,), kind, content, 0, (1,))[at]


def _walked(content: Bytes, wanted: Collection[int], tell: Any) -> Found:
    """Messages of wanted channels by going from record to record; schemas and channels are told."""
    found: dict[int, list[tuple[int, int, int]]] = {}
    raw, at, size = content.data, 0, len(content)
    message = struct.Struct("<HIQ")
    while at + _HEAD.size <= size:
        opcode, length = _HEAD.unpack_from(raw, at)
        body = at + _HEAD.size
        if body + length > size:
            raise InputError("a record ends outside of its chunk")
        if opcode == _MESSAGE and length >= ROOM - _HEAD.size:
            channel, _, received = message.unpack_from(raw, body)
            if channel in wanted:
                found.setdefault(channel, []).append((received, at + ROOM, length - (ROOM - _HEAD.size)))
        elif opcode in (_SCHEMA, _CHANNEL):
            tell(opcode, bytes(raw[body : body + length]))
        at = body + length
    return {
        channel: tuple(np.array(a, np.int64) for a in zip(*rows, strict=True))  # type: ignore[misc]
        for channel, rows in found.items()
    }
