"""A robot's own recording as a Run, and as the readings of a survey."""

import warnings

import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose, assert_array_equal
from recordings import START, UPRIGHT, as_db3, inertial, magnetic, moved, pose, record, stamped
from refusing import refused
from scipy.spatial.transform import Rotation

from magtwin.cli import main
from magtwin.errors import InputError, RepairWarning
from magtwin.io.bags import read_bag
from magtwin.io.formats import read_run
from magtwin.io.surveys.columns import Columns
from magtwin.io.surveys.readings import read_readings

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*by its size.*:magtwin.errors.RepairWarning"),
    pytest.mark.filterwarnings("ignore:.* joins .*:magtwin.errors.RepairWarning"),
]
MAG, POSE, ODOM, IMU = "/robot/qtfm/magnitude", "/robot/enu/pose", "/robot/odom", "/robot/imu"
BATTERY, CMD, SCAN = "/robot/battery_state", "/robot/cmd_vel", "/robot/scan"
POSES = ("PoseStamped", "PoseWithCovarianceStamped", "TransformStamped")
ODOMETRY, VECTOR3 = "nav_msgs/msg/Odometry", "geometry_msgs/msg/Vector3Stamped"
WORLD = np.array([12_000.0, 20_000.0, -38_000.0])
UP = (0, 0, 9.80665)
LATE = 0.003
"""Time that messages take to be received [s]."""


def turned(yaw):
    return Rotation.from_euler("z", yaw)


def at(rate_hz, seconds=4.0, offset=0.0):
    return offset + np.arange(int(seconds * rate_hz)) / rate_hz


def said(times, message, late=LATE):
    """Messages of a topic: `message` of the number and the time of each."""
    return [(t + late, *message(k, t)) for k, t in enumerate(times)]


def readings(scale=1.0, count=200):
    return said(at(50)[:count], lambda k, t: magnetic(t, scale * (41_000 + k)))


def vectors(scale=1.0, kind="sensor_msgs/msg/MagneticField", rate_hz=50):
    return said(
        at(rate_hz), lambda k, t: magnetic(t, *(scale * turned(0.3 * t).inv().apply(WORLD)), kind=kind)
    )


def poses(kind="geometry_msgs/msg/PoseStamped", rate_hz=20, frame="map", x=0.0):
    return said(at(rate_hz), lambda k, t: pose(t, (x + 0.2 * t, 0, 0), turned(0.3 * t), kind, frame=frame))


def odometry(rate_hz=25):
    return poses(ODOMETRY, rate_hz, "odom", 1.0)


def imu(q=UPRIGHT, frame="imu_link"):
    return said(at(30), lambda k, t: inertial(t, q, (0, 0, 0.5), UP, frame))


