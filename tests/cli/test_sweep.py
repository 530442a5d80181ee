"""`magtwin sweep`: the data set that it writes, its seeds and sessions, and what it refuses."""

import csv

import numpy as np

from magtwin.cli import main
from magtwin.io.tables import read_parquet
from magtwin.twin import MIXTURE, in_session, open_twin, simulate

SHORT = ("--duration-s", "1", "--magnetometer", "physical")


def listed(folder):
    with open(folder / "runs.csv", encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_each_file_is_the_run_of_its_seed_and_path_to_the_last_bit(lab_scene, tmp_path):
    out = tmp_path / "set"
    options = ["--out", str(out), "--count", "5", "--seed", "7", "--sessions", "survey"]
    main(["sweep", str(lab_scene), *options, "--path", "figure8", "random", *SHORT])
    rows = listed(out)
    assert sorted(p.name for p in out.iterdir()) == [f"run_0000{k}.parquet" for k in range(5)] + ["runs.csv"]
    twin = open_twin(lab_scene, magnetometer="physical")
    for k, row in enumerate(rows):
        path = ("figure8", "random")[k % 2]
        own = simulate(twin, path, seed=7 + k, session="survey", duration_s=1.0)
        run = read_parquet(out / row["file"])
        assert dict(run.metadata) == dict(own.metadata)
        assert list(run) == list(own)
        assert all(run[name].tobytes() == own[name].tobytes() for name in own)
        assert row["path"] == own.metadata["path"]
        assert (int(row["seed"]), int(row["readings"]), row["session"]) == (7 + k, own.rows, "survey")


def test_sessions_differ_and_their_runs_share_what_a_session_has(lab_scene, tmp_path, monkeypatch):
    monkeypatch.setenv("MAGTWIN_SWEEP_KEEP", "battery_fraction b_measured_nt")
    options = ["--count", "4", "--sessions", "2", *SHORT]
    for name in ("a", "b"):
        main(["sweep", str(lab_scene), "--out", str(tmp_path / name), *options])
    runs = [read_parquet(tmp_path / "a" / row["file"]) for row in listed(tmp_path / "a")]
    charges = [run["battery_fraction"][0] for run in runs]
    assert charges[0] == charges[1] != charges[2] == charges[3]
    assert [run.metadata["session"] for run in runs] == [0, 0, 1, 1]
    assert len({run.metadata["speed_m_s"] for run in runs}) == 4
    assert list(runs[0]) == ["t", "battery_fraction", "b_measured_nt"]
    assert not np.array_equal(runs[0]["b_measured_nt"], runs[1]["b_measured_nt"])
    for file in (tmp_path / "a").iterdir():
        assert file.read_bytes() == (tmp_path / "b" / file.name).read_bytes()


def test_the_default_is_a_mixture_of_paths_in_sessions_that_each_drive_all_of_them(lab_scene, tmp_path):
    out = tmp_path / "set"
    main(["sweep", str(lab_scene), "--out", str(out), "--count", "10", *SHORT])
    rows = listed(out)
    driven = {s: {row["path"] for row in rows if row["session"] == s} for s in ("0", "1")}
    assert driven["0"] == driven["1"] == set(MIXTURE)
    own = simulate(
        in_session(open_twin(lab_scene, magnetometer="physical"), 1),
        "sine",
        seed=5,
        speed=float(rows[5]["speed_m_s"]),
        duration_s=1.0,
    )
    run = read_parquet(out / "run_00005.parquet")
    assert dict(run.metadata) == dict(own.metadata)
    assert all(run[name].tobytes() == own[name].tobytes() for name in own)
