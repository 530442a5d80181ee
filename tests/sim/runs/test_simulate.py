"""simulate: every column, the field's closed forms, determinism, refusals."""

import dataclasses
from pathlib import Path as FilePath

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from rooms import EARTH, SOURCES, scene_of, wavy_map

from magtwin.errors import InputError
from magtwin.frames import rotate, yaw_from_quat
from magtwin.path import Path, path_named
from magtwin.run.run import COLUMNS, Run
from magtwin.sim.interference import ambient_gradient_nt_m
from magtwin.sim.runs.simulate import simulate
from magtwin.spec.drive import DriveSpec
from magtwin.spec.magnetics import PlatformFieldSpec, SourceSpec
from magtwin.spec.robot import RobotSpec
from magtwin.spec.scene import Scene
from magtwin.spec.sensors import ImuSpec, MagnetometerSpec

EARTH_NT = np.array(EARTH.b_world_nt)
ROBOT = RobotSpec(
    name="robot",
    asset=FilePath("robot.usda"),
    p_base_magnetometer=(0.05, 0.0, 0.36),
    platform=PlatformFieldSpec(hard_iron_nt=(620.0, -430.0, 250.0), lidar_nt=(160.0, -90.0, 130.0)),
    drive=DriveSpec(localization_std_m=0.0, localization_yaw_std=0.0, localization_latency_s=0.0),
)
SURVEYED = scene_of(ROBOT, "surveyed")
KNOWN = scene_of(ROBOT, "known", earth=EARTH, sources=SOURCES)
LINE = Path("line", np.array([[-0.5, 0.2], [0.5, 0.2]]))


MAP = wavy_map()
FLAT = dataclasses.replace(MAP, values_nt=np.full((4, 15, 25), 41_000.0))


def drive(scene: Scene = KNOWN, path: Path = LINE, *, seed: int = 0, disturbance_nt=None, **options) -> Run:
    if disturbance_nt is not None:
        options |= {"network": True, "finish": lambda sensed: sensed.predicted(disturbance_nt)}
    options.setdefault("anomaly_map", MAP)
    return simulate(scene, path, rng=np.random.default_rng(seed), **options)


def with_robot(scene: Scene, **changes) -> Scene:
    return dataclasses.replace(scene, robot=dataclasses.replace(scene.robot, **changes))


def test_a_run_has_every_column_in_order_and_no_other():
    run = drive()
    assert list(run) == list(COLUMNS)
    for name, values in run.items():
        assert values.dtype == (bool if COLUMNS[name].unit == "bool" else float), name
        if name != "b_sd_nt":
            assert np.all(np.isfinite(values)), name
    assert np.isnan(run["b_sd_nt"]).all()


def test_columns_of_the_truth_agree_with_each_other():
    run = drive(path=path_named("figure8"), rate_hz=1000.0, duration_s=20.0)
    assert_allclose(yaw_from_quat(run["q_world_base_xyzw"]), run["yaw"], atol=1e-12)
    assert run["yaw"].min() >= -np.pi
    assert run["yaw"].max() < np.pi
    moved = np.diff(run["p_world_base"], axis=0) * 1000
    wanted = rotate(run["q_world_base_xyzw"], run["v_base"])[:-1]
    assert_allclose(moved, wanted, atol=2e-3)  # a reading's turn, and a step of 0.018 m/s shared by two
    turned = np.diff(np.unwrap(run["yaw"])) * 1000
    assert np.abs(turned - run["w_base"][:-1, 2]).mean() < 1e-3
    # The motors lag, the wheels slip, and the drive keeps its limits: in the mean it does what it is told.
    assert_allclose(run["v_cmd"].mean(), run["v_base"][:, 0].mean(), rtol=0.02)
    assert_allclose(run["w_cmd"].mean(), run["w_base"][:, 2].mean(), atol=0.01)


def test_the_field_is_that_at_the_magnetometer_not_at_base_link():
    from magtwin.field.sources.dipoles import dipole_field_nt

    lever = np.array([0.1, -0.05, 0.36])
    parts = {"p_base_magnetometer": tuple(lever.tolist()), "base_height_m": -0.02}
    scene = with_robot(KNOWN, **parts, platform=PlatformFieldSpec())
    run = drive(scene, path_named("figure8"), duration_s=20.0)
    assert_allclose(run["p_world_base"][:, 2], -0.02)
    p = run["p_world_base"] + rotate(run["q_world_base_xyzw"], lever)
    places, moments = zip(*((s.p_world, s.m_world) for s in SOURCES), strict=True)
    field = dipole_field_nt(p, np.array(places), np.array(moments)) + EARTH_NT
    assert_allclose(run["b_truth_nt"], np.linalg.norm(field, axis=1), rtol=0, atol=1e-3)


