"""Obstacles: outlines are convex, distances are signed and exact."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from magtwin.errors import InputError
from magtwin.spec.obstacles import Obstacles

SQUARE = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]])


def test_distance_from_a_box_is_that_of_the_closed_form():
    boxes = Obstacles(("desk",), (SQUARE,))
    p = np.array([[1.0, 1.5], [3.0, 2.0], [1.0, 0.5], [0.1, 0.5], [-1.0, 0.5], [2.0, 0.5]])
    distance, which = boxes.clearance(p)
    np.testing.assert_allclose(distance, [0.5, np.sqrt(2), -0.5, -0.1, 1.0, 0.0], atol=1e-15)
    assert which.tolist() == [0] * 6


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


def test_what_is_beyond_reach_is_not_there():
    distance, which = Obstacles(("desk",), (SQUARE,)).clearance([[1.0, 1.5], [1.0, 1.1]], reach_m=0.2)
    np.testing.assert_allclose(distance, [np.inf, 0.1])
    assert which.tolist() == [-1, 0]


def test_an_outline_becomes_its_convex_hull_anticlockwise_without_idle_corners():
    cross = [[0, 0], [1, 0], [2, 0], [2, 1], [1, 0.5], [0, 1], [0, 0.5], [0, 0]]
    (outline,) = Obstacles(("desk",), (np.array(cross, float),)).outlines
    assert outline.tolist() == [[0, 0], [2, 0], [2, 1], [0, 1]]


def test_edges_lead_round_each_outline():
    edges, begins = Obstacles(("a", "b"), (SQUARE, SQUARE + 5)).edges
    assert begins.tolist() == [0, 4, 8]
    np.testing.assert_array_equal(edges[:4, 2:], np.roll(SQUARE, -1, axis=0))


def test_no_obstacles_leave_all_of_the_floor_clear():
    distance, which = Obstacles().clearance(np.zeros((3, 2)))
    assert np.all(distance == np.inf)
    assert np.all(which == -1)


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


def test_an_obstacle_without_an_outline_is_refused():
    with pytest.raises(InputError, match="1 obstacles have 0 outlines"):
        Obstacles(("desk",), ())
