"""Motion capture: the true pose with noise, dropouts of the spread of the spec, held and flagged."""

import numpy as np
import pytest
from clocks import held
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.frames import canonical, quat_from_yaw, rotate
from magtwin.sim.motion.drive import Motion
from magtwin.sim.sensors.mocap import Dropouts, Mocap
from magtwin.spec.drive import DriveSpec
from magtwin.spec.sensors import MocapSpec

T = np.arange(135 * 60) / 135.0
CIRCLE = Motion(DriveSpec(), 0.02, np.full(3000, 0.2), np.full(3000, 0.5), (1.0, -1.0, 2.0))
QUIET = {"latency_s": 0.0, "jitter_s": 0.0, "p_noise_std_m": 0.0, "angle_noise_std": 0.0, "dropout_s": 0.0}


def generator(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_without_noise_it_is_the_true_pose_at_its_rate():
    read = Mocap(MocapSpec(**QUIET), 0.04, generator()).sense(CIRCLE, T)
    stamps, latest = held(T, 120.0)
    pose = CIRCLE.at(stamps).pose[latest]
    assert_allclose(read["mocap_p"], np.column_stack([pose[:, :2], np.full(len(T), 0.04)]), atol=1e-12)
    assert_allclose(read["mocap_q_xyzw"], canonical(quat_from_yaw(pose[:, 2])), atol=1e-12)
    assert not read["flag_pose_lost"].any()


def test_a_body_that_is_taken_to_be_elsewhere_is_seen_there_whatever_its_heading():
    spec = MocapSpec(**QUIET, offset_m=(0.05, -0.02))
    read = Mocap(spec, 0.04, generator()).sense(CIRCLE, T)
    turn, seen = read["mocap_q_xyzw"], read["mocap_p"]
    base = seen + rotate(turn, np.tile([0.05, -0.02, 0.0], (len(T), 1)))
    assert_allclose(
        base, Mocap(MocapSpec(**QUIET), 0.04, generator()).sense(CIRCLE, T)["mocap_p"], atol=1e-12
    )


def test_in_a_dropout_the_last_pose_is_held_and_flagged():
    spec = MocapSpec(**{**QUIET, "dropout_s": 0.5}, dropout_every_s=3.0)
    read = Mocap(spec, 0.0, generator(1)).sense(CIRCLE, T)
    stamps, latest = held(T, spec.rate_hz)
    lost = Dropouts(spec, generator(1).spawn(3)[2]).lost(stamps)
    assert 5 < np.count_nonzero(np.diff(lost.astype(int)) == 1) < 40
    assert_array_equal(read["flag_pose_lost"], lost[latest])
    gone = read["flag_pose_lost"]
    steps = np.linalg.norm(np.diff(read["mocap_p"], axis=0), axis=1)
    assert_array_equal(steps[gone[1:]], 0)  # held
    stale = CIRCLE.at(T).pose[:, :2] - read["mocap_p"][:, :2]
    assert np.linalg.norm(stale[~gone], axis=1).max() < 0.2 / 120 + 1e-9  # at most a sample old when seen
    assert np.linalg.norm(stale[gone], axis=1).max() > 0.02


def test_dropouts_are_as_often_and_as_long_as_the_spec_says():
    spec = MocapSpec(dropout_every_s=5.0, dropout_s=1.0)
    stamps = np.arange(120 * 20_000) / 120.0
    lost = Dropouts(spec, generator()).lost(stamps)
    assert not lost[0]
    starts = np.count_nonzero(np.diff(lost.astype(int)) == 1)
    assert starts == pytest.approx(20_000 / 6, rel=0.06)  # some 3,300 cycles: 1.2 % is one sigma
    assert lost.mean() == pytest.approx(1 / 6, rel=0.08)
