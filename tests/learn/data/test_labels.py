import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import magtwin
from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.files.file import shipped
from magtwin.frames import quat_from_yaw
from magtwin.learn.data.alignment import Alignment, fit_alignment
from magtwin.learn.data.labels import labelled
from magtwin.run.run import Run


def hills(x, y):
    """A field with slopes of up to 6 uT/m, in nT."""
    return 41e3 + 1500 * np.sin(3.1 * x + 0.3) * np.cos(2.3 * y) + 900 * np.cos(4.2 * y - 1.1 * x)


def a_map(cell=0.02, variance=None):
    x, y = np.arange(-2, 2 + cell / 2, cell), np.arange(-1.5, 1.5 + cell / 2, cell)
    values = hills(x[None, :], y[:, None])[None]
    spread = None if variance is None else np.full(values.shape, variance)
    return AnomalyMap(
        values_nt=values,
        origin_m=(-2.0, -1.5),
        cell_m=(cell, cell),
        headings_rad=np.zeros(1),
        variance_nt2=spread,
        name="hills",
    )


def a_run(
    lever=(0.0, 0.0), latency=0.0, *, seconds=60.0, swing=0.7, noise=5.0, seed=0, straight=False, rate=20
):
    """A Lissajous drive (or a straight one at 0.2 m/s) whose sensor sits at a lever arm and answers late."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * rate)) / rate

    def pose(t):
        if straight:
            return -1.5 + 0.2 * t, np.full(len(t), 0.2), np.zeros(len(t))
        phase = 0.14 * t + swing * np.sin(0.31 * t)
        x, y = 1.6 * np.sin(phase), 1.1 * np.sin(2 * phase + 0.4)
        return x, y, np.arctan2(2.2 * np.cos(2 * phase + 0.4), 1.6 * np.cos(phase))

    x, y, yaw = pose(t)
    then_x, then_y, then = pose(t - latency)
    c, s = np.cos(then), np.sin(then)
    b = hills(then_x + c * lever[0] - s * lever[1], then_y + s * lever[0] + c * lever[1])
    b = b + 300 * np.cos(yaw) - 120 * np.sin(2 * yaw) + rng.normal(0, noise, len(t))
    p = np.column_stack([x, y, np.zeros(len(t))])
    return Run({"t": t, "p_world_base": p, "yaw": (yaw + np.pi) % (2 * np.pi) - np.pi, "b_measured_nt": b})


FIELD = a_map()


def test_a_label_is_what_was_measured_less_the_map_at_the_sensor():
    run = a_run((0.1, -0.04), 0.15)
    given = Alignment((0.1, -0.04), 0.15)
    robot = 300 * np.cos(run["yaw"]) - 120 * np.sin(2 * run["yaw"])
    label, raw = labelled(run, FIELD, given)["label_nt"], labelled(run, FIELD)["label_nt"]
    assert np.isfinite(label).mean() > 0.98
    assert np.nanstd(np.abs(label - robot)) < 8
    assert np.nanstd(np.abs(raw - robot)) > 100


def test_a_label_carries_the_maps_own_error_and_that_of_the_alignment():
    run = a_run()
    assert_array_equal(labelled(run, FIELD)["label_sd_nt"], 0.0)
    assert_allclose(labelled(run, a_map(variance=900.0))["label_sd_nt"], 30.0)
    unsure = labelled(run, a_map(variance=900.0), Alignment(lever_arm_sd_m=(0.01, 0.02)))
    forward, left = unsure["b_map_gradient_nt_m"].T
    assert_allclose(unsure["label_sd_nt"], np.sqrt(900 + (0.01 * forward) ** 2 + (0.02 * left) ** 2))


def test_readings_without_lock_pose_or_map_have_no_label():
    run = a_run()
    lost, gone, none = (np.arange(run.rows) % 10 == k for k in range(3))
    b = np.where(none, np.nan, run["b_measured_nt"])
    p = np.where((np.arange(run.rows) % 10 == 3)[:, None], 9.0, run["p_world_base"])
    run = run.with_columns(flag_lost_lock=lost, flag_pose_lost=gone, b_measured_nt=b, p_world_base=p)
    assert_array_equal(np.isfinite(labelled(run, FIELD)["label_nt"]), np.arange(run.rows) % 10 >= 4)


def test_motion_capture_is_the_pose_where_there_is_one():
    run = a_run()
    q = quat_from_yaw(run["yaw"])
    moved = run.with_columns(mocap_p=run["p_world_base"] + [0.1, 0, 0], mocap_q_xyzw=q)
    elsewhere = FIELD.lookup(run["p_world_base"][:, :2] + [0.1, 0], run["yaw"])
    assert_allclose(labelled(moved, FIELD)["b_map_nt"], elsewhere)
    taken = labelled(Run({k: v for k, v in moved.items() if k != "yaw"}), FIELD)
    assert_allclose(taken["yaw"], run["yaw"], atol=1e-12)


def test_a_labelled_run_is_whole_and_says_what_its_labels_are():
    run = labelled(a_run(), FIELD)
    known = np.isfinite(run["label_nt"])
    assert_allclose(run["b_map_nt"][known] + run["label_nt"][known], run["b_measured_nt"][known])
    assert run.spec("label_sd_nt").unit == "nT"
    step, yaw = 1e-4, run["yaw"]
    left = run["p_world_base"][:, :2] + step * np.column_stack([-np.sin(yaw), np.cos(yaw)])
    change = (FIELD.lookup(left, yaw) - run["b_map_nt"]) / step
    close = np.isclose(change, run["b_map_gradient_nt_m"][:, 1], rtol=0.02, atol=5)
    assert close.mean() > 0.9  # but where the step leads into the next cell


def test_lever_arm_and_latency_are_found_together_to_their_stated_spread():
    truth = np.array([0.04, -0.03, 0.12])
    found = fit_alignment([a_run(truth[:2], truth[2], seed=k, swing=0.5 + k) for k in range(2)], FIELD)
    got = np.array([*found.lever_arm_m, found.latency_s])
    sd = np.array([*found.lever_arm_sd_m, found.latency_sd_s])
    assert_allclose(got, truth, atol=0.004)
    assert (np.abs(got - truth) < 4 * sd + 0.002).all()
    assert (sd < 0.01).all()


@pytest.mark.slow
def test_stated_spreads_of_the_twin_hold_its_true_lever_arm_and_latency():
    """20 independent data sets of 8 min; the markers are attached anew and motion capture lags by 75 ms."""
    twin = magtwin.open_twin(shipped("scenes", "lab", "lab.usda"), magnetometer="physical")
    field = magtwin.load_map(shipped("maps", "lab", "lab.usdc"))
    truth, scores = np.array([0.055, -0.03, -0.0752]), []
    for k in range(20):
        runs = magtwin.sweep(twin, None, 12, seed=10_000 + 1000 * k, sessions=4, duration_s=40, rate_hz=10)
        found = fit_alignment(list(runs), field)
        error = np.array([*found.lever_arm_m, found.latency_s]) - truth
        scores.append(error / [*found.lever_arm_sd_m, found.latency_sd_s])
    assert 0.6 < np.sqrt(np.mean(np.square(scores))) < 1.2
    assert 0.85 <= np.count_nonzero(np.abs(scores) < 1.645) / 60 <= 0.98


def test_where_runs_keep_to_one_line_at_one_speed_nothing_is_claimed():
    """3 cm forward and 0.15 s late at 0.2 m/s are the same there: their sum is known, each only as before."""
    found = fit_alignment([a_run((0.03, 0.0), straight=True, seconds=16)], FIELD)
    (forward, _), late = found.lever_arm_m, found.latency_s
    assert forward - 0.2 * late == pytest.approx(0.03, abs=0.004)
    assert abs(late) < 0.1
    assert found.latency_sd_s > 0.05
    assert abs(late) < 2 * found.latency_sd_s


def test_the_motors_torque_where_a_robot_slows_is_taken_for_neither(monkeypatch):
    run = a_run(swing=2.0)
    p, t, yaw = run["p_world_base"][:, :2], run["t"], run["yaw"]
    vx, vy = np.gradient(p, t, axis=0).T
    speed = np.cos(yaw) * vx + np.sin(yaw) * vy
    torque = 2500 * np.gradient(speed, t) * (1 + 0.5 * np.cos(yaw))
    run = run.with_columns(b_measured_nt=run["b_measured_nt"] + torque)
    found = fit_alignment([run], FIELD)
    assert (*found.lever_arm_m, found.latency_s) == pytest.approx((0, 0, 0), abs=0.005)
    monkeypatch.setattr("magtwin.learn.data.alignment._slope", lambda values, t, at: np.zeros(len(at)))
    assert abs(fit_alignment([run], FIELD).lever_arm_m[0]) > 0.02


def test_on_a_level_map_the_alignment_is_what_was_known_before():
    level = dataclasses.replace(FIELD, values_nt=np.full(FIELD.values_nt.shape, 41e3))
    run = a_run()
    run = run.with_columns(b_measured_nt=np.full(run.rows, 41e3) + np.cos(run["yaw"]))
    found = fit_alignment([run], level)
    assert found.lever_arm_m == pytest.approx((0, 0), abs=1e-6)
    assert (*found.lever_arm_sd_m, found.latency_sd_s) == pytest.approx((0.05, 0.05, 0.1))


def test_what_cannot_be_aligned_is_refused():
    far = a_run()
    far = far.with_columns(p_world_base=far["p_world_base"] + [40, 0, 0])
    with pytest.raises(InputError, match="0 readings have a label on the map 'hills', too few"):
        fit_alignment([far], FIELD)
    with pytest.raises(InputError, match=r"none of 1200 readings has a label.*the robot was at x, y 38"):
        labelled(far, FIELD)
    with pytest.raises(InputError, match="lever_arm_m must be within 100 m of 0"):
        Alignment((np.nan, 0.0))
