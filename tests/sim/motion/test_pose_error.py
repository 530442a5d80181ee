"""Pose error: its statistics, its equation, and that robots follow paths with it."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.path import path_named
from magtwin.sim.motion.closed_loop import LOOPS, run_loops
from magtwin.sim.motion.controllers import CONTROLLERS
from magtwin.sim.motion.drive import advance
from magtwin.sim.motion.follow import loop_along
from magtwin.sim.motion.pose_error import EXACT, draw_pose_error
from magtwin.spec.drive import DriveSpec

DRIVE = DriveSpec()
SINE = path_named("sine")


def test_errors_have_the_standard_deviations_and_the_correlation_time_of_the_drive():
    drive = dataclasses.replace(DRIVE, localization_latency_s=0.0)
    t = np.array([0.0, drive.localization_time_s, 100.0])
    drawn = np.array(
        [
            [error.perceived(now, (0.0, 0.0, 0.0), 0.0, 0.0) for now in t]
            for error in (draw_pose_error(drive, np.random.default_rng(seed)) for seed in range(4000))
        ]
    )
    assert_allclose(drawn.std(axis=0), [[0.02, 0.02, 0.01]] * 3, rtol=0.04)
    assert_allclose(drawn.mean(axis=0), 0.0, atol=1.2e-3)
    related = np.mean(drawn[:, 0] * drawn[:, 1], axis=0) / drawn.var(axis=0).mean(axis=0)
    assert_allclose(related, np.exp(-1), atol=0.08)


def test_latency_gives_the_pose_of_that_time_ago():
    drive = DriveSpec(localization_std_m=0.0, localization_yaw_std=0.0, localization_latency_s=0.2)
    error = draw_pose_error(drive, np.random.default_rng(0))
    for v, w in ((0.25, 0.0), (0.2, 1.5), (-0.1, -0.7)):
        before = (0.3, -0.4, 2.0)
        now = tuple(advance(before, v, w, 0.2).tolist())
        assert_allclose(error.perceived(5.0, now, v, w), before, atol=3e-4)


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_robots_stay_within_centimetres_of_their_path(controller):
    def distance(error) -> np.ndarray:
        loop = loop_along(SINE, DRIVE, speed=0.2, controller=controller)
        poses = run_loops([dataclasses.replace(loop, pose_error=error)])[0].poses[:, :2]
        a, b = SINE.p_xy[:-1], SINE.p_xy[1:]
        along = np.clip(np.sum((poses[:, None] - a) * (b - a), -1) / np.sum((b - a) ** 2, -1), 0, 1)
        return np.linalg.norm(poses[:, None] - a - along[..., None] * (b - a), axis=-1).min(axis=1)

    exact = distance(EXACT)
    with_error = distance(draw_pose_error(DRIVE, np.random.default_rng(3)))
    assert np.sqrt(np.mean((with_error) ** 2)) < np.sqrt(np.mean(exact**2)) + 0.04
    assert with_error.max() < exact.max() + 0.08
    if controller == "follower":
        assert np.sqrt(np.mean(with_error**2)) > 0.01


def test_compiled_and_plain_loops_give_the_same_bytes():
    rng = np.random.default_rng(7)
    loops = [
        dataclasses.replace(
            loop_along(SINE, DRIVE, speed=0.25, duration_s=20.0), pose_error=draw_pose_error(DRIVE, rng)
        )
        for _ in range(3)
    ]
    LOOPS.open()
    compiled = run_loops(loops)
    code, LOOPS.code = LOOPS.code, None
    pays, LOOPS.pays = LOOPS.pays, np.inf
    try:
        plain = run_loops(loops)
    finally:
        LOOPS.code, LOOPS.pays = code, pays
    for a, b in zip(compiled, plain, strict=True):
        assert_array_equal(a.poses, b.poses)
    assert not np.array_equal(compiled[0].poses, compiled[1].poses)
