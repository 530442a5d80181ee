import numpy as np
import pytest
from numpy.testing import assert_array_equal

from magtwin.field.grid import Grid
from magtwin.field.sources.dipoles import dipole_field_nt
from magtwin.field.survey.folder import read_grid
from magtwin.field.survey.readings import Readings
from magtwin.field.survey.stuck import SURE, find_stuck, mask_stuck, steps_nt

QUARTERS = tuple(np.arange(4) * np.pi / 2)


def lab_field_nt(p_xy, yaw, seed):
    """|R^T B + h| over a floor with forty dipoles in it, and a robot's hard iron."""
    rng = np.random.default_rng(seed)
    at = np.column_stack([rng.uniform(-4, 4, 40), rng.uniform(-3, 3, 40), rng.uniform(-0.6, -0.3, 40)])
    moments = rng.normal(0, 1.2, (40, 3))
    p = np.concatenate([p_xy, np.full((*p_xy.shape[:-1], 1), 0.35)], axis=-1)
    b = np.array([2_000, 21_000, -38_000]) + dipole_field_nt(p, at, moments)
    c, s = np.cos(yaw), np.sin(yaw)
    bx, by, bz = np.moveaxis(b, -1, 0)
    return np.linalg.norm(np.stack([c * bx + s * by + 400, -s * bx + c * by - 250, bz + 300], -1), axis=-1)


def gridded(seed=0, *, resolution_nt=0.01, noise_nt=5.0, change=lambda b, rng: b, rows=11, columns=17):
    """A survey of 4 headings; `change` works on the readings, shape (H, Y, X)."""
    rng = np.random.default_rng(1_000 + seed)
    grid = Grid(
        origin_m=(-2.0, -1.25), cell_m=(0.25, 0.25), headings_rad=QUARTERS, rows=rows, columns=columns
    )
    p, yaw = grid.poses()
    yaw = yaw + np.radians(rng.normal(0, 5, yaw.shape))
    b = lab_field_nt(p, yaw, seed) + noise_nt * rng.standard_normal(yaw.shape)
    b = change(np.rint(b / resolution_nt) * resolution_nt, rng)
    node = np.stack(np.meshgrid(*map(np.arange, grid.shape), indexing="ij"), axis=-1)
    return Readings(
        p_xy=p.reshape(-1, 2),
        yaw=yaw.ravel(),
        b_nt=b.ravel(),
        grid=grid,
        node=node.reshape(-1, 3),
        name="lab",
    )


def drive(seed=0, *, change=lambda b, rng: b, lanes=8, noise_nt=3.0):
    """A lawnmower drive at 0.2 m/s and 25 Hz; `change` works on the readings, shape (N,)."""
    rng = np.random.default_rng(2_000 + seed)
    x = np.arange(-2, 2, 0.008)
    rows = [
        np.column_stack([x if k % 2 == 0 else x[::-1], np.full(len(x), -1.2 + 0.3 * k)]) for k in range(lanes)
    ]
    p = np.concatenate(rows)
    yaw = np.repeat([0.0 if k % 2 == 0 else np.pi for k in range(lanes)], len(x))
    b = lab_field_nt(p, yaw, seed) + noise_nt * rng.standard_normal(len(p))
    return Readings(p_xy=p, yaw=yaw, b_nt=change(b, rng), t=np.arange(len(p)) / 25, runs=("mow",), name="mow")


def test_on_the_real_survey_all_17_stuck_nodes_are_found_and_no_more_than_five_others(real_data):
    readings = read_grid(real_data / "aprilab/maps")
    masked, report = mask_stuck(readings)
    bad = np.zeros(readings.grid.shape, bool)
    bad[tuple(readings.node[~masked.good].T)] = True
    told = np.zeros(readings.grid.shape, bool)  # the figure of those who looked: 17, 17, 26, 20 nodes
    low = (readings.b_nt >= 35_545) & (readings.b_nt <= 35_750)
    told[tuple(readings.node[low].T)] = True
    assert told.sum(axis=(1, 2)).tolist() == [17, 17, 26, 20]
    every = told.all(axis=0)
    assert every.sum() == 17
    assert bad.all(axis=0)[every].all()
    assert np.count_nonzero(bad.any(axis=0) & ~every) <= 5
    assert not np.any(bad & ~told)
    figures = {f.name: f.value for f in report.figures}
    assert figures["stuck at every heading"] == 17
    assert figures["stuck level"] == pytest.approx(35_612, abs=15)
    assert figures["masked falsely"] < (1 - SURE) * figures["stuck readings"]


