"""Several robots in one lab: each by numbers of its own, felt by the others, kept from meeting."""

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from rooms import EARTH, scene_of

from magtwin.author.scene import author_scene
from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.sources.dipoles import dipole_field_nt
from magtwin.files.file import shipped
from magtwin.io.provenance import repeat
from magtwin.io.tables import read_parquet
from magtwin.path import Path
from magtwin.run import mapped
from magtwin.run.run import Run
from magtwin.sim.motion.drive import Motion
from magtwin.sim.runs.multi_robot import simulate_robots as run_robots
from magtwin.sim.runs.neighbours import Neighbour, iron_moments, neighbours_field_nt
from magtwin.spec.drive import DriveSpec
from magtwin.spec.magnetics import PlatformFieldSpec
from magtwin.spec.robot import PlacedRobot, RobotSpec
from magtwin.spec.scene import Scene
from magtwin.twin import Twin, scene_from_toml, simulate_robots
from magtwin.twin import simulate as simulate_one

EARTH_NT = np.array(EARTH.b_world_nt)
FLAT = AnomalyMap(
    values_nt=np.full((1, 2, 2), np.linalg.norm(EARTH_NT)),
    origin_m=(-3, -2),
    cell_m=(6, 4),
    headings_rad=np.zeros(1),
)
IRON = PlatformFieldSpec(
    hard_iron_nt=(415.0, 760.0, 2000.0),
    soft_iron=(0.008, 0.001, 0.0, 0.001, -0.004, 0.0005, 0.0, 0.0005, 0.002),
    eddy_s=(0.004, 0.0, 0.0, 0.0, 0.004, 0.0, 0.0, 0.0, 0.006),
)
EXACT = DriveSpec(
    localization_std_m=0.0,
    localization_yaw_std=0.0,
    localization_latency_s=0.0,
    wheel_radius_error_std=0.0,
    wheel_separation_error_std=0.0,
    slip_s2_m=0.0,
    yaw_slip=0.0,
)
RATE_HZ = 50.0


def robot(name: str, **fields) -> RobotSpec:
    given = {"platform": IRON, "drive": EXACT, "p_base_magnetometer": (-0.02, 0.01, 0.3)} | fields
    return RobotSpec(name=name, asset="robot.usda", base_height_m=0.04, **given)


def line(name: str, *points: tuple[float, float]) -> Path:
    return Path(name, np.array(points))


OTHERS = (PlacedRobot(robot=robot("bob")), PlacedRobot(robot=robot("cleo")))
SCENE = scene_of(robot("ann"), earth=EARTH, others=OTHERS)
EAST, WEST = line("east", (-2, 0), (2, 0)), line("west", (2, 0.6), (-2, 0.6))
FAR = line("far", (-2.5, -1.5), (-2.4, -1.5))


def rngs(*names: str) -> dict[str, np.random.Generator]:
    return {name: np.random.default_rng(ord(name[0])) for name in names}


def drive(scene: Scene = SCENE, ways: dict | None = None, **options) -> dict[str, Run]:
    ways = {"ann": EAST, "bob": WEST} if ways is None else ways
    return run_robots(scene, ways, **{"anomaly_map": FLAT, "rngs": rngs(*ways), "rate_hz": RATE_HZ} | options)


@pytest.fixture(scope="module")
def passing() -> dict[str, Run]:
    """Two robots that pass each other at 0.6 m."""
    return drive()


def test_long_runs_of_several_robots_are_those_that_are_made_at_once(passing, monkeypatch):
    monkeypatch.setattr(mapped, "LONG", 300)
    monkeypatch.setattr(mapped, "BLOCK", 170)
    seen: dict[str, list[Run]] = {"ann": [], "bob": []}
    made = drive(each=lambda name, block: seen[name].append(block))
    for name, run in made.items():
        assert dict(run.metadata) == dict(passing[name].metadata)
        assert {key: v.tobytes() for key, v in run.items()} == {
            key: v.tobytes() for key, v in passing[name].items()
        }
        assert_array_equal(np.concatenate([block["t"] for block in seen[name]]), run["t"])
        assert len(seen[name]) > 4


