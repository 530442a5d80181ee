"""Every bag that magtwin writes or reads, held to the libraries `mcap` and `rosbags`."""

import struct
from collections import Counter, defaultdict

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.records import Channel, Chunk, Message, MessageIndex, Schema, Statistics
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as PeerWriter
from recordings import as_db3
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

import magtwin
from magtwin.io.bags import RawBagWriter, write_bag
from magtwin.io.bags import mcap as ours
from magtwin.io.bags.bag import Bag
from magtwin.io.bags.cdr import encode
from magtwin.io.bags.db3 import Db3Reader
from magtwin.io.bags.mcap import McapReader
from magtwin.io.bags.topics import SCAN, Qos
from magtwin.io.bags.types import layout

STORE = get_typestore(Stores.ROS2_HUMBLE)
LASER = "sensor_msgs/msg/LaserScan"
TEXT = "std_msgs/msg/String"
FORMS = {LASER: "ranges", "sensor_msgs/msg/JointState": "position", TEXT: "data"}
"""Types whose messages differ in size, and the field that does it."""


def message(kind, size, t_ns=0):
    """A message in CDR of one of `FORMS`."""
    values = "x" * size if kind == TEXT else np.arange(float(size))[None] + t_ns % 97
    fields = {"header.stamp": np.array([t_ns]), "header.frame_id": "laser", FORMS[kind]: values}
    return encode(layout(kind), fields, 1)[0].tobytes()


def by_magtwin(file):
    """By topic the times and bytes of messages that our reader finds."""
    reader = (McapReader if file.suffix == ".mcap" else Db3Reader)(file)
    names = {heard.id: heard.topic for heard in reader.topics}
    found = defaultdict(list)
    for number, messages in reader.messages(names).items():
        for t, at, size in zip(messages.received, messages.start, messages.size, strict=True):
            found[names[number]].append((int(t), messages.buffer[at : at + size].tobytes()))
    reader.close()
    return dict(found)


def by_rosbags(path):
    """The same by rosbags; its counts are those that it finds."""
    found = defaultdict(list)
    with Reader(path) as reader:
        for connection, t, data in reader.messages():
            found[connection.topic].append((t, bytes(data)))
        assert reader.message_count == sum(map(len, found.values()))
        assert {c.topic: c.msgcount for c in reader.connections if c.msgcount} == counts(found)
    return dict(found)


def by_mcap(file, kind):
    """The same by mcap's own readers: SeekingReader goes by the summary, NonSeekingReader by the data."""
    found = defaultdict(list)
    with open(file, "rb") as stream:
        for _, channel, m in kind(stream, validate_crcs=True).iter_messages():
            assert m.publish_time == m.log_time
            found[channel.topic].append((m.log_time, m.data))
    return dict(found)


def counts(found):
    return {topic: len(messages) for topic, messages in found.items()}


def storage_file(path):
    """The storage file of a bag, which may be a folder."""
    return next(p for p in path.iterdir() if p.suffix != ".yaml") if path.is_dir() else path


def assert_everyone_reads(path, expected):
    """Ours, rosbags' and mcap's readers give exactly these messages, each topic in order."""
    file = storage_file(path)
    assert {topic: m for topic, m in by_magtwin(file).items() if m} == expected
    assert by_rosbags(path) == expected
    if file.suffix == ".mcap":
        assert by_mcap(file, SeekingReader) == expected
        assert by_mcap(file, NonSeekingReader) == expected
        assert_as_specified(file)


