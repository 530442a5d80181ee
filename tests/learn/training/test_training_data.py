"""What a training takes from a data set, and the ridge that stands beside every model."""

import numpy as np
from numpy.testing import assert_allclose
from test_train_command import FIELD, a_run

from magtwin.learn.data.dataset import build_dataset
from magtwin.learn.data.recording import Source
from magtwin.learn.data.split import split
from magtwin.learn.training.training_data import read_training_data
from magtwin.run.run import Run

INPUTS = ("yaw_sin", "odom_v_x")


def a_set(tmp_path, change=lambda run: run, days=3):
    """Six recordings of some days."""
    sources = [
        Source(name, lambda i=i: change(a_run(i, "eight")), session=f"day{i % days}")
        for i, name in enumerate("abcdef")
    ]
    return build_dataset(sources, FIELD, tmp_path / "set")


def parts_of(data, by="session"):
    return split(data.recordings, by, rng=np.random.default_rng(0))


def test_rows_know_their_session_where_days_are_kept_together(tmp_path):
    data = a_set(tmp_path, days=6)
    of = read_training_data(data, parts_of(data), INPUTS)
    session = {one.name: one.session for one in data.recordings}
    numbers = sorted(session.values())
    for part, rows in of.rows.items():
        told = [numbers[i] for i in of.groups[part]]
        assert told == [session[rows.names[i]] for i in rows.recording]


def test_where_one_day_is_all_there_is_to_learn_from_its_recordings_are_left_out_in_turn(tmp_path):
    data = a_set(tmp_path)
    of = read_training_data(data, parts_of(data), INPUTS)
    assert len({one.session for one in data.recordings if one.name in of.rows["train"].names}) == 1
    assert len(np.unique(of.groups["train"])) == len(of.rows["train"].names) == 2


def test_the_ridge_takes_what_terms_the_recordings_have(tmp_path):
    kept = ("t", "p_world_base", "yaw", "odom_v", "b_measured_nt")
    data = a_set(tmp_path, lambda run: Run({name: run[name] for name in kept}, run.metadata))
    of = read_training_data(data, parts_of(data), INPUTS)
    terms = ("yaw_sin", "yaw_cos", "yaw_sin_2", "yaw_cos_2", "odom_v_x")
    assert of.ridge.model.features == terms
    mean, _ = of.ridge_of("test")
    assert np.abs(mean - of.rows["test"].y).mean() < 10  # 2 nT of noise, 100 nT of speed


def test_a_hole_in_what_only_the_ridge_reads_costs_no_row_and_counts_as_the_mean(tmp_path):
    def holed(run):
        current = run["battery_a"].copy()
        current[10:20] = np.nan
        return run.with_columns(battery_a=current)

    data = a_set(tmp_path, holed)
    of = read_training_data(data, parts_of(data), INPUTS)
    assert len(of.rows["test"].y) == 400
    j = of.ridge.model.features.index("battery_a")
    with_mean = of.rows["test"].beside.copy()
    hole = np.isnan(with_mean[:, j])
    assert hole.sum() == 20
    with_mean[hole, j] = np.nanmean(of.rows["train"].beside[:, j])
    assert_allclose(of.ridge_of("test")[0], of.ridge.model.predict(with_mean)[0])
