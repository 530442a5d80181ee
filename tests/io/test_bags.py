"""Runs as bags and back; rosbags and MCAP's own reader are the judges."""

import json
import sqlite3
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from recordings import as_db3
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

import magtwin
from magtwin.errors import InputError, RepairWarning
from magtwin.io.bags import RawBagWriter, read_bag, write_bag
from magtwin.io.bags.bag import Bag
from magtwin.io.bags.cdr import encode
from magtwin.io.bags.storage import partial_of
from magtwin.io.bags.topics import TOPICS
from magtwin.io.bags.types import layout
from magtwin.io.surveys.readings import read_readings, readings_of_run
from magtwin.run.run import COLUMNS, Column, Run

STORE = get_typestore(Stores.ROS2_HUMBLE)
BATTERY = ("battery_v", "battery_a", "battery_fraction")
FIELDS = ("b_measured_nt", "b_vector_measured_nt")
KINDS = ("bag", "run.mcap")


@pytest.fixture(scope="module")
def twin(lab_scene):
    return magtwin.open_twin(lab_scene)


@pytest.fixture(scope="module")
def made(twin):
    """A run of 8 s, its LiDAR on, with a column of a user's own and readings that are missing; its scans."""
    run = magtwin.simulate(twin, "figure8", seed=3, duration_s=8.0, lidar="on")
    measured = run["b_measured_nt"].copy()
    measured[[0, 70, 71]] = np.nan
    vector = run["b_vector_measured_nt"].copy()
    vector[:5, 1], vector[2] = np.nan, np.nan
    run = run.with_columns(
        b_measured_nt=measured,
        b_vector_measured_nt=vector,
        est_p=np.arange(2.0 * run.rows).reshape(-1, 2),
        est_count=np.arange(run.rows),
        est_one=np.ones((run.rows, 1), np.float32),
    )
    from magtwin.twin import scan

    run = run.with_specs(est_p=Column("m", "world", "an estimate", 2, ("x", "y"), interpolation="hold"))
    return run.with_metadata(note='quoted "text", ä', share=0.1, yes=True), scan(twin, run)


@pytest.fixture(scope="module")
def bags(made, twin, tmp_path_factory):
    """The run in every form of a bag."""
    folder = tmp_path_factory.mktemp("bags")
    for name in KINDS:
        write_bag(made[0], folder / name, twin, scans=made[1])
    as_db3(folder / "run.mcap", folder / "run.db3")
    write_bag(made[0], folder / "nt.mcap", twin, units="nT")
    return folder


def assert_same(back, run, *, unit="T"):
    """Columns and metadata are equal to the precision that bags promise."""
    assert list(back) == list(run)
    assert dict(back.metadata) == dict(run.metadata)
    assert dict(back.specs) == dict(run.specs)
    for name in run:
        assert back[name].dtype == run[name].dtype, name
        if name in BATTERY:
            assert_allclose(back[name], run[name], rtol=6e-8, err_msg=name)
        elif name in FIELDS and unit == "T":
            assert_allclose(back[name], run[name], rtol=5e-16, err_msg=name)
        else:
            assert_array_equal(back[name], run[name], err_msg=name)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32), st.integers(0, 60), st.integers(1, 60))
def test_any_run_in_blocks_of_any_size_comes_back_to_the_last_bit(tmp_path_factory, seed, rows, block):
    rng = np.random.default_rng(seed)
    columns = {"t": np.cumsum(rng.uniform(1e-3, 0.2, rows))}
    for name in rng.permutation(sorted(COLUMNS.keys() - {"t", *BATTERY}))[: rng.integers(30)]:
        spec = COLUMNS[name]
        values = rng.choice([0.0, -0.0, 1.0, np.nan, np.inf, -np.inf, 40e3, 5e-324], (rows, spec.width))
        held = np.maximum.accumulate(np.where(rng.random(rows) < 0.4, np.arange(rows), 0))
        values = values[held] if rng.random() < 0.7 else rng.normal(size=(rows, spec.width))
        values = values if spec.width > 1 else values[:, 0]
        columns[str(name)] = values != 0 if spec.unit == "bool" else values
    run = Run(columns, {"seed": seed})
    path = tmp_path_factory.mktemp("any") / "run.mcap"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("magtwin.io.bags.writer.BLOCK", block)
        write_bag(run, path, units="nT")
    back = read_bag(path)
    assert list(back) == list(run)
    for name in run:
        a, b = back[name], run[name]
        gone = np.zeros(rows, bool)
        if name in FIELDS:  # a reading that is no number is no message; any nan is as another
            gone = ~np.isfinite(b) if b.ndim == 1 else ~np.isfinite(b).any(axis=1)
            assert np.isnan(a[gone]).all()
        assert a[~gone].tobytes() == b[~gone].tobytes(), name