def test_the_moment_for_a_robots_iron_makes_its_field_at_its_own_magnetometer():
    spec = robot("ann")
    b = np.random.default_rng(1).normal(0, 3e4, (5, 3))
    m = iron_moments(spec, b)
    seen = [dipole_field_nt(spec.p_base_magnetometer, np.zeros((1, 3)), one[None]) for one in m]
    assert_allclose(seen, b @ np.reshape(IRON.soft_iron, (3, 3)).T + IRON.hard_iron_nt, rtol=1e-6)
    assert not iron_moments(replace(spec, platform=PlatformFieldSpec()), b).any()


def test_a_robot_at_rest_feels_another_as_the_dipole_that_this_is():
    """Closed form, in world axes and then in the reader's, whose soft iron answers to it."""
    here, there = (0.2, -0.3, 0.7), (0.9, 0.4, -2.0)
    still = [Motion(EXACT, 0.02, np.zeros(5), np.zeros(5), pose) for pose in (here, there)]
    t = np.array([0.02, 0.05])
    field = neighbours_field_nt(
        SCENE, [Neighbour(SCENE.robots[1].robot, still[1])], still[0], t, still[0].at(t)
    )
    turn = [np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]]) for a in (0.7, -2.0)]
    m_world = turn[1] @ iron_moments(SCENE.robots[1].robot, (turn[1].T @ EARTH_NT)[None])[0]
    p_sensor = np.array([*here[:2], 0.04]) + turn[0] @ SCENE.robot.p_base_magnetometer
    b = turn[0].T @ dipole_field_nt(p_sensor, np.array([[*there[:2], 0.04]]), m_world[None])
    assert np.linalg.norm(b) > 20  # nT
    assert_allclose(field, [b + np.reshape(IRON.soft_iron, (3, 3)) @ b] * 2, rtol=1e-6)


def test_what_a_robot_drives_past_adds_eddy_currents_by_the_rate_of_its_field():
    t = np.arange(0.5, 4, 1e-3)
    ahead = Motion(EXACT, 0.02, np.full(250, 0.3), np.full(250, 0.4), (-0.5, 0.0, 0.0))
    back = Motion(EXACT, 0.02, np.full(250, 0.2), np.zeros(250), (0.8, 0.7, np.pi))
    others, true = [Neighbour(SCENE.robots[1].robot, back)], ahead.at(t)

    def seen(platform: PlatformFieldSpec) -> np.ndarray:
        scene = replace(SCENE, robot=robot("ann", platform=platform))
        return neighbours_field_nt(scene, others, ahead, t, true)

    plain = seen(replace(IRON, soft_iron=(0.0,) * 9, eddy_s=(0.0,) * 9))
    with_eddy = seen(replace(IRON, soft_iron=(0.0,) * 9))
    rate = np.gradient(plain, t, axis=0)
    assert np.abs(rate).max() > 50  # nT/s
    want = rate @ np.reshape(IRON.eddy_s, (3, 3)).T
    assert_allclose((with_eddy - plain)[1:-1], want[1:-1], atol=2e-3 * np.abs(want).max())


def test_robots_that_would_meet_are_refused_with_time_and_place():
    ways = {"ann": line("east", (-1, 0), (1, 0)), "bob": line("west", (1, 0), (-1, 0)), "cleo": FAR}
    # they touch when each has gone 1 - 0.171 m; at 0.2 m/s, after 0.15 s to get going
    with pytest.raises(
        InputError, match=r"'ann' and 'bob' would run into each other after 4\.\d\d s at \(-?0\.00, "
    ):
        drive(ways=ways)


