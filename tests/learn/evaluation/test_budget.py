"""The error budget of a twin: parts that add up to a model's error, and what closing each of them leaves."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from magtwin.errors import InputError
from magtwin.learn.data.alignment import Alignment
from magtwin.learn.data.dataset import build_dataset
from magtwin.learn.data.labels import labelled
from magtwin.learn.data.recording import Source
from magtwin.learn.evaluation.budget import TERMS, Truth, at_rest_nt, budget
from magtwin.learn.evaluation.candidates import naive, named_map, tolles_lawson
from magtwin.learn.evaluation.evaluate import evaluate
from magtwin.run.run import Run
from magtwin.twin import check_scene, in_session_of, open_twin, simulate

SEED = 11


@pytest.fixture(scope="module")
def twin(lab_scene):
    return open_twin(lab_scene, magnetometer="physical")


@pytest.fixture(scope="module")
def drives(twin):
    """Short drives of two sessions, as `magtwin sweep` deals them."""

    def drive(day, path):
        metadata = {"session_seed": SEED, "session": day}
        run = simulate(in_session_of(twin, metadata), path, seed=day, duration_s=25.0, rate_hz=10.0)
        return run.with_metadata(**metadata)

    return {f"d{day}": drive(day, path) for day, path in enumerate(("figure8", "sine", "figure8"))}


@pytest.fixture(scope="module")
def truth(twin):
    def scene_of(name, run):
        scene = in_session_of(twin, run.metadata).scene
        check_scene(scene, run.metadata, name)
        return scene

    return Truth(twin.scene, scene_of)


@pytest.fixture(scope="module")
def named(twin):
    return named_map("lab", twin.field)


@pytest.fixture(scope="module")
def train(drives, named, tmp_path_factory):
    learned = {name: drives[name] for name in ("d0", "d1")}
    return build_dataset(learned, named.field, tmp_path_factory.mktemp("budget") / "set")


@pytest.fixture(scope="module")
def found(drives, named, train):
    trials = [Source("d2", lambda: drives["d2"])]
    baseline = naive(named, dataset=train)
    return evaluate([tolles_lawson(named, train)], trials, baseline=baseline, rng=np.random.default_rng(0))


@pytest.fixture(scope="module")
def made(found, truth, train):
    return [budget(found, m, truth, train) for m in range(2)]


def test_the_parts_of_a_label_add_up_to_it(truth, drives, named):
    run, alignment = drives["d2"], Alignment((0.03, 0.01), -0.02)
    run = labelled(run, named.field, alignment)
    rows = np.flatnonzero(np.isfinite(run["label_nt"]))
    parts = truth.parts("d2 moved", run, rows, run["b_map_nt"][rows], alignment, run["b_measured_nt"][rows])
    assert_allclose(
        parts.sum(axis=0), -run["label_nt"][rows], atol=1e-6
    )  # fields of 4e4 nT, double precision


def test_all_terms_closed_leave_nothing_and_its_figures_are_told_by_term(made):
    for one in made:
        assert one.left_nt[-1] == pytest.approx(0, abs=1e-6)
        told = one.summary()
        assert [term["name"] for term in told["terms"]] == list(TERMS)
        assert [term["mae_closed_in_turn_nt"] for term in told["terms"]] == list(one.left_nt)


def test_closing_the_map_leaves_what_naive_errs_by_on_an_exact_map(made, found, twin, train, drives):
    def exact_label(run):
        p = run["mocap_p"][:, :2]
        label = labelled(run, found.maps[0].field)["label_nt"]
        yaw = 2 * np.arctan2(run["mocap_q_xyzw"][:, 2], run["mocap_q_xyzw"][:, 3])
        return np.where(np.isfinite(label), run["b_measured_nt"] - at_rest_nt(twin.scene, p, yaw), np.nan)

    mean = np.mean(np.concatenate([v[np.isfinite(v)] for _, run in train.runs() for v in [exact_label(run)]]))
    error = mean - exact_label(drives["d2"])
    closed = made[0].left_nt[TERMS.index("map")]
    assert closed == pytest.approx(np.nanmean(np.abs(error)), rel=1e-3)  # headings by arctan, tilt left out


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda run: run.with_metadata(config_sha256="0" * 64), "made in a scene whose values have"),
        (lambda run: Run({k: v for k, v in run.items() if k != "b_truth_nt"}, run.metadata), "no b_truth_nt"),
    ],
)
def test_a_run_of_another_scene_or_without_the_truth_is_refused(drives, truth, found, train, change, text):
    judged = replace(found.judged[0], name=text, run=change(drives["d2"]))
    with pytest.raises(InputError, match=text):
        budget(replace(found, judged=(judged,)), 0, truth, train)