def test_a_reading_that_others_contradict_is_named_with_place_and_size_and_left_in(real_data):
    readings = read_grid(real_data / "aprilab/maps")
    k = int(np.flatnonzero(np.all(readings.p_xy == [2.0, -1.0], axis=1))[2])
    b = readings.b_nt.copy()
    b[k] += 4_000
    masked, report = mask_stuck(readings.with_(b_nt=b))
    assert masked.good[k]
    assert "at (2, -1) m" in report.metadata["outliers"][0]
    assert "in 180_map.csv" in report.metadata["outliers"][0]
    assert float(report.metadata["outliers"][0].split(" nT")[0].replace(",", "")) == pytest.approx(
        4_000, abs=400
    )


@pytest.mark.parametrize("seed", range(2))
def test_a_sound_survey_has_none(seed):
    found = find_stuck(gridded(seed))
    assert found.judged
    assert not found.frozen.any()
    assert not found.stuck.any()
    assert np.count_nonzero(found.outlier) <= 3


@pytest.mark.parametrize("resolution_nt", [1.0, 20.0, 200.0])
def test_a_coarse_sensor_that_repeats_itself_by_rounding_is_not_stuck(resolution_nt):
    readings = gridded(1, resolution_nt=resolution_nt)
    if resolution_nt == 200:
        grid = readings.b_nt.reshape(readings.grid.shape)
        assert np.count_nonzero(np.diff(grid, axis=2) == 0) > 10
    found = find_stuck(readings)
    assert not found.frozen.any()
    assert not found.stuck.any()


def test_the_simulated_lab_has_none(lab_scene):
    from magtwin.sim.survey import survey
    from magtwin.twin import open_twin

    field = survey(open_twin(lab_scene).scene, rng=np.random.default_rng(3))
    p, yaw = field.grid.poses()
    node = np.stack(np.meshgrid(*map(np.arange, field.grid.shape), indexing="ij"), axis=-1)
    readings = Readings(
        p_xy=p.reshape(-1, 2),
        yaw=yaw.ravel(),
        b_nt=field.values_nt.ravel(),
        grid=field.grid,
        node=node.reshape(-1, 3),
    )
    found = find_stuck(readings)
    assert found.judged
    assert not found.frozen.any()
    assert not found.stuck.any()


def test_nodes_where_the_sensor_had_lost_lock_are_found_repeating_or_not():
    where = np.zeros((4, 11, 17), bool)
    where[:, 3:8, 5:7] = True  # wide rows repeat to the last digit, as the sensor holds its value ...
    where[:, 8, 5] = True  # ... and here it came back to its level anew

    def stuck(b, rng):
        level = np.round(31_000 + 15 * rng.standard_normal(b.shape[:2]), 2)
        b = np.where(where, level[..., None], b)
        b[1] = np.where(where[1], np.round(31_000 + 25 * rng.standard_normal(b.shape[1:]), 2), b[1])
        return b

    readings = gridded(2, change=stuck)
    found = find_stuck(readings)
    assert_array_equal((found.frozen | found.stuck).reshape(where.shape), where)
    assert found.level_nt == pytest.approx(31_000, abs=20)


def test_a_survey_of_one_heading_that_is_stuck_in_a_row_is_found():
    def stick(b, rng):
        b[0, 4, 3:9] = b[0, 4, 3]
        return b

    whole = gridded(3, change=stick)
    one = whole.take(whole.node[:, 0] == 0)
    found = find_stuck(one)
    assert found.frozen.sum() == 6
    assert np.all(one.node[found.frozen][:, 1] == 4)


@pytest.mark.parametrize("resolution_nt", [0.001, 1.0, 20.0])
def test_a_sound_drive_has_none_however_coarse_its_sensor(resolution_nt):
    readings = drive(4)
    found = find_stuck(readings.with_(b_nt=np.rint(readings.b_nt / resolution_nt) * resolution_nt))
    assert np.count_nonzero(found.outlier) <= 3
    assert not found.frozen.any()
    assert not found.stuck.any()


def test_a_drive_whose_sensor_is_stuck_for_a_while_is_found_to_the_row():
    def stick(b, rng):
        b[1_200:1_260] = b[1_200]
        return b

    found = find_stuck(drive(change=stick))
    assert_array_equal(np.flatnonzero(found.frozen), np.arange(1_200, 1_260))