def test_bumps_are_flagged_in_both_while_they_overlap_where_that_is_asked_for():
    ways = {"ann": line("east", (-1, 0), (1, 0)), "bob": line("west", (1, 0.1), (-1, 0.1)), "cleo": FAR}
    runs = drive(ways=ways, meet="flag")
    apart = np.hypot(*(runs["ann"]["p_world_base"] - runs["bob"]["p_world_base"])[:, :2].T)
    assert (apart < 0.342).any()
    for name in ("ann", "bob"):
        assert_array_equal(runs[name]["flag_bump"], apart < 0.342)
    assert not runs["cleo"]["flag_bump"].any()
    assert runs["cleo"].metadata["nearest_clearance_m"] > 0.5


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"ways": {}}, "no robot is to drive"),
        ({"ways": {"anne": EAST}}, "no robot 'anne'; did you mean 'ann'"),
        ({"ways": {"ann": line("out", (0, 0), (9, 0))}}, r"robot 'ann': path out"),
        ({"meet": "bounce"}, "no way of robots to meet 'bounce'"),
    ],
)
def test_what_cannot_be_driven_together_is_refused(options, said):
    with pytest.raises(InputError, match=said):
        drive(**options)


def test_a_scene_drives_all_of_its_robots_the_first_as_by_itself(tmp_path):
    (tmp_path / "far.csv").write_text("-2.5,-1.5\n-2.4,-1.5\n")
    placed = PlacedRobot(robot=robot("bob"), path=tmp_path / "far.csv")
    scene = replace(SCENE, path="sine", others=(placed,))
    twin = Twin(scene, tmp_path / "two.usda", FLAT, None)
    runs = simulate_robots(twin, {"ann": line("short", (0, 1), (0.5, 1))}, seed=4, rate_hz=RATE_HZ)
    assert list(runs) == ["ann", "bob"]
    assert [run.metadata["path"] for run in runs.values()] == ["short", "far.csv"]
    alone = simulate_one(twin, line("short", (0, 1), (0.5, 1)), seed=4, rate_hz=RATE_HZ)
    for name in ("p_world_base", "odom_p", "imu_w", "battery_v", "b_map_nt", "mocap_p"):
        assert_array_equal(runs["ann"][name], alone[name], err_msg=name)
    rows = min(run.rows for run in runs.values())
    assert not np.allclose(runs["ann"]["battery_v"][:rows], runs["bob"]["battery_v"][:rows])
    with pytest.raises(InputError, match="no robot 'an'; did you mean 'ann'"):
        simulate_robots(twin, robots=["an"])


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """The default lab with two robots that pass each other, on disk."""
    folder = tmp_path_factory.mktemp("two")
    for name, text in (("ann", "-0.4,0\n0.4,0\n"), ("bob", "0.4,0.5\n-0.4,0.5\n")):
        (folder / f"{name}.csv").write_text(text)
    lab = scene_from_toml(shipped("scenes", "lab.toml"))
    sensor = replace(lab.robot.magnetometer, kind="physical", network=None, network_sha256="", inputs=())
    ann, bob = (replace(lab.robot, name=name, magnetometer=sensor) for name in ("ann", "bob"))
    others = (PlacedRobot(robot=bob, path=folder / "bob.csv"),)
    return author_scene(replace(lab, robot=ann, path=folder / "ann.csv", others=others), folder / "scene")


def test_run_writes_a_file_for_each_robot_or_one_to_the_same_bits(two, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("MAGTWIN_RUN_RATE_HZ", "20")
    main(["run", str(two), "--out", str(tmp_path / "r.parquet"), "--json"])
    report = json.loads(capsys.readouterr().out)
    assert {"ann_duration_s", "bob_duration_s"} <= report["figures"].keys()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["r.ann.parquet", "r.bob.parquet"]
    main(["run", str(two), "--robot", "bob", "--out", str(tmp_path / "one.parquet")])
    whole, one = read_parquet(tmp_path / "r.bob.parquet"), read_parquet(tmp_path / "one.parquet")
    for name, values in whole.items():
        assert_array_equal(values, one[name], err_msg=name)
    again = repeat(whole)
    assert again.equal
    assert not again.causes
    assert whole.metadata["nearest_robot"] == report["metadata"]["bob"]["nearest_robot"] == "ann"