def assert_as_specified(file):
    """Statistics, chunk indexes and message indexes are those of https://mcap.dev/spec."""
    content = file.read_bytes()
    with open(file, "rb") as stream:
        records = list(StreamReader(stream, emit_chunks=True, validate_crcs=True).records)
    with open(file, "rb") as stream:
        summary = SeekingReader(stream, validate_crcs=True).get_summary()
    chunks = [r for r in records if isinstance(r, Chunk)]
    messages = [[m for m in breakup_chunk(c, True) if isinstance(m, Message)] for c in chunks]
    every = [m for part in messages for m in part]
    statistics = summary.statistics
    assert [r for r in records if isinstance(r, Statistics)] == [statistics]
    assert statistics.message_count == len(every)
    told = {k: n for k, n in statistics.channel_message_counts.items() if n}
    assert told == Counter(m.channel_id for m in every)
    assert statistics.chunk_count == len(chunks) == len(summary.chunk_indexes)
    assert statistics.channel_count == len(summary.channels)
    assert statistics.schema_count == len(summary.schemas)
    times = [m.log_time for m in every] or [0]
    assert (statistics.message_start_time, statistics.message_end_time) == (min(times), max(times))
    data = records[: next(k for k, r in enumerate(records) if type(r).__name__ == "DataEnd")]
    inside = [r for c in chunks for r in breakup_chunk(c, True)] + data
    assert {c.id for c in inside if isinstance(c, Channel)} == set(summary.channels)
    assert {s.id for s in inside if isinstance(s, Schema)} == set(summary.schemas)
    for index, chunk, held in zip(summary.chunk_indexes, chunks, messages, strict=True):
        opcode, length = struct.unpack_from("<BQ", content, index.chunk_start_offset)
        assert opcode == 6
        assert length + 9 == index.chunk_length
        times = [m.log_time for m in held]
        assert times == sorted(times)
        assert (index.message_start_time, index.message_end_time) == (times[0], times[-1])
        assert (chunk.message_start_time, chunk.message_end_time) == (times[0], times[-1])
        assert index.compressed_size == len(chunk.data)
        plain = zstandard.ZstdDecompressor().decompress(chunk.data, index.uncompressed_size)
        assert len(plain) == index.uncompressed_size
        assert set(index.message_index_offsets) == {m.channel_id for m in held}
        end = index.chunk_start_offset + index.chunk_length + index.message_index_length
        for channel, at in index.message_index_offsets.items():
            opcode, length, about, size = struct.unpack_from("<BQHI", content, at)
            assert (opcode, about, length) == (7, channel, size + 6)
            assert at + 9 + length <= end
            entries = list(struct.iter_unpack("<QQ", content[at + 15 : at + 15 + size]))
            assert [t for t, _ in entries] == [m.log_time for m in held if m.channel_id == channel]
            for t, offset in entries:
                kind, _, number, _, log, publish = struct.unpack_from("<BQHIQQ", plain, offset)
                assert (kind, number, log, publish) == (5, channel, t, t)
    assert sum(isinstance(r, MessageIndex) for r in records) == sum(
        len(index.message_index_offsets) for index in summary.chunk_indexes
    )


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32), st.booleans(), st.booleans())
def test_any_messages_of_any_sizes_are_read_back_by_everyone(tmp_path_factory, seed, late, small):
    """Several topics, equal times, times that go back, flushes anywhere, several chunks."""
    rng = np.random.default_rng(seed)
    path = tmp_path_factory.mktemp("any") / "bag.mcap"
    topics = [(f"/{kind.rpartition('/')[2]}{k}", kind) for k in range(2) for kind in FORMS]
    writer = RawBagWriter(path)
    sent, t = defaultdict(list), 10**18
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ours, "CHUNK", 2000 if small else ours.CHUNK)
        for topic, kind in topics:
            writer.add(topic, kind, Qos())
        for _ in range(rng.integers(1, 300)):
            t += int(rng.choice([0, 1, 10**6])) - (int(rng.integers(3)) * 10**6 if late else 0)
            topic, kind = topics[rng.integers(len(topics) - 1)]  # the last one stays empty
            sent[topic].append((t, message(kind, int(rng.integers(40)), t)))
            writer.write(topic, *sent[topic][-1])
            if rng.random() < 0.05:
                writer.flush()
        writer.close()
    if not late:
        assert_everyone_reads(path, dict(sent))
        return
    found = by_magtwin(path)
    in_time = {topic: sorted(m, key=lambda one: one[0]) for topic, m in sent.items()}
    assert {topic: m for topic, m in found.items() if m} == in_time
    assert {topic: sorted(m) for topic, m in by_rosbags(path).items()} == {
        k: sorted(m) for k, m in sent.items()
    }
    assert_as_specified(path)
    assert {k: sorted(m) for k, m in by_mcap(path, SeekingReader).items()} == {
        k: sorted(m) for k, m in sent.items()
    }


@pytest.fixture(scope="module")
def made(lab_scene, tmp_path_factory):
    """A run of 20 s with its LiDAR on, as a bag by every writer of ours; the messages of its bag."""
    from magtwin.twin import scan

    folder = tmp_path_factory.mktemp("made")
    twin = magtwin.open_twin(lab_scene)
    run = magtwin.simulate(twin, "figure8", seed=3, duration_s=20.0, lidar="on")
    write_bag(run, folder / "whole.mcap", twin, scans=scan(twin, run))
    as_db3(folder / "whole.mcap", folder / "whole.db3")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("magtwin.io.bags.writer.BLOCK", 500)
        write_bag(run, folder / "blocks.mcap", twin, scans=scan(twin, run))
    with Reader(folder / "whole.mcap") as reader:
        said = [(c.topic, c.msgtype, t, bytes(data)) for c, t, data in reader.messages()]
    raw = RawBagWriter(folder / "raw.mcap")
    for k, (topic, kind, t, data) in enumerate(said):
        raw.add(topic, kind, Qos())
        raw.write(topic, t, data)
        if k % 1500 == 0:
            raw.flush()
    raw.close()
    expected = defaultdict(list)
    for topic, _, t, data in said:
        expected[topic].append((t, data))
    return folder, run, dict(expected)