def twists(rate_hz=10):
    kind = "geometry_msgs/msg/Twist"
    return said(
        at(rate_hz), lambda k, t: (kind, {"linear": [0.1 * (k // 10), 0, 0], "angular": [0, 0, 0.2]}), 0.008
    )


def drive():
    """A drive on the topics of magtwin, each at a rate of its own."""
    charge = {"current": -1.25, "percentage": 0.75, "present": 1}
    return {
        MAG: readings(),
        POSE: said(at(20), lambda k, t: pose(t, (0.2 * t, 0, 0), turned(0.3))),
        ODOM: said(
            at(25, offset=0.001),
            lambda k, t: pose(
                t, (1 + 0.2 * t, 0, 0), turned(0.1), ODOMETRY, frame="odom", v=(0.2, 0, 0), w=(0, 0, 0.5)
            ),
        ),
        IMU: said(at(30, offset=0.5), lambda k, t: inertial(t, turned(-0.3), (0, 0, 0.5), (0.1, 0.2, 9.8))),
        BATTERY: said(
            at(1),
            lambda k, t: (
                "sensor_msgs/msg/BatteryState",
                {**stamped(t), "voltage": 15.5 + 0.1 * k, **charge},
            ),
        ),
        CMD: twists(),
        SCAN: said(
            at(10, 2.0), lambda k, t: ("sensor_msgs/msg/LaserScan", {**stamped(t), "ranges": np.ones(5 + k)})
        ),
        "/rosout": [(0.0, "std_msgs/msg/String", {"data": "hello"})],
    }


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_drive_becomes_a_run_on_the_magnetometers_clock(tmp_path, storage):
    bag = record(tmp_path / "run.mcap", drive())
    run = read_bag(bag if storage == "mcap" else as_db3(bag, tmp_path / "bag"))
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
    assert_array_equal(run["lidar_on"], t < 1.9 + 0.5 - 1e-9)
    known = {"field_unit": "nT", "stamps": "header", "imu_gravity": "removed", "truth": f"topic {POSE}"}
    known |= {"start_ns": str(START * 10**9), "topics": " ".join(sorted(drive().keys() - {"/rosout"}))}
    assert known.items() <= run.metadata.items()


# by what the field is published in: options of the reader
FIELDS = {
    "T": ({"/imu/mag": vectors(1e-9)}, {}),
    "uT": ({"/imu/mag": vectors(1e-3)}, {}),
    "nT": ({"/imu/mag": vectors()}, {}),
    "mG": ({"/imu/mag": vectors(1e-2)}, {}),
    "G": ({"/imu/mag": vectors(1e-5)}, {}),
    "units of 42942 nT": ({"/imu/mag": vectors(1 / 42_942)}, {"scale": 42_942.0}),
    "T, by its name": ({"/compass": vectors(1e-9, VECTOR3), "/wind": vectors(3.0, VECTOR3)}, {}),
}


@pytest.mark.parametrize(("unit", "kind"), zip(FIELDS, POSES * 3, strict=False))
def test_roles_are_found_by_type_and_units_by_size_in_a_run_and_in_readings(tmp_path, unit, kind):
    topics = {
        "/vicon/pose": poses(f"geometry_msgs/msg/{kind}"),
        "/odometry/filtered": odometry(),
        "/imu/data": imu(),
    }
    topics |= {"/cmd_vel": twists(), "/wheel/speed": twists(), "/clicked": poses()[:1], **FIELDS[unit][0]}
    bag, options = record(tmp_path / "a.mcap", topics), FIELDS[unit][1]
    run, survey = read_bag(bag, **options), read_readings(bag, columns=Columns(**options))
    b = np.array([turned(0.3 * t).inv().apply(WORLD) for t in run["t"]])
    assert_allclose(run["b_vector_measured_nt"], b, rtol=1e-9)
    inside = ~run["flag_pose_lost"]
    assert_allclose(run["p_world_base"][inside, 0], 0.2 * run["t"][inside], atol=1e-9)
    assert {"odom_p", "imu_w", "v_cmd"} <= set(run)
    assert run.metadata["field_unit"] == unit.split(",")[0]
    assert "field /" in run.metadata["taken"]
    assert (
        "pose /vicon/pose, odometry /odometry/filtered, IMU /imu/data by their types" in run.metadata["taken"]
    )
    assert "commands /cmd_vel by " in run.metadata["taken"]
    assert len(survey) == inside.sum() == 198
    assert_array_equal(survey.p_xy, run["p_world_base"][inside, :2])
    assert_allclose(survey.b_body_nt, b[inside], rtol=1e-9)
    assert f"field of {run.metadata['clock']} in {run.metadata['field_unit']}, " in survey.source


def test_a_recording_and_the_table_that_is_made_of_it_give_the_same_readings(tmp_path, capsys):
    gap = [row for row in poses() if not 1.0 < row[0] < 2.0]
    bag = record(tmp_path / "a.mcap", {"/imu/mag": vectors(1 / 42_942), "/vicon/pose": gap})
    main(["convert", str(bag), str(tmp_path / "a.parquet"), "--scale", "42942"])
    main(["info", str(bag), "--scale", "42942"])
    assert "200" in capsys.readouterr().out
    direct, made = read_readings(bag, columns=Columns(scale=42_942.0)), read_readings(tmp_path / "a.parquet")
    assert len(direct) == len(made) == 146
    for name in ("p_xy", "yaw", "b_nt", "b_body_nt", "t"):
        assert_array_equal(getattr(direct, name), getattr(made, name))
    assert "no recording; drop the option 'scale'" in refused(capsys, "info", "lab", "--scale", "2")
    assert "no option 'scale'; drop it" in refused(capsys, "info", tmp_path / "a.parquet", "--scale", "2")


BASE = {"/mag": readings(), "/pose": poses()}
SLAM = poses("geometry_msgs/msg/PoseWithCovarianceStamped", 5)
TWO = {"/odom1": odometry(), "/odom2": odometry()}
TIES = [
    (read_bag, {**BASE, "/a/mag": readings()}, "field topics, /a/mag .*, 50 Hz.*--field-topic TOPIC$"),
    (read_readings, {**BASE, "/a/mag": readings()}, "field topics, .*--field-topic TOPIC$"),
    (
        read_bag,
        {"/mag": readings(), "/place": poses(), "/site": SLAM},
        "pose topics, /place .*/site .*, 5 Hz.*",
    ),
    (read_bag, {**BASE, **TWO}, "odometry topics, /odom1 .*, /odom2 .*--remap /robot/odom:=TOPIC$"),
    (read_readings, {"/mag": readings(), **TWO}, "odometry topics, .*--pose-topic TOPIC$"),
]


@pytest.mark.parametrize(("read", "topics", "words"), TIES, ids=range(len(TIES)))
def test_a_role_of_several_topics_is_refused_with_their_rates_and_the_option(tmp_path, read, topics, words):
    bag = record(tmp_path / "a.mcap", topics)
    with pytest.raises(InputError, match=words):
        read(bag)


def test_a_name_that_is_given_or_that_magtwin_gives_decides_between_topics(tmp_path):
    topics = {
        MAG: readings(),
        "/mag": readings(2.0),
        POSE: poses(),
        "/slam": poses(x=9.0),
        "/odom": odometry(),
    }
    bag = record(tmp_path / "a.mcap", topics | {ODOM: odometry(), "/imu": imu()})
    run = read_bag(bag)
    assert run["b_measured_nt"][0] == 41_000
    assert run.metadata["truth"] == f"topic {POSE}"
    assert run.metadata["topics"] == f"/imu {POSE} {ODOM} {MAG}"
    other = read_bag(bag, topics={POSE: "/slam", MAG: "/mag"})
    assert (other["p_world_base"][0, 0], other["b_measured_nt"][0]) == (9.0, 82_000)
    survey = read_readings(bag, pose_topic="/slam", field_topic="/mag")
    assert (survey.p_xy[0, 0], survey.b_nt[0]) == (9.0, 82_000)


def test_a_minor_role_of_several_topics_or_of_another_clock_is_left_out_with_a_warning(tmp_path):
    far = said(at(1, offset=1e6), lambda k, t: ("sensor_msgs/msg/BatteryState", stamped(t)))
    bag = record(tmp_path / "a.mcap", {**BASE, "/imu/a": imu(), "/imu/b": imu(), "/battery": far})
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        run = read_bag(bag)
    assert not {"imu_w", "battery_v"} & set(run)
    words = [str(warning.message) for warning in told]
    imus, battery = (text for text in words if " joins " not in text and "by its size" not in text)
    assert "2 IMU topics, /imu/a (sensor_msgs/msg/Imu, 30 Hz), /imu/b" in imus
    assert imus.endswith(f"choose with --remap {IMU}:=TOPIC; none is read")
    assert "battery topic left out: /battery spans 1000000.000..1000003.000 s since" in battery


def test_odometry_is_the_truth_only_if_something_moves_it_or_it_is_named_and_that_is_told(tmp_path):
    bag = record(tmp_path / "a.mcap", {"/mag": readings(), ODOM: odometry()})
    assert "p_world_base" not in read_bag(bag)
    survey = read_readings(bag)
    assert_allclose(survey.p_xy[:, 0], 1 + 0.2 * survey.t, atol=1e-9)
    assert f"taken poses of {ODOM}, which is odometry and drifts" in survey.source
    with pytest.warns(RepairWarning, match=f"{ODOM} is both the odometry and the true pose"):
        run = read_bag(bag, topics={POSE: ODOM})
    assert {"p_world_base", "odom_p"} <= set(run)


@pytest.mark.parametrize("by", [1, 0])
def test_odometry_is_moved_into_the_map_by_transforms_unless_its_topic_is_named(tmp_path, by):
    steps = [(0.0, *moved(0.0, ("map", "odom", (0, 0, 0), UPRIGHT)))]
    there = ("map", "/odom", (3.0 * by, 4.0 * by, 0), turned(-0.5 * by))
    steps.append((1.0, *moved(1.0, ("base_link", "wheel", (9, 0, 0), UPRIGHT), there)))
    bag = record(tmp_path / "a.mcap", {"/odom": odometry(), "/mag": readings(), "/tf": steps})
    survey, named = read_readings(bag), read_readings(bag, pose_topic="/odom")
    text = "; taken poses of /odom from 'odom' to 'map', by /tf (by up to 5 m and 28.6 deg)"
    assert (text in survey.source) == by
    assert (f"{text}, which is not applied, as their topic was named" in named.source) == by
    p = np.column_stack([1 + 0.2 * named.t, 0 * named.t])
    assert_allclose(named.p_xy, p, atol=1e-9)
    later = survey.t >= 1.0  # the last transform holds on
    c, s = np.cos(-0.5 * by), np.sin(-0.5 * by)
    assert_allclose(survey.p_xy[later], (np.array([3.0, 4.0]) * by + p @ [[c, s], [-s, c]])[later], atol=1e-7)
    assert_allclose(np.exp(1j * (survey.yaw - named.yaw))[later], np.exp(-0.5j * by), atol=1e-6)
    if by:
        run = read_bag(bag)
        assert run.metadata["truth"] == f"topic {text.removeprefix('; taken poses of ')}"
        assert_allclose(run["odom_p"][:, 0], 1 + 0.2 * np.floor(run["t"] * 25 + 1e-6) / 25, atol=1e-9)


@pytest.mark.parametrize(("scale", "unit"), [(1, "nT"), (1e-3, "uT"), (1e-9, "T")])
def test_the_unit_is_told_by_size_or_given(tmp_path, scale, unit):
    bag = record(tmp_path / "a.mcap", {MAG: readings(scale)})
    run = read_bag(bag)
    assert_allclose(run["b_measured_nt"], 41_000 + np.arange(200), rtol=1e-12)
    assert (run.metadata["field_unit"], run.metadata["field_unit_told"]) == (unit, "by its size")
    assert read_bag(bag, unit=unit).metadata["field_unit_told"] == "given"
    with pytest.warns(RepairWarning, match="nT in G, not that of the Earth's field: iron near"):
        assert_allclose(read_bag(bag, unit="G")["b_measured_nt"], 1e5 * scale * (41_000 + np.arange(200)))


@pytest.mark.parametrize(("factor", "unit"), [(3.7e-9, None), (3.7e-9, "T"), (0.2e-9, "T")])
def test_a_field_with_the_robots_iron_is_read_with_a_warning(tmp_path, factor, unit):
    bag = record(tmp_path / "a.mcap", {MAG: readings(factor)})
    with pytest.warns(RepairWarning, match="nT in T, not that of the Earth's field: iron near the sensor"):
        run = read_bag(bag, unit=unit)
    assert_allclose(run["b_measured_nt"], factor * 1e9 * (41_000 + np.arange(200)), rtol=1e-12)


def test_a_vector_beside_the_magnitude_has_a_unit_of_its_own(tmp_path):
    run = read_bag(record(tmp_path / "a.mcap", {MAG: readings(), "/robot/qtfm/field": vectors(1e-9)}))
    assert_allclose(run["b_vector_measured_nt"][0], WORLD)
    assert_array_equal(run["b_measured_nt"], 41_000 + np.arange(200))
    assert (run.metadata["field_unit"], run.metadata["vector_unit"]) == ("nT", "T")


def test_a_simulation_that_begins_at_0_has_stamps(tmp_path):
    def early(said):
        return [
            (t, kind, {**fields, "header.stamp": fields["header.stamp"] - START * 10**9})
            for t, kind, fields in said
        ]

    topics = {MAG: early(readings()), POSE: early(poses()), CMD: twists()[:1]}
    run = read_bag(record(tmp_path / "a.mcap", topics))
    assert run.metadata["stamps"] == "header"
    assert_allclose(run["mocap_p"][:, 0], 0.2 * np.floor(run["t"] * 20 + 1e-6) / 20, atol=1e-9)
    assert_array_equal(np.isfinite(run["v_cmd"]), run["t"] >= 0.005)  # though it was received years later


def test_a_message_that_came_twice_is_one_reading(tmp_path):
    one = readings(count=20)
    assert read_bag(record(tmp_path / "a.mcap", {MAG: one[:6] + one[5:]})).rows == 20


def swapped(rows, k):
    """Messages of which two were received in each other's place."""
    first, second = rows[k], rows[k + 1]
    return [*rows[:k], (first[0], *second[1:]), (second[0], *first[1:]), *rows[k + 2 :]]


def changed(rows, changes):
    """Messages of which some are others."""
    return [(row[0], *changes[k]) if k in changes else row for k, row in enumerate(rows)]


WITHOUT = ("geometry_msgs/msg/PoseStamped", stamped(2.0, "map"))
UNSET = magnetic(None, 41_000)
NOUGHT = {7: magnetic(0.14, 0.0), 9: magnetic(0.18, 0.0)}
REPAIRED = [
    ({"/pose": swapped(poses(), 40)}, 200, 198, "messages of /pose: 1 sorted, of 80"),
    ({"/mag": swapped(readings(), 90)}, 200, 198, "messages of /mag: 1 sorted, of 200"),
    (
        {"/mag": changed(readings(), {100: magnetic(None, 41_000)})},
        199,
        197,
        "messages of /mag: 1 without a stamp left out, of 200",
    ),
    ({"/mag": changed(readings(), NOUGHT)}, 200, 196, "2 of 200 messages of /mag as missing, which are 0"),
    ({"/pose": changed(poses(), {40: WITHOUT})}, 200, 198, "1 of 80 poses as missing"),
]


@pytest.mark.parametrize(("topics", "rows", "known", "words"), REPAIRED, ids=range(len(REPAIRED)))
def test_a_few_faulty_messages_are_repaired_or_left_out_and_told(tmp_path, topics, rows, known, words):
    bag = record(tmp_path / "a.mcap", {**BASE, **topics})
    run, survey = read_bag(bag), read_readings(bag)
    assert (run.rows, len(survey)) == (rows, known)
    assert words in run.metadata["taken"]
    assert words in survey.source
    assert_allclose(survey.p_xy[:, 0], 0.2 * survey.t, atol=1e-9)


def test_an_imu_without_orientation_is_taken_as_upright(tmp_path):
    run = read_bag(record(tmp_path / "a.mcap", {**BASE, "/imu": imu(np.zeros(4))}))
    assert np.isnan(run["imu_q_xyzw"]).all()
    assert_allclose(run["imu_a"], 0, atol=1e-12)
    assert "120 of 120 orientations of /imu as missing" in run.metadata["taken"]


def test_readings_lie_between_poses_and_are_level(tmp_path):
    roll = Rotation.from_euler("x", 0.2)
    tilted = said(at(20), lambda k, t: pose(t, (0.2 * t, 0, 0), turned(0.3 * t) * roll))
    field = said(at(50), lambda k, t: magnetic(t, *((turned(0.3 * t) * roll).inv().apply(WORLD) * 1e-9)))
    field[7] = (field[7][0], *magnetic(at(50)[7], np.nan))
    gap = [row for row in tilted if not 1.0 < row[0] < 2.0]
    survey = read_readings(record(tmp_path / "a.mcap", {"/mag": field, "/pose": gap}))
    assert len(survey) == 145
    assert "(55 of 200 rows without a value left out)" in survey.source
    assert_allclose(survey.p_xy[:, 0], 0.2 * survey.t, atol=1e-9)
    level = np.array([turned(0.3 * t).inv().apply(WORLD) for t in survey.t])
    assert_allclose(survey.b_body_nt, level, rtol=1e-6)


LATER = [(t, *pose(t - 1.1 * (k in (40, 60)), (0, 0, 0), UPRIGHT)) for k, t in enumerate(at(20))]
BACKWARDS = {MAG: [(t, *magnetic(1.0 - 0.001 * k, 41_000)) for k, t in enumerate(at(50, 1.0))]}
FAR = said(at(20, offset=1e6), lambda k, t: pose(t, (0, 0, 0), UPRIGHT), -1e6)
NO_NUMBER = said(at(50), lambda k, t: magnetic(t, np.nan))
NO_TURN = said(at(20), lambda k, t: ("geometry_msgs/msg/PoseStamped", stamped(t)))
REFUSED = [
    ({"/depth": poses()}, {}, r"no field topic .*; topics in it: /depth \("),
    ({}, {}, r"no field topic .*; topics in it: /rosout \(std_msgs"),
    ({MAG: readings()}, {POSE: "/vrpn"}, "no topic /vrpn; topics in it"),
    (BASE, {POSE: "/pos"}, "no topic /pos; did you mean '/pose'"),
    (BASE, {"/robot/pose": "/a"}, "^no topic '/robot/pose'; did you mean '/robot/enu/pose'"),
    ({MAG: readings(), POSE: readings()}, {}, "/robot/enu/pose is a sensor_msgs/msg/MagneticField"),
    (BACKWARDS, {}, "run backwards for good, from .* in message 2 of 50"),
    ({"/mag": readings(), "/pose": LATER}, {}, "2 of 80 stamps of /pose are wrong, .* in message 41"),
    ({"/mag": readings(), "/pose": FAR}, {}, "are they of one clock"),
    ({"/mag": NO_NUMBER}, {}, "no message of /mag holds a number"),
    ({"/mag": readings(1e-4)}, {}, "median of /mag is 4.10995; in no unit"),
    ({"/mag": readings(), "/pose": []}, {POSE: "/pose"}, "topic /pose has no message"),
    ({"/mag": readings(), "/pose": NO_TURN}, {}, "80 of 80 poses .* quaternion is 0,0,0,0"),
]


@pytest.mark.parametrize(("topics", "names", "words"), REFUSED, ids=range(len(REFUSED)))
def test_what_cannot_be_a_run_is_refused_with_what_is_there(tmp_path, topics, names, words):
    bag = record(tmp_path / "bag", {"/rosout": drive()["/rosout"], **topics})
    with pytest.raises(InputError, match=words) as refusal:
        read_bag(bag, topics=names)
    assert str(bag) in str(refusal.value) or "no topic '" in words
    assert "\n" not in str(refusal.value)


def test_convert_takes_the_names_of_topics(tmp_path, capsys):
    bag = record(tmp_path / "bag", {MAG: readings(), "/vrpn/pose": poses(), "/slam": poses()})
    out = tmp_path / "run.parquet"
    main(["convert", str(bag), str(out), "--remap", f"{POSE}:=/vrpn/pose", "--unit", "nT"])
    assert "p_world_base" in read_run(out)
    for topic, text in {
        "/vrpn/pose": "/robot/enu/pose:=/vrpn/pose, each once, got '/vrpn/pose'",
        f"{POSE}=/vrnp/pose": "no topic /vrnp/pose; did you mean '/vrpn/pose'",
    }.items():
        assert text in refused(capsys, "convert", bag, out, "--force", "--remap", topic)
    with pytest.raises(InputError, match=r"Parquet has no option .unit.; drop it"):
        read_run(out, unit="T")


def test_a_bag_in_two_files_is_one(tmp_path):
    """As `ros2 bag record --max-bag-duration` makes them."""
    for k in range(2):
        half = {topic: [row for row in rows if (row[0] >= 2) == k] for topic, rows in BASE.items()}
        as_db3(record(tmp_path / f"{k}.mcap", half), tmp_path / f"part_{k}")
    bag = tmp_path / "part_0"
    (tmp_path / "part_1" / "part_1.db3").rename(bag / "part_1.db3")
    told = yaml.safe_load((bag / "metadata.yaml").read_text())
    told["rosbag2_bagfile_information"]["relative_file_paths"].append("part_1.db3")
    (bag / "metadata.yaml").write_text(yaml.safe_dump(told))
    one, two = read_bag(record(tmp_path / "one.mcap", BASE)), read_bag(bag)
    for name in one:
        assert_array_equal(one[name], two[name])


def test_metadata_that_is_none_or_points_outside_its_folder_reaches_nothing_and_runs_nothing(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    bag = record(tmp_path / "bag", {MAG: readings()})
    (bag / "bag_0.mcap").rename(tmp_path / "bag_0.mcap")
    text = (bag / "metadata.yaml").read_text()
    (bag / "metadata.yaml").write_text(text.replace("bag_0.mcap", "../bag_0.mcap"))
    with pytest.raises(InputError, match=r"storage file bag_0\.mcap is missing"):
        read_bag(bag)
    texts = [
        "",
        "{",
        "rosbag2_bagfile_information: 1\n",
        "!!python/object/apply:os.system ['touch x']\n",
        "[" * 500,
    ]
    for bad in [*texts, "rosbag2_bagfile_information:\n  version: 99\n"]:
        (bag / "metadata.yaml").write_text(bad)
        with pytest.raises(InputError, match="bag: damaged bag, or none") as refusal:
            read_bag(bag)
        assert "\n" not in str(refusal.value)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bag", "bag_0.mcap"]
