"""Layout: axes with room for their labels, an eye that no rail hides from."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from magtwin.io.rerun.layout import lab_eye, value_range
from magtwin.spec.lab import LabSpec


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


def test_no_rail_or_camera_of_the_room_hides_the_floor_from_the_eye():
    for lab in (LabSpec(), LabSpec(floor_m=(12.0, 4.0)), LabSpec(floor_m=(4.0, 8.0), post_height_m=3.0)):
        eye = np.array(lab_eye(lab)[0])
        edge, reach = lab.floor_m[1] / 2, lab.wall_thickness_m
        rail = np.array([0, -edge - reach, lab.post_height_m])
        assert eye[2] > rail[2]
        behind = eye + (rail - eye) * eye[2] / (eye[2] - rail[2])  # where the rail is seen on the ground
        assert behind[1] < -edge
