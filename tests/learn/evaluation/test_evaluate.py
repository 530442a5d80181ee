"""Evaluation: models on their maps, judged by recordings that they never saw."""

from dataclasses import replace

import numpy as np
import pytest
from learn_drives import a_drive, hills

from magtwin.errors import InputError
from magtwin.learn.data.alignment import Alignment
from magtwin.learn.data.dataset import build_dataset
from magtwin.learn.data.features import features as features_of
from magtwin.learn.data.labels import labelled
from magtwin.learn.data.recording import Source
from magtwin.learn.data.split import split
from magtwin.learn.evaluation.candidates import NAIVE, Candidate, Mean, candidate_of, naive, named_map
from magtwin.learn.evaluation.evaluate import evaluate, trials_of, unlearned, unseen
from magtwin.learn.training.config import TrainConfig
from magtwin.learn.training.train import fit
from magtwin.run.run import Run

HILLS = named_map("hills", hills(variance=400.0))
HIGHER = named_map("higher", hills("higher", 41.5e3))


def a_run(seed=0, **metadata):
    """A drive whose disturbance is 300 nT, 100 nT a m/s of speed, and noise."""
    run = a_drive(seed, 300, 20.0, 300.0, session=seed % 4, session_seed=1, **metadata)
    return Run({name: run[name] for name in run if name != "b_truth_nt"}, run.metadata)


def trial(name="one", run=None, **told):
    run = a_run(7, path="figure8") if run is None else run
    return Source(name, lambda: run, **told)


def judged(models, *trials, **options):
    """An evaluation, the first model the baseline."""
    rng = np.random.default_rng(0)
    return evaluate(models[1:], trials or [trial()], baseline=models[0], rng=rng, **options)


FLAT = Candidate(NAIVE, Mean(300.0, 100.0), HILLS)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    runs = {f"r{k}": a_run(k, path=("sine", "figure8")[k % 2]) for k in range(8)}
    return build_dataset(runs, HILLS.field, tmp_path_factory.mktemp("data") / "set")


@pytest.fixture(scope="module")
def weights(data, tmp_path_factory):
    """A linear model of the data set, with the split that its metadata repeat."""
    config = TrainConfig(model="linear", features="circular", seed=3)
    deals, draws = np.random.default_rng(config.seed).spawn(2)
    parts = split(data.recordings, config.split, rng=deals)
    made = fit(config, data, parts, rng=draws)
    path = tmp_path_factory.mktemp("weights") / "line.safetensors"
    made.predictor.save(path)
    return path, parts


def test_an_error_is_map_and_prediction_less_what_was_measured():
    run = a_run(3, path="figure8")
    found = judged([FLAT], trial(run=run))
    error = HILLS.field.lookup(run["p_world_base"][:, :2], run["yaw"]) + 300 - run["b_measured_nt"]
    assert found.every.scores[0].mae_nt == pytest.approx(np.abs(error).mean())
    assert found.every.scores[0].ratio == 1.0


def test_a_model_looks_its_map_up_with_its_own_lever_arm_and_latency():
    alignment = Alignment((0.05, -0.02), 0.1)
    run = a_run(5, path="figure8")
    moved = labelled(run, HILLS.field, alignment)
    found = judged([FLAT, Candidate("moved", Mean(300.0, 1.0), HILLS, alignment)], trial(run=run))
    kept = np.isfinite(moved["label_nt"])
    assert found.every.scores[1].rows == kept.sum() < run.rows
    assert found.every.scores[1].mae_nt == pytest.approx(np.abs(300 - moved["label_nt"][kept]).mean())


def test_all_models_are_judged_on_common_readings_and_what_is_left_out_is_counted():
    masked = np.ones((1, 33, 41), bool)
    masked[0, :, :16] = False
    holed = named_map("holed", hills("holed", valid=masked))
    found = judged([FLAT, Candidate("holed", Mean(300.0, 1.0), holed)])
    assert found.left_out == {"have no label on holed": 300 - found.every.scores[0].rows}
    assert {score.rows for score in found.every.scores} == {found.every.scores[0].rows}


def test_paths_of_the_paper_are_its_cases_and_others_go_by_their_names():
    runs = [
        trial(path, a_run(k, path=path)) for k, path in enumerate(("spiral", "narrow_figure8", "fast_sine"))
    ]
    found = judged([FLAT], *runs, cases={"D": "spiral"})
    assert [case.name for case in found.cases] == ["A", "D", "E", "all", "mean"]
    found = judged([FLAT], *runs)
    assert [case.name for case in found.cases] == ["A", "E", "spiral", "all", "mean"]


def test_the_noise_floor_of_a_map_is_the_mean_size_of_a_normal_error_of_its_own_variance():
    mae, rms = judged([FLAT]).floor(HILLS)
    assert rms == pytest.approx(20.0)
    assert mae == pytest.approx(20.0 * np.sqrt(2 / np.pi))


def test_weights_tell_their_mean_label_where_no_training_set_is_at_hand(weights):
    own = candidate_of(weights[0], [HILLS])
    assert naive(HILLS, weights=[own]).model.mean_nt == own.metadata["label_mean_nt"]
    with pytest.raises(InputError, match="the mean training label on the map higher"):
        naive(HIGHER, weights=[own])


def test_weights_take_the_map_that_they_were_trained_on_by_its_checksum(weights):
    assert candidate_of(weights[0], [HIGHER, HILLS]).map is HILLS


