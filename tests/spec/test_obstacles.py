"""Obstacles: outlines are convex, distances are signed and exact."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from magtwin.errors import InputError
from magtwin.spec.obstacles import Obstacles


@given(st.integers(0, 2**32 - 1))
def test_distance_is_signed_by_the_box_and_least_among_obstacles(seed):
    rng = np.random.default_rng(seed)
    centre, half = rng.uniform(-3, 3, (4, 2)), rng.uniform(0.1, 1, (4, 2))
    corners = half[:, None] * [[-1, -1], [1, -1], [1, 1], [-1, 1]] + centre[:, None]
    things = Obstacles(tuple("abcd"), tuple(corners))
    p = rng.uniform(-4, 4, (50, 2))
    q = np.abs(p[:, None] - centre) - half  # the signed distance of a box
    expected = np.hypot(*np.maximum(q, 0).transpose(2, 0, 1)) + np.minimum(q.max(axis=2), 0)
    distance, which = things.clearance(p)
    np.testing.assert_allclose(distance, expected.min(axis=1), atol=1e-12)
    np.testing.assert_array_equal(which, expected.argmin(axis=1))


def test_an_outline_becomes_its_convex_hull_anticlockwise_without_idle_corners():
    cross = [[0, 0], [1, 0], [2, 0], [2, 1], [1, 0.5], [0, 1], [0, 0.5], [0, 0]]
    (outline,) = Obstacles(("desk",), (np.array(cross, float),)).outlines
    assert outline.tolist() == [[0, 0], [2, 0], [2, 1], [0, 1]]


@pytest.mark.parametrize(
    ("outline", "what"),
    [
        ([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]], "no area"),
        ([[0.0, 0.0], [1.0, np.nan], [2.0, 2.0]], "finite"),
        ([[0.0, 0.0, 1.0]], r"shape \(K, 2\)"),
    ],
)
def test_an_outline_that_is_none_is_refused_by_the_obstacle_s_name(outline, what):
    with pytest.raises(InputError, match=f"'desk'.*{what}"):
        Obstacles(("desk",), (np.array(outline),))
