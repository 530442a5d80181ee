"""A robot that drives three times around an oval in a field of eigenfunctions, with noisy odometry."""

import numpy as np
from scipy.spatial.transform import Rotation

from magtwin.localization.problem import OdometryModel, Prior, Problem, SensorModel
from magtwin.localization.readings import readings_of
from magtwin.localization.slam.hilbert import basis
from magtwin.run.run import Run

WHITE_NT, SD_NT, LENGTH_M, RATE_HZ = 200.0, 8_000.0, 0.8, 5.0
STEP_M, STEP_RAD = 0.02, 0.01
OFFSET_NT = np.array([600.0, -400.0, 300.0])
UNIFORM_NT = np.array([5_000.0, 18_000.0, -40_000.0])


def about_z(yaw):
    """Rotations about z."""
    return Rotation.from_rotvec(np.outer(yaw, [0.0, 0.0, 1.0]))


def oval(*, rows=240, seed=0, vector=True):
    """Problem, readings and true x, y, yaw of a drive, with body-frame odometry."""
    rng = np.random.default_rng(seed)
    along = np.linspace(0, 3, rows)
    x, y = 1.5 * np.cos(2 * np.pi * along), 0.9 * np.sin(2 * np.pi * along)
    yaw = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
    truth = np.column_stack([x, y, yaw])
    R = about_z(yaw).as_matrix()
    p = np.column_stack([x, y, np.zeros(rows)])
    local = (R[:-1].transpose(0, 2, 1) @ np.diff(p, axis=0)[..., None])[..., 0]
    local[:, :2] += STEP_M * rng.standard_normal((rows - 1, 2))
    turned = np.diff(yaw) + STEP_RAD * rng.standard_normal(rows - 1)
    odom_yaw = yaw[0] + np.concatenate([[0], np.cumsum(turned)])
    into = about_z(odom_yaw).as_matrix()
    odom = p[0] + np.vstack([np.zeros(3), np.cumsum((into[:-1] @ local[..., None])[..., 0], axis=0)])
    if vector:
        functions = basis([-2.5, -1.9, -1.0], [2.5, 1.9, 1.0], 60)
        weights = rng.standard_normal(60) * np.sqrt(
            functions.variances(sd=SD_NT * LENGTH_M, length_m=LENGTH_M)
        )
        world = functions.gradients(p) @ weights + UNIFORM_NT
        b = (R.transpose(0, 2, 1) @ world[..., None])[..., 0] + OFFSET_NT
        b += WHITE_NT * rng.standard_normal(b.shape)
        columns = {"b_vector_measured_nt": b, "b_measured_nt": np.linalg.norm(b, axis=1)}
    else:
        functions = basis([-2.5, -1.9], [2.5, 1.9], 60)
        weights = rng.standard_normal(60) * np.sqrt(functions.variances(sd=SD_NT, length_m=LENGTH_M))
        b = functions.values(p[:, :2]) @ weights + 45_000 + WHITE_NT * rng.standard_normal(rows)
        columns = {"b_measured_nt": b}
    t = np.arange(rows) / RATE_HZ
    run = Run({"t": t, "odom_p": odom, "odom_q_xyzw": about_z(odom_yaw).as_quat(), **columns})
    problem = Problem(
        belief=None,
        extent=(-1.5, 1.5, -0.9, 0.9),
        prior=Prior(mean=tuple(truth[0]), sd=(1e-3, 1e-3, 1e-3)),
        sensor=SensorModel(white_nt=WHITE_NT, drift_nt=0.0, offset_nt=600.0),
        odometry=OdometryModel(
            position_std=0.0,
            position_std_s=STEP_M * RATE_HZ**0.5,
            yaw_std=0.0,
            turn_std=0.0,
            yaw_std_s=STEP_RAD * RATE_HZ**0.5,
            scale_std=0.0,
        ),
        rate_hz=RATE_HZ,
    )
    return problem, run, truth


def first_readings(run, count):
    """The first readings of a run."""
    return list(readings_of(run.take(slice(0, count))))