def test_eddy_currents_see_the_fields_rate_in_turning_axes():
    # Spin-like circle in the Earth's field alone: db/dt = -w x b, so E = e 1 adds -e w x b.
    e = 0.01
    platform = PlatformFieldSpec(eddy_s=(e, 0, 0, 0, e, 0, 0, 0, e))
    scene = with_robot(dataclasses.replace(KNOWN, sources=()), platform=platform)
    run = drive(scene, path_named("narrow_figure8"), anomaly_map=FLAT)
    b = rotate(run["q_world_base_xyzw"] * [-1, -1, -1, 1], np.broadcast_to(EARTH_NT, (run.rows, 3)))
    assert_allclose(run["b_vector_nt"], b - e * np.cross(run["w_base"], b), atol=1e-6)


def test_eddy_currents_see_the_fields_change_along_the_way():
    e = 1.0
    platform = PlatformFieldSpec(eddy_s=(e, 0, 0, 0, e, 0, 0, 0, e))
    still, moving = (
        drive(with_robot(KNOWN, platform=p))["b_vector_nt"] for p in (PlatformFieldSpec(), platform)
    )
    run = drive()
    cruising = (run["t"] > 1) & (run["t"] < 4)
    assert_allclose(run["v_cmd"][cruising], 0.2, rtol=1e-6)
    # On a straight line base_link does not turn: the eddy part is the derivative of the rest.
    slope = np.gradient(still, run["t"], axis=0)
    assert_allclose((moving - still)[cruising], slope[cruising], rtol=0, atol=1e-5 * np.abs(slope).max())
    assert np.abs((moving - still)[cruising]).max() > 10


def test_columns_turn_with_the_links_that_carry_the_sensors():
    # imu_link is yawed by a quarter to the left: base_link's x is its -y, base_link's y its x.
    # magnetometer_link lies on its back: y and z are turned over.
    none = (0.0, 0.0, 0.0)
    quiet = ImuSpec(
        tilt=(0.0, 0.0),
        level_error=(0.0, 0.0),
        tilt_std=0.0,
        orientation_noise_std=0.0,
        gyro_noise_std=0.0,
        gyro_bias_walk=0.0,
        gyro_vibration=none,
        accel_noise_std=0.0,
        accel_vibration=none,
    )
    plain = with_robot(KNOWN, imu=quiet)
    turned = with_robot(
        plain,
        q_base_imu_link_xyzw=(0.0, 0.0, 0.5**0.5, 0.5**0.5),
        q_base_magnetometer_link_xyzw=(1.0, 0.0, 0.0, 0.0),
    )
    a, b = (drive(scene, path_named("figure8"), duration_s=20.0) for scene in (plain, turned))
    assert np.abs(a["imu_a"]).max() > 0.02
    assert_allclose(b["imu_a"], a["imu_a"][:, [1, 0, 2]] * [1, -1, 1], atol=1e-12)
    assert_allclose(b["imu_w"], a["imu_w"], atol=1e-12)
    ahead = yaw_from_quat(b["imu_q_xyzw"]) - yaw_from_quat(a["imu_q_xyzw"])
    assert_allclose(np.sin(ahead), 1, atol=1e-12)
    assert_allclose(b["b_vector_nt"], a["b_vector_nt"] * [1, -1, -1], atol=1e-8)
    assert_array_equal(b["b_truth_nt"], a["b_truth_nt"])


def test_a_network_gives_the_disturbance_from_columns_that_are_filled():
    seen: list[Run] = []

    def network(run: Run) -> np.ndarray:
        seen.append(run)
        return 100 + 10 * run["imu_w"][:, 2]

    run = drive(SURVEYED, disturbance_nt=network)
    assert len(seen) == 1
    late = {"b_disturbance_nt", "b_total_nt", "b_noise_nt", "b_measured_nt"}
    late |= {"b_model_error_nt", "flag_lost_lock"}
    assert set(seen[0]) == set(COLUMNS) - late
    for name in set(COLUMNS) - late:
        assert_array_equal(seen[0][name], run[name])
    assert_array_equal(run["b_disturbance_nt"], 100 + 10 * run["imu_w"][:, 2])
    assert np.isnan(run["b_truth_nt"]).all()
    assert np.isnan(run["b_vector_nt"]).all()


def test_every_error_has_an_address():
    spec = MagnetometerSpec(
        noise_density_nt=0.5, bandwidth_hz=20.0, heading_error_nt=3.0, vector_bias_nt=(50, 0, 0)
    )
    neural = with_robot(KNOWN, magnetometer=dataclasses.replace(spec, kind="neural"))
    for scene, predicts in (
        (with_robot(KNOWN, magnetometer=spec), None),
        (with_robot(KNOWN, magnetometer=dataclasses.replace(spec, kind="map-only")), None),
        (neural, lambda run: 30 * run["yaw"]),
    ):
        run = drive(scene, path_named("figure8"), disturbance_nt=predicts, duration_s=20.0)
        assert_allclose(run["b_map_nt"] + run["b_disturbance_nt"], run["b_total_nt"], rtol=0, atol=1e-9)
        assert_allclose(run["b_total_nt"] + run["b_noise_nt"], run["b_measured_nt"], rtol=0, atol=1e-9)
        assert_allclose(np.linalg.norm(run["b_vector_nt"], axis=1), run["b_truth_nt"], rtol=1e-12)
        if run.metadata["magnetometer"] == "physical":
            assert_allclose(run["b_total_nt"], run["b_truth_nt"], rtol=0, atol=1e-9)
        assert np.abs(run["b_noise_nt"]).max() > 1
        off = (run["b_vector_measured_nt"] - run["b_vector_nt"]).mean(axis=0)
        # an axis is held for a reading on average, in which a field of 24,000 nT turns by about 1 mrad
        assert_allclose(off, [50, 0, 0], atol=25)