def test_a_robot_that_waits_is_not_stuck():
    still = drive(noise_nt=0.0)
    rows = np.concatenate([np.arange(1_500), np.full(400, 1_500), np.arange(1_500, len(still))])
    waiting = still.take(rows)
    found = find_stuck(waiting.with_(t=np.arange(len(rows)) / 25, b_nt=np.round(waiting.b_nt, 1)))
    assert not found.frozen.any()
    assert not found.stuck.any()


def test_a_plateau_in_the_noise_that_other_lanes_contradict_is_stuck():
    def stuck(b, rng):
        b[1_300:1_420] = 30_000 + 3 * rng.standard_normal(120)
        return b

    found = find_stuck(drive(1, change=stuck))
    assert found.stuck[1_300:1_420].all()
    assert found.stuck.sum() == 120


def test_a_spike_of_a_drive_is_an_outlier_to_the_row():
    def spike(b, rng):
        b[777] += 900
        return b

    found = find_stuck(drive(change=spike))
    assert found.outlier[777] == pytest.approx(900, abs=60)
    assert found.stuck.sum() == 0


def test_rows_that_were_bad_before_stay_so_and_count_for_nothing():
    def stick(b, rng):
        b[1_200:1_260] = b[1_200]
        return b

    readings = drive(change=stick)
    good = np.ones(len(readings), bool)
    good[1_200:1_260] = False
    masked, report = mask_stuck(readings.with_(good=good))
    assert_array_equal(masked.good, good)
    assert {f.name: f.value for f in report.figures}["frozen readings"] == 0


def wander(seed, quantum_nt=0.01):
    """A drive of a minute at 0.2 m/s and 10 Hz that turns all the time, with vectors rounded to a quantum."""
    rng = np.random.default_rng(seed)
    t = np.arange(600) / 10
    p = np.column_stack(
        [2 * np.sin(0.11 * t + rng.uniform(0, 6)), 1.5 * np.sin(0.17 * t + rng.uniform(0, 6))]
    )
    yaw = np.arctan2(np.gradient(p[:, 1]), np.gradient(p[:, 0]))
    at = np.column_stack([rng.uniform(-1.5, 1.5, (4, 2)), np.full(4, -0.3)])
    b = np.array([500, 24_000, -40_000]) + dipole_field_nt(
        np.column_stack([p, np.full(600, 0.5)]), at, rng.normal(0, 5, (4, 3))
    )
    c, s = np.cos(yaw), np.sin(yaw)
    body = np.column_stack([c * b[:, 0] + s * b[:, 1], c * b[:, 1] - s * b[:, 0], b[:, 2]])
    body = np.rint((body + 20 * rng.standard_normal(body.shape)) / quantum_nt) * quantum_nt
    return Readings(p_xy=p, yaw=yaw, b_body_nt=body, t=t)


@pytest.mark.parametrize(("seed", "quantum_nt"), [(8, 60.0), (14, 100.0), (4, 150.0)])
def test_a_sound_drive_that_turns_has_none_though_its_vectors_are_rounded(seed, quantum_nt):
    found = find_stuck(wander(seed, quantum_nt))
    assert found.judged
    assert not (found.frozen | found.stuck).any()


def test_a_coarse_sensor_whose_stretches_all_look_flat_is_compared_with_its_neighbours():
    readings = wander(1)
    b = 500 * np.rint(readings.b_nt / 500)
    _, report = mask_stuck(Readings(p_xy=readings.p_xy, yaw=readings.yaw, b_nt=b))
    assert "note" not in report.metadata


def test_the_report_doubts_a_survey_of_which_much_is_masked():
    def stick(b, rng):
        b[1_000:3_000] = b[1_000]
        return b

    _, report = mask_stuck(drive(change=stick))
    assert "2000 of 4000 readings are masked as stuck" in report.metadata["doubts"][0]
    assert "--keep-stuck" in report.metadata["doubts"][0]
    assert "doubts" not in mask_stuck(drive())[1].metadata


