"""MCAP: the default storage of rosbag2, written and read in whole arrays.

A file is a sequence of records: opcode, length, content. Messages lie in compressed chunks, each followed by
an index of its messages by channel. A summary at the end locates all of it. Chunks are read without their
index and without the summary, so a truncated file is readable up to its last whole chunk.
Specification: https://mcap.dev/spec. Small records are those of the library `mcap`, whose own writer takes
one message at a time and is ten times as slow.
"""

import struct
import zlib
from array import array
from collections.abc import Collection, Iterator, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
from mcap import records
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.files.budget import BUDGETS, check_decoded
from magtwin.io.bags.cdr import Bytes, Index, Messages
from magtwin.io.bags.storage import ROOM, Batch, Connection, StoredTopic, in_time

MAGIC = b"\x89MCAP0\r\n"

CHUNK = 1 << 20  # Approximate bytes of a chunk before compression
LARGEST_CHUNK = BUDGETS["bag"].count  # Largest chunk that is read [bytes]
MOST_RATIO = 1000  # Largest compression ratio that is accepted, beyond `SPARE`
SPARE = 1 << 26  # Bytes that chunks may hold beyond `MOST_RATIO`: blank images compress to almost none
LEVEL = 1  # Compression level of zstd
FOOTER = 29  # Bytes of the record that ends a file
PRIVATE = 0x80  # Opcodes from which a record is of no concern
_DAMAGED = (ValueError, struct.error, McapError, IndexError, OverflowError)  # Raised for damaged records

_HEAD = struct.Struct("<BQ")
_RECORD = struct.Struct("<BQH")  # Opcode and length of a record, and the channel of a message


