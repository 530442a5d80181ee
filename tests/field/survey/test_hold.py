import numpy as np
import pytest
from numpy.testing import assert_array_equal
from test_stuck import drive

from magtwin.field.survey.hold import without_repeats
from magtwin.field.survey.stuck import find_stuck


def held(ratio, change=lambda b: b):
    """A drive whose logger is `ratio` times as fast as its sensor; and the rows with a new value."""
    readings = drive()
    rows = np.floor(np.floor(np.arange(len(readings)) / ratio + 1e-9) * ratio + 1e-9).astype(int)
    return readings.with_(b_nt=change(readings.b_nt[rows])), np.unique(rows, return_index=True)[1]


@pytest.mark.parametrize("ratio", [1.5, 2, 2.5, 5])
def test_of_values_that_a_fast_logger_repeats_the_first_is_kept_and_none_is_stuck(ratio):
    readings, sampled = held(ratio)
    once = without_repeats(readings)
    assert_array_equal(once.t, readings.t[sampled])
    assert f"each value is repeated {ratio:g} times" in once.source
    found = find_stuck(once)
    assert not (found.frozen | found.stuck).any()


def test_a_sensor_that_sticks_is_found_behind_a_fast_logger():
    def stick(b):
        b[1_200:1_260] = b[1_200]
        return b

    once = without_repeats(held(3, stick)[0])
    found = find_stuck(once)
    assert_array_equal(once.t[found.frozen] * 25, np.arange(1_200, 1_260, 3))


@pytest.mark.parametrize("resolution_nt", [0.001, 20.0, 200.0])
def test_values_that_rounding_repeats_are_all_kept(resolution_nt):
    readings = drive()
    readings = readings.with_(b_nt=np.rint(readings.b_nt / resolution_nt) * resolution_nt)
    assert without_repeats(readings) is readings
