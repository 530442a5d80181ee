"""`magtwin train`: from a data set to weights that a simulation runs, with card and curve."""

import contextlib
import io
import json
import re

import numpy as np
import pytest
import torch
from learn_drives import HILLS, a_drive
from threadpoolctl import threadpool_limits

import magtwin as mt
from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.files.file import sha256
from magtwin.io.formats import read_run
from magtwin.learn.data.dataset import build_dataset, open_dataset
from magtwin.learn.data.features import features
from magtwin.learn.data.split import LEAK
from magtwin.learn.models.predictor import load_predictor
from magtwin.learn.training.fit_network import Descent


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """Networks as small as these take longer in two threads than in one."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def a_run(seed, path):
    """A drive whose disturbance is 100 nT a m/s of speed, and 300."""
    return a_drive(seed, 200, 2.0, 300.0, path=path)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """Options of a training that takes a moment."""
    file = tmp_path_factory.mktemp("tiny") / "tiny.toml"
    file.write_text("layers = [12, 12]\nepochs = 6\nbatch = 32\nlr = 0.01\ndropout = 0.0\n")
    return ["--config", str(file)]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    runs = {name: a_run(i, "eight" if i % 2 else "sine") for i, name in enumerate("abcdefg")}
    folder = tmp_path_factory.mktemp("data") / "set"
    build_dataset(runs, HILLS, folder)
    return folder


@pytest.fixture(scope="module")
def trained(data, tiny, tmp_path_factory):
    out = tmp_path_factory.mktemp("trained") / "f.safetensors"
    main(["train", str(data), "--out", str(out), *tiny, "--hold-out", "f", "g", "--json"])
    return out


def card_of(weights):
    """The card beside weights, its lines put end to end."""
    return " ".join(weights.with_suffix(".md").read_text().split())


def test_the_card_tells_checksum_errors_by_path_and_how_to_repeat(trained):
    card = trained.with_suffix(".md").read_text()
    assert sha256(trained) in card
    metadata = load_predictor(trained).metadata
    mae = metadata["test_mae_nt"]
    assert mae < 0.5 * metadata["test_naive_mae_nt"]
    assert f"| test | 2 | 400 | {mae:.1f} |" in card
    assert "| test, path eight | 1 | 200 |" in card
    assert "Test: f, g." in card
    assert "Warning" not in card


def test_the_learning_curve_is_drawn(trained):
    assert trained.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    assert sorted(path.suffix for path in trained.parent.iterdir()) == [".md", ".png", ".safetensors"]


def test_a_simulation_runs_the_trained_network(trained, lab_scene, tmp_path, capsys):
    out = tmp_path / "a.parquet"
    main(["run", str(lab_scene), "--network", str(trained), "--duration-s", "1", "--out", str(out), "--json"])
    run = read_run(out)
    assert run.metadata["network_sha256"] == sha256(trained)
    assert run["b_sd_nt"][0] == pytest.approx(load_predictor(trained).residual_sd_nt)
    assert np.isfinite(run["b_disturbance_nt"]).all()


def test_a_training_that_is_ended_leaves_nothing(data, tiny, tmp_path, monkeypatch):
    def killed(self, number, advance):
        raise KeyboardInterrupt

    monkeypatch.setattr(Descent, "_pass", killed)
    with pytest.raises(SystemExit) as ended:
        main(["train", str(data), "--out", str(tmp_path / "f.safetensors"), *tiny])
    assert ended.value.code == 130
    assert list(tmp_path.iterdir()) == []


def test_fine_tuning_goes_on_from_the_weights(data, trained, tiny, tmp_path):
    out = tmp_path / "g.safetensors"
    words = [*tiny, "--init", str(trained), "--epochs", "2", "--hold-out", "f", "g", "--json"]
    main(["train", str(data), "--out", str(out), *words])
    net, before = load_predictor(out), load_predictor(trained)
    assert net.metadata["init_sha256"] == sha256(trained)
    assert np.array_equal(net.inputs.mean, before.inputs.mean)
    assert net.metadata["validation_mae_nt"] <= 1.05 * before.metadata["validation_mae_nt"]
    assert f"It continues from `f.safetensors` (SHA-256 `{sha256(trained)}`)." in card_of(out)


def test_threads_are_those_asked_for_while_training_and_told(data, tmp_path, capsys, monkeypatch):
    seen = []
    one_pass = Descent._pass
    monkeypatch.setattr(Descent, "_pass", lambda *a: seen.append(torch.get_num_threads()) or one_pass(*a))
    (tmp_path / "t.toml").write_text("layers = [4]\nepochs = 1\nthreads = 2\n")
    words = ["--config", str(tmp_path / "t.toml"), "--json"]
    main(["train", str(data), "--out", str(tmp_path / "f.safetensors"), *words])
    assert (seen, torch.get_num_threads()) == ([2], 1)
    assert json.loads(capsys.readouterr().out)["metadata"]["threads"] == 2


@pytest.mark.parametrize("kind", ["paper", "hybrid", "linear"])
def test_the_number_of_processors_changes_no_bit_of_a_training(data, tiny, tmp_path, kind):
    """The default is one thread, whatever torch and numpy would take."""
    options = ["--model", kind, "--features", "odom_v_x,yaw_sin,yaw_cos"]
    options = [*tiny, "--epochs", "2"] if kind == "paper" else options
    for threads in (1, 3):
        torch.set_num_threads(threads)
        with threadpool_limits(threads):
            main(["train", str(data), "--out", str(tmp_path / f"{threads}" / "f.safetensors"), *options])
        assert torch.get_num_threads() == threads
    torch.set_num_threads(1)
    one, three = (tmp_path / name / "f.safetensors" for name in "13")
    assert one.read_bytes() == three.read_bytes()


def test_a_curve_that_cannot_be_drawn_leaves_no_weights(data, tiny, tmp_path, monkeypatch):
    """All outputs of a training are one transaction."""

    def full(*args, **options):
        raise InputError("f.png: cannot be written (No space left on device)")

    monkeypatch.setattr("magtwin.figures.canvas.save", full)
    with pytest.raises(SystemExit):
        main(["train", str(data), "--out", str(tmp_path / "f.safetensors"), *tiny, "--epochs", "1"])
    assert list(tmp_path.iterdir()) == []


def test_a_split_by_row_carries_its_warning_everywhere(data, tiny, tmp_path, capsys):
    out = tmp_path / "f.safetensors"
    main(["train", str(data), "--out", str(out), *tiny, "--epochs", "1", "--split", "row", "--json"])
    assert json.loads(capsys.readouterr().out)["metadata"]["warning"] == LEAK
    assert load_predictor(out).metadata["warning"] == LEAK
    assert LEAK in card_of(out)


# Other kinds than perceptrons

SMALL = {"linear": [], "hybrid": ["--epochs", "2"]}


@pytest.fixture(scope="module")
def kinds(data, tmp_path_factory):
    """A file of each kind, and what its training printed."""
    folder = tmp_path_factory.mktemp("kinds")
    found = {}
    for kind, words in SMALL.items():
        out = folder / f"{kind}.safetensors"
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            words = ["--model", kind, *words, "--hold-out", "f", "g", "--json"]
            main(["train", str(data), "--out", str(out), *words])
        found[kind] = out, json.loads(printed.getvalue())
    return found


@pytest.mark.parametrize("kind", SMALL)
def test_what_is_told_of_a_kind_is_its_own_error_beside_the_naive_and_the_ridges(data, kinds, kind):
    out, printed = kinds[kind]
    predictor, figures = load_predictor(out), printed["figures"]
    assert figures["kind"] == predictor.kind == kind
    errors, naive, inside, ridge = [], [], [], []
    peer = load_predictor(kinds["linear"][0])  # on the set "circular", as the baseline
    for _, run in open_dataset(data).runs(["f", "g"]):
        mean, sd = predictor.predict(features(run, predictor.features))
        errors.append(np.abs(mean - run["label_nt"]))
        inside.append(errors[-1] <= 1.645 * sd)
        naive.append(np.abs(predictor.metadata["label_mean_nt"] - run["label_nt"]))
        ridge.append(np.abs(peer.predict(features(run, peer.features))[0] - run["label_nt"]))
    assert figures["test_mae_nt"] == pytest.approx(np.mean(errors))
    assert figures["test_naive_mae_nt"] == pytest.approx(np.mean(naive))
    assert figures["test_ridge_mae_nt"] == pytest.approx(np.mean(ridge))
    assert figures["test_coverage"] == pytest.approx(np.mean(inside), abs=0.003)
    assert np.mean(errors) < 0.8 * np.mean(naive)
    row = f"{np.mean(errors) / np.mean(naive):.3f} | {np.mean(ridge):.1f} |"
    assert row in out.with_suffix(".md").read_text()


@pytest.mark.parametrize("kind", SMALL)
def test_the_configuration_of_any_kind_repeats_its_weights_to_the_byte(data, kinds, kind, tmp_path):
    (tmp_path / "c.toml").write_text(load_predictor(kinds[kind][0]).metadata["config"])
    again = tmp_path / f"{kind}.safetensors"
    main(["train", str(data), "--out", str(again), "--config", str(tmp_path / "c.toml"), "--json"])
    assert again.read_bytes() == kinds[kind][0].read_bytes()


def test_a_linear_model_goes_on_from_another(data, kinds):
    result = mt.train(data, model="linear", init=kinds["linear"][0], penalty=1e9)
    before = load_predictor(kinds["linear"][0])
    np.testing.assert_allclose(result.predictor.coefficients_nt, before.coefficients_nt, rtol=1e-4)


@pytest.mark.skipif(torch.cuda.is_available(), reason="this torch sees a GPU")
def test_a_gpu_that_is_not_there_is_refused_and_auto_takes_the_cpu(data, kinds):
    with pytest.raises(InputError, match="device cuda: this torch sees no GPU"):
        mt.train(data, device="cuda")
    assert load_predictor(kinds["hybrid"][0]).metadata["device"] == "cpu"


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--model", "linear", "--epochs", "3"], "epochs is no option of 'linear'"),
        (["--model", "forest"], "no model 'forest'; known: hybrid"),
        (["--model", "hybrid", "--init", "KINDS/linear.safetensors"], "holds a linear, but the training"),
        (["--model", "linear", "--init", "KINDS/linear.safetensors", "--features", "gradient"],
         "the model to continue from has inputs yaw_sin,"),
        (["--model", "linear", "--features", "odom_x"], "no feature set 'odom_x'"),
        (["--hold-out", "h"], "no session or recording to hold out 'h'"),
        (["--init", "DATA/none.safetensors"], "none.safetensors: no such weights file"),
        (["--config", "DATA/dataset.json"], "dataset.json: is a JSON, not settings of a training"),
        (["--out", "DATA/f.onnx"], "a network ends in .safetensors"),
    ],
)  # fmt: skip
def test_what_cannot_be_trained_is_refused_and_writes_nothing(data, kinds, tmp_path, refusal, words, text):
    folders = {"KINDS": str(kinds["linear"][0].parent), "DATA": str(data)}
    words = [re.sub("^(KINDS|DATA)", lambda found: folders[found[1]], word) for word in words]
    out = [] if "--out" in words else ["--out", str(tmp_path / "f.safetensors")]
    assert text in refusal("train", data, *out, *words)
    assert list(tmp_path.iterdir()) == []


def test_files_beside_the_weights_are_not_written_over(data, tmp_path, tiny, capsys):
    (tmp_path / "f.png").write_text("mine")
    main(["train", str(data), *tiny, "--out", str(tmp_path / "f.safetensors")])
    assert f"exists: wrote {tmp_path / 'f-1.safetensors'}" in capsys.readouterr().out
    assert sorted(p.name for p in tmp_path.glob("f*")) == ["f-1.md", "f-1.png", "f-1.safetensors", "f.png"]
