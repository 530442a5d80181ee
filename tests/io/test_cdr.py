"""Messages in bytes: rosbags is the judge."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from rosbags.typesys import Stores, get_typestore

from magtwin.errors import InputError
from magtwin.io.bags.cdr import Messages, decode, encode, leaves
from magtwin.io.bags.messages import TOPICS, TYPES, transforms

STORE = get_typestore(Stores.ROS2_HUMBLE)
FORMS = {**TYPES, **{f"tf2_msgs/msg/TFMessage of {n}": transforms(n) for n in (0, 1, 3)}}
ROWS = 3


def some(leaf, rng):
    """Something to put into a leaf."""
    if leaf.kind == "none" or leaf.name == "count":
        return None
    if leaf.kind == "time":
        return np.array([0, 5 * 10**9 + 7, 2**31 * 10**9 - 1])
    if leaf.kind == "text":
        return ("left", "right wheel") if leaf.count is None else leaf.name[:5]
    count = 3 if leaf.count is None else leaf.count
    values = rng.normal(size=(ROWS, count)) if leaf.kind[0] == "f" else rng.integers(0, 2, (ROWS, count))
    return values.astype(leaf.kind)[:, 0] if leaf.count == 1 else values.astype(leaf.kind)


def filled(form, *, sequences=True):
    rng = np.random.default_rng(0)
    fields = {leaf.name: some(leaf, rng) for leaf in form if sequences or leaf.count is not None}
    if "count" in {leaf.name for leaf in form}:
        fields["count"] = sum(leaf.name.endswith("child_frame_id") for leaf in form)
    return {name: value for name, value in fields.items() if value is not None}


def lying(rows, before=3):
    """Messages as they lie in a buffer, after some other bytes."""
    size = rows.shape[1]
    buffer = np.concatenate([np.full(before, 9, np.uint8), rows.ravel()])
    start = before + size * np.arange(len(rows))
    return Messages(np.arange(len(rows)), buffer, start, np.full(len(rows), size))


@pytest.mark.parametrize("kind", FORMS)
@pytest.mark.parametrize("sequences", [True, False])
def test_messages_are_rosbags_to_the_byte_and_come_back(kind, sequences):
    form = leaves(FORMS[kind])
    fields = filled(form, sequences=sequences)
    rows = encode(form, fields, ROWS, room=5)[:, 5:]
    ros = kind.split(" of ")[0]
    for row in rows:
        assert bytes(STORE.serialize_cdr(STORE.deserialize_cdr(row.tobytes(), ros), ros)) == row.tobytes()
    back = decode(form, lying(rows), fields)
    for name, value in fields.items():
        if isinstance(value, str | tuple):
            assert back[name] == [value] * ROWS
        else:
            assert_array_equal(back[name], np.broadcast_to(value, back[name].shape))


def test_every_topic_is_of_a_type_that_is_known_in_both_libraries():
    for topic in TOPICS.values():
        assert topic.kind in STORE.fielddefs
        assert topic.kind in TYPES or topic.kind == "tf2_msgs/msg/TFMessage"


def test_strings_of_any_length_move_what_follows_them_message_by_message():
    kind = "geometry_msgs/msg/PoseStamped"
    form = leaves(TYPES[kind])
    parts = [encode(form, {"header.frame_id": "m" * n, "pose.position": np.full(3, n)}, 1) for n in range(9)]
    size = np.array([p.shape[1] for p in parts])
    messages = Messages(
        np.arange(9), np.concatenate([p.ravel() for p in parts]), np.cumsum(size) - size, size
    )
    back = decode(form, messages, ["pose.position", "header.frame_id"])
    assert_array_equal(back["pose.position"], np.repeat(np.arange(9.0)[:, None], 3, axis=1))
    assert back["header.frame_id"] == ["m" * n for n in range(9)]


@pytest.mark.parametrize("kind", FORMS)
def test_messages_that_are_cut_anywhere_are_refused_and_read_nothing_beyond(kind):
    form = leaves(FORMS[kind])
    fields = filled(form)
    rows = encode(form, fields, ROWS)[:1]
    if not fields or rows.shape[1] <= 8:
        pytest.skip("nothing to cut")
    for size in range(rows.shape[1]):
        with pytest.raises(InputError):
            decode(form, lying(rows[:, :size]), [*fields, form[-1].name])


@pytest.mark.parametrize("count", [2**32 - 1, 2**31, 10**6])
@pytest.mark.parametrize(
    ("kind", "leaf"),
    [
        ("sensor_msgs/msg/LaserScan", "ranges"),
        ("sensor_msgs/msg/JointState", "name"),
        ("std_msgs/msg/String", "data"),
    ],
)
def test_a_length_that_the_bytes_do_not_fill_is_refused_before_anything_is_allocated(kind, leaf, count):
    form = leaves(TYPES[kind])
    empty = encode(form, {}, 1)
    at = encode(form[: [x.name for x in form].index(leaf)], {}, 1).shape[1]
    at = 4 + (at - 4 + 3) // 4 * 4
    empty[:, at : at + 4] = np.frombuffer(np.uint32(count).tobytes(), np.uint8)
    with pytest.raises(InputError):
        decode(form, lying(empty), [leaf])


def test_other_encodings_are_refused():
    form = leaves(TYPES["std_msgs/msg/Float64"])
    rows = encode(form, {"data": np.ones(2)}, 2)
    rows[1, 1] = 0
    with pytest.raises(InputError, match="little-endian"):
        decode(form, lying(rows), ["data"])
