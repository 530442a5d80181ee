"""A harmonic field and the robot in it, held against closed forms and finite differences."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from magtwin.errors import InputError
from magtwin.field.sources.dipoles import dipole_field_nt
from magtwin.field.sources.harmonic import HarmonicField


def field(**parts):
    rng = np.random.default_rng(0)
    given = {
        "p_world_dipole": rng.uniform((-2, -2, -1), (2, 2, -0.3), (12, 3)),
        "m_world": rng.normal(scale=3.0, size=(12, 3)),
        "b_uniform_nt": (-2_745.6, 24_067.1, -38_418.4),
        "hard_iron_nt": (400.0, -250.0, 900.0),
        "soft_iron": [[0.01, 0.002, 0], [-0.003, 0.02, 0.001], [0, 0.004, -0.01]],
        "p_base_sensor": (0.05, -0.02, 0.4),
    }
    return HarmonicField(**{**given, **parts})


def test_without_dipoles_and_platform_every_pose_reads_the_uniform_field():
    none = np.zeros((0, 3))
    plain = field(p_world_dipole=none, m_world=none, hard_iron_nt=np.zeros(3), soft_iron=np.zeros((3, 3)))
    assert_allclose(plain.magnitude_nt([[0, 0], [1, 2]], [0.0, 2.0]), np.linalg.norm(plain.b_uniform_nt))


def test_hard_iron_and_lever_arm_turn_with_the_robot():
    some = field(soft_iron=np.zeros((3, 3)))
    quarter = dipole_field_nt([0.02, 0.05, 0.4], some.p_world_dipole, some.m_world) + some.b_uniform_nt
    want = np.linalg.norm(quarter + np.array([250.0, 400.0, 900.0]))
    assert_allclose(some.magnitude_nt([0.0, 0.0], np.pi / 2), want, rtol=1e-12)


@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(-4, 4))
@settings(max_examples=40, deadline=None)
def test_the_compiled_magnitude_is_the_plain_one_up_to_rounding(x, y, yaw):
    compiled = field().magnitude_nt([x, y], yaw, compiled=True)
    assert_allclose(compiled, field().magnitude_nt([x, y], yaw), rtol=1e-12)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"m_world": np.zeros((3, 3))}, "12 dipoles of HarmonicField have 3 moments"),
        ({"b_uniform_nt": np.zeros(2)}, r"b_uniform_nt of HarmonicField must be finite, of shape \(3,\)"),
        ({"hard_iron_nt": [np.nan, 0, 0]}, "hard_iron_nt of HarmonicField must be finite"),
    ],
)
def test_parts_that_do_not_fit_are_refused(parts, message):
    with pytest.raises(InputError, match=message):
        field(**parts)
