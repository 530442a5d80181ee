"""Means of a drive's readings, and which of them are left out together."""

import numpy as np
from numpy.testing import assert_array_equal

from magtwin.field.survey.bins import BIN, MOST_BINS, MOST_MEANS, means
from magtwin.field.survey.readings import Readings

DEPTH_M = 0.3


def drive(laps, rows, runs=1):
    """Laps of a Lissajous figure of 3 x 2 m, each a little off the last."""
    way = np.linspace(0, laps, rows)
    p = np.column_stack([1.5 * np.sin(2 * np.pi * way), np.sin(6 * np.pi * way + 0.7 * way)])
    yaw = np.arctan2(*np.gradient(p, axis=0).T[::-1])
    run = np.minimum((runs * way / laps).astype(int), runs - 1)
    names = tuple(str(k) for k in range(runs))
    return Readings(p_xy=p, yaw=yaw, b_nt=np.full(rows, 4e4), t=way, run=run, runs=names)


def test_a_short_drive_is_averaged_along_its_way_in_its_order_and_never_across_runs():
    readings = drive(6, 4_000, runs=3)
    cell, follow = means(readings, DEPTH_M)
    assert follow
    assert set(np.diff(cell)) == {0, 1}
    assert cell.max() < MOST_MEANS
    for k in range(cell.max() + 1):
        own = cell == k
        assert len(set(readings.run[own])) == 1
        assert np.ptp(readings.p_xy[own], axis=0).max() < DEPTH_M


def test_a_long_drive_is_averaged_by_place_and_heading_over_all_passes():
    readings = drive(200, 60_000)
    cell, follow = means(readings, DEPTH_M)
    assert not follow
    assert_array_equal(np.unique(cell), np.arange(cell.max() + 1))
    assert MOST_MEANS / 3 < cell.max() < MOST_BINS
    passes = [np.unique(np.floor(readings.t[cell == k])).size for k in range(0, cell.max(), 50)]
    assert np.median(passes) > 5
    for k in range(0, cell.max(), 50):
        own = cell == k
        assert np.ptp(readings.p_xy[own], axis=0).max() <= BIN * DEPTH_M * 1.1**8
        turned = np.angle(np.exp(1j * (readings.yaw[own] - readings.yaw[own][0])))
        assert np.ptp(turned) <= np.pi / 2 + 1e-9


def test_the_rows_of_a_drive_may_come_in_any_order():
    readings = drive(6, 1_000)
    order = np.random.default_rng(0).permutation(1_000)
    cell, _ = means(readings, DEPTH_M)
    assert_array_equal(means(readings.take(order), DEPTH_M)[0], cell[order])
