"""The report of a localization: every number that it shows, recomputed from the raw arrays."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

import magtwin as mt
from magtwin.frames import yaw_from_quat
from magtwin.tasks.localizing import localization


@pytest.fixture(scope="module")
def run():
    """A drive with dropouts of up to 1.5 s, and lost motion capture."""
    twin = mt.in_session(mt.open_twin("lab"), 2)
    made = mt.simulate(twin, "lawnmower", seed=2, duration_s=60)
    t, rows = made["t"], np.arange(made.rows)
    lost = (rows % 3 == 0) | ((t > 20) & (t < 21.5)) | ((t > 40) & (t < 40.5))
    return made.with_columns(
        b_measured_nt=np.where(lost, np.nan, made["b_measured_nt"]),
        flag_lost_lock=(t > 30) & (t < 31),
        flag_pose_lost=(t > 50) & (t < 50.6),
    ).with_metadata(truth="motion capture, /vrpn/pose")


def dead_reckoning(run, start):
    """The start moved by the increments of the odometry, shape (N, 2)."""
    p, yaw = run["odom_p"][:, :2], yaw_from_quat(run["odom_q_xyzw"])
    c, s = np.cos(start[2] - yaw[0]), np.sin(start[2] - yaw[0])
    return np.array(start[:2]) + (p - p[0]) @ np.array([[c, s], [-s, c]])


@pytest.mark.parametrize("prior", ["tracking", "heading"])
def test_every_number_of_the_report_is_that_of_the_raw_arrays(run, prior):
    made = localization(run, "lab", prior=prior)
    printed = json.loads(made.report().to_json())
    figures = made.report().figures
    shown = {figure.name: figure.value for figure in figures}
    notes = {figure.name: figure.note for figure in figures}
    got = made.run
    t, known = got["t"], ~got["flag_pose_lost"]
    off = (got["est_p_world_base"] - got["p_world_base"])[:, :2]
    turn = (got["est_yaw"] - got["yaw"] + np.pi) % (2 * np.pi) - np.pi
    size = np.hypot(*off.T)

    begin = t[0]
    if prior == "heading":  # errors count from the first time on from which 10 s are below 0.25 m
        seen = np.flatnonzero(known)
        near = size[seen] < 0.25
        begin = next(
            t[k]
            for i, k in enumerate(seen)
            if near[i:][t[seen[i:]] <= t[k] + 10].all() and t[-1] >= t[k] + 10
        )
        assert shown["converged after"] == pytest.approx(begin - t[seen[0]])
    counted = known & (t >= begin)
    e = size[counted]
    assert shown["position error, RMSE"] == pytest.approx(np.sqrt(np.mean(e**2)))
    assert shown["position error, median"] == pytest.approx(np.median(e))
    assert shown["position error, 95 %"] == pytest.approx(np.percentile(e, 95))
    assert shown["position error, end"] == pytest.approx(size[known][-1])
    assert shown["heading error, RMSE"] == pytest.approx(np.degrees(np.sqrt(np.mean(turn[counted] ** 2))))

    start = made.problem.prior.mean
    if prior == "heading":
        start = (*got["p_world_base"][0, :2], got["yaw"][0])
    dead = np.hypot(*(dead_reckoning(got, start) - got["p_world_base"][:, :2]).T)[counted]
    assert shown["dead reckoning, RMSE"] == pytest.approx(np.sqrt(np.mean(dead**2)), rel=1e-6)
    assert notes["dead reckoning, RMSE"] == ("from the true start" if prior == "heading" else "")

    bound = np.sqrt(np.mean(made.bounds.correlated[counted] ** 2))
    assert shown["bound"] == pytest.approx(bound)
    assert shown["bound, exact map"] == pytest.approx(np.sqrt(np.mean(made.bounds.exact[counted] ** 2)))
    assert notes["position error, RMSE"] == f"{np.sqrt(np.mean(e**2)) / bound:.2f} of the bound"

    P = np.empty((got.rows, 3, 3))
    P[:, *np.triu_indices(3)] = P.transpose(0, 2, 1)[:, *np.triu_indices(3)] = got["est_covariance"]
    trusted = counted & ~got["est_lost"]
    errors = np.column_stack([off, turn])[trusted]
    squares = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(P[trusted]), errors)
    flat = np.einsum("ni,nij,nj->n", off[trusted], np.linalg.inv(P[trusted, :2, :2]), off[trusted])
    assert shown["ANEES per state"] == pytest.approx(squares.mean() / 3, rel=1e-6)
    assert shown["in the 90 % ellipse"] == pytest.approx(np.mean(flat <= 2 * np.log(10)))
    assert shown["flagged lost"] == pytest.approx(np.mean(got["est_lost"][known]))
    assert shown["time a step"] == pytest.approx(1e6 * made.track.step_s)

    # of the source: which intervals of 0.2 s, after the first row alone, hold a reading
    good = np.isfinite(run["b_measured_nt"]) & ~run["flag_lost_lock"]
    interval = np.ceil((run["t"] - run["t"][0]) * 5 - 1e-9)
    assert interval[-1] == 300  # its last rows are after the last tick
    filled = np.unique(interval[good & (interval < 300)])
    assert shown["with a reading"] == pytest.approx(len(filled) / 300)
    assert printed["metadata"]["readings"].startswith(f"{len(filled):,} in {t[-1] - t[0]:.1f} s, ")
    assert printed["metadata"]["errors"].endswith(f", known at {known.sum():,} of them")
    sizes = f"{100 * np.sqrt(np.mean(e**2)):.1f} cm RMSE against {100 * np.sqrt(np.mean(dead**2)):.1f} cm"
    less = 1 - np.sqrt(np.mean(e**2) / np.mean(dead**2))
    assert sizes + (f", {less:.0%} less." if less > 0.03 else ".") in printed["verdict"]
    assert f"ANEES {squares.mean() / 3:.2f} per state" in printed["verdict"]


def test_the_files_of_a_localization_hold_the_errors_that_its_report_shows(run, tmp_path):
    from magtwin.figures.localization import save_localization

    made = localization(run, "lab", method="ekf")
    save_localization(made, tmp_path / "out")
    estimate, truth = (np.loadtxt(tmp_path / "out" / f"{name}.tum") for name in ("estimate", "truth"))
    at = np.isin(estimate[:, 0], truth[:, 0])
    size = np.hypot(*(estimate[at] - truth)[:, 1:3].T)
    shown = {figure.name: figure.value for figure in made.report().figures}
    assert_allclose(np.sqrt(np.mean(size**2)), shown["position error, RMSE"], atol=1e-8)
    assert_allclose(size[-1], shown["position error, end"], atol=1e-8)
