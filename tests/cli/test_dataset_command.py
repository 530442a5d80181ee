"""`magtwin dataset`: recordings of several kinds, labelled on the default lab's map."""

import json

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import csv, parquet

from magtwin.cli import main
from magtwin.files.file import sha256, shipped
from magtwin.io.formats import read_run, write_run
from magtwin.learn.data.dataset import open_dataset
from magtwin.learn.data.labels import labelled
from magtwin.usd.maps.layer import load_map

MAP = shipped("maps", "lab", "lab.usdc")


def node(path, start, seed):
    """A recording of the released node: a drive in circles, its field 300 nT over the map's."""
    rng = np.random.default_rng(seed)
    t = np.arange(80) / 10
    x, y, yaw = 1.2 * np.cos(0.3 * t), 0.9 * np.sin(0.3 * t), (0.3 * t + np.pi / 2) % 6
    on_map = load_map(MAP).lookup(np.column_stack([x, y]), yaw)
    with open(path, "w", encoding="utf-8") as file:
        file.write("[\n")
        for i in range(len(t)):
            q = [0.0, 0.0, float(np.sin(yaw[i] / 2)), float(np.cos(yaw[i] / 2))]
            told = {
                "timestamp": start + t[i],
                "nn_magnetic_magnitude": on_map[i] + 300 + rng.normal(0, 20),
                "map_magnetic_magnitude": on_map[i],
                "pose_data": [x[i], y[i], yaw[i]],
                "odom": [[0.3, 0.0, 0.0], [0.0, 0.0, float(rng.normal())]],
                "imu_data": [q, rng.normal(size=3).tolist(), rng.normal(size=3).tolist()],
                "battery_data": [15.0 + seed, 0.9],
                "lidar": int(i > 40),
            }
            file.write(json.dumps(told) + ",\n")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("days")
    for i, (day, name) in enumerate((("monday", "a"), ("monday", "b"), ("tuesday", "a"))):
        (folder / day).mkdir(exist_ok=True)
        node(folder / day / f"{name}.json", 1.7e9 + 1000 * i, i)
    write_run(read_run(folder / "tuesday" / "a.json").with_metadata(path="circle"), folder / "c.parquet")
    return folder


@pytest.fixture(scope="module")
def made(recorded, tmp_path_factory):
    out = tmp_path_factory.mktemp("made") / "set"
    files = [*(recorded / "monday").iterdir(), recorded / "tuesday" / "a.json", recorded / "c.parquet"]
    main(["dataset", "build", *map(str, sorted(files)), "--map", str(MAP), "--out", str(out)])
    return out


def test_recordings_of_several_kinds_become_one_data_set_with_a_name_each(made, recorded):
    found = open_dataset(made)
    assert found.names == ("c", "monday_a", "b", "tuesday_a")
    assert found.recording("c").path == "circle"
    assert found.map_sha256 == sha256(MAP)
    ((_, run),) = found.runs(["tuesday_a"])
    expected = labelled(read_run(recorded / "tuesday" / "a.json"), load_map(MAP))
    np.testing.assert_array_equal(run["label_nt"], expected["label_nt"])
    assert np.nanmean(run["label_nt"]) == pytest.approx(300, abs=15)


def test_sessions_are_told_by_folder_on_request(recorded, tmp_path, capsys):
    files = [str(recorded / "monday" / "a.json"), str(recorded / "tuesday" / "a.json")]
    options = ["--map", str(MAP), "--session-by", "folder", "--path-by", "file", "--rate-hz", "5", "--json"]
    main(["dataset", "build", *files, "--out", str(tmp_path / "set"), *options])
    told = json.loads(capsys.readouterr().out)
    assert told["figures"]["sessions"] == 2
    found = open_dataset(tmp_path / "set")
    assert [one.session for one in found.recordings] == ["monday", "tuesday"]
    assert [one.path for one in found.recordings] == list(found.names)
    assert {one.rows for one in found.recordings} == {40}


@pytest.mark.parametrize("end", [".csv", ".parquet"])
def test_a_table_of_another_program_is_read_by_its_own_names_of_columns(recorded, tmp_path, end):
    run = read_run(recorded / "c.parquet")
    p, yaw = run["p_world_base"], run["yaw"]
    table = {"time": run["t"], "east": p[:, 0], "north": p[:, 1], "heading": yaw, "B": run["b_measured_nt"]}
    theirs = tmp_path / f"theirs{end}"
    (csv.write_csv if end == ".csv" else parquet.write_table)(pa.table(table), theirs)
    names = ["t=time", "p_world_base_x=east", "p_world_base_y=north", "yaw=heading", "b_measured_nt=B"]
    words = [word for name in names for word in ("--column", name)]
    main(["dataset", "build", str(theirs), "--map", str(MAP), "--out", str(tmp_path / "set"), *words])
    ((_, found),) = open_dataset(tmp_path / "set").runs()
    np.testing.assert_array_equal(found["b_measured_nt"], run["b_measured_nt"])
    np.testing.assert_array_equal(found["p_world_base"], p * [1, 1, 0])
    assert np.isfinite(found["label_nt"]).any()


def test_a_folder_of_runs_stands_for_its_runs_and_their_sessions(recorded, tmp_path, capsys):
    (tmp_path / "runs").mkdir()
    run = read_run(recorded / "c.parquet")
    for k in range(3):
        dealt = run.with_metadata(session=k % 2, session_seed=5)
        write_run(dealt, tmp_path / "runs" / f"run_0000{k}.parquet")
    (tmp_path / "runs" / "runs.csv").write_text("file\n")
    command = ["dataset", "build", str(tmp_path / "runs"), "--map", str(MAP), "--out"]
    main([*command, str(tmp_path / "set"), "--jobs", "2"])
    found = open_dataset(tmp_path / "set")
    assert [one.session for one in found.recordings] == ["5-0", "5-1", "5-0"]
    (tmp_path / "runs" / "run_00001.parquet").write_bytes(b"no table")
    with pytest.raises(SystemExit):
        main([*command, str(tmp_path / "other"), "--jobs", "2"])
    assert "run_00001.parquet: " in capsys.readouterr().err
    assert not (tmp_path / "other").exists()


def test_info_tells_of_every_recording_and_reads_every_shard(made, capsys):
    main(["dataset", "info", str(made), "--json"])
    told = json.loads(capsys.readouterr().out)
    assert list(told["metadata"]["recordings"]) == ["c", "monday_a", "b", "tuesday_a"]
    assert told["metadata"]["feature_sets"] == "full, correlated"
    assert told["figures"]["labels"] == 320


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("build DAYS/monday/x.json", "no such recording"),
        ("build DAYS/monday/a.json DAYS/monday/a.json", "two recordings are called 'monday_a'"),
        ("build DAYS/c.parquet --alignment fit --latency-s 0.1", "drop it, or --lever-arm-m and --latency-s"),
        ("build DAYS/c.parquet --alignment fit", "80 readings have a label"),
        ("info DAYS", "no such manifest"),
    ],
)
def test_what_cannot_be_done_is_refused_in_a_line(command, words, recorded, tmp_path, refusal):
    arguments = command.replace("DAYS", str(recorded)).split()
    if arguments[0] == "build":
        arguments += ["--map", str(MAP), "--out", str(tmp_path / "new")]
    assert words in refusal("dataset", *arguments)
    assert list(tmp_path.iterdir()) == []
