"""Layout: axes with room for their labels, legends that hide no line, an eye that no rail hides from."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from rerun.blueprint import Corner2D

from magtwin.io.rerun.layout import lab_eye, legend_corner, value_range
from magtwin.spec.lab import LabSpec

TIMES = np.linspace(0, 100, 1001)
RAMP = np.linspace(0, 1, 1001)[:, None]


@given(
    low=st.floats(-1e5, 1e5),
    span=st.floats(1e-3, 1e5),
)
def test_values_and_ticks_keep_their_distance_from_the_ends_of_an_axis(low, span):
    high = low + span
    ends = value_range(np.array([low, high, np.nan]))
    assert ends is not None
    room = 0.079 * (high - low)
    assert ends[0] <= low - room
    assert ends[1] >= high + room
    assert ends[1] - ends[0] < 1.5 * (high - low)
    tick = 10.0 ** np.floor(np.log10(high - low))
    ticks = np.arange(np.ceil(ends[0] / tick), np.floor(ends[1] / tick) + 1) * tick
    inside = ticks[(ticks > ends[0]) & (ticks < ends[1])]
    assert np.all(inside - ends[0] >= room)
    assert np.all(ends[1] - inside >= room)


@pytest.mark.parametrize("values", [[3.0, 3.0], [np.nan], [0.0], [1e9, 1e9 + 1e-7]])
def test_the_axis_of_what_does_not_vary_is_left_to_the_viewer(values):
    assert value_range(np.array(values)) is None


@pytest.mark.parametrize(
    ("values", "corner"),
    [
        (RAMP, Corner2D.LeftTop),
        (-RAMP, Corner2D.RightTop),
        (np.minimum(1, 5 * RAMP), Corner2D.RightBottom),
        (np.maximum(0, 1 - 5 * RAMP), Corner2D.RightTop),
        (1 - np.maximum(0, 5 * RAMP - 4), Corner2D.LeftBottom),
    ],
)
def test_a_legend_goes_to_the_corner_that_is_empty_and_the_axis_stays(values, corner):
    ends = value_range(values)
    assert legend_corner(values, TIMES, ends, (0.25, 0.35)) == (corner, ends)


@given(
    heights=st.lists(st.floats(-10, 10), min_size=11, max_size=11),
    width=st.floats(0.1, 0.4),
    height=st.floats(0.1, 0.6),
)
def test_a_legend_hides_no_more_than_a_hundredth_of_the_readings_beside_it(heights, width, height):
    values = np.interp(TIMES, np.linspace(0, 100, 11), heights)[:, None]
    ends = value_range(values)
    if ends is None:
        return
    corner, (low, high) = legend_corner(values, TIMES, ends, (width, height))
    assert low <= ends[0]
    assert high >= ends[1]
    left = corner in (Corner2D.LeftTop, Corner2D.LeftBottom)
    beside = 100 * width >= TIMES if left else 100 * (1 - width) <= TIMES
    part = values[beside]
    if corner in (Corner2D.LeftTop, Corner2D.RightTop):
        hidden = part > high - height * (high - low) + 1e-9
    else:
        hidden = part < low + height * (high - low) - 1e-9
    assert hidden.sum() <= 0.01 * part.size + 1


def test_where_every_corner_is_full_the_axis_grows_just_enough():
    values = np.sin(TIMES)[:, None]  # up and down everywhere
    ends = value_range(values)
    _, (low, high) = legend_corner(values, TIMES, ends, (0.25, 0.4))
    grown = (high - low) / (ends[1] - ends[0])
    assert 1.3 < grown < 1.7
    room = max((low + 0.4 * (high - low)) / -1.0, 0) if low < ends[0] else (high - 0.4 * (high - low))
    assert_allclose(room, 1.0, atol=0.02)


def test_no_rail_or_camera_of_the_room_hides_the_floor_from_the_eye():
    for lab in (LabSpec(), LabSpec(floor_m=(12.0, 4.0)), LabSpec(floor_m=(4.0, 8.0), post_height_m=3.0)):
        eye = np.array(lab_eye(lab)[0])
        edge, reach = lab.floor_m[1] / 2, lab.wall_thickness_m
        rail = np.array([0, -edge - reach, lab.post_height_m])
        assert eye[2] > rail[2]
        behind = eye + (rail - eye) * eye[2] / (eye[2] - rail[2])  # where the rail is seen on the ground
        assert behind[1] < -edge