def messages(path):
    """By topic the times and messages that rosbags reads."""
    found = {}
    with Reader(path) as reader:
        for connection, t, data in reader.messages():
            found.setdefault(connection.topic, []).append(
                (t, STORE.deserialize_cdr(data, connection.msgtype))
            )
    return found


@pytest.fixture(scope="module")
def heard(bags):
    return messages(bags / "bag")


def test_qualities_of_service_are_read_by_rosbags_as_they_are_meant(bags):
    with Reader(bags / "bag") as reader:
        qos = {c.topic: c.ext.offered_qos_profiles[0] for c in reader.connections}
    assert qos.keys() <= TOPICS.keys()
    for topic, said in qos.items():
        meant = TOPICS[topic].qos
        assert said.depth == meant.depth
        assert said.reliability.name == ("RELIABLE" if meant.reliable else "BEST_EFFORT")
        assert said.durability.name == ("TRANSIENT_LOCAL" if meant.latched else "VOLATILE")
        assert said.deadline.sec == 9223372036


def test_the_same_run_gives_the_same_bytes(bags, made, twin, tmp_path):
    for name in KINDS:
        write_bag(made[0], tmp_path / name, twin, scans=made[1])
        files = [tmp_path / name] if Path(name).suffix else sorted((tmp_path / name).iterdir())
        for file in files:
            assert file.read_bytes() == (bags / file.relative_to(tmp_path)).read_bytes()
    write_bag(made[0], tmp_path / "other name.mcap", twin, scans=made[1])
    assert (tmp_path / "other name.mcap").read_bytes() == (bags / "run.mcap").read_bytes()


def test_fields_are_in_tesla_with_the_predicted_variance_or_in_nt(bags, made, heard):
    run = made[0]
    known = np.isfinite(run["b_measured_nt"])
    said = [m for _, m in heard["/robot/qtfm/magnitude"]]
    assert_allclose([m.magnetic_field.x for m in said], run["b_measured_nt"][known] * 1e-9, rtol=1e-15)
    assert all(m.magnetic_field.y == m.magnetic_field.z == 0 for m in said)
    variance = [m.magnetic_field_covariance[0] for m in said]
    assert_allclose(variance, (run["b_sd_nt"][known] * 1e-9) ** 2, rtol=1e-12)
    nt = messages(bags / "nt.mcap")["/robot/qtfm/magnitude"]
    assert_array_equal([m.magnetic_field.x for _, m in nt], run["b_measured_nt"][known])


def test_stamps_are_sim_time_and_a_reading_that_is_missing_is_no_message(made, heard):
    run = made[0]
    ns = np.rint(run["t"] * 1e9).astype(int)[np.isfinite(run["b_measured_nt"])]
    said = heard["/robot/qtfm/magnitude"]
    assert_array_equal([t for t, _ in said], ns)
    assert_array_equal([m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for _, m in said], ns)


def test_slower_signals_come_at_their_own_rates(heard, twin):
    robot, seconds = twin.scene.robot, 8.0
    rates = {
        "/robot/odom": robot.drive.odometry_rate_hz,
        "/robot/imu": robot.imu.rate_hz,
        "/robot/enu/pose": robot.mocap.rate_hz,
        "/robot/scan": robot.lidar.scan_rate_hz,
        "/clock": 40.0,
        "/robot/joint_states": 62.0,
        "/tf": 62.0,
    }
    for topic, rate in rates.items():
        assert len(heard[topic]) / seconds == pytest.approx(rate, rel=0.12), topic
    assert 4 <= len(heard["/robot/battery_state"]) <= 7


def test_commands_are_sent_again_before_the_robot_would_stop_for_want_of_one(made, heard):
    times = np.array([t for t, _ in heard["/robot/cmd_vel"]]) / 1e9
    assert np.diff(times).max() < 0.12
    run = made[0]
    at = np.searchsorted(times, run["t"] + 1e-9) - 1
    assert_array_equal([heard["/robot/cmd_vel"][k][1].linear.x for k in at], run["v_cmd"])


