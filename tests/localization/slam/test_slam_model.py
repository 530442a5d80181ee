"""Derivatives of the SLAM model against finite differences, and its motion against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from oval import about_z, first_readings, oval
from scipy.spatial.transform import Rotation

from magtwin.errors import InputError
from magtwin.localization.problem import OdometryModel, Prior, SensorModel
from magtwin.localization.slam.model import Model, State
from magtwin.localization.slam.samples import samples_of
from magtwin.localization.slam.settings import Settings


def full_model(vector, odometry_axes):
    """A model with every constant and a drift, 7 samples, and a random state near them."""
    problem, run, _ = oval(rows=40, vector=vector)
    problem = replace(
        problem,
        sensor=SensorModel(lever_arm_m=(0.2, -0.1), drift_nt=50.0, offset_nt=300.0, iron_nt=200.0),
        odometry=OdometryModel(scale_std=0.02),
    )
    settings = Settings(
        functions=20, velocity_sd_m_s=0.01, soft_iron_sd=0.1, odometry_axes=odometry_axes, sd_nt=9_000.0
    )
    samples = samples_of(first_readings(run, 7), vector)
    model = Model(problem, settings, samples.take(slice(0, 1)), vector)
    rng = np.random.default_rng(5)
    tilt = Rotation.from_rotvec(rng.normal(0, 0.3 if vector else 0, (7, 3))).as_matrix()
    g = rng.standard_normal(model.layout.count) * np.sqrt(model.constants_variance)
    return (
        model,
        samples,
        State(samples.p_odom, tilt @ samples.R_odom, rng.normal(0, 50, (7, model.drifts)), g),
    )


def test_the_heading_s_variance_of_a_tilted_robot_agrees_with_draws():
    model, _, state = full_model(True, "body")
    covariance = np.zeros((model.size, model.size))
    root = np.array([[0.02, 0, 0], [0.005, 0.01, 0], [-0.01, 0.004, 0.015]])
    covariance[3:6, 3:6] = root @ root.T
    made = model.estimate(0.0, state.p[2], state.R[2], covariance, state.drift[2])
    draws = Rotation.from_rotvec(np.random.default_rng(6).standard_normal((100_000, 3)) @ root.T).as_matrix()
    turned = draws @ state.R[2]
    yaw = np.arctan2(turned[:, 1, 0], turned[:, 0, 0]) - made.yaw
    assert_allclose(made.covariance[2, 2], np.var(yaw), rtol=0.02)  # of 100,000 draws: 0.45 %


@pytest.mark.parametrize("odometry_axes", ["body", "world"])
def test_exact_odometry_in_a_turned_frame_gives_the_true_path(odometry_axes):
    problem, run, truth = oval(rows=60)
    turn = Rotation.from_euler("z", 0.7)
    shift = np.array([3.0, -2.0, 0.0])
    p = shift + turn.apply(np.column_stack([truth[:, :2], np.zeros(60)]))
    q = (turn * about_z(truth[:, 2])).as_quat()
    samples = samples_of(first_readings(run.with_columns(odom_p=p, odom_q_xyzw=q), 60), True)
    model = Model(problem, Settings(odometry_axes=odometry_axes), samples.take(slice(0, 1)), True)
    steps, state = model.steps(samples), model.start
    for k in range(59):
        state = model.move(state, type(steps)(*[part[k : k + 1] for part in steps]))[0]
    assert_allclose(state.p[0, :2], truth[-1, :2], atol=1e-12)
    assert_allclose(Rotation.from_matrix(state.R[0]).as_euler("ZYX")[0], np.angle(np.exp(1j * truth[-1, 2])))


def test_an_unknown_start_is_refused():
    problem, run, _ = oval(rows=5)
    first = samples_of(first_readings(run, 1), True)
    anywhere = replace(problem, prior=Prior(sd=(np.inf, np.inf, 0.1)))
    with pytest.raises(InputError, match="prior"):
        Model(anywhere, Settings(), first, True)


@pytest.mark.parametrize(
    "options",
    [{"functions": 0}, {"functions": 2.5}, {"length_m": 0.0}, {"sd_nt": np.nan},
     {"odometry_axes": "odom"}, {"soft_iron_sd": -1.0}],
)  # fmt: skip
def test_wrong_options_are_refused(options):
    with pytest.raises(InputError, match=next(iter(options))):
        Settings(**options)
