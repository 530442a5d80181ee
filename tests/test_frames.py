"""Rotations against scipy."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from magtwin import frames

RNG = np.random.default_rng(0)
A, B = Rotation.random(50, rng=RNG), Rotation.random(50, rng=RNG)


def same_rotation(q, rotation):
    assert_allclose(frames.canonical(q), frames.canonical(rotation.as_quat()), atol=1e-14)


def test_products_rotations_matrices_and_inverses_are_scipys():
    v = RNG.normal(size=(50, 3))
    same_rotation(frames.quat_multiply(A.as_quat(), B.as_quat()), A * B)
    same_rotation(frames.quat_conjugate(A.as_quat()), A.inv())
    assert_allclose(frames.rotate(A.as_quat(), v), A.apply(v), atol=1e-14)
    assert_allclose(frames.matrix_from_quat(A.as_quat()), A.as_matrix(), atol=1e-14)


def test_rpy_is_urdfs_fixed_axis_order():
    rpy = RNG.uniform(-1.5, 1.5, (50, 3))
    same_rotation(frames.quat_from_rpy(rpy), Rotation.from_euler("xyz", rpy))


@given(st.floats(-10, 10))
def test_a_yaw_survives_its_quaternion(yaw):
    q = frames.quat_from_yaw(yaw)
    assert_allclose(np.sin(frames.yaw_from_quat(q) - yaw), 0, atol=1e-12)
    same_rotation(q, Rotation.from_euler("z", yaw))


def test_the_yaw_of_a_quaternion_is_that_of_its_direction_and_nan_without_one():
    q = frames.quat_from_yaw([0.3, 0.3, 0.3, 0.3]) * [[1.0], [2.0], [1e-3], [0.0]]
    assert_allclose(frames.yaw_from_quat(q), [0.3, 0.3, 0.3, np.nan])


@given(st.floats(-1e3, 1e3))
def test_wrapping_changes_an_angle_by_whole_turns_into_minus_pi_to_pi(angle):
    wrapped = frames.wrap_angle(angle)
    assert -np.pi <= wrapped < np.pi
    turns = (angle - wrapped) / (2 * np.pi)
    assert_allclose(turns, np.round(turns), atol=1e-9)