def test_frames_make_one_tree_that_puts_base_link_where_it_is(made, heard, twin):
    run = made[0]
    static = {t.child_frame_id: t.header.frame_id for t in heard["/tf_static"][0][1].transforms}
    t, message = heard["/tf"][-1]
    moving = {m.child_frame_id: m for m in message.transforms}
    assert [(m.header.frame_id, m.child_frame_id) for m in message.transforms[:2]] == [
        ("map", "odom"),
        ("odom", "base_link"),
    ]
    parents = static | {child: m.header.frame_id for child, m in moving.items()}
    frames = {
        m[0][1].header.frame_id
        for topic, m in heard.items()
        if topic.startswith("/robot/q") or "imu" in topic
    }
    for frame in frames | {"left_wheel", "rplidar_link"}:
        while frame != "map":
            frame = parents[frame]
    row = np.searchsorted(np.rint(run["t"] * 1e9), t)
    from magtwin.frames import rotate

    def parts(m):
        p, q = m.transform.translation, m.transform.rotation
        return np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w])

    p0, q0 = parts(moving["odom"])
    p1, _ = parts(moving["base_link"])
    assert_allclose(p0 + rotate(q0, p1), run["p_world_base"][row], atol=1e-12)
    _, wheel = parts(moving["left_wheel"])
    assert np.linalg.norm(wheel) == pytest.approx(1)


def test_scans_are_stamped_when_they_were_taken_and_received_when_they_came(made, heard):
    scans = made[1]
    said = heard["/robot/scan"]
    assert_array_equal([t for t, _ in said], np.rint(scans.arrival * 1e9).astype(int))
    stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for _, m in said]
    assert_array_equal(stamps, np.rint(scans.t * 1e9).astype(int))
    assert_array_equal([m.ranges for _, m in said], scans.ranges_m)
    one = said[0][1]
    assert one.angle_max == pytest.approx(
        one.angle_min + one.angle_increment * (len(one.ranges) - 1), rel=1e-6
    )


def test_covariances_are_those_of_the_robots_specs(heard, twin):
    drive = twin.scene.robot.drive
    odometry = heard["/robot/odom"][-1][1]
    spread = np.sqrt(np.diag(odometry.twist.covariance.reshape(6, 6)))
    assert_allclose(spread, (*drive.odometry_v_noise_std, *drive.odometry_w_noise_std))
    imu, spec = heard["/robot/imu"][-1][1], twin.scene.robot.imu
    speed = odometry.twist.twist.linear.x
    wanted = np.hypot(spec.accel_noise_std, speed * np.array(spec.accel_vibration))
    assert_allclose(np.sqrt(np.diag(imu.linear_acceleration_covariance.reshape(3, 3))), wanted, rtol=0.1)


def test_a_robot_with_its_urdf_beside_it_is_described(made, tmp_path):
    from magtwin.files.file import shipped

    twin = magtwin.open_twin(shipped("scenes", "lab", "lab.usda"))
    write_bag(made[0], tmp_path / "run.mcap", twin)
    said = messages(tmp_path / "run.mcap")["/robot/robot_description"]
    urdf = ElementTree.parse(shipped("robots", "turtlebot4", "turtlebot4.urdf")).getroot()
    told = ElementTree.fromstring(said[0][1].data)
    assert [link.get("name") for link in told.iter("link")] == [
        link.get("name") for link in urdf.iter("link")
    ]
    parents = {j.find("child").get("link"): j.find("parent").get("link") for j in told.iter("joint")}
    assert "base_link" not in parents  # /tf puts it below odom
    assert parents["base_footprint"] == "base_link"


UNFIT = [
    (lambda run: run, {"force": False}, "exists already"),
    (lambda run: run, {"units": "uT"}, '"T" or "nT"'),
    (lambda run: run.take(slice(None, None, -1)), {}, "the run to write: "),
    (lambda run: run.with_columns(t=run["t"] + 2.0**31), {}, "subtract the first time"),
    (lambda run: run.with_columns(name=np.full(run.rows, "a")), {}, "'name' cannot stand in a bag"),
    (lambda run: Run({"yaw": run["yaw"]}), {}, "column 't' is missing"),
]


@pytest.mark.parametrize(("change", "options", "words"), UNFIT, ids=range(len(UNFIT)))
def test_what_no_bag_can_hold_is_refused_and_what_was_there_stays(made, tmp_path, change, options, words):
    target = tmp_path / "run.mcap"
    target.write_bytes(b"earlier")
    with pytest.raises(InputError, match=words):
        write_bag(change(made[0]), target, **{"force": True, **options})
    assert [p.name for p in tmp_path.iterdir()] == ["run.mcap"]
    assert target.read_bytes() == b"earlier"


