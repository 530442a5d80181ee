"""What sensors share: their clocks, latency and jitter, causality."""

import numpy as np
import pytest
from clocks import held
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from magtwin.errors import InputError
from magtwin.run.run import Run
from magtwin.sim.motion.drive import Moment, Motion
from magtwin.sim.motion.sampling import moment_at
from magtwin.sim.sensors.battery import Battery
from magtwin.sim.sensors.clock import SampledSensor
from magtwin.sim.sensors.imu import Imu
from magtwin.sim.sensors.lidar import Scanner, scans_of
from magtwin.sim.sensors.magnetometer import Magnetometer
from magtwin.sim.sensors.mocap import Mocap
from magtwin.sim.sensors.model_error import ModelError
from magtwin.sim.sensors.odometry import Odometry
from magtwin.spec.drive import DriveSpec
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.robot import RobotSpec
from magtwin.spec.sensors import BatterySpec, ImuSpec, LidarSpec, MagnetometerSpec, MocapSpec

T = np.arange(135 * 60) / 135.0


def generator(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def winding(steps: int = 3000) -> Motion:
    k = np.arange(steps)
    return Motion(DriveSpec(), 0.02, 0.2 + 0.1 * np.sin(k / 40), np.cos(k / 90), (1.0, -1.0, 2.0))


def sensor(name: str, rng: np.random.Generator) -> SampledSensor:
    """A sensor of a motion, with delays and noise."""
    if name == "odometry":
        return Odometry(DriveSpec(odometry_jitter_s=0.02, odometry_noise_std=0.01), rng)
    if name == "imu":
        return Imu(ImuSpec(jitter_s=0.02, gyro_bias_walk=1e-3), (0.0, 0.6, 0.0, 0.8), rng)
    if name == "mocap":
        return Mocap(MocapSpec(dropout_every_s=2.0, offset_m=(0.1, 0.2)), 0.3, rng)
    return Battery(BatterySpec(rate_hz=20.0), DriveSpec(), lambda t: t % 7 > 3, rng)


NAMES = ("odometry", "imu", "mocap", "battery")


def cut(t: np.ndarray, seed: int) -> list[np.ndarray]:
    """Pieces of random length, mostly short, and some empty."""
    edges = np.cumsum(generator(seed).choice([0, 1, 2, 3, 17, 400], len(t)))
    return np.split(t, np.concatenate([[0, 1], 1 + edges[1 + edges < len(t)]]))


def assert_same_bytes(pieces: list[dict[str, np.ndarray]], whole: dict[str, np.ndarray]) -> None:
    for name, values in whole.items():
        joined = np.concatenate([piece[name] for piece in pieces])
        assert joined.tobytes() == values.tobytes(), name


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10_000), rate=st.sampled_from([7.0, 50.0, 135.0]))
def test_steps_give_the_bytes_of_a_whole_run(name, seed, rate):
    t = np.arange(int(30 * rate)) / rate
    whole = sensor(name, generator(seed)).sense(winding(), t)
    by_steps = sensor(name, generator(seed))
    pieces = [by_steps.sense(winding(), piece, piece[-1] + 1e-4) for piece in cut(t, seed) if len(piece)]
    assert_same_bytes(pieces, whole)


@pytest.mark.parametrize("name", ["odometry", "imu"])
def test_sensors_of_many_robots_give_the_bytes_of_each(name):
    motions = [winding(), winding(100), winding(700)]
    stamps = np.arange(500) / 50.0
    alone = [sensor(name, generator(i)) for i in range(3)]
    stacked = type(alone[0]).stacked([sensor(name, generator(i)) for i in range(3)])
    moments = [moment_at(motion, stamps) for motion in motions]
    fields = Moment.__dataclass_fields__
    every = Moment(**{f: np.stack([getattr(m, f) for m in moments], axis=1) for f in fields})
    together = stacked.sample(stamps, every)
    for i, one in enumerate(alone):
        for column, values in one.sample(stamps, moments[i]).items():
            assert_array_equal(together[column][:, i], values, err_msg=column)


