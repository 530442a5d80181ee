"""`magtwin evaluate`: a report of weights, with pictures, from the command line."""

import json
import re

import pytest
from learn_drives import HILLS, a_drive, hills
from places import DOCS

from magtwin.cli import main
from magtwin.files.file import sha256
from magtwin.io.formats import write_run
from magtwin.learn.data.dataset import build_dataset
from magtwin.twin import in_session_of, open_twin, simulate
from magtwin.usd.maps.layer import save_map


def a_run(seed, path):
    return a_drive(seed, 400, 20.0, 300.0, session=seed % 5, session_seed=1, path=path)


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A folder with two maps, a training set, weights of it, and runs that nothing has seen."""
    folder = tmp_path_factory.mktemp("room")
    save_map(HILLS, folder / "hills.usdc")
    save_map(hills("higher", 41.5e3), folder / "higher.usdc")
    runs = {f"r{k}": a_run(k, ("fast_sine", "figure8")[k % 2]) for k in range(10)}
    build_dataset(runs, HILLS, folder / "set", map_sha256=sha256(folder / "hills.usdc"))
    (folder / "small.toml").write_text('layers = [8]\nepochs = 2\nfeatures = "circular"\nbatch = 64\n')
    small = ["--config", str(folder / "small.toml"), "--json"]
    main(["train", str(folder / "set"), "--out", str(folder / "net.safetensors"), *small])
    for k, path in enumerate(("fast_sine", "curvilinear", "spiral")):
        write_run(a_run(20 + k, path), folder / f"drive{k}.parquet")
    return folder


def evaluated(room, name):
    """The folder that an evaluation of all drives on both maps writes."""
    drives = [str(room / f"drive{k}.parquet") for k in range(3)]
    maps = [str(room / name) for name in ("hills.usdc", "higher.usdc")]
    words = ["evaluate", str(room / "net.safetensors"), "--runs", *drives, "--map", *maps]
    words += ["--train", str(room / "set"), "--overlay", drives[2]]
    main([*words, "--out", str(room / name)])
    return room / name


@pytest.fixture(scope="module")
def report(room):
    return evaluated(room, "report")


def test_the_report_has_the_table_with_every_model_and_case(report):
    told = json.loads((report / "evaluation.json").read_text())
    assert [case["name"] for case in told["cases"]] == ["A", "B", "spiral", "all", "mean"]
    names = ["naive", "net", "Tolles-Lawson, hills", "Tolles-Lawson, higher"]
    assert [one["name"] for one in told["models"]] == names
    every = told["cases"][3]
    assert every["rows"] == 1200
    assert every["models"]["naive"]["ratio"] == 1
    assert every["models"]["Tolles-Lawson, hills"]["ratio"] < 0.4
    page = (report / "evaluation.html").read_text()
    assert f"{every['models']['net']['mae_nt']:.1f} ({every['models']['net']['ratio']:.3f})" in page
    assert "217.6 (0.966)" in page


def test_every_figure_of_the_paper_is_drawn_and_shown_in_html(report):
    pictures = {path.name for path in (report / "figures").iterdir()}
    charts = "placed_aligned recorded_aligned recorded_distance timed_aligned"
    numbers = ("2", "5_field", "5_1", "6ab", "7_0", "7_1", "7_2", *(f"8_{name}" for name in charts.split()))
    assert pictures == {f"figure_{number}.svg" for number in numbers}
    page = (report / "evaluation.html").read_text()
    assert page.count("<svg ") == len(pictures)
    assert not re.search(r'(src|href)="(?!data:|#)', page)


def test_the_same_evaluation_gives_the_same_bytes(room, report):
    again = evaluated(room, "again")
    for path in (path for path in report.rglob("*") if path.is_file()):
        assert path.read_bytes() == (again / path.relative_to(report)).read_bytes(), path.name


def test_of_its_own_data_set_weights_are_judged_by_their_test_recordings(room, capsys):
    own = ["--dataset", str(room / "set"), "--train", str(room / "set"), "--map", str(room / "hills.usdc")]
    main(["evaluate", str(room / "net.safetensors"), *own, "--out", str(room / "own"), "--json"])
    told = json.loads(capsys.readouterr().out)
    metadata = told["models"][1]["metadata"]
    assert told["cases"][-2]["models"]["net"]["mae_nt"] == pytest.approx(metadata["test_mae_nt"], rel=1e-4)
    assert told["cases"][-2]["models"]["naive"]["mae_nt"] == pytest.approx(
        metadata["test_naive_mae_nt"], rel=1e-3
    )


def test_a_recording_that_baselines_learn_from_is_refused_whatever_its_name(room, tmp_path, refusal):
    write_run(a_run(3, "figure8"), tmp_path / "new.parquet")
    own = ["--train", room / "set", "--map", room / "hills.usdc", "--out", room / "x"]
    said = refusal("evaluate", room / "net.safetensors", "--runs", tmp_path / "new.parquet", *own)
    assert "new: is 'r3' of" in said
    assert said.endswith("which was learned from; judge by others")


def test_weights_for_another_map_are_refused_with_both_checksums(room, refusal):
    words = ["--runs", room / "drive0.parquet", "--map", room / "higher.usdc", "--out", room / "x"]
    said = refusal("evaluate", room / "net.safetensors", *words)
    assert sha256(room / "hills.usdc") in said
    assert sha256(room / "higher.usdc") in said
    assert not (room / "x").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--map", "hills.usdc"], "judge by --runs or by a --dataset, one of the two"),
        (["--runs", "drive0.parquet"], "no map: name those that the weights were trained on"),
        (["--runs", "drive0.parquet", "--map", "hills.usdc", "hills.usdc"], "hills.usdc is named twice"),
        (["--runs", "drive0.parquet", "--map", "hills.usdc", "--case", "D"], "--case takes a row"),
        (["--runs", "drive0.parquet", "--map", "hills.usdc", "--scene", "lab.usda"], "--scene adds an error"),
        (["--runs", "no.parquet", "--map", "hills.usdc"], "no.parquet: no such"),
    ],
)
def test_what_cannot_be_judged_is_refused_in_a_line(room, refusal, words, said):
    words = [word if word.startswith("--") or "." not in word else room / word for word in words]
    assert said in refusal("evaluate", room / "net.safetensors", *words, "--out", room / "x")


def test_a_budget_is_made_where_the_scene_is_at_hand(room, lab_scene, tmp_path, capsys):
    twin = open_twin(lab_scene, magnetometer="physical")
    for day in range(3):
        metadata = {"session_seed": 1, "session": day}
        run = simulate(in_session_of(twin, metadata), "figure8", seed=day, duration_s=20.0, rate_hz=10.0)
        write_run(run.with_metadata(**metadata), tmp_path / f"d{day}.parquet")
    layer = twin.scene.map_layer
    drives = [str(tmp_path / f"d{day}.parquet") for day in range(3)]
    main(["dataset", "build", *drives[:2], "--map", str(layer), "--out", str(tmp_path / "set"), "--json"])
    capsys.readouterr()
    words = ["--train", str(tmp_path / "set"), "--scene", str(lab_scene), "--any-map", "--json"]
    net, out = str(room / "net.safetensors"), tmp_path / "out"
    main(["evaluate", net, "--runs", drives[2], *words, "--out", str(out)])
    told = json.loads(capsys.readouterr().out)["budget"]["models"]
    assert [one["model"] for one in told] == ["naive", "net", "Tolles-Lawson, lab"]
    page = (out / "evaluation.html").read_text()
    for one in told:
        left = [term["mae_closed_in_turn_nt"] for term in one["terms"]]
        assert left[-1] == pytest.approx(0, abs=1e-6)
        assert one["mae_nt"] > left[-2]
        assert one["model"] in page.split("Error budget")[1]


def test_the_example_of_the_docs_runs(room, tmp_path, monkeypatch, capsys):
    page = (DOCS / "evaluate.md").read_text(encoding="utf-8")
    files = {"map.usdc": "hills.usdc", "set": "set", "f.safetensors": "net.safetensors"}
    for name, of in (files | {"a.parquet": "drive0.parquet", "b.parquet": "drive1.parquet"}).items():
        (tmp_path / name).symlink_to(room / of)
    monkeypatch.chdir(tmp_path)
    exec(page.split("```python")[1].split("```")[0], {})
    ratio, low, high = map(float, re.findall(r"[\d.]+", capsys.readouterr().out.splitlines()[-1]))
    assert low <= ratio <= high