def phone(step_nt, rate_hz, kind, seed=0, locks=()):
    """A walk of a minute at 0.5 m/s over 5 m x 2.1 m that stands still twice for 3 s, with a phone's steps.

    `kind` is what is known: vectors in its axes, their magnitudes, these with a bias below the steps, or
    rounded magnitudes. The sensor holds its value for 2 s at the times `locks` [s].
    """
    rng = np.random.default_rng(3_000 + seed)
    x = np.arange(-2.5, 2.5, 0.5 / rate_hz)
    p = np.concatenate([np.column_stack([x[:: (-1) ** k], np.full(len(x), 0.35 * k)]) for k in range(7)])
    yaw = np.repeat([0.0 if k % 2 == 0 else np.pi for k in range(7)], len(x))
    times = np.ones(len(p), int)
    times[rng.integers(0, len(p), 2)] = 3 * rate_hz
    p, yaw = np.repeat(p, times, axis=0), np.repeat(yaw, times)
    at = np.column_stack([rng.uniform(-3, 3, 6), rng.uniform(-0.5, 2.5, 6), rng.uniform(-0.5, -0.2, 6)])
    sensor = np.column_stack([p, np.full(len(p), 0.5)])
    b = np.array([2_000, 21_000, -39_000]) + dipole_field_nt(sensor, at, rng.normal(0, 8, (6, 3)))
    turned = np.cos(yaw)[:, None] * b[:, :2]  # headings are 0 and 180 deg
    b = np.column_stack([turned, b[:, 2]]) + 60 * rng.standard_normal(b.shape)
    bias = rng.uniform(-20_000, 20_000, 3) if kind == "biased" else 0
    if kind == "rounded":
        b = np.linalg.norm(b, axis=1)
    b = step_nt * np.rint((b + bias) / step_nt) - bias
    held = np.zeros(len(b), bool)
    for start in (int(s * rate_hz) for s in locks):
        b[start : start + 2 * rate_hz], held[start : start + 2 * rate_hz] = b[start], True
    field = (
        {"b_body_nt": b} if kind == "vector" else {"b_nt": b if b.ndim == 1 else np.linalg.norm(b, axis=1)}
    )
    return Readings(p_xy=p, yaw=yaw, t=np.arange(len(p)) / rate_hz, **field), held


KINDS = ["vector", "magnitude", "biased", "rounded"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("step_nt", "rate_hz"), [(150, 100), (690, 45)])
def test_of_a_walk_with_a_phones_steps_at_most_one_percent_is_masked(step_nt, rate_hz, kind):
    readings, _ = phone(step_nt, rate_hz, kind)
    assert np.count_nonzero(np.diff(readings.b_nt) == 0) > 100
    found = find_stuck(readings)
    assert np.count_nonzero(found.frozen | found.stuck) <= 0.01 * len(readings)
    assert np.count_nonzero(found.outlier) <= 5


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("step_nt", [10, 690])
def test_a_phone_that_holds_a_value_for_2_s_of_a_walk_through_a_gradient_is_found(step_nt, kind):
    sound, _ = phone(step_nt, 45, kind)
    starts = np.arange(1, 70, 3.0)
    change = [abs(np.subtract(*sound.b_nt[[int(s * 45), int(s * 45) + 90]])) for s in starts]
    readings, held = phone(step_nt, 45, kind, locks=starts[np.argsort(change)[-2:]])
    found = find_stuck(readings)
    masked = found.frozen | found.stuck
    assert masked[held].all()
    value = np.cumsum(np.diff(readings.b_nt, prepend=0) != 0)  # it may have begun before it was held
    assert np.count_nonzero(masked & ~np.isin(value, value[held])) <= 0.01 * len(readings)


@pytest.mark.parametrize("step_nt", [1, 10, 150, 690])
def test_the_step_of_a_sensor_is_learnt_from_values_that_lie_on_it(step_nt):
    readings, _ = phone(step_nt, 45, "rounded")
    assert steps_nt(readings, [np.arange(len(readings))])[0] == pytest.approx(step_nt, rel=0.35)


def test_masked_falsely_counts_repeats_that_agree_with_their_neighbours_and_no_others():
    away = drive(change=lambda b, rng: np.where(np.arange(len(b)) // 60 == 20, b[1_200] + 3_000, b))
    agree = drive(change=lambda b, rng: np.where(np.arange(len(b)) // 13 == 92, b[1_199], b))
    for readings, count, least, most in ((away, 60, 0, 0), (agree, 13, 1, 13)):
        _, report = mask_stuck(readings)
        figures = {f.name: f for f in report.figures}
        assert figures["stuck readings"].value == count
        assert least <= figures["masked falsely"].value <= most
        assert "at most" in figures["masked falsely"].note
