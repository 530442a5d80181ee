"""Messages in bytes; rosbags is the judge."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from rosbags.typesys import Stores, get_typestore

from magtwin.errors import InputError
from magtwin.io.bags.cdr import Messages, decode, encode
from magtwin.io.bags.topics import TOPICS
from magtwin.io.bags.types import layout

STORE = get_typestore(Stores.ROS2_HUMBLE)
KINDS = sorted(
    kind
    for kind in {kind for topic in TOPICS.values() for kind in (topic.kind, *topic.reads)}
    if not kind.startswith("px4_msgs/")  # which bags bring with them
)
DIAGNOSTICS = {"status": 2, "status.0.values": 0, "status.1.values": 2}
FORMS = [(kind, {}) for kind in KINDS]
FORMS += [("tf2_msgs/msg/TFMessage", {"transforms": n}) for n in (1, 3)]
FORMS += [("diagnostic_msgs/msg/DiagnosticArray", DIAGNOSTICS), ("geometry_msgs/msg/PolygonStamped", {})]
ROWS = 3


def some(leaf, rng):
    """A value for a leaf."""
    if leaf.kind == "none":
        return None
    if leaf.kind == "time":
        return np.array([0, 5 * 10**9 + 7, 2**31 * 10**9 - 1])
    if leaf.kind == "text":
        return ("left", "right wheel") if leaf.count is None else leaf.name[:5]
    count = 3 if leaf.count is None else leaf.count
    values = rng.normal(size=(ROWS, count)) if leaf.kind[0] == "f" else rng.integers(0, 2, (ROWS, count))
    return values.astype(leaf.kind)[:, 0] if leaf.count == 1 else values.astype(leaf.kind)


def filled(leaves, counts, *, sequences=True):
    rng = np.random.default_rng(0)
    fields = {leaf.name: some(leaf, rng) for leaf in leaves if sequences or leaf.count is not None}
    return {name: value for name, value in fields.items() if value is not None} | counts


def buffered(rows, before=3):
    """Messages in a buffer, after some other bytes."""
    size = rows.shape[1]
    buffer = np.concatenate([np.full(before, 9, np.uint8), rows.ravel()])
    start = before + size * np.arange(len(rows))
    return Messages(np.arange(len(rows)), buffer, start, np.full(len(rows), size))


@pytest.mark.parametrize(("kind", "counts"), FORMS)
def test_messages_equal_those_of_rosbags_to_the_byte_and_come_back(kind, counts):
    leaves = layout(kind, counts)
    for sequences in (True, False):
        fields = filled(leaves, counts, sequences=sequences)
        rows = encode(leaves, fields, ROWS, room=5)[:, 5:]
        for row in rows:
            decoded = STORE.deserialize_cdr(row.tobytes(), kind)
            assert bytes(STORE.serialize_cdr(decoded, kind)) == row.tobytes()
        back = decode(leaves, buffered(rows), fields)
        for name, value in fields.items():
            if isinstance(value, str | tuple):
                assert back[name] == [value] * ROWS
            else:
                assert_array_equal(back[name], np.broadcast_to(value, back[name].shape))


def test_strings_of_any_length_move_what_follows_them_message_by_message():
    leaves = layout("geometry_msgs/msg/PoseStamped")
    parts = [
        encode(leaves, {"header.frame_id": "m" * n, "pose.position": np.full(3, n)}, 1) for n in range(9)
    ]
    size = np.array([p.shape[1] for p in parts])
    buffer = np.concatenate([p.ravel() for p in parts])
    messages = Messages(np.arange(9), buffer, np.cumsum(size) - size, size)
    back = decode(leaves, messages, ["pose.position", "header.frame_id"])
    assert_array_equal(back["pose.position"], np.repeat(np.arange(9.0)[:, None], 3, axis=1))
    assert back["header.frame_id"] == ["m" * n for n in range(9)]


@pytest.mark.parametrize(("kind", "counts"), FORMS)
def test_truncated_messages_are_refused(kind, counts):
    leaves = layout(kind, counts)
    fields = filled(leaves, counts)
    rows = encode(leaves, fields, ROWS)[:1]
    for size in range(rows.shape[1]):
        with pytest.raises(InputError):
            decode(leaves, buffered(rows[:, :size]), [*fields, leaves[-1].name])


@pytest.mark.parametrize("count", [2**32 - 1, 10**6])
@pytest.mark.parametrize(
    ("kind", "leaf"),
    [
        ("sensor_msgs/msg/LaserScan", "ranges"),
        ("sensor_msgs/msg/JointState", "name"),
        ("std_msgs/msg/String", "data"),
    ],
)
def test_a_length_beyond_the_bytes_is_refused_before_anything_is_allocated(kind, leaf, count):
    leaves = layout(kind)
    empty = encode(leaves, {}, 1)
    at = encode(leaves[: [x.name for x in leaves].index(leaf)], {}, 1).shape[1]
    at = 4 + (at - 4 + 3) // 4 * 4
    empty[:, at : at + 4] = np.frombuffer(np.uint32(count).tobytes(), np.uint8)
    with pytest.raises(InputError):
        decode(leaves, buffered(empty), [leaf])


def test_other_encodings_are_refused():
    leaves = layout("std_msgs/msg/Float64")
    rows = encode(leaves, {"data": np.ones(2)}, 2)
    rows[1, 1] = 0
    with pytest.raises(InputError, match="little-endian"):
        decode(leaves, buffered(rows), ["data"])
