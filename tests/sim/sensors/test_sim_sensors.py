"""What sensors share: their clocks, latency and jitter, causality."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.errors import InputError
from magtwin.run.run import Run
from magtwin.sim.motion.drive import Motion
from magtwin.sim.motion.sampling import held, moment_at
from magtwin.sim.sensors.battery import STEP_S, discharge, sense_battery
from magtwin.sim.sensors.imu import sense_imu
from magtwin.sim.sensors.lidar import scans_of
from magtwin.sim.sensors.mocap import sense_mocap
from magtwin.sim.sensors.odometry import sense_odometry
from magtwin.spec.drive import DriveSpec
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.robot import RobotSpec
from magtwin.spec.sensors import BatterySpec, ImuSpec, LidarSpec, MocapSpec

T = np.arange(135 * 60) / 135.0
LEVEL = (0.0, 0.0, 0.0, 1.0)


def generator(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def winding(steps: int = 3000) -> Motion:
    k = np.arange(steps)
    return Motion(DriveSpec(), 0.02, 0.2 + 0.1 * np.sin(k / 40), np.cos(k / 90), (1.0, -1.0, 2.0))


def off(t: np.ndarray) -> np.ndarray:
    return np.zeros(np.shape(t), bool)


def battery_columns(motion: Motion, t: np.ndarray, rng: np.random.Generator, **spec):
    battery = BatterySpec(**spec)
    return sense_battery(battery, discharge(battery, DriveSpec(), motion, off, float(t[-1])), t, rng)


SENSES = {
    "odometry": lambda motion, t: sense_odometry(DriveSpec(odometry_jitter_s=0.02), motion, t, generator(1)),
    "imu": lambda motion, t: sense_imu(ImuSpec(jitter_s=0.02), LEVEL, motion, t, generator(1)),
    "mocap": lambda motion, t: sense_mocap(MocapSpec(dropout_every_s=2.0), 0.0, motion, t, generator(1)),
    "battery": lambda motion, t: battery_columns(motion, t, generator(1), rate_hz=20.0),
}
"""Every sensor of a motion, with delays and noise."""

every_sense = pytest.mark.parametrize("sense", SENSES.values(), ids=SENSES)


@given(rate=st.floats(0.01, 500), reading=st.floats(1, 500), count=st.integers(1, 500))
def test_a_held_sample_is_never_from_the_future_and_is_the_latest(rate, reading, count):
    t = np.arange(count) / reading
    stamps, latest = held(t, rate)
    assert np.all(stamps[latest] <= t)
    assert np.all((np.arange(len(stamps) + 1) / rate)[latest + 1] > t)
    assert_allclose(np.diff(stamps), 1 / rate, rtol=1e-9)
    assert latest[-1] == len(stamps) - 1


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


def test_a_latency_shows_the_past_by_just_so_much():
    t = np.arange(3000) / 1000.0
    stamps, latest = held(t, 100.0, latency_s=0.25)
    assert_allclose(np.median(t - stamps[latest]), 0.25 + 0.0045, atol=6e-4)
    assert (t - stamps[latest]).max() < 0.26 + 1e-9
    assert stamps[0] == pytest.approx(-0.25)


def test_jitter_delays_by_its_mean_where_samples_do_not_overtake_each_other():
    t = np.arange(400_000) / 1000.0
    stamps, latest = held(t, 10.0, latency_s=0.01, jitter_s=0.005, rng=generator())
    first_seen = t[np.flatnonzero(np.diff(latest)) + 1]
    delay = first_seen - stamps[latest[np.flatnonzero(np.diff(latest)) + 1]] - 0.01
    # Seen at the next millisecond, half of one late on average; 4,000 delays tell the mean to 1.6 %.
    assert delay.mean() == pytest.approx(0.005 + 0.0005, rel=0.06)
    assert delay.std() == pytest.approx(0.005, rel=0.1)


def test_before_the_start_the_robot_stands_at_its_first_pose():
    motion = winding()
    moment = moment_at(motion, np.array([-2.0, -0.01, 0.0, 0.5]))
    assert_allclose(moment.pose[:2], [motion.pose0] * 2)
    assert_array_equal(moment.v[:2], 0)
    assert_array_equal(moment.w[:2], 0)
    assert_array_equal(moment.a[:2], 0)
    assert moment.v[2] == 0.2
    assert_array_equal(moment.pose[3], motion.at(np.array([0.5])).pose[0])


@every_sense
def test_what_happens_later_changes_nothing_that_was_read_before(sense):
    whole, cut = winding(), winding(1500)  # the second one stops after 30 s
    before = T < 30.0
    a, b = sense(whole, T), sense(cut, T)
    for name in a:
        assert_array_equal(a[name][before], b[name][before], err_msg=name)
    assert any(not np.array_equal(a[name], b[name]) for name in a)


@every_sense
def test_a_longer_run_begins_with_the_noise_of_a_shorter_one(sense):
    short, long = sense(winding(), T[:1000]), sense(winding(), T)
    for name, values in short.items():
        assert_array_equal(values, long[name][:1000], err_msg=name)


@every_sense
def test_one_seed_gives_the_same_bytes(sense):
    a, b = sense(winding(), T), sense(winding(), T)
    assert all(a[name].tobytes() == b[name].tobytes() for name in a)


def test_each_sensor_changes_at_its_own_rate():
    t = np.arange(10_000) / 1000.0
    imu = sense_imu(ImuSpec(jitter_s=0.0, latency_s=0.0), LEVEL, winding(), t, generator())
    battery = battery_columns(winding(), t, generator(), jitter_s=0.0, latency_s=0.0)
    assert np.count_nonzero(np.diff(imu["imu_a"][:, 0])) == np.floor(9.999 * 62)
    assert np.count_nonzero(np.diff(battery["battery_v"])) == np.floor(9.999 * 0.5)
    assert STEP_S < 0.1


SCANNED = Run(
    {"t": T, "p_world_base": np.zeros((len(T), 3)), "yaw": T * 0.0, "lidar_on": np.ones(len(T), bool)}
)


@pytest.mark.parametrize(
    ("sense", "says"),
    [
        (
            lambda: held(T, 1e12),
            r"samples of a sensor of 1e\+12 Hz would be 6e\+13 in .* more than 20,000,000",
        ),
        (lambda: held(T, 62.0, latency_s=1e9), "samples of a sensor of 62 Hz would be"),
        (
            lambda: sense_mocap(
                MocapSpec(dropout_every_s=1e-9, dropout_s=1e-9), 0.0, winding(), T, generator()
            ),
            r"dropouts of 5e\+08 Hz would be",
        ),
        (
            lambda: scans_of(
                SCANNED,
                RobotSpec(name="r", asset="r.usda", lidar=LidarSpec(scan_rate_hz=1e9)),
                Obstacles(),
                generator(),
            ),
            r"a LiDAR's scans of 1e\+09 Hz would be",
        ),
    ],
)
def test_more_samples_than_memory_could_hold_are_refused(sense, says):
    with pytest.raises(InputError, match=says):
        sense()
