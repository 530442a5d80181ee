"""Sessions: what is drawn, and that runs over the presets look like the real robot's to a network."""

import dataclasses
from pathlib import Path as FilePath

import numpy as np
import pytest
from rooms import EARTH, scene_of

from magtwin.field.maps.map import AnomalyMap
from magtwin.learn.data.features import FULL, features
from magtwin.path import PATHS, path_named
from magtwin.sim.runs.simulate import simulate
from magtwin.sim.session import draw_session, draw_speed
from magtwin.spec.robot import RobotSpec

REAL = {
    "yaw_deg": (180.295, 101.551),
    "odom_v_x": (0.232589, 0.0658757),
    "odom_v_y": (3.06e-4, 2.75e-3),
    "odom_v_z": (-2.6e-6, 1.35e-4),
    "odom_w_x": (4.3e-5, 0.010961),
    "odom_w_y": (2.75e-4, 0.028157),
    "odom_w_z": (0.009994, 0.524086),
    "imu_q_x": (-0.001381, 0.004811),
    "imu_q_y": (-0.001085, 0.006556),
    "imu_q_z": (0.002862, 0.696160),
    "imu_q_w": (0.664672, 0.271099),
    "imu_w_x": (-2.2e-6, 0.012694),
    "imu_w_y": (2.30e-4, 0.039108),
    "imu_w_z": (0.007966, 0.512536),
    "imu_a_x": (-0.004313, 0.424792),
    "imu_a_y": (0.002215, 0.271545),
    "imu_a_z": (0.021819, 0.980056),
    "battery_v": (15.6979, 0.532527),
    "battery_fraction": (0.856926, 0.140275),
    "lidar_on": (0.340609, 0.473914),
}
"""Means and scales of the 20 signals of the real TurtleBot 4 over 73 min: the scalers of the network that
was released with the paper (aprilab-uf/nn_magnetometer, nn_magnetometer_model_v0.0.1.pth)."""

SEED, RUNS_A_PATH = 7, 6
LONGEST_S = 90.0
"""No run is longer, so that no path stands for all."""

ROBOT = RobotSpec(name="robot", asset=FilePath("robot.usda"))
SCENE = scene_of(ROBOT, earth=EARTH)
MAP = AnomalyMap(
    values_nt=np.full((4, 2, 2), 41_000.0),
    origin_m=(-3.0, -1.75),
    cell_m=(6.0, 3.5),
    headings_rad=np.arange(4) * np.pi / 2,
)


@pytest.fixture(scope="module")
def signals() -> np.ndarray:
    """What a network would be trained on: every preset, each run a session and a speed of its own."""
    names = sorted(PATHS) * RUNS_A_PATH
    rows = []
    for name, rng in zip(names, np.random.default_rng(SEED).spawn(len(names)), strict=True):
        day, wanted, noise = rng.spawn(3)
        robot = draw_session(ROBOT, day)
        run = simulate(
            dataclasses.replace(SCENE, robot=robot),
            path_named(name),
            anomaly_map=MAP,
            rng=noise,
            speed=draw_speed(robot.drive, wanted),
            duration_s=LONGEST_S,
            rate_hz=27.0,
            lidar="schedule",
        )
        rows.append(features(run, FULL))
    return np.vstack(rows)


def test_runs_over_the_presets_have_the_real_means_and_scales_of_all_twenty_signals(signals):
    assert tuple(REAL) == FULL
    lines, wrong = [], []
    for i, (name, (mean, scale)) in enumerate(REAL.items()):
        shift, ratio = (signals[:, i].mean() - mean) / scale, signals[:, i].std() / scale
        fits = abs(shift) <= 0.5 and 0.75 <= ratio <= 1.25
        wrong += [name] * (not fits)
        lines.append(
            f"{name:17} real {mean:10.5f} +- {scale:9.5f}  ours {signals[:, i].mean():10.5f} +- "
            f"{signals[:, i].std():9.5f}  shift {shift:5.2f}  ratio {ratio:4.2f}{'' if fits else '  <--'}"
        )
    assert not wrong, "\n".join([f"not within half a scale and 25 %: {', '.join(wrong)}", *lines])


def test_heading_and_the_quaternions_z_order_the_runs_alike_as_the_real_ones_do(signals):
    # Both have the rank correlation 0.31 with the real disturbance; an IMU whose zero faces +x would order
    # them against each other.
    def rank(x: np.ndarray) -> np.ndarray:
        return np.argsort(np.argsort(x))

    yaw, z = signals[:, FULL.index("yaw_deg")], signals[:, FULL.index("imu_q_z")]
    assert np.corrcoef(rank(yaw), rank(z))[0, 1] > 0.6


def test_a_session_draws_what_differs_from_day_to_day_and_nothing_else():
    robot = draw_session(ROBOT, np.random.default_rng(0))
    undrawn = dataclasses.replace(
        robot,
        platform=ROBOT.platform,
        battery=dataclasses.replace(robot.battery, initial_fraction=ROBOT.battery.initial_fraction),
        imu=dataclasses.replace(robot.imu, yaw_zero=0.0, gyro_bias=(0.0, 0.0, 0.0)),
        lidar=dataclasses.replace(robot.lidar, phase_s=0.0),
        drive=dataclasses.replace(
            robot.drive,
            wheel_errors=(0.0, 0.0),
            wheel_radius_error_std=0.002,
            wheel_separation_error_std=0.003,
            odometry_scale=(1.0, 1.0),
            odometry_noise_std=0.002,
        ),
    )
    assert undrawn == ROBOT
    assert robot.battery.initial_fraction < 1
    assert robot.imu.yaw_zero != 0
    assert 0 < robot.lidar.phase_s < robot.lidar.on_s + robot.lidar.off_s
    assert robot.drive.odometry_scale[0] != robot.drive.odometry_scale[1]
    assert draw_session(ROBOT, np.random.default_rng(0)) == robot
    assert draw_session(ROBOT, np.random.default_rng(1)) != robot