def _bytes(record: records.McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


class McapWriter:
    """An MCAP file that grows; whatever was flushed stays readable."""

    def __init__(self, path: Path, library: str) -> None:
        self._file: BinaryIO = open(path, "xb")  # noqa: SIM115
        self._file.write(MAGIC + _bytes(records.Header("ros2", library)))
        self._schemas: dict[str, records.Schema] = {}
        self._channels: list[records.Channel] = []
        self._pending = b""  # schemas and channels that the next chunk begins with
        self._chunks: list[records.ChunkIndex] = []
        self._metadata: list[records.MetadataIndex] = []
        self.counts: dict[int, int] = {}  # Messages by connection
        self.first, self.last = 2**63 - 1, 0  # Times of the first and the last message [ns]

    def add(self, connection: Connection) -> None:
        """Register a topic, before its first message."""
        kind = connection.kind
        if kind not in self._schemas:
            definition = connection.definition.encode()
            self._schemas[kind] = records.Schema(len(self._schemas) + 1, definition, "ros2msg", kind)
            self._pending += _bytes(self._schemas[kind])
        about = {"offered_qos_profiles": connection.offered_qos, "topic_type_hash": connection.digest}
        schema = self._schemas[kind].id
        self._channels.append(records.Channel(connection.id, connection.topic, "cdr", about, schema))
        self._pending += _bytes(self._channels[-1])
        self.counts[connection.id] = 0

    def note(self, name: str, entries: Mapping[str, str]) -> None:
        """Write a metadata record."""
        record = _bytes(records.Metadata(name, dict(entries)))
        self._metadata.append(records.MetadataIndex(self._file.tell(), len(record), name))
        self._file.write(record)

    def write(self, batches: Sequence[Batch]) -> None:
        """Write messages in the order of their times."""
        codec = pa.Codec("zstd", compression_level=LEVEL)
        for times, content, index in self._cut([batch for batch in batches if len(batch.received)]):
            raw = codec.compress(content, asbytes=True)
            self._put_chunk(int(times[0]), int(times[-1]), content, raw, index)

    def flush(self) -> None:
        """Hand everything to the operating system, so that it outlives this process."""
        self._file.flush()

    def close(self) -> None:
        """Write the summary, which completes the file."""
        self._file.write(self._pending)  # topics without a message: the summary may only repeat the data
        self._file.write(_bytes(records.DataEnd(0)))
        start, count = self._file.tell(), sum(self.counts.values())
        statistics = records.Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=self.counts,
            chunk_count=len(self._chunks),
            message_count=count,
            message_start_time=self.first if count else 0,
            message_end_time=self.last if count else 0,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        groups: list[tuple[Opcode, Sequence[records.McapRecord]]] = [
            (Opcode.SCHEMA, list(self._schemas.values())),
            (Opcode.CHANNEL, self._channels),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.METADATA_INDEX, self._metadata),
            (Opcode.STATISTICS, [statistics]),
        ]
        offsets = b""
        for opcode, group in groups:
            content = b"".join(map(_bytes, group))
            if content:
                offsets += _bytes(records.SummaryOffset(opcode, self._file.tell(), len(content)))
                self._file.write(content)
        offsets_start = self._file.tell()
        self._file.write(offsets + _bytes(records.Footer(start, offsets_start, 0)) + MAGIC)
        self._file.close()

    def abort(self) -> None:
        """Close the file as it is."""
        self._file.close()

    def _cut(self, batches: Sequence[Batch]) -> Iterator[tuple[Index, Bytes, dict[int, Any]]]:
        """Chunks of messages in the order of their times: times, content, and the index by channel."""
        times, which = in_time(batches)
        ids = [batch.connection.id for batch in batches]
        for k, batch in enumerate(batches):
            rank = np.arange(len(batch.received))
            if ids.count(ids[k]) > 1:  # a topic of several sizes, whose messages are numbered in time
                same = np.flatnonzero(np.array(ids)[which] == ids[k])
                rank = np.searchsorted(same, np.flatnonzero(which == k))
            _fill_heads(batch, self.counts[ids[k]] + rank)
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
            index: dict[int, list[Any]] = {}
            for k, batch in enumerate(batches):
                at = offsets[which[first:last] == k]
                if len(at):
                    rows = slice(done[k], done[k] + len(at))
                    done[k] = rows.stop
                    kind = f"V{batch.rows.shape[1]}"
                    _windows(content, kind)[at] = batch.rows[rows].view(kind)[:, 0]
                    entries = np.stack([batch.received[rows], at], axis=1)
                    index.setdefault(batch.connection.id, []).append(entries)
            yield times[first:last], content, {c: np.concatenate(parts) for c, parts in index.items()}
            first = last

    def _put_chunk(self, first: int, last: int, content: Bytes, raw: bytes, index: dict[int, Any]) -> None:
        begin = self._file.tell()
        chunk = records.Chunk("zstd", raw, last, first, zlib.crc32(content.data), len(content))
        self._file.write(_bytes(chunk))
        end = self._file.tell()
        offsets, indexes = {}, b""
        for channel, entries in index.items():
            offsets[channel] = end + len(indexes)
            entries = entries[np.argsort(entries[:, 1], kind="stable")].astype("<u8")
            head = struct.pack("<HI", channel, entries.nbytes)
            indexes += _HEAD.pack(Opcode.MESSAGE_INDEX, len(head) + entries.nbytes) + head + entries.tobytes()
            self.counts[channel] += len(entries)
        self._file.write(indexes)
        self.first, self.last = min(self.first, first), max(self.last, last)
        self._chunks.append(
            records.ChunkIndex(
                chunk_length=end - begin,
                chunk_start_offset=begin,
                compression="zstd",
                compressed_size=len(raw),
                message_start_time=first,
                message_end_time=last,
                message_index_length=len(indexes),
                message_index_offsets=offsets,
                uncompressed_size=len(content),
            )
        )


def _fill_heads(batch: Batch, sequence: NDArray[np.intp]) -> None:
    """Make each row a message record: opcode, length, channel, sequence, and the time twice."""
    count, width = batch.rows.shape
    formats = ["u1", "<u8", "<u2", "<u4", "<u8", "<u8"]
    heads = np.zeros(count, np.dtype({"names": list("olcstp"), "formats": formats}))
    heads["o"], heads["l"], heads["c"] = Opcode.MESSAGE, width - _HEAD.size, batch.connection.id
    heads["t"] = heads["p"] = batch.received
    heads["s"] = sequence
    batch.rows[:, :ROOM] = heads.view(np.uint8).reshape(count, ROOM)