@pytest.mark.parametrize("name", ["whole.mcap", "blocks.mcap", "raw.mcap", "whole.db3"])
def test_every_writer_says_the_same_and_everyone_reads_all_of_it(made, name):
    folder, _, expected = made
    assert len(expected) >= 12  # every topic of a run of the lab's robot, scans among them
    assert len(expected[SCAN.name]) > 100
    assert_everyone_reads(folder / name, expected)
    if name.endswith("mcap"):
        with open(folder / name, "rb") as stream:
            assert SeekingReader(stream).get_summary().statistics.chunk_count > 3


def shuffled(rng, count=900):
    """Messages of two topics, whose times are out of order and whose sizes differ."""
    times = 10**18 + rng.permutation(count) * 10**6
    kinds = [LASER, TEXT]
    return [
        (f"/{kinds[k % 2].rpartition('/')[2]}", kinds[k % 2], int(t), message(kinds[k % 2], int(n), int(t)))
        for k, (t, n) in enumerate(zip(times, rng.integers(0, 200, count), strict=True))
    ]


def in_time(said):
    found = defaultdict(list)
    for topic, _, t, data in sorted(said, key=lambda m: m[2]):
        found[topic].append((t, data))
    return dict(found)


@pytest.mark.parametrize(
    ("compression", "index", "chunked"),
    [
        *((compression, IndexType.ALL, True) for compression in CompressionType),
        (CompressionType.ZSTD, IndexType.NONE, True),
        (CompressionType.NONE, IndexType.ALL, False),
    ],
)
def test_what_mcaps_own_writer_wrote_out_of_order_is_read_in_order(tmp_path, compression, index, chunked):
    said = shuffled(np.random.default_rng(1))
    with open(tmp_path / "bag.mcap", "wb") as stream:
        writer = PeerWriter(stream, 20_000, compression, index, use_chunking=chunked)
        writer.start("ros2")
        numbers = {}
        for topic, kind, t, data in said:
            if topic not in numbers:
                schema = writer.register_schema(kind, "ros2msg", b"")
                numbers[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(numbers[topic], t, data, t - 5)
        writer.finish()
    assert by_magtwin(tmp_path / "bag.mcap") == in_time(said)


WAYS = [
    (StoragePlugin.SQLITE3, None),
    (StoragePlugin.MCAP, None),
    (StoragePlugin.MCAP, CompressionMode.STORAGE),
    (StoragePlugin.SQLITE3, CompressionMode.FILE),
    (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
]


@pytest.mark.parametrize(("plugin", "mode"), WAYS)
def test_what_rosbags_wrote_out_of_order_is_read_in_order(tmp_path, plugin, mode):
    said = shuffled(np.random.default_rng(2))
    writer = Writer(tmp_path / "bag", version=8, storage_plugin=plugin)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        links = {}
        for topic, kind, t, data in said:
            if topic not in links:
                links[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(links[topic], t, data)
    with Bag(tmp_path / "bag") as bag:
        found = {
            topic: [
                (int(t), m.buffer[at : at + size].tobytes())
                for t, at, size in zip(m.received, m.start, m.size, strict=True)
            ]
            for topic, m in bag.messages(links).items()
        }
    assert found == in_time(said)


def test_a_chunk_of_blank_images_is_read(tmp_path):
    blank = message(TEXT, 0)[:4] + bytes(8_000_000)
    with open(tmp_path / "bag.mcap", "wb") as stream:
        writer = PeerWriter(stream, compression=CompressionType.ZSTD)
        writer.start("ros2")
        channel = writer.register_channel(
            "/image", "cdr", writer.register_schema("x/msg/Image", "ros2msg", b"")
        )
        for t in range(3):
            writer.add_message(channel, t, blank, t)
        writer.finish()
    assert (tmp_path / "bag.mcap").stat().st_size < 10_000
    assert by_magtwin(tmp_path / "bag.mcap") == {"/image": [(t, blank) for t in range(3)]}