EVERY_FAULT = MagnetometerSpec(
    noise_density_nt=0.02,
    flicker_corner_hz=0.5,
    resolution_nt=0.001,
    bandwidth_hz=20.0,
    clock_offset_s=0.011,
    heading_error_nt=3.0,
    dead_zone_axis=0.3,
    dropout_share=0.05,
    vector_bias_nt=(60.0, -40.0, 85.0),
)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), gap=st.sampled_from([0, 50]))
def test_a_magnetometer_with_every_fault_gives_the_same_bytes_in_pieces(seed, gap):
    count = 600
    angle = np.linspace(0, 9, count)
    vector = 5e4 * np.column_stack([np.sin(angle), np.zeros(count), np.cos(angle)])
    total = 5e4 + 300 * np.sin(3 * angle)
    total[gap : gap + 10] = np.nan
    steep = (np.arange(count) // 30) % 5 == 3

    def read(magnetometer: Magnetometer, rows: np.ndarray) -> dict[str, np.ndarray]:
        axes = magnetometer.axes(vector[rows], steep=steep[rows])
        return {"axes": axes, **magnetometer.read(total[rows], vector[rows])}

    whole = read(Magnetometer(EVERY_FAULT, 135.0, generator(seed)), np.arange(count))
    by_steps = Magnetometer(EVERY_FAULT, 135.0, generator(seed))
    assert_same_bytes([read(by_steps, rows) for rows in cut(np.arange(count), seed)], whole)
    assert whole["flag_lost_lock"].any()
    assert np.isnan(whole["b_measured_nt"]).sum() > 10


def test_a_model_error_and_scans_give_the_same_bytes_in_pieces():
    whole, by_steps = (ModelError(60.0, 2.0).process(generator(3), 135.0) for _ in range(2))
    pieces = [{"u": by_steps.next(len(piece))} for piece in cut(T, 3)]
    assert_same_bytes(pieces, {"u": whole.next(len(T))})
    wall = Obstacles(triangles=np.array([[[2.0, -9.0, -1.0], [2.0, 9.0, -1.0], [2.0, 0.0, 5.0]]]))
    robot = RobotSpec(name="r", asset="r.usda", lidar=LidarSpec(jitter_s=0.05))

    def scan(scanner: Scanner, until: float) -> dict[str, np.ndarray]:
        scans = scanner.scan(
            until, lambda t: np.stack([0.1 * t, t * 0, t * 0, t], axis=1), lambda t: t % 3 > 1
        )
        return {name: getattr(scans, name) for name in ("t", "arrival", "p_world_lidar", "ranges_m")}

    by_steps = Scanner(robot, wall, generator(4))
    pieces = [scan(by_steps, until) for until in np.arange(1, 401) * 0.02]
    assert_same_bytes(pieces, scan(Scanner(robot, wall, generator(4)), 8.0))


@given(
    rate=st.floats(0.1, 300),
    latency=st.floats(0, 3),
    jitter=st.floats(0, 1),
    count=st.integers(1, 400),
    seed=st.integers(0, 9),
)
def test_whatever_the_delays_no_sample_is_seen_before_it_arrives(rate, latency, jitter, count, seed):
    t = np.arange(count) / 50.0
    stamps, latest = held(t, rate, latency_s=latency, jitter_s=jitter, rng=generator(seed))
    late = generator(seed).exponential(jitter, len(stamps)) if jitter else 0.0
    arrivals = np.maximum.accumulate(stamps + latency + late)
    seen = latest > 0  # the first is of a robot that has long been standing
    assert np.all(arrivals[latest][seen] <= t[seen])
    following = np.append(arrivals, np.inf)[latest + 1]
    assert np.all(following > t)  # and it is the newest that has arrived
    assert np.all(stamps[latest] <= t)
    assert np.all(np.diff(latest) >= 0)
    assert stamps[0] <= 0


STANDING = {"t": T, "p_world_base": np.zeros((len(T), 3)), "yaw": T * 0.0, "lidar_on": T >= 0}
OFTEN = MocapSpec(dropout_every_s=1e-9, dropout_s=1e-9)
FAST = RobotSpec(name="r", asset="r.usda", lidar=LidarSpec(scan_rate_hz=1e9))


@pytest.mark.parametrize(
    ("sense", "words"),
    [
        (lambda: held(T, 1e12), r"1e\+12 Hz would be 6e\+13 .* more than 20,000,000"),
        (lambda: held(T, 62.0, latency_s=1e9), "62 Hz would be"),
        (lambda: Mocap(OFTEN, 0.0, generator()).sense(winding(), T), "dropouts of"),
        (lambda: scans_of(Run(STANDING), FAST, Obstacles(), generator()), "a LiDAR's scans of"),
    ],
)
def test_more_samples_than_memory_could_hold_are_refused(sense, words):
    with pytest.raises(InputError, match=words):
        sense()