def test_weights_for_another_map_are_refused_naming_both(weights):
    with pytest.raises(InputError, match=r"line.*trained on the map 'hills'.*higher has") as refusal:
        candidate_of(weights[0], [HIGHER])
    for checksum in (*HILLS.checksums, *HIGHER.checksums):
        assert checksum in str(refusal.value)
    assert candidate_of(weights[0], [HIGHER], any_map=True).map is HIGHER


def test_released_weights_which_name_no_map_take_the_first(real_data):
    released = candidate_of(
        real_data / "aprilab" / "models" / "nn_magnetometer_model_v0.0.1.pth", [HIGHER, HILLS]
    )
    assert released.map is HIGHER
    score = judged([Candidate(NAIVE, Mean(300.0, 1.0), HIGHER), released]).every.scores[1]
    assert np.isfinite(score.mae_nt)
    assert score.outside == 1.0  # inputs drawn at random are nothing that it knows


def test_of_the_set_that_weights_were_trained_on_their_test_recordings_judge(data, weights):
    path, parts = weights
    names, learned = unseen(data, [candidate_of(path, [HILLS])])
    assert names == tuple(name for name in data.names if name in parts.test)
    assert set(learned) == set(parts.train)
    assert unseen(data, [FLAT]) == (data.names, data.names)
    assert [one.name for one in trials_of(data, names)] == list(names)


def test_baselines_are_not_judged_by_what_they_learn_from(data):
    sources = unlearned(trials_of(data, ["r1", "r2"]), data, ["r0", "r1"])
    with pytest.raises(InputError, match="r1: is 'r1' of"):
        sources[0].read()
    assert sources[1].read().rows == 300


def test_weights_trained_on_rows_of_every_recording_are_refused(data, weights):
    one = candidate_of(weights[0], [HILLS])
    leaky = replace(one, metadata={**one.metadata, "config": 'split = "row"\nseed = 3\n'})
    with pytest.raises(InputError, match="trained on rows of every recording"):
        unseen(data, [leaky])


def test_the_figures_of_a_report_are_those_of_the_raw_arrays(data, weights):
    runs = {"one": a_run(7, path="figure8"), "other": a_run(9, path="sine")}
    candidate = candidate_of(weights[0], [HILLS])
    made = judged([FLAT, candidate], *(trial(name, run) for name, run in runs.items()))
    every = next(case for case in made.summary()["cases"] if case["name"] == "all")
    errors, sds, naive_errors = [], [], []
    for run in runs.values():
        here = labelled(run, HILLS.field, candidate.alignment)
        mean, sd = candidate.model.net.predict(features_of(here, candidate.model.features))
        kept = np.isfinite(here["label_nt"])
        errors.append((mean - here["label_nt"])[kept])
        sds.append(sd[kept])
        naive_errors.append((300.0 - labelled(run, HILLS.field)["label_nt"])[kept])
    error, sd, plain = (np.concatenate(parts) for parts in (errors, sds, naive_errors))
    shown, naive_shown = every["models"][candidate.name], every["models"][NAIVE]
    assert every["rows"] == len(error)
    assert naive_shown["mae_nt"] == pytest.approx(np.abs(plain).mean(), rel=1e-9)
    wanted = {
        "mae_nt": np.abs(error).mean(),
        "ratio": np.abs(error).mean() / np.abs(plain).mean(),
        "rmse_nt": np.sqrt(np.mean(error**2)),
        "bias_nt": error.mean(),
        "coverage": np.mean(np.abs(error) <= 1.6448536 * sd),
    }
    for name, value in wanted.items():
        assert shown[name] == pytest.approx(value, rel=1e-9), name
    (line,) = made.verdicts().values()
    sizes = (
        f"{wanted['mae_nt']:,.0f} nT against {np.abs(plain).mean():,.0f} nT, a ratio of {wanted['ratio']:.2f}"
    )
    assert sizes in line
    assert f"hold {wanted['coverage']:.0%} of the readings" in line


def constant(run):
    return run.with_columns(b_measured_nt=HILLS.field.lookup(run["p_world_base"][:, :2], run["yaw"]) + 5)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda run: run.with_metadata(magnetometer="neural"), "come from a neural magnetometer"),
        (lambda run: run.with_columns(p_world_base=run["p_world_base"] + 50), "one: naive: none of 300"),
        (constant, "every label is 5 nT on all 300 readings"),
    ],
)
def test_a_run_that_cannot_judge_is_refused(change, text):
    with pytest.raises(InputError, match=text):
        judged([FLAT], trial(run=change(a_run(2, path="figure8"))))


def test_readings_on_no_common_ground_are_refused_with_counts():
    left, right = (np.ones((1, 33, 41), bool) for _ in range(2))
    left[0, :, 21:] = False
    right[0, :, :20] = False
    halves = [named_map(name, hills(name, valid=v)) for name, v in (("left", left), ("right", right))]
    with pytest.raises(InputError, match="no reading that every model can be judged"):
        judged([Candidate(one.name, Mean(0.0, 1.0), one) for one in halves])


def test_two_of_one_name_are_refused():
    with pytest.raises(InputError, match="two models are called 'naive'"):
        judged([FLAT, FLAT])
    with pytest.raises(InputError, match="two recordings are called 'one'"):
        judged([FLAT], trial(), trial())