def _windows(content: Bytes, kind: str) -> NDArray[Any]:
    """The bytes from each offset on, as numbers of a kind."""
    size = np.dtype(kind).itemsize
    return np.ndarray((max(len(content) - size + 1, 0),), kind, content, 0, (1,))


class McapReader:
    """An MCAP file: its topics, its metadata, and its messages on demand.

    A damaged record costs itself, and a damaged chunk its messages: records are walked through from the
    beginning, and from a damaged one on by the index at the end of the file. `topics` are its channels,
    `notes` metadata records by name, `definitions` encoding and text of message types; `whole` tells whether
    it has its end, `compression` how its `chunks` are packed, and `damaged` the places of what could not be
    read so far.
    """

    def __init__(self, path: Path) -> None:
        self._file: BinaryIO = open(path, "rb")  # noqa: SIM115
        self._path, self._size = path, path.stat().st_size
        self.notes: dict[str, dict[str, str]] = {}
        self.definitions: dict[str, tuple[str, str]] = {}
        self.whole = False
        self.damaged: set[int] = set()
        self.compression: set[str] = set()
        self._noted = 0
        self._spare = SPARE
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, records.Channel] = {}
        self._chunks: dict[int, int] = {}  # place and length
        self._indexes = array("q")  # place and length of indexes of messages, and the place of their chunk
        self._spans: dict[int, tuple[int, int]] = {}  # first and last time of each chunk
        self._loose = array("q")  # channel, time of receipt, place and size of messages outside of chunks
        try:
            same = sum(a == b for a, b in zip(self._file.read(len(MAGIC)), MAGIC, strict=False))
            if same < len(MAGIC) - 1:
                raise InputError("it does not begin like MCAP")
            summary, sound = self._summary()
            self._scan(len(MAGIC), summary or self._size)
            if not (sound and self._channels):
                for place in self._chunks:
                    if (content := self._content(place)) is not None:
                        self._walk(content, (), place)
        except BaseException:
            self.close()
            raise
        self.chunks = len(self._chunks)
        self.topics: list[StoredTopic] = []
        for c in self._channels.values():
            kind, qos = self._schemas.get(c.schema_id, ""), c.metadata.get("offered_qos_profiles", "")
            self.topics.append(StoredTopic(c.id, c.topic, kind, c.message_encoding, qos))

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def times(self) -> dict[int, Index]:
        """Times of receipt of the messages of each topic [ns], from the indexes of messages."""
        parts: dict[int, list[Index]] = {topic.id: [] for topic in self.topics}
        loose = np.array(self._loose, np.int64).reshape(-1, 4)
        for channel in np.unique(loose[:, 0]).tolist():
            parts.setdefault(channel, []).append(loose[loose[:, 0] == channel, 1])
        if len(self._indexes):
            for place, length, chunk in np.array(self._indexes, np.int64).reshape(-1, 3).tolist():
                raw = self._at(place, length)
                entries = np.frombuffer(raw, "<i8", (len(raw) - 6) // 16 * 2, 6) if len(raw) > 6 else ()
                times = np.asarray(entries, np.int64)[::2]
                times = np.clip(times, *self._spans[chunk]) if chunk in self._spans else times
                parts.setdefault(int.from_bytes(raw[:2], "little"), []).append(times)
        elif self._chunks:
            for number, messages in self.messages(parts.keys()).items():
                parts[number] = [messages.received]
        none = np.zeros(0, np.int64)
        return {number: np.sort(np.concatenate([none, *found])) for number, found in parts.items()}

    def messages(self, ids: Collection[int], most: int | None = None) -> dict[int, Messages]:
        """The messages of some topics in the order of receipt; of chunks of at most `most` bytes in all."""
        self._spare = SPARE
        parts: list[tuple[Bytes, Any]] = []
        held = 0
        loose = np.array(self._loose, np.int64).reshape(-1, 4)
        if len(loose := loose[np.isin(loose[:, 0], list(ids))]):
            raw = bytearray()
            for place, size in loose[:, 2:].tolist():
                raw += self._at(place, size)
            loose[:, 2] = np.cumsum(loose[:, 3]) - loose[:, 3]
            parts.append((np.frombuffer(raw, np.uint8), loose))
        spent = 0
        for place in self._chunks:
            if most is not None and spent > most:
                break
            if (content := self._content(place)) is None:
                continue
            spent += len(content)
            found = self._walk(content, ids, place)
            if len(found):
                content, found = _without_others(content, found)
                held += len(content)
                check_decoded(self._path, self._size, held)
                parts.append((content, found))
        buffer = np.concatenate([np.zeros(0, np.uint8), *(raw for raw, _ in parts)])
        bases = np.cumsum([0] + [len(raw) for raw, _ in parts])
        table = [rows + np.array([0, 0, base, 0]) for (_, rows), base in zip(parts, bases, strict=False)]
        rows = np.concatenate([np.zeros((0, 4), np.int64), *table])
        joined = {}
        for number in ids:
            _, received, start, size = rows[rows[:, 0] == number].T
            joined[number] = Messages(received, buffer, start, size).in_order()
        return joined

    def _at(self, place: int, length: int) -> bytes:
        self._file.seek(place)
        return self._file.read(length)

    def _summary(self) -> tuple[int, bool]:
        """Begin of the section behind the data, 0 if there is none, and whether its topics are sound."""
        length = FOOTER + len(MAGIC)
        tail = self._at(max(self._size - length, 0), length)
        if len(tail) < length or tail[0] != Opcode.FOOTER:
            return 0, False
        self.whole = True
        begin, _, crc = struct.unpack_from("<QQI", tail, _HEAD.size)
        if not len(MAGIC) < begin < self._size:
            return 0, False
        raw = self._at(begin, self._size - begin - len(MAGIC) - 4)
        if crc and zlib.crc32(raw) != crc:
            self.damaged.add(begin)
            return begin, False
        at = 0
        while at + _HEAD.size <= len(raw):
            opcode, length = _HEAD.unpack_from(raw, at)
            at += _HEAD.size
            content = raw[at : at + length]
            try:
                if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    self._learn(opcode, content)
                elif opcode == Opcode.CHUNK_INDEX:
                    chunk = records.ChunkIndex.read(ReadDataStream(BytesIO(content)))
                    place = chunk.chunk_start_offset + _HEAD.size
                    self._chunks[place] = chunk.chunk_length - _HEAD.size
                    self._spans[place] = chunk.message_start_time, chunk.message_end_time
                    self.compression.add(chunk.compression)
            except _DAMAGED:
                return begin, False
            at += length
        return begin, True

    def _scan(self, at: int, end: int) -> None:
        """Go through the records outside of chunks; those behind a damaged one are found by the index."""
        indexed, self._chunks, place = self._chunks, {}, 0
        while at + _HEAD.size <= end:
            head = self._at(at, ROOM)
            opcode, length = _HEAD.unpack_from(head)
            body = at + _HEAD.size
            if not (1 <= opcode <= Opcode.DATA_END or opcode >= PRIVATE) or body + length > end:
                if not self.whole and body + length > end:
                    break  # the rest is missing
                self.damaged.add(body)
                at = min((other - _HEAD.size for other in indexed if other > body), default=end)
                continue
            if opcode == Opcode.CHUNK:
                self._chunks[body], place = length, body
            elif opcode == Opcode.MESSAGE_INDEX:
                self._indexes.extend((body, length, place))
            elif opcode == Opcode.MESSAGE and length >= ROOM - _HEAD.size:
                channel, _, received = struct.unpack_from("<HIq", head, _HEAD.size)
                self._loose.extend((channel, received, at + ROOM, length - (ROOM - _HEAD.size)))
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA):
                try:
                    self._learn(opcode, self._at(body, length))
                except _DAMAGED:
                    self.damaged.add(body)
            at = body + length
        self._chunks = dict(sorted((self._chunks | indexed).items()))

    def _learn(self, opcode: int, content: bytes) -> None:
        stream = ReadDataStream(BytesIO(content))
        if opcode == Opcode.SCHEMA:
            schema = records.Schema.read(stream)
            kind = schema.name
            if schema.encoding.startswith("ros1") and kind.count("/") == 1:
                kind = kind.replace("/", "/msg/")
            self._schemas.setdefault(schema.id, kind)
            if schema.encoding in ("ros1msg", "ros2msg"):
                self.definitions[kind] = schema.encoding, schema.data.decode(errors="replace")
        elif opcode == Opcode.CHANNEL:
            channel = records.Channel.read(stream)
            self._channels.setdefault(channel.id, channel)
        else:
            self._noted += len(content)
            if self._noted > (most := BUDGETS["JSON"].file):
                raise InputError(f"its metadata have over {most:,} bytes; write it again")
            note = records.Metadata.read(stream)
            self.notes[note.name] = note.metadata

    def _walk(self, content: Bytes, wanted: Collection[int], place: int) -> NDArray[np.int64]:
        """Channel, time, offset and size of wanted messages, shape (M, 4); learns schemas and channels."""
        places: list[int] = []
        raw, at, size = content.data, 0, len(content)
        unpack, message = _RECORD.unpack_from, int(Opcode.MESSAGE)
        while at + _RECORD.size <= size:
            opcode, length, channel = unpack(raw, at)
            after = at + 9 + length
            if after > size:
                self.damaged.add(place)  # a record ends outside of its chunk
                break
            if opcode == message:
                if channel in wanted and length >= ROOM - 9:
                    places.append(at)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._learn(opcode, bytes(raw[at + 9 : after]))
            at = after
        start = np.array(places, np.int64)
        sizes = _windows(content, "<u8")[start + 1].astype(np.int64) - (ROOM - 9)
        columns = _windows(content, "<u2")[start + 9], _windows(content, "<u8")[start + 15]
        return np.stack([*(c.astype(np.int64) for c in columns), start + ROOM, sizes], axis=1)

    def _content(self, place: int) -> Bytes | None:
        """The uncompressed content of a chunk; None if it is damaged, as its checksum shows."""
        try:
            chunk = records.Chunk.read(ReadDataStream(BytesIO(self._at(place, self._chunks[place]))))
        except _DAMAGED:
            self.damaged.add(place)
            return None
        size, raw, codec = chunk.uncompressed_size, chunk.data, chunk.compression
        most = min(LARGEST_CHUNK, self._spare + MOST_RATIO * len(raw))
        if size > most or codec not in ("", "zstd", "lz4"):
            if len(self._chunks) > 1 and (size > SPARE + MOST_RATIO * len(raw) or size <= most):
                self.damaged.add(place)
                return None
            raise InputError(
                f"a chunk claims {size} bytes, packed into {len(raw)} ({codec[:8]}); not supported"
            )
        self._spare -= max(0, size - MOST_RATIO * len(raw))
        try:
            content = pa.Codec(codec).decompress(raw, size) if codec else raw
        except (pa.ArrowException, OSError, ValueError):
            content = b""
        whole = np.frombuffer(content, np.uint8)
        crc = chunk.uncompressed_crc
        if len(whole) != size or (crc and zlib.crc32(whole.data) != crc):
            self.damaged.add(place)
            return None
        return whole


def _without_others(content: Bytes, found: NDArray[np.int64]) -> tuple[Bytes, NDArray[np.int64]]:
    """Content without the bytes of other messages, if these are most of it."""
    sizes = found[:, 3]
    total = int(sizes.sum())
    if 4 * total > len(content):
        return content, found
    begins = np.cumsum(sizes) - sizes
    at = np.arange(total) + np.repeat(found[:, 2] - begins, sizes)
    return content[at], np.column_stack([found[:, :2], begins, sizes])