@pytest.mark.parametrize("name", KINDS)
def test_a_recording_that_did_not_end_is_read_up_to_its_last_flush(bags, tmp_path, name):
    writer = RawBagWriter(tmp_path / name)
    with Bag(bags / "run.mcap") as bag:
        for topic, kind in bag.kinds.items():
            writer.add(topic, kind, TOPICS[topic].qos)
        for topic, found in bag.messages(bag.kinds).items():
            for at, start, size in zip(found.received, found.start, found.size, strict=True):
                writer.write(topic, int(at), found.buffer[start : start + size].tobytes())
    writer.flush()
    assert_array_equal(read_bag(writer.partial)["t"], read_bag(bags / "run.mcap")["t"])
    with pytest.raises(InputError, match="left by a recording that did not end"):
        RawBagWriter(tmp_path / name)
    writer.close()


@pytest.mark.parametrize("keep", [0.3, 0.97])
def test_of_an_mcap_that_was_cut_anywhere_what_is_whole_is_read(made, tmp_path, monkeypatch, keep):
    monkeypatch.setattr("magtwin.io.bags.mcap.CHUNK", 1 << 16)
    cut, partial = tmp_path / "run.mcap", tmp_path / "run.partial.mcap"
    write_bag(made[0], cut)
    content = cut.read_bytes()
    cut.write_bytes(content[: int(keep * len(content))])
    with pytest.warns(RepairWarning, match="cut short: its end is missing; it is read up to its last whole"):
        read_bag(cut)
    back = read_bag(cut.rename(partial))
    rows = back.rows
    assert rows > 0.8 * keep * made[0].rows
    assert_same(back, made[0].take(slice(rows)))
    partial.write_bytes(content[:1000])
    with pytest.raises(InputError, match=r"no field topic .*; topics in it: none"):
        read_bag(partial)


@pytest.mark.filterwarnings("ignore::magtwin.errors.RepairWarning")
@pytest.mark.parametrize("name", ["run.mcap", "run.db3"])
def test_a_file_that_is_cut_or_has_a_wrong_byte_anywhere_gives_a_run_or_one_line(bags, tmp_path, name):
    content = bytearray((bags / name).read_bytes())
    rng, said = np.random.default_rng(0), []
    for _ in range(25):
        wrong = content.copy()
        for place in rng.integers(0, len(wrong), 3):
            wrong[place] = rng.integers(256)
        if rng.integers(2):
            wrong = wrong[: rng.integers(len(wrong))]
        file = partial_of(tmp_path / name)
        file.write_bytes(wrong)
        try:
            read_bag(file)
        except InputError as refusal:
            said.append(str(refusal))
    assert all("run.partial." in text and "\n" not in text for text in said)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.mcap", b"not mcap at all", "does not begin like MCAP"),
        ("a.db3", b"not a database at all, but longer than its header" * 40, "not a database"),
        ("a.db3", b"", "missing tables"),
        ("a.txt", b"hello", "no bag: a folder with metadata.yaml is one"),
        (".", None, "no bag: metadata.yaml is missing"),
        ("nothing", None, "no such bag"),
    ],
)
def test_what_is_no_bag_is_refused_in_a_line(tmp_path, name, content, words):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=words) as refusal:
        read_bag(tmp_path / name)
    assert "\n" not in str(refusal.value)


def test_a_table_of_columns_that_lies_is_refused(bags, made, tmp_path):
    path = tmp_path / "run.db3"
    source = sqlite3.connect(bags / "run.db3")
    (number,) = source.execute("SELECT id FROM topics WHERE name = '/magtwin/columns'").fetchone()
    (data,) = source.execute("SELECT data FROM messages WHERE topic_id = ?", (number,)).fetchone()
    table = json.loads(data[8:-1])
    source.close()
    lies = {
        "is not in the readings": {"first": 10_000},
        "unknown type": {"dtype": "object"},
        "no topic '/nowhere'": {"topic": "/nowhere"},
        "damaged bag": {"width": -5},
    }
    for text, lie in lies.items():
        told = json.loads(json.dumps(table))
        told["columns"][-1].update(lie)
        path.write_bytes((bags / "run.db3").read_bytes())
        database = sqlite3.connect(path)
        row = encode(layout("std_msgs/msg/String"), {"data": json.dumps(told)}, 1)[0].tobytes()
        database.execute("UPDATE messages SET data = ? WHERE topic_id = ?", (row, number))
        database.commit()
        database.close()
        with pytest.raises(InputError, match=text) as refusal:
            read_bag(path)
        assert "\n" not in str(refusal.value)


