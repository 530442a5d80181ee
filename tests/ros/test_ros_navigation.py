"""Room for localization: one tree of frames, a localizer that completes it, and what viewers show."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import pytest
from nodes import DOMAINS, in_a_domain, spin

from magtwin.frames import quat_from_yaw, rotate, wrap_angle, yaw_from_quat
from magtwin.io.bags.sender import Transforms
from magtwin.io.bags.topics import COMMAND, LATCHED, ODOMETRY, TF, TF_STATIC, Qos
from magtwin.io.bags.types import typestore
from magtwin.path.occupancy import occupancy_of
from magtwin.ros.bus import Bus, Message, open_bus, poses_bytes, to_bytes
from magtwin.ros.localization.localize import PARAMETERS, LocalizerNode
from magtwin.ros.localization.poses import ESTIMATE, POSE_KIND, read_pose
from magtwin.ros.localization.poses import PATH as ESTIMATED_PATH
from magtwin.ros.parameters import settings
from magtwin.ros.simulate import Simulator
from magtwin.ros.topics import FIELD, OCCUPANCY, PATH, READINGS, TRUTH
from magtwin.ros.views import MOST_POSES, Trail
from magtwin.tasks.localizing import live_problem
from magtwin.twin import Twin, room_of

pytest.importorskip("cyclonedds", reason="extra ros is not installed")

MANY = Qos(depth=2000)
DURATION_S = 10.0


@pytest.fixture(scope="module")
def node() -> Iterator[Callable[..., Bus]]:
    """Makes nodes in one domain."""
    with in_a_domain() as made:
        yield made


def content(message: Message):
    """The message as an object of rosbags."""
    return typestore().deserialize_cdr(message.data, message.kind)


def stamp_ns(header) -> int:
    return header.stamp.sec * 10**9 + header.stamp.nanosec


@dataclass
class Heard:
    """What a listener received while a robot was driven and localized."""

    transforms: dict[tuple[str, str], list[tuple[int, np.ndarray, np.ndarray]]] = field(default_factory=dict)
    """Stamp, translation and rotation of each transform, by parent and child."""

    messages: dict[str, list[Message]] = field(default_factory=dict)

    def tf(self, message: Message) -> None:
        for t in content(message).transforms:
            p, q = t.transform.translation, t.transform.rotation
            row = (stamp_ns(t.header), np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w]))
            self.transforms.setdefault((t.header.frame_id, t.child_frame_id), []).append(row)


@pytest.fixture(scope="module")
def heard(twin: Twin, node: Callable[..., Bus]) -> Heard:
    """A drive at three times real time, with `magtwin ros localize` beside it."""
    seen, ear, bus = Heard(), node("ear"), node("localizer", sim_time=True)
    simulator = Simulator(twin, node("sim"), seed=3, speed=3.0, lidar="on")
    spin(lambda: bus.types(ODOMETRY.name) and bus.types("qtfm/magnitude"), bus)
    values = settings(PARAMETERS, ["prior:=0.05,-0.05,0.05", "use_sim_time:=true"])
    LocalizerNode(twin, bus, values, method="rbpf-iron", problem=live_problem(twin, seed=4))
    ear.subscribe(TF.name, TF.kind, seen.tf, MANY)
    ear.subscribe(TF_STATIC.name, TF_STATIC.kind, seen.tf, LATCHED)
    for name, kind in (
        *((topic.name, topic.kind) for topic in (TRUTH, ODOMETRY, READINGS, PATH)),
        *((ESTIMATE, POSE_KIND), (ESTIMATED_PATH, PATH.kind)),
    ):
        seen.messages[name] = []
        ear.subscribe(name, kind, seen.messages[name].append, MANY)
    drive = ear.publisher(COMMAND.name, COMMAND.kind, COMMAND.qos)
    spin(lambda: drive.subscribers() and ear.publishers(ESTIMATE) and ear.types(TF.name), ear, bus)
    sent = [-1.0]

    def others() -> bool:
        if simulator.online.t - sent[-1] > 0.2:
            sent.append(simulator.online.t)
            drive.publish(to_bytes(COMMAND.kind, {"linear": [0.2, 0.0, 0.0], "angular": [0.0, 0.0, 0.35]}))
        for each in (bus, ear):
            each.spin_once(0.0)
        return False

    simulator.run(others, duration_s=DURATION_S)
    for _ in range(20):
        bus.spin_once(0.01)
        ear.spin_once(0.01)
    return seen


def test_with_a_localizer_the_frames_are_one_tree_and_no_frame_has_two_parents(heard: Heard) -> None:
    parents = {child: parent for parent, child in heard.transforms}
    assert len(parents) == len(heard.transforms)
    for frame in [*parents, "base_footprint", "magnetometer_link", "rplidar_link"]:
        for _ in range(10):
            frame = parents.get(frame, frame)
        assert frame == "map"
    assert parents["odom"] == "map"
    assert parents["base_link"] == "odom"
    assert parents["ground_truth"] == "map"
    footprint = heard.transforms["base_link", "base_footprint"][0][1]
    truth = heard.transforms["map", "ground_truth"][-1][1]
    assert truth[2] + footprint[2] == pytest.approx(0.0, abs=1e-9)  # on the floor


def test_map_to_odom_puts_base_link_at_the_estimate_without_jumps(heard: Heard) -> None:
    chain = heard.transforms["map", "odom"]
    odometry = {
        stamp_ns(m.header): (m.pose.pose.position, m.pose.pose.orientation)
        for m in map(content, heard.messages[ODOMETRY.name])
    }
    stamps = np.array(sorted(odometry))
    poses = [read_pose(message) for message in heard.messages[ESTIMATE]]
    assert len(chain) >= 5 * DURATION_S - 12
    assert len(chain) == len(poses)
    last = None
    for (valid_ns, p, q), (taken_ns, frame, pose, covariance) in zip(chain, poses, strict=True):
        assert frame == "map"
        assert valid_ns == taken_ns + 200_000_000  # it holds until the next one
        at, turn = odometry[stamps[np.searchsorted(stamps, taken_ns, side="right") - 1]]
        base = p + rotate(q, [at.x, at.y, at.z])
        heading = yaw_from_quat(q) + yaw_from_quat(np.array([turn.x, turn.y, turn.z, turn.w]))
        # odometry reaches the node up to one period after its stamp, in which the robot drives 3 mm
        np.testing.assert_allclose(base[:2], pose[:2], atol=0.01)
        assert abs(wrap_angle(heading - pose[2])) < 0.03
        if last is not None:  # what the correction moves the robot by is within what the filter admits
            moved = base[:2] - (last[0] + rotate(last[1], [at.x, at.y, at.z]))[:2]
            assert np.hypot(*moved) < 4 * np.sqrt(np.trace(covariance[:2, :2])) + 0.01
        last = p, q


def test_readings_and_paths_are_where_the_robot_was(heard: Heard, twin: Twin) -> None:
    clouds = list(map(content, heard.messages[READINGS.name]))
    tables = [np.frombuffer(bytes(m.data), "<f4").reshape(m.width, len(m.fields)) for m in clouds]
    assert [f.name for f in clouds[0].fields] == ["x", "y", "z", "b_nt"]
    table = np.concatenate(tables)
    rate = twin.scene.robot.magnetometer.rate_hz
    assert len(table) == pytest.approx(rate * DURATION_S, rel=0.03)
    b_nt = twin.field
    assert (
        np.nanmin(b_nt.values_nt) - 500 < table[:, 3].min() <= table[:, 3].max() < b_nt.values_nt.max() + 500
    )
    assert table[:, 2] == pytest.approx(twin.scene.robot.p_base_magnetometer[2] - 0.00445, abs=1e-3)
    true = np.array([[m.pose.pose.position.x, m.pose.pose.position.y]
                     for m in map(content, heard.messages[TRUTH.name])])  # fmt: skip
    for name, most in ((PATH.name, 0.02), (ESTIMATED_PATH, 1.0)):
        path = content(heard.messages[name][-1])
        p = np.array([[pose.pose.position.x, pose.pose.position.y] for pose in path.poses])
        assert path.header.frame_id == "map"
        assert len(p) > 10
        assert np.hypot(*(p[:, None] - true).transpose(2, 0, 1)).min(axis=1).max() < most
        assert (np.hypot(*np.diff(p, axis=0).T) >= 0.05 - 2e-9).all()


@pytest.mark.parametrize("tf", ["all", "none"])
def test_all_also_gives_map_to_odom_and_none_leaves_odom_to_base_link_to_a_filter(
    twin: Twin, tf: Transforms
) -> None:
    domain = next(DOMAINS)
    bus, ear = (open_bus(name, backend="cyclonedds", domain=domain) for name in ("sim", "ear"))
    simulator, seen = Simulator(twin, bus, speed=4.0, tf=tf), Heard()
    ear.subscribe(TF.name, TF.kind, seen.tf, MANY)
    spin(lambda: ear.types(TF.name), ear)
    simulator.run(lambda: ear.spin_once(0.0) or len(seen.transforms) > 2)
    bus.close()
    ear.close()
    drive = {pair for pair in seen.transforms if "wheel" not in pair[1]}
    if tf == "all":
        assert drive == {("map", "odom"), ("odom", "base_link")}
    else:
        assert drive == {("map", "ground_truth")}


def test_the_lab_is_latched_as_grid_and_cloud(twin: Twin, node: Callable[..., Bus]) -> None:
    late, got = node("late"), dict[str, Message]()
    for topic in (OCCUPANCY, FIELD):
        late.subscribe(topic.name, topic.kind, lambda m, name=topic.name: got.update({name: m}), topic.qos)
    held = Simulator(twin, node("another"), speed=4.0)
    spin(lambda: len(got) == 2, late)
    grid, shown = occupancy_of(room_of(twin)), content(got[OCCUPANCY.name])
    assert (shown.info.height, shown.info.width) == grid.cells.shape
    np.testing.assert_array_equal(np.asarray(shown.data).reshape(grid.cells.shape), grid.cells)
    assert (shown.info.origin.position.x, shown.info.origin.position.y) == grid.origin_m
    cloud = content(got[FIELD.name])
    table = np.frombuffer(bytes(cloud.data), "<f4").reshape(cloud.width, 5)
    assert [f.name for f in cloud.fields] == ["x", "y", "z", "b_nt", "sd_nt"]
    field_map = twin.field
    every = np.repeat(table[:, None, :2].astype(float), len(field_map.headings_rad), axis=1)
    mean = field_map.lookup(every, np.broadcast_to(field_map.headings_rad, every.shape[:2]), outside="clamp")
    np.testing.assert_allclose(table[:, 3], mean.mean(axis=1), atol=0.5)  # float32 places and values
    assert held.robots


@pytest.mark.parametrize("frame", ["map", "a_map", ""])
@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_a_path_is_one_to_the_reference_reader(frame: str, count: int) -> None:
    poses = np.column_stack(
        [np.random.default_rng(1).normal(size=(count, 3)), np.tile([0, 0, 0, 1.0], (count, 1))]
    )
    data = poses_bytes(PATH.kind, 3_000_000_007, frame, poses)
    path = typestore().deserialize_cdr(data, PATH.kind)
    assert bytes(typestore().serialize_cdr(path, PATH.kind)) == data
    assert [(p.header.frame_id, stamp_ns(p.header)) for p in path.poses] == [(frame, 3_000_000_007)] * count
    read = [[p.pose.position.x, p.pose.position.y, p.pose.position.z] for p in path.poses]
    np.testing.assert_array_equal(np.array(read).reshape(-1, 3), poses[:, :3])


def test_a_trail_keeps_the_newest_poses_a_step_apart() -> None:
    trail = Trail()
    for x in np.arange(0, 0.05 * (MOST_POSES + 50), 0.01):
        trail.add([x, 0, 0], quat_from_yaw(0.0))
    assert len(trail.poses) == MOST_POSES
    x = np.array([pose[0] for pose in trail.poses])
    assert x[-1] > 0.05 * (MOST_POSES + 48)
    np.testing.assert_allclose(np.diff(x), 0.05, atol=0.0101)
