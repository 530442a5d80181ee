"""What a localizer gets leads to no true pose, no true field and no later reading."""

import gc
import math
import sys
import types

import numpy as np
import pytest

import magtwin as mt
from magtwin.errors import RepairWarning
from magtwin.frames import quat_from_yaw
from magtwin.localization.problem import Estimate, Problem
from magtwin.localization.readings import onboard, readings_of
from magtwin.localization.track import LocalizerError, track
from magtwin.run.run import Run

TRUE = ("p_world_base", "q_world_base_xyzw", "yaw", "v_base", "w_base")
TRUE += ("b_truth_nt", "b_map_nt", "b_total_nt")
"""Columns that no localizer may see."""


@pytest.fixture(scope="module")
def run():
    return mt.simulate("lab", "figure8", seed=2, duration_s=10, rate_hz=5, magnetometer="physical")


@pytest.fixture(scope="module")
def turning():
    """Readings of a robot that turns seven times in one direction."""
    t = np.arange(600) / 5
    p = np.zeros((600, 3))
    return Run({"t": t, "b_measured_nt": 4e4 + t, "odom_p": p, "odom_q_xyzw": quat_from_yaw(44 * t / t[-1])})


def reachable(*starts):
    """All arrays that can be reached from some objects, without modules, classes and functions' globals."""
    seen, stack, arrays = set(), list(starts), []
    while stack:
        item = stack.pop()
        if id(item) in seen or isinstance(
            item, types.ModuleType | type | types.FunctionType | types.FrameType
        ):
            continue
        seen.add(id(item))
        if isinstance(item, np.ndarray):
            arrays.append(item)
            stack.append(item.base)
        stack += gc.get_referents(item)
    return arrays


def holds(arrays, values):
    """Whether an array has the values of a column, or of its parts, anywhere in it."""
    for column in values.T.reshape(-1, len(values)):
        if np.ptp(column) == 0:  # such as the height
            continue
        for array in arrays:
            if array.dtype.kind == "f" and array.size >= len(column):
                parts = array.reshape(-1, array.shape[-1]).T if array.ndim > 1 else array[None]
                if any(part.size == column.size and np.array_equal(part, column) for part in parts):
                    return True
    return False


def test_no_true_column_can_be_reached_from_a_problem_and_a_reading(run):
    reading = next(iter(readings_of(run)))
    problem = Problem(belief=None, extent=(-3, 3, -2, 2))
    arrays = reachable(problem, reading, onboard(run))
    assert holds(arrays, run["odom_p"][:, :2])  # the search finds what is there
    for name in TRUE:
        assert not holds(arrays, run[name]), name


def test_a_reading_holds_no_later_reading(run):
    readings = readings_of(run)
    next(readings)
    second = next(readings)
    later = run["b_measured_nt"][2:]
    for array in reachable(second):
        assert not np.isin(later, array).any()
    assert not np.isin(later, [value for value in second.signals.values() if np.isscalar(value)]).any()


class Wrong:
    def __init__(self, estimate):
        self.estimate = estimate

    def reset(self, problem):
        pass

    def step(self, reading):
        return self.estimate(reading)


@pytest.mark.parametrize(
    ("estimate", "text"),
    [
        (lambda r: 1 / 0, "raised ZeroDivisionError at t = 0 s"),
        (lambda r: (0, 0, 0), "returned tuple at t = 0 s, not an Estimate"),
        (lambda r: Estimate(r.t, np.nan, 0, 0), "a pose that is not finite at t = 0 s"),
        (lambda r: Estimate(r.t + 1, 0, 0, 0), "an estimate from the future at t = 0 s"),
        (lambda r: Estimate(r.t - 1, 0, 0, 0), "an estimate of another reading at t = 0 s"),
        (lambda r: Estimate(r.t, "east", 0, 0), "returned x that is not a number at t = 0 s: str 'east'"),
        (lambda r: Estimate(r.t, 0, np.zeros(3), 0), "y that is not a number at t = 0 s: an array of shape"),
        (lambda r: Estimate(r.t, 0, 0, 0, None, "1"), "bias_nt that is not a number at t = 0 s: str '1'"),
        (lambda r: Estimate(r.t, 0, 0, 0, "wide"), "covariance that is not an array of numbers"),
        (lambda r: Estimate(r.t, 0, 0, 0, lost=np.ones(2)), "lost that is not true or false"),
        (lambda r: Estimate(r.t, 0, 0, 0, np.eye(2)), r"a covariance of shape \(2, 2\)"),
        (lambda r: Estimate(r.t, 0, 0, 0, -np.eye(3)), "not positive semidefinite"),
        (lambda r: Estimate(r.t, 0, 0, 0, np.arange(9.0).reshape(3, 3)), "not symmetric at t = 0 s"),
        (lambda r: Estimate(r.t, 0, 0, 0, np.diag([1, 1, np.inf])), "a covariance that is not finite"),
        (lambda r: sys.exit(3), "raised SystemExit at t = 0 s: 3"),
    ],
)
def test_a_wrong_estimate_is_refused_with_its_time(run, estimate, text):
    with pytest.raises(LocalizerError, match=text):
        track(Wrong(estimate), Problem(belief=None, extent=(-3, 3, -2, 2)), run)


@pytest.mark.parametrize(
    "heading",
    [lambda yaw: 270, math.degrees, lambda yaw: math.degrees(yaw) % 360, lambda yaw: 90 + math.degrees(yaw)],
)
def test_headings_in_degrees_are_reported(turning, heading):
    degrees = Wrong(lambda r: Estimate(r.t, 0, 0, heading(r.odometry[2])))
    with pytest.warns(RepairWarning, match=r"Wrong returned yaw .* if they are degrees, return radians"):
        track(degrees, Problem(belief=None, extent=(-3, 3, -2, 2)), turning)


def test_a_refusal_of_a_localizer_says_what_is_wrong_and_not_where_it_was_raised(run):
    class Refuses(Wrong):
        def reset(self, problem):
            raise mt.InputError("a map is needed")

    with pytest.raises(LocalizerError, match=r"^Refuses: a map is needed$"):
        track(Refuses(None), Problem(belief=None, extent=(-3, 3, -2, 2)), run)
