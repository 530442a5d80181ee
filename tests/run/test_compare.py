"""Two runs laid over each other."""

import math

import numpy as np
import pytest

from magtwin.errors import InputError
from magtwin.run.compare import compare, errors_of
from magtwin.run.run import Run


def circle(speed=0.2, radius=1.0, seconds=60.0, rate=50.0, start_s=0.0, at_s=0.0, offset_nt=0.0, aside_m=0.0):
    """A run on a circle over a field that changes with the place; `at_s` is when on the circle it begins."""
    t = np.arange(int(seconds * rate)) / rate
    angle = (t + at_s) * speed / radius
    r = radius - aside_m
    place = np.column_stack([r * np.cos(angle), r * np.sin(angle), 0 * t])
    b = 41_000 + 500 * np.sin(angle) + 300 * np.cos(3 * angle) + offset_nt
    yaw = (angle + math.pi / 2 + math.pi) % (2 * math.pi) - math.pi
    return Run({"t": t + start_s, "p_world_base": place, "yaw": yaw, "b_measured_nt": b})


def figures(comparison):
    return {one.name: one for one in comparison.agreements()}


@pytest.mark.parametrize("late", [-7.3, 0.0, 4.567])
def test_the_offset_of_two_clocks_is_found_to_a_tenth_of_a_millisecond(late):
    a = circle(seconds=25.0)
    b = circle(seconds=25.0, start_s=1_700_000_000.0, at_s=late)
    found = compare(a, b)
    assert found.shift == pytest.approx(late - 1_700_000_000.0, abs=1e-4)
    assert figures(found)["along-track"].greatest < 1e-4
    assert figures(found)["b_measured_nt"].correlation > 0.999999


def test_ahead_left_and_turned_are_told_apart():
    a = circle(radius=1.0)
    inside = circle(radius=1.0, aside_m=0.05)  # counter-clockwise, so inside is to the left
    found = figures(compare(a, inside))
    assert found["cross-track"].mean == pytest.approx(0.05, abs=1e-6)
    assert found["along-track"].greatest < 1e-6
    ahead = figures(compare(a, circle(at_s=0.5), align="none"))
    assert ahead["along-track"].mean == pytest.approx(math.sin(0.1), abs=1e-6)
    assert ahead["heading"].mean == pytest.approx(math.degrees(0.1), abs=1e-6)


def test_speeds_that_differ_drift_apart_in_time_and_agree_along_the_path():
    slow, fast = circle(speed=0.2), circle(speed=0.25)
    by_time, by_path = compare(slow, fast), compare(slow, fast, align="path")
    assert figures(by_time)["along-track"].rms > 0.5
    assert figures(by_path)["along-track"].rms < 0.002
    assert figures(by_path)["b_measured_nt"].rms < 0.01 * figures(by_time)["b_measured_nt"].rms
    assert by_path.unit == "m"


def test_nothing_is_interpolated_across_a_gap():
    a = circle()
    b = circle()
    kept = (b["t"] < 20) | (b["t"] > 30)
    found = compare(a, Run({name: values[kept] for name, values in b.items()}), align="none")
    assert not ((found.at > 20.1) & (found.at < 29.9)).any()
    assert figures(found)["along-track"].greatest < 1e-6


def test_a_real_robots_run_without_truth_is_compared_by_motion_capture():
    a, b = (
        Run({"t": r["t"], "mocap_p": r["p_world_base"], "b_measured_nt": r["b_measured_nt"]})
        for r in (circle(), circle(at_s=0.7, aside_m=0.02))
    )
    found = compare(a, b)
    assert found.shift == pytest.approx(0.7, abs=1e-3)
    assert figures(found)["cross-track"].mean == pytest.approx(0.02, abs=1e-3)
    assert "heading" not in figures(found)


@pytest.mark.parametrize(
    ("a", "b", "align", "what"),
    [
        (Run({"t": [0.0]}), circle(), "time", "the first run has 1 readings"),
        (circle(), Run({"t": [0.0, 0.0]}), "time", "the second run has no time that ascends"),
        (Run({"t": [0.0, 1.0]}), circle(), "time", "no column of p_world_base, mocap_p, odom_p is known"),
        (Run({"t": [0.0, 1.0]}), circle(), "none", "nothing to compare"),
        (circle(), circle(start_s=500.0), "none", "do not overlap: 0 to 59.98 s and 500 to"),
        (
            circle(),
            Run({"t": np.arange(9.0), "p_world_base": np.zeros((9, 3))}),
            "path",
            "the second run cannot be aligned: its robot moves no 0.01 m; align by time",
        ),
    ],
)
def test_what_cannot_be_compared_is_refused(a, b, align, what):
    with pytest.raises(InputError, match=what):
        compare(a, b, align=align)


def test_each_error_of_a_run_has_its_address():
    run = Run(
        {
            "t": np.arange(3.0),
            "b_truth_nt": np.array([100.0, 100.0, np.nan]),
            "b_map_nt": np.array([90.0, 94.0, 90.0]),
            "b_total_nt": np.array([103.0, 99.0, 100.0]),
            "b_measured_nt": np.array([104.0, 99.0, np.nan]),
        }
    )
    errors = errors_of(run)
    assert errors["map"].mean == -8
    assert errors["disturbance"].mae == 2
    assert (errors["noise"].greatest, errors["noise"].count) == (1, 2)
    assert errors["total"].rms == pytest.approx(math.sqrt((16 + 1) / 2))
    assert "model error" not in errors
    drawn = errors_of(run.with_columns(b_model_error_nt=np.array([0.5, 0.0, -2.0])))
    assert drawn["noise"].greatest == 0.5
    assert drawn["model error"].greatest == 2
    assert errors_of(Run({"t": np.arange(3.0)})) == {}
