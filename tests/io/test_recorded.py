"""A robot's own recording as a Run; rosbags writes the bags."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from magtwin.errors import InputError, RepairWarning
from magtwin.io.bags import read_bag

STORE = get_typestore(Stores.ROS2_HUMBLE)
START = 1_700_000_000_000_000_000
MS = 1_000_000
MAG, POSE, ODOM, IMU = "/robot/qtfm/magnitude", "/robot/enu/pose", "/robot/odom", "/robot/imu"
BATTERY, CMD, JOINTS, SCAN = "/robot/battery_state", "/robot/cmd_vel", "/robot/joint_states", "/robot/scan"


def make(kind, **parts):
    return STORE.types[kind](**parts)


def header(ns, frame="map"):
    stamp = make("builtin_interfaces/msg/Time", sec=ns // 10**9, nanosec=ns % 10**9)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def vector(x=0.0, y=0.0, z=0.0, kind="Vector3"):
    return make(f"geometry_msgs/msg/{kind}", x=float(x), y=float(y), z=float(z))


def quaternion(yaw):
    return make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=np.sin(yaw / 2), w=np.cos(yaw / 2))


def pose_of(x, yaw):
    return make("geometry_msgs/msg/Pose", position=vector(x, kind="Point"), orientation=quaternion(yaw))


def twist(v, w):
    return make("geometry_msgs/msg/Twist", linear=vector(v), angular=vector(z=w))


def covered(kind, what, value, size):
    return make(kind, **{what: value, "covariance": np.zeros(size)})


def magnetic(ns, *b):
    return make(
        "sensor_msgs/msg/MagneticField",
        header=header(ns, "qtfm"),
        magnetic_field=vector(*b),
        magnetic_field_covariance=np.zeros(9),
    )


def posed(ns, x, yaw, kind="PoseStamped"):
    if kind == "PoseStamped":
        return make("geometry_msgs/msg/PoseStamped", header=header(ns), pose=pose_of(x, yaw))
    pose = covered("geometry_msgs/msg/PoseWithCovariance", "pose", pose_of(x, yaw), 36)
    if kind == "PoseWithCovarianceStamped":
        return make("geometry_msgs/msg/PoseWithCovarianceStamped", header=header(ns), pose=pose)
    return odometry(ns, x, yaw, 0.0, 0.0)


def odometry(ns, x, yaw, v, w):
    return make(
        "nav_msgs/msg/Odometry",
        header=header(ns, "odom"),
        child_frame_id="base_link",
        pose=covered("geometry_msgs/msg/PoseWithCovariance", "pose", pose_of(x, yaw), 36),
        twist=covered("geometry_msgs/msg/TwistWithCovariance", "twist", twist(v, w), 36),
    )


def inertial(ns, yaw, a):
    zero = np.zeros(9)
    return make(
        "sensor_msgs/msg/Imu",
        header=header(ns, "imu_link"),
        orientation=quaternion(yaw),
        orientation_covariance=zero,
        angular_velocity=vector(z=0.5),
        angular_velocity_covariance=zero,
        linear_acceleration=vector(*a),
        linear_acceleration_covariance=zero,
    )


def battery(ns, volts):
    names = ("temperature", "charge", "capacity", "design_capacity")
    flags = ("power_supply_status", "power_supply_health", "power_supply_technology")
    cells = np.full(4, volts / 4, np.float32)
    return make(
        "sensor_msgs/msg/BatteryState",
        header=header(ns, ""),
        voltage=volts,
        current=-1.25,
        percentage=0.75,
        **dict.fromkeys(names, 0.0),
        **dict.fromkeys(flags, 0),
        present=True,
        cell_voltage=cells,
        cell_temperature=cells[:0],
        location="bay",
        serial_number="a-1",
    )


def joints(ns, names, position):
    none = np.zeros(0)
    position = np.array(position, float)
    return make(
        "sensor_msgs/msg/JointState",
        header=header(ns, ""),
        name=names,
        position=position,
        velocity=none,
        effort=none,
    )


def scanned(ns, rays):
    numbers = (
        "angle_min",
        "angle_max",
        "angle_increment",
        "time_increment",
        "scan_time",
        "range_min",
        "range_max",
    )
    return make(
        "sensor_msgs/msg/LaserScan",
        header=header(ns, "rplidar_link"),
        **dict.fromkeys(numbers, 0.0),
        ranges=np.ones(rays, np.float32),
        intensities=np.zeros(0, np.float32),
    )


def record(path, topics, storage="mcap"):
    """A bag of messages: by topic a list of (time of receipt [ns], message)."""
    rows = [(t, topic, message) for topic, said in topics.items() for t, message in said]
    with Writer(path, version=8, storage_plugin=StoragePlugin[storage.upper()]) as writer:
        connections = {
            topic: writer.add_connection(
                topic, said[0][1].__msgtype__ if said else "std_msgs/msg/Float64", typestore=STORE
            )
            for topic, said in topics.items()
        }
        for t, topic, message in sorted(rows, key=lambda row: row[0]):
            writer.write(connections[topic], t, STORE.serialize_cdr(message, message.__msgtype__))
    return path


def at(rate_hz, seconds=4.0, late_ms=3, offset_ms=0):
    """Stamps and times of receipt [ns]."""
    stamps = START + offset_ms * MS + (np.arange(int(seconds * rate_hz)) * 10**9 // rate_hz)
    return [(int(s), int(s) + late_ms * MS) for s in stamps]


def x_at(ns):
    return 0.2 * (ns - START) / 1e9


def readings(scale=1.0, count=None):
    said = [(r, magnetic(s, scale * (41_000 + k))) for k, (s, r) in enumerate(at(50))]
    return said[:count]


def poses(kind="PoseStamped", **options):
    return [(r, posed(s, x_at(s), 0.3, kind)) for s, r in at(20, **options)]


def drive():
    return {
        MAG: readings(),
        POSE: poses(),
        ODOM: [(r, odometry(s, x_at(s) + 1, 0.1, 0.2, 0.5)) for s, r in at(25, offset_ms=1)],
        IMU: [(r, inertial(s, -0.3, (0.1, 0.2, 9.8))) for s, r in at(30, offset_ms=500)],
        BATTERY: [(r, battery(s, 15.5 + 0.1 * k)) for k, (s, r) in enumerate(at(1))],
        CMD: [(r, twist(0.1 * (k // 10), 0.2)) for k, (s, r) in enumerate(at(10, late_ms=8))],
        JOINTS: [
            (r, joints(s, ["arm", "right_wheel_joint", "left_wheel_joint"][k % 2 :], [9, 2, 1][k % 2 :]))
            for k, (s, r) in enumerate(at(10))
        ],
        SCAN: [(r, scanned(s, 5 + k)) for k, (s, r) in enumerate(at(10, seconds=2.0))],
        "/rosout": [(START, make("std_msgs/msg/String", data="hello"))],
    }


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_drive_becomes_a_run_on_the_magnetometers_clock(tmp_path, storage):
    run = read_bag(record(tmp_path / "bag", drive(), storage))
    t = np.arange(200) / 50
    assert_allclose(run["t"], t, atol=1e-9)
    assert_array_equal(run["b_measured_nt"], 41_000.0 + np.arange(200))
    assert_allclose(run["mocap_p"][:, 0], 0.2 * np.floor(t * 20 + 1e-6) / 20, atol=1e-9)
    inside = t <= 3.95
    assert_allclose(run["p_world_base"][inside, 0], 0.2 * t[inside], atol=1e-9)
    assert_array_equal(run["flag_pose_lost"], ~inside)
    assert_allclose(run["yaw"], 0.3)
    held = np.floor((t - 0.001) * 25 + 1e-6)
    assert_allclose(run["odom_p"][1:, 0], 1 + 0.2 * (held[1:] / 25 + 0.001), atol=1e-9)
    assert np.isnan(run["odom_v"][0]).all()
    assert_allclose(run["odom_w"][1:], np.tile([0, 0, 0.5], (199, 1)))
    assert np.isnan(run["imu_a"][:25]).all()
    assert_allclose(run["imu_a"][25:], np.tile([0.1, 0.2, 9.8 - 9.80665], (175, 1)), atol=1e-9)
    assert (run["imu_q_xyzw"][25:, 3] >= 0).all()
    assert_allclose(run["battery_v"], 15.5 + 0.1 * np.floor(t), rtol=1e-7)
    assert_allclose(run["battery_a"], 1.25)
    came = np.floor((t - 0.005) * 10 + 1e-6)  # less what the magnetometer's messages took
    assert_allclose(run["v_cmd"][1:], 0.1 * (came[1:] // 10))
    assert_array_equal(run["wheel_angle"], np.tile([1.0, 2.0], (200, 1)))
    assert_array_equal(run["lidar_on"], t < 1.9 + 0.5 - 1e-9)
    assert run.metadata["field_unit"] == "nT"
    assert run.metadata["stamps"] == "header"
    assert run.metadata["start_ns"] == str(START)
    assert run.metadata["imu_gravity"] == "removed"
    assert POSE in run.metadata["topics"]


@pytest.mark.parametrize("kind", ["PoseStamped", "PoseWithCovarianceStamped", "Odometry"])
def test_poses_may_be_of_several_types_under_a_name_of_their_own(tmp_path, kind):
    bag = record(tmp_path / "bag", {MAG: readings(), "/vrpn/robot/pose": poses(kind)})
    run = read_bag(bag, topics={POSE: "/vrpn/robot/pose"})
    inside = run["t"] <= 3.95
    assert_allclose(run["p_world_base"][inside, 0], 0.2 * run["t"][inside], atol=1e-9)
    assert list(read_bag(bag)) == ["t", "b_measured_nt"]


@pytest.mark.parametrize(("scale", "unit"), [(1, "nT"), (1e-3, "uT"), (1e-9, "T")])
def test_the_unit_is_told_by_size_and_said(tmp_path, scale, unit):
    bag = record(tmp_path / "bag", {MAG: readings(scale)})
    run = read_bag(bag)
    assert_allclose(run["b_measured_nt"], 41_000 + np.arange(200), rtol=1e-12)
    assert (run.metadata["field_unit"], run.metadata["field_unit_told"]) == (unit, "by its size")
    assert read_bag(bag, unit=unit).metadata["field_unit_told"] == "given"
    with pytest.raises(InputError, match=f"in {unit} it would be"):
        read_bag(bag, unit="G")


@pytest.mark.parametrize(("factor", "unit"), [(3.7e-9, None), (3.7e-9, "T"), (0.2e-9, "T")])
def test_a_field_with_the_robots_iron_is_read_with_a_warning(tmp_path, factor, unit):
    bag = record(tmp_path / "bag", {MAG: readings(factor)})
    with pytest.warns(RepairWarning, match="nT in T, not that of the Earth's field: iron near the sensor"):
        run = read_bag(bag, unit=unit)
    assert_allclose(run["b_measured_nt"], factor * 1e9 * (41_000 + np.arange(200)), rtol=1e-12)


def test_a_vector_field_gives_its_magnitude_and_itself(tmp_path):
    b = np.array([12_000.0, 20_000.0, -38_000.0])
    bag = record(tmp_path / "bag", {MAG: [(r, magnetic(s, *(b * 1e-9))) for s, r in at(50)]})
    run = read_bag(bag)
    assert_allclose(run["b_vector_measured_nt"], np.tile(b, (200, 1)))
    assert_allclose(run["b_measured_nt"], np.linalg.norm(b))


def test_a_vector_beside_the_magnitude_has_a_unit_of_its_own(tmp_path):
    b = np.array([12_000.0, 20_000.0, -38_000.0])
    field = [(r, magnetic(s, *(b * 1e-9))) for s, r in at(50)]
    run = read_bag(record(tmp_path / "bag", {MAG: readings(), "/robot/qtfm/field": field}))
    assert_allclose(run["b_vector_measured_nt"], np.tile(b, (200, 1)))
    assert (run.metadata["field_unit"], run.metadata["vector_unit"]) == ("nT", "T")


def test_plain_numbers_are_taken_as_received(tmp_path):
    said = [(r, make("std_msgs/msg/Float64", data=41_000.0)) for _, r in at(50)]
    run = read_bag(record(tmp_path / "bag", {"/mag": said, POSE: poses()}), topics={MAG: "/mag"})
    assert run.metadata["stamps"] == "receipt"
    assert_allclose(run["mocap_p"][:, 0], 0.2 * np.floor(run["t"] * 20 + 1e-6) / 20, atol=1e-9)


def test_a_simulation_that_begins_at_0_has_stamps(tmp_path):
    said = [(START + k * 20 * MS, magnetic(k * 20 * MS, 41_000)) for k in range(100)]
    pose = [(START + k * 50 * MS, posed(k * 50 * MS, k, 0.0)) for k in range(40)]
    command = [(START + 70 * MS, twist(0.3, 0.0))]
    run = read_bag(record(tmp_path / "bag", {MAG: said, POSE: pose, CMD: command}))
    assert run.metadata["stamps"] == "header"
    assert_allclose(run["mocap_p"][:, 0], np.floor(run["t"] * 20 + 1e-6), atol=1e-9)
    assert_array_equal(np.isfinite(run["v_cmd"]), run["t"] >= 0.07)  # though it was received years later


def test_a_message_that_came_twice_is_one_reading(tmp_path):
    said = readings(count=20)
    run = read_bag(record(tmp_path / "bag", {MAG: [*said, *said[5:6]][:6] + said[5:]}))
    assert run.rows == 20


def test_messages_that_overtook_each_other_are_sorted_and_told(tmp_path):
    said = poses()
    said[40], said[41] = [(said[k][0], said[81 - k][1]) for k in (40, 41)]
    run = read_bag(record(tmp_path / "bag", {MAG: readings(), POSE: said}))
    straight = read_bag(record(tmp_path / "straight", {MAG: readings(), POSE: poses()}))
    for name in straight:
        assert_array_equal(run[name], straight[name])
    assert "1 messages of /robot/enu/pose by their stamps, behind which they came" in run.metadata["taken"]


@pytest.mark.parametrize(("row", "stamp_ns"), [(0, 0), (100, 0), (100, START - 60 * 10**9)])
def test_one_stamp_that_is_wrong_is_one_reading_less_and_told(tmp_path, row, stamp_ns):
    said = readings()
    said[row] = said[row][0], magnetic(stamp_ns, 41_000)
    run = read_bag(record(tmp_path / "bag", {MAG: said}))
    assert run.rows == 199
    assert run["t"][-1] < 4
    text = f"1 of 200 messages of {MAG} as missing, whose stamps are wrong"
    assert text in run.metadata["taken"]


def backwards(said):
    return [(t, magnetic(START + (1000 - k) * MS, 41_000)) for k, (t, _) in enumerate(said)]


def test_what_cannot_be_a_run_is_refused_with_what_is_there(tmp_path):
    far = [(r, posed(s + 10**15, 0, 0)) for s, r in at(20)]
    late = [(r, posed(s - 1100 * MS * (k in (40, 60)), 0, 0)) for k, (s, r) in enumerate(at(20))]
    cases = {
        "no topic /robot/qtfm/magnitude; did you mean '/robot/qtfm/magnetude'.; topics in it: "
        r"/robot/qtfm/magnetude \(sensor_msgs": ({"/robot/qtfm/magnetude": readings()}, None),
        r"no topic /robot/qtfm/magnitude; topics in it: none": ({}, None),
        r"no topic /vrpn; topics in it: /robot/qtfm/magnitude": ({MAG: readings()}, {POSE: "/vrpn"}),
        "^no topic '/robot/pose'; did you mean '/robot/enu/pose'": ({MAG: readings()}, {"/robot/pose": "/a"}),
        r"/robot/enu/pose is a sensor_msgs/msg/MagneticField; it must be geometry_msgs/msg/PoseStamped or": (
            {MAG: readings(), POSE: readings()},
            None,
        ),
        r"stamps of /robot/qtfm/magnitude run backwards: .* in message 2 of 200": (
            {MAG: backwards(readings())},
            None,
        ),
        r"stamps of /robot/enu/pose run backwards: .* in message 41 of 80": (
            {MAG: readings(), POSE: late},
            None,
        ),
        r"/robot/enu/pose spans 1000000.000\.\.1000003.950 s since .* are they of one clock": (
            {MAG: readings(), POSE: far},
            None,
        ),
        r"no message of /robot/qtfm/magnitude holds a number": (
            {MAG: [(r, magnetic(s, np.nan)) for s, r in at(50)]},
            None,
        ),
        r"in no unit is that the Earth's field": ({MAG: readings(1e-4)}, None),
    }
    for k, (text, (topics, names)) in enumerate(cases.items()):
        bag = record(tmp_path / f"bag{k}", topics)
        with pytest.raises(InputError, match=text) as refusal:
            read_bag(bag, topics=names)
        assert str(bag) in str(refusal.value) or "no topic '" in text
        assert "\n" not in str(refusal.value)


def test_convert_makes_a_table_of_a_robots_own_bag(tmp_path, capsys):
    from magtwin.cli import main
    from magtwin.io.formats import read_run

    bag, out = record(tmp_path / "bag", {MAG: readings(), "/vrpn/pose": poses()}), tmp_path / "run.parquet"
    main(["convert", str(bag), str(out), "--remap", f"{POSE}:=/vrpn/pose", "--unit", "nT"])
    assert "p_world_base" in read_run(out)
    for topic, text in {
        "/vrpn/pose": "/robot/enu/pose:=/vrpn/pose, each once, got '/vrpn/pose'",
        f"{POSE}=/vrnp/pose": "no topic /vrnp/pose; did you mean '/vrpn/pose'",
    }.items():
        with pytest.raises(SystemExit, match="1"):
            main(["convert", str(bag), str(out), "--force", "--remap", topic])
        assert text in capsys.readouterr().err
    with pytest.raises(InputError, match=r"Parquet has no option .unit.; drop it"):
        read_run(out, unit="T")


def test_a_bag_in_two_files_is_one(tmp_path):
    """As `ros2 bag record --max-bag-duration` makes them."""
    import yaml

    whole = drive()
    half = START + 2 * 10**9
    for k, keep in enumerate((lambda t: t < half, lambda t: t >= half)):
        part = {
            topic: [m for m in said if keep(m[0])] for topic, said in whole.items() if topic in (MAG, POSE)
        }
        record(tmp_path / f"part_{k}", part, "sqlite3")
    bag = tmp_path / "part_0"
    (tmp_path / "part_1" / "part_1.db3").rename(bag / "part_1.db3")
    told = yaml.safe_load((bag / "metadata.yaml").read_text())
    told["rosbag2_bagfile_information"]["relative_file_paths"].append("part_1.db3")
    (bag / "metadata.yaml").write_text(yaml.safe_dump(told))
    (tmp_path / "one").mkdir()
    one = read_bag(record(tmp_path / "one" / "bag", {MAG: whole[MAG], POSE: whole[POSE]}))
    two = read_bag(bag)
    for name in one:
        assert_array_equal(one[name], two[name])


def test_metadata_that_points_outside_its_folder_reaches_nothing_and_runs_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    bag = record(tmp_path / "bag", {MAG: readings()})
    (bag / "bag.mcap").rename(tmp_path / "bag.mcap")
    text = (bag / "metadata.yaml").read_text()
    (bag / "metadata.yaml").write_text(text.replace("bag.mcap", "../bag.mcap"))
    with pytest.raises(InputError, match=r"storage file bag\.mcap is missing"):
        read_bag(bag)
    for bad in (
        "",
        "{",
        "rosbag2_bagfile_information: 1\n",
        "!!python/object/apply:os.system ['touch x']\n",
        "[" * 500,
    ):
        (bag / "metadata.yaml").write_text(bad)
        with pytest.raises(InputError, match="bag: damaged bag, or none") as refusal:
            read_bag(bag)
        assert "\n" not in str(refusal.value)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bag", "bag.mcap"]
