"""`magtwin train`: from a data set to weights that a simulation runs, with card and curve."""

import contextlib
import io
import json

import numpy as np
import pytest
import torch
from rerun.chunk import RrdReader
from threadpoolctl import threadpool_limits

from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.files.file import sha256
from magtwin.io.formats import read_run
from magtwin.learn.data.dataset import build_dataset, open_dataset
from magtwin.learn.data.features import features
from magtwin.learn.data.split import LEAK
from magtwin.learn.models.predictor import load_predictor
from magtwin.learn.training.config import read_config
from magtwin.learn.training.descent import _Descent
from magtwin.run.run import COLUMNS, Run

FIELD = AnomalyMap(
    values_nt=np.full((1, 9, 9), 41e3),
    origin_m=(-2.0, -2.0),
    cell_m=(0.5, 0.5),
    headings_rad=np.zeros(1),
    name="flat",
)
TINY = ["--layers", "12,12", "--epochs", "6", "--batch", "32", "--lr", "0.01", "--dropout", "0"]


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """Networks as small as these take longer in two threads than in one."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def a_run(seed, path):
    """A drive whose disturbance is 100 nT a m/s of speed, and 300."""
    rng = np.random.default_rng(seed)
    columns = {}
    for name, spec in COLUMNS.items():
        values = rng.normal(size=(200,) if spec.width == 1 else (200, spec.width))
        columns[name] = values > 0 if spec.unit == "bool" else values
    columns = {name: values for name, values in columns.items() if not name.startswith("mocap")}
    columns |= {"t": np.arange(200) / 10, "p_world_base": rng.uniform(-1, 1, (200, 3))}
    columns |= {name: np.zeros(200, bool) for name in columns if name.startswith("flag")}
    columns["b_measured_nt"] = 41e3 + 300 + 100 * columns["odom_v"][:, 0] + rng.normal(0, 2, 200)
    return Run(columns, {"path": path})


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    runs = {name: a_run(i, "eight" if i % 2 else "sine") for i, name in enumerate("abcdefg")}
    folder = tmp_path_factory.mktemp("data") / "set"
    build_dataset(runs, FIELD, folder)
    return folder


@pytest.fixture(scope="module")
def trained(data, tmp_path_factory):
    out = tmp_path_factory.mktemp("trained") / "f.safetensors"
    main(["train", str(data), "--out", str(out), *TINY, "--hold-out", "f", "g", "--json"])
    return out


def card_of(weights):
    """The card beside weights, its lines put end to end."""
    return " ".join(weights.with_suffix(".md").read_text().split())


def refused(capsys, *words):
    with pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    assert ended.value.code == 1
    return capsys.readouterr().err.splitlines()[-1]


def test_the_error_told_is_that_of_the_weights_on_what_was_held_out(data, trained):
    net = load_predictor(trained)
    rows = open_dataset(data).rows("full", ["f", "g"])
    error = net.predict(rows.x)[0] - rows.y
    assert net.metadata["test_mae_nt"] == pytest.approx(np.abs(error).mean())
    assert net.residual_sd_nt == pytest.approx(np.sqrt(np.mean(error**2)))
    assert net.metadata["test_mae_nt"] < 0.5 * net.metadata["test_naive_mae_nt"]
    assert net.metadata["dataset_sha256"] == sha256(data / "dataset.json")


def test_the_card_tells_checksum_errors_by_path_and_how_to_repeat(trained):
    card = trained.with_suffix(".md").read_text()
    assert sha256(trained) in card
    mae = load_predictor(trained).metadata["test_mae_nt"]
    assert f"| test | 2 | 400 | {mae:.1f} |" in card
    assert "| test, path eight | 1 | 200 |" in card
    assert "Test: f, g." in card
    assert "Warning" not in card


def test_the_configuration_in_the_weights_repeats_them_to_the_byte(data, trained, tmp_path):
    (tmp_path / "c.toml").write_text(load_predictor(trained).metadata["config"])
    assert read_config(tmp_path / "c.toml").hold_out == ("f", "g")
    again = tmp_path / "g.safetensors"
    main(["train", str(data), "--out", str(again), "--config", str(tmp_path / "c.toml"), "--json"])
    assert again.read_bytes() == trained.read_bytes()


def test_the_learning_curve_is_drawn_and_tabled(trained):
    table = trained.with_suffix(".csv").read_text().splitlines()
    assert table[0] == "number,train_rmse_nt,val_rmse_nt,val_mae_nt,best"
    assert [line.split(",")[0] for line in table[1:]] == ["1", "2", "3", "4", "5", "6"]
    assert trained.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    assert not trained.with_suffix(".checkpoint").exists()


def test_the_learning_curve_is_a_recording_on_a_timeline_of_epochs(data, tmp_path):
    words = ["--model", "hybrid", *SMALL["hybrid"], "--rrd", str(tmp_path / "f.rrd"), "--json"]
    main(["train", str(data), "--out", str(tmp_path / "f.safetensors"), *words])
    table = np.genfromtxt(tmp_path / "f.csv", delimiter=",", names=True)
    seen = {}
    for chunk in RrdReader(tmp_path / "f.rrd").stream():
        batch = chunk.to_record_batch()
        if "epoch" in batch.schema.names and "Scalars:scalars" in batch.schema.names:
            values = [row[0] for row in batch["Scalars:scalars"].to_pylist()]
            seen[chunk.entity_path] = dict(zip(batch["epoch"].to_pylist(), values, strict=True))
    assert list(seen["/learning/validation"]) == table["number"].astype(int).tolist()
    assert list(seen["/learning/validation"].values()) == table["val_rmse_nt"].tolist()
    assert list(seen["/learning/training"].values()) == table["train_rmse_nt"].tolist()
    ((number, rmse),) = seen["/learning/kept"].items()
    assert rmse == table["val_rmse_nt"].min() == seen["/learning/validation"][number]


def test_a_simulation_runs_the_trained_network(trained, lab_scene, tmp_path, capsys):
    out = tmp_path / "a.parquet"
    main(
        [
            "run",
            str(lab_scene),
            "--network",
            str(trained),
            "--duration-s",
            "1",
            "--out",
            str(out),
            "--json",
        ]
    )
    run = read_run(out)
    assert run.metadata["network_sha256"] == sha256(trained)
    assert run["b_sd_nt"][0] == pytest.approx(load_predictor(trained).residual_sd_nt)
    assert np.isfinite(run["b_disturbance_nt"]).all()


def test_a_killed_training_is_resumed_to_the_byte(data, trained, tmp_path, capsys, monkeypatch):
    out = tmp_path / "f.safetensors"
    words = ["train", str(data), "--out", str(out), *TINY, "--hold-out", "f", "g", "--json"]

    def killed(self, number, advance):
        if number == 3:
            raise KeyboardInterrupt
        return one_pass(self, number, advance)

    one_pass = _Descent._pass
    with monkeypatch.context() as patch:
        patch.setattr(_Descent, "_pass", killed)
        with pytest.raises(SystemExit) as ended:
            main(words)
    assert ended.value.code == 130
    assert [path.name for path in tmp_path.iterdir()] == ["f.checkpoint"]
    assert "an unfinished training; resume it (--resume), or replace it (--force)" in refused(capsys, *words)
    main([*words, "--resume"])
    assert out.read_bytes() == trained.read_bytes()
    assert not (tmp_path / "f.checkpoint").exists()


def test_fine_tuning_tells_the_error_before_and_after(data, trained, tmp_path, capsys):
    out = tmp_path / "g.safetensors"
    words = ["--init", str(trained), "--freeze", "layers.0", "layers.1", "--layers", "12,12", "--epochs", "2"]
    main(["train", str(data), "--out", str(out), *words, "--hold-out", "f", "g", "--json"])
    figures = json.loads(capsys.readouterr().out)["figures"]
    assert figures["test MAE before"]["value"] == pytest.approx(
        load_predictor(trained).metadata["test_mae_nt"]
    )
    net = load_predictor(out)
    assert net.metadata["init_sha256"] == sha256(trained)
    assert np.array_equal(net.layers[0].weight, load_predictor(trained).layers[0].weight)
    card = card_of(out)
    assert (
        f"It continues from `f.safetensors` (SHA-256 `{sha256(trained)}`), layers.0, layers.1 frozen." in card
    )
    assert out.with_suffix(".csv").read_text().splitlines()[1].startswith("0,")


def test_threads_are_those_asked_for_while_training_and_told(data, tmp_path, capsys, monkeypatch):
    seen = []
    one_pass = _Descent._pass
    monkeypatch.setattr(_Descent, "_pass", lambda *a: seen.append(torch.get_num_threads()) or one_pass(*a))
    words = ["--layers", "4", "--epochs", "1", "--threads", "2", "--json"]
    main(["train", str(data), "--out", str(tmp_path / "f.safetensors"), *words])
    assert (seen, torch.get_num_threads()) == ([2], 1)
    assert json.loads(capsys.readouterr().out)["metadata"]["threads"] == 2


@pytest.mark.parametrize("kind", ["paper", "hybrid", "linear"])
def test_the_number_of_processors_changes_no_bit_of_a_training(data, tmp_path, kind):
    """The default is one thread, whatever torch and numpy would take."""
    options = TINY if kind == "paper" else ["--model", kind, "--features", "odom_v_x,yaw_sin,yaw_cos"]
    for threads in (1, 3):
        torch.set_num_threads(threads)
        with threadpool_limits(threads):
            main(["train", str(data), "--out", str(tmp_path / f"{threads}" / "f.safetensors"), *options])
        assert torch.get_num_threads() == threads
    torch.set_num_threads(1)
    one, three = (tmp_path / name / "f.safetensors" for name in "13")
    assert one.read_bytes() == three.read_bytes()


def test_a_curve_that_cannot_be_drawn_leaves_no_weights_and_keeps_the_checkpoint(data, tmp_path, monkeypatch):
    """All outputs of a training are one transaction, and the training is not lost."""
    out = tmp_path / "f.safetensors"

    def full(*args, **options):
        raise InputError("f.png: cannot be written (No space left on device)")

    with monkeypatch.context() as patch:
        patch.setattr("magtwin.figures.canvas.save", full)
        with pytest.raises(SystemExit):
            main(["train", str(data), "--out", str(out), *TINY])
    assert [file.name for file in tmp_path.iterdir()] == ["f.checkpoint"]
    main(["train", str(data), "--out", str(out), *TINY, "--resume"])
    ends = sorted(file.suffix for file in tmp_path.iterdir())
    assert ends == [".csv", ".md", ".png", ".safetensors"]


def test_a_split_by_row_carries_its_warning_everywhere(data, tmp_path, capsys):
    out = tmp_path / "f.safetensors"
    main(["train", str(data), "--out", str(out), *TINY[:2], "--epochs", "1", "--split", "row", "--json"])
    assert json.loads(capsys.readouterr().out)["metadata"]["warning"] == LEAK
    assert load_predictor(out).metadata["warning"] == LEAK
    assert LEAK in card_of(out)


# Other kinds than perceptrons

SMALL = {
    "linear": [],
    "hybrid": ["--layers", "8", "--epochs", "2"],
}


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
    assert figures["kind"]["value"] == predictor.kind == kind
    errors, naive, inside, ridge = [], [], [], []
    peer = load_predictor(kinds["linear"][0])  # on the set "circular", as the baseline
    for _, run in open_dataset(data).runs(["f", "g"]):
        mean, sd = predictor.predict(features(run, predictor.features))
        errors.append(np.abs(mean - run["label_nt"]))
        inside.append(errors[-1] <= 1.645 * sd)
        naive.append(np.abs(predictor.metadata["label_mean_nt"] - run["label_nt"]))
        ridge.append(np.abs(peer.predict(features(run, peer.features))[0] - run["label_nt"]))
    assert figures["test MAE"]["value"] == pytest.approx(np.mean(errors))
    assert figures["test naive MAE"]["value"] == pytest.approx(np.mean(naive))
    assert figures["test ridge MAE"]["value"] == pytest.approx(np.mean(ridge))
    assert figures["test coverage"]["value"] == pytest.approx(np.mean(inside), abs=0.003)
    assert np.mean(errors) < 0.8 * np.mean(naive)
    row = f"{np.mean(errors) / np.mean(naive):.3f} | {np.mean(ridge):.1f} |"
    assert row in out.with_suffix(".md").read_text()


@pytest.mark.parametrize("kind", SMALL)
def test_the_configuration_of_any_kind_repeats_its_weights_to_the_byte(data, kinds, kind, tmp_path):
    (tmp_path / "c.toml").write_text(load_predictor(kinds[kind][0]).metadata["config"])
    again = tmp_path / f"{kind}.safetensors"
    main(["train", str(data), "--out", str(again), "--config", str(tmp_path / "c.toml"), "--json"])
    assert again.read_bytes() == kinds[kind][0].read_bytes()


@pytest.mark.parametrize("kind", ["hybrid"])
def test_a_killed_training_of_any_kind_is_resumed_to_the_byte(data, kinds, kind, tmp_path, monkeypatch):
    out = tmp_path / f"{kind}.safetensors"
    words = ["train", str(data), "--out", str(out), "--model", kind, *SMALL[kind], "--hold-out", "f", "g"]
    one_pass = _Descent._pass

    def killed(self, number, advance):
        if number == 2:
            raise KeyboardInterrupt
        return one_pass(self, number, advance)

    with monkeypatch.context() as patch:
        patch.setattr(_Descent, "_pass", killed)
        with pytest.raises(SystemExit) as ended:
            main([*words, "--json"])
    assert ended.value.code == 130
    main([*words, "--resume", "--json"])
    assert out.read_bytes() == kinds[kind][0].read_bytes()


def test_a_model_that_is_fitted_at_once_has_no_learning_curve(kinds):
    beside = sorted(path.name for path in kinds["linear"][0].parent.glob("linear.*"))
    assert beside == ["linear.md", "linear.safetensors"]
    assert kinds["hybrid"][0].with_suffix(".csv").exists()


def test_a_hybrid_says_whether_its_network_was_kept_and_both_figures(kinds):
    out, printed = kinds["hybrid"]
    hybrid, figures = load_predictor(out), printed["figures"]
    base, whole = (figures[name]["value"] for name in ("base alone MAE", "with network MAE"))
    assert (hybrid.net is not None) == (whole < base) == (figures["network"]["value"] == "kept")
    assert f"the base alone errs by {base:.1f} nT, with the network by {whole:.1f} nT" in card_of(out)


@pytest.mark.parametrize("bent", [True, False])
def test_a_hybrid_keeps_its_network_only_where_the_base_leaves_something(tmp_path, bent):
    runs = {name: a_run(i, "eight") for i, name in enumerate("abcdefg")}
    for name, run in runs.items():
        speed = run["odom_v"][:, 0]
        field = run["b_measured_nt"] + (300 * np.abs(speed) if bent else 0)
        runs[name] = run.with_columns(b_measured_nt=field)
    build_dataset(runs, FIELD, tmp_path / "set")
    words = ["--model", "hybrid", "--features", "odom_v_x,imu_w_z", "--layers", "16", "--epochs", "8"]
    words += ["--batch", "32", "--lr", "0.02", "--json"]
    main(["train", str(tmp_path / "set"), "--out", str(tmp_path / "h.safetensors"), *words])
    metadata = load_predictor(tmp_path / "h.safetensors").metadata
    assert metadata["network"] == ("kept" if bent else "left out")
    if bent:
        assert metadata["test_mae_nt"] < 0.5 * metadata["test_ridge_mae_nt"]


def test_a_hybrid_is_fine_tuned_with_its_base_frozen(data, kinds, tmp_path):
    begun = kinds["hybrid"][0]
    words = ["--model", "hybrid", "--layers", "8", "--epochs", "1", "--init", str(begun), "--freeze", "base"]
    main(["train", str(data), "--out", str(tmp_path / "h.safetensors"), *words, "--json"])
    before, after = load_predictor(begun), load_predictor(tmp_path / "h.safetensors")
    assert np.array_equal(before.base.coefficients_nt, after.base.coefficients_nt)
    assert "base frozen" in card_of(tmp_path / "h.safetensors")


def test_a_linear_model_goes_on_from_another(data, kinds, tmp_path, capsys):
    words = ["--model", "linear", "--init", str(kinds["linear"][0]), "--penalty", "1e9"]
    main(["train", str(data), "--out", str(tmp_path / "l.safetensors"), *words, "--json"])
    before, after = load_predictor(kinds["linear"][0]), load_predictor(tmp_path / "l.safetensors")
    np.testing.assert_allclose(after.coefficients_nt, before.coefficients_nt, rtol=1e-4)
    assert "test MAE before" in json.loads(capsys.readouterr().out)["figures"]


@pytest.mark.skipif(torch.cuda.is_available(), reason="this torch sees a GPU")
def test_a_gpu_that_is_not_there_is_refused_and_auto_takes_the_cpu(data, kinds, tmp_path, capsys):
    out = tmp_path / "f.safetensors"
    said = refused(capsys, "train", data, "--out", out, "--device", "cuda", *TINY)
    assert "device cuda: this torch sees no GPU" in said
    assert load_predictor(kinds["hybrid"][0]).metadata["device"] == "cpu"


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--model", "linear", "--epochs", "3"], "epochs is no option of 'linear'; leave it out, or choose"),
        (["--model", "forest"], "no model 'forest'; known: hybrid, linear, mixed, paper, released"),
        (["--model", "linear", "--penalty", "-1"], "penalty must be 0 or more and finite, got -1.0"),
        (["--model", "linear", "--resume"], "a linear model is fitted at once"),
        (["--model", "hybrid", "--init", "KINDS/linear.safetensors"], "holds a linear, but the training"),
        (["--model", "linear", "--init", "KINDS/linear.safetensors", "--features", "gradient"],
         "the model to continue from has inputs yaw_sin,"),
        (["--model", "hybrid", "--init", "KINDS/hybrid.safetensors", "--freeze", "layers.7"],
         "no layer 'layers.7'"),
        (["--model", "linear", "--rrd", "OUT/f.rrd"], "--rrd: a linear model is fitted at once and has no"),
        (["--rrd", "OUT/f.csv"], "f.csv: a Rerun recording ends in .rrd"),
        (["--model", "linear", "--features", "odom_x"], "no feature set 'odom_x'"),
    ],
)  # fmt: skip
def test_what_a_kind_cannot_do_is_refused_and_writes_nothing(data, kinds, tmp_path, capsys, words, text):
    folder = kinds["linear"][0].parent
    words = [word.replace("KINDS", str(folder)).replace("OUT", str(tmp_path)) for word in words]
    assert text in refused(capsys, "train", data, "--out", tmp_path / "f.safetensors", *words)
    assert list(tmp_path.iterdir()) == []


# Refusals


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--layers", "8,x"], "--layers takes whole numbers separated by commas, got '8,x'"),
        (["--layers", "8", "--model", "paper"], "--model and --layers both set the widths; give one of them"),
        (["--features", "ful"], "no feature set 'ful'; did you mean 'full'?"),
        (["--hold-out", "h"], "no session or recording to hold out 'h'"),
        (["--resume"], "f.checkpoint: no such checkpoint"),
        (["--init", "DATA/none.safetensors"], "none.safetensors: no such weights file"),
        (["--config", "DATA/dataset.json"], "dataset.json: is a JSON, not settings of a training"),
        (["--out", "DATA/f.onnx"], "a network ends in .safetensors"),
    ],
)
def test_what_cannot_be_trained_is_refused_and_writes_nothing(data, tmp_path, capsys, words, text):
    words = [word.replace("DATA", str(data)) for word in words]
    out = [] if "--out" in words else ["--out", str(tmp_path / "f.safetensors")]
    assert text in refused(capsys, "train", data, *out, *words)
    assert list(tmp_path.iterdir()) == []


def test_files_beside_the_weights_are_not_written_over(data, trained, tmp_path, capsys):
    (tmp_path / "f.csv").write_text("mine")
    said = refused(capsys, "train", data, "--out", tmp_path / "f.safetensors", *TINY)
    assert "f.csv: exists already; give --force" in said