STEEP = SourceSpec(name="beam", p_world=(0.0, 0.35, 0.36), m_world=(0.0, 0.0, 3.0))
"""Beside the middle of LINE, at the magnetometer's height and 15 cm from where it comes by."""


def test_lock_is_lost_beside_steel_and_found_again_farther_on():
    spec = MagnetometerSpec(gradient_max_nt_m=60e3, gradient_relock_nt_m=30e3, stuck_std_nt=20.0)
    scene = with_robot(dataclasses.replace(KNOWN, sources=(STEEP,)), magnetometer=spec)
    run = drive(scene)
    lost, b = run["flag_lost_lock"], run["b_measured_nt"]
    begins = np.flatnonzero(np.diff(lost.astype(int)) == 1)
    ends = np.flatnonzero(np.diff(lost.astype(int)) == -1)
    assert len(begins) == len(ends) == 1
    assert len(np.unique(b[lost])) == 1  # a plateau, exactly repeated
    assert abs(b[lost][0] - 35_650) < 100
    # gradients where it is lost and found, of the exact field, within a step of the look-out (4 cm)
    sensor = run["p_world_base"] + rotate(run["q_world_base_xyzw"], np.array([0.05, 0.0, 0.36]))
    step = 0.2 / 5.0
    for k, limit in ((begins[0], 60e3), (ends[0], 30e3)):
        near = sensor[k] + np.array([[0, 0, 0], [-step, 0, 0]])
        before, after = np.sort(ambient_gradient_nt_m(scene, near))
        assert before * 0.99 < limit < after * 1.01
    distance = np.abs(sensor[:, 0])
    assert distance[ends[0]] > distance[begins[0]] + 0.03  # hysteresis: found later than lost
    assert_array_equal(
        run["b_measured_nt"][~lost],
        drive(with_robot(scene, magnetometer=MagnetometerSpec()))["b_measured_nt"][~lost],
    )


def test_one_seed_gives_identical_arrays_and_another_gives_others():
    a, b, c = drive(seed=3), drive(seed=3), drive(seed=4)
    for name in COLUMNS:
        assert a[name].tobytes() == b[name].tobytes(), name
    for name in ("odom_v", "imu_w", "imu_a", "imu_q_xyzw", "battery_v", "b_measured_nt"):
        assert not np.array_equal(a[name], c[name]), name


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"speed": 0.5}, r"speed must be above 0 and at most 0\.306 m/s"),
        ({"rate_hz": 0.0}, "rate_hz of the magnetometer must be above 0 Hz"),
        ({"rate_hz": float("inf")}, "rate_hz of the magnetometer must be above 0 Hz and finite"),
        ({"duration_s": -1.0}, "duration_s must be above 0 s"),
        ({"duration_s": float("inf")}, "duration_s must be above 0 s and finite, got inf"),
        ({"duration_s": 3600.0, "rate_hz": 1e4}, "more than 20,000,000; lower `rate_hz` to 5556 Hz"),
        ({"anomaly_map": wavy_map(extent_m=(0.5, 3.5)), "outside": "raise"}, "off the map"),
        ({"lidar": "maybe"}, 'lidar must be "schedule", "on" or "off"'),
        ({"outside": "guess"}, 'outside must be "nan", "clamp" or "raise"'),
        ({"scene": SURVEYED, "anomaly_map": FLAT}, "'surveyed' has a constant map and no Earth field"),
        ({"scene": with_robot(KNOWN, magnetometer=MagnetometerSpec(kind="neural"))}, "no network predicts"),
        ({"path": Path("far", np.array([[0.0, 0.0], [2.9, 0.0]]))}, "far leaves the floor at point 2"),
        *(
            ({"scene": with_robot(KNOWN, **robot)}, rf"{name} of \w+ must be at most")
            for name, robot in {
                "odometry_rate_hz": {"drive": DriveSpec(odometry_rate_hz=1e9)},
                "v_max": {"drive": DriveSpec(v_max=1e300)},
                "rate_hz": {"imu": ImuSpec(rate_hz=1e8)},
                "clock_offset_s": {"magnetometer": MagnetometerSpec(clock_offset_s=1e300)},
            }.items()
        ),
        ({"path": np.array([[0.0, 0.0], [1.0, 0.0]])}, "path must be a Path, Commands, a Run or"),
        ({"path": "figure8"}, "path must be a Path"),
        ({"disturbance_nt": lambda run: np.zeros(3)}, r"disturbance_nt must give shape \(\d+,\), got \(3,\)"),
    ],
)
def test_what_cannot_be_simulated_is_refused(options, says):
    with pytest.raises(InputError, match=says):
        drive(**options)