def sqlite_bag(path, topics=1, messages=1):
    """A bag of empty topics and messages, in pages of 512 bytes."""
    database = sqlite3.connect(path)
    database.executescript(
        "PRAGMA page_size = 512;"
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format);"
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)"
    )
    database.executemany(
        "INSERT INTO topics VALUES(?, '/m', 'std_msgs/msg/Empty', 'cdr')", ((k,) for k in range(topics))
    )
    rows = ((k, k, bytes(100)) for k in range(messages))
    database.executemany("INSERT INTO messages VALUES(?, 0, ?, ?)", rows)
    database.commit()
    return database


def test_pages_of_an_sqlite_file_that_lead_to_each_other_again_and_again_are_not_followed_to_the_end(
    tmp_path,
):
    path = tmp_path / "run.db3"
    with sqlite_bag(path, messages=2000) as database:
        (root,) = database.execute("SELECT rootpage FROM sqlite_master WHERE name = 'messages'").fetchone()
    database.close()
    content = bytearray(path.read_bytes())
    leaves = [page for page in range(3, len(content) // 512) if content[512 * page - 512] == 13]
    for page, below in pairwise(
        [root, *leaves[:9]]
    ):  # inner pages of 50 cells, all of which lead to the next
        head = bytes([5, 0, 0, 0, 50, 1, 0, 0]) + below.to_bytes(4)
        places = b"".join((200 + 5 * k).to_bytes(2) for k in range(50))
        cells = (below.to_bytes(4) + b"\x01") * 50
        content[512 * page - 512 : 512 * page] = (head + places).ljust(200, b"\0") + cells.ljust(312, b"\0")
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"damaged bag, or none \(interrupted\)"), Bag(path) as bag:
        bag.messages(["/m"])


@pytest.mark.parametrize("name", ["%2e%2e%2fother.db3", "%6fther.db3#.db3", "other.db3?.db3"])
def test_the_name_of_an_sqlite_bag_is_no_uri(name, tmp_path):
    folder = tmp_path / "50 % #1?"
    folder.mkdir()
    for path, count in ((folder / name, 3), (folder / "other.db3", 5), (tmp_path / "other.db3", 5)):
        sqlite_bag(path, messages=count).close()
    with Bag(folder / name) as bag:
        assert len(bag.messages(["/m"])["/m"]) == 3


def test_the_quality_of_service_of_an_sqlite_bag_is_not_parsed(tmp_path):
    with sqlite_bag(tmp_path / "run.db3") as database:
        database.execute("ALTER TABLE topics ADD offered_qos_profiles")
        database.execute("UPDATE topics SET offered_qos_profiles = ?", ("[" * 1_000_000,))
    database.close()
    with Bag(tmp_path / "run.db3") as bag:
        assert len(bag.messages(["/m"])["/m"]) == 1


def test_an_sqlite_bag_of_too_many_topics_or_of_texts_for_messages_is_refused(tmp_path):
    sqlite_bag(tmp_path / "topics.db3", 10_001).close()
    with pytest.raises(InputError, match="it has over 10,000 topics"):
        read_bag(tmp_path / "topics.db3")
    with sqlite_bag(tmp_path / "texts.db3") as database:
        database.execute("UPDATE messages SET data = 'text'")
    database.close()
    with pytest.raises(InputError, match="damaged bag"), Bag(tmp_path / "texts.db3") as bag:
        bag.messages(["/m"])


@pytest.mark.filterwarnings("ignore:.* joins .*:magtwin.errors.RepairWarning")
def test_a_chunk_that_says_it_is_a_thousand_times_its_size_is_refused_unread(bags, tmp_path):
    content = bytearray((bags / "run.mcap").read_bytes())
    chunk = content.index(b"zstd") - 4 - 4 - 8  # its size stands before checksum and codec
    content[chunk : chunk + 8] = (1 << 29).to_bytes(8, "little")
    (tmp_path / "run.mcap").write_bytes(content)
    with pytest.warns(RepairWarning, match=r"1 of \d chunks or records are damaged"):
        run = read_bag(tmp_path / "run.mcap")
    assert 0 < run.rows < read_bag(bags / "run.mcap").rows


def test_an_own_bag_gives_the_readings_of_its_run_or_those_of_the_topics_that_are_named(bags, made):
    readings, of_run = read_readings(bags / "bag"), readings_of_run(made[0])
    assert_array_equal(readings.p_xy, of_run.p_xy)
    assert_allclose(readings.b_nt, of_run.b_nt, rtol=5e-16)
    named = read_readings(bags / "bag", field_topic="/robot/qtfm/magnitude")
    assert "(poses of topic /robot/enu/pose, field of /robot/qtfm/magnitude in T, by its size" in named.source
    assert len(named) > 0.9 * made[0].rows
