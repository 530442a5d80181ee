import json

import numpy as np
import pytest
from learn_drives import a_drive, hills
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.errors import InputError
from magtwin.io.tables import read_parquet
from magtwin.learn.data.alignment import Alignment
from magtwin.learn.data.dataset import build_dataset, open_dataset
from magtwin.learn.data.features import features
from magtwin.learn.data.labels import labelled
from magtwin.learn.data.recording import Source
from magtwin.run.run import Run

FIELD, a_run = hills(variance=400.0), a_drive


RUNS = {
    "a": a_run(0, session=3, session_seed=7, path="sine"),
    "b": a_run(1, session=4, session_seed=7, path="figure8"),
    "c": a_run(2),
}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return build_dataset(RUNS, FIELD, tmp_path_factory.mktemp("set") / "lab")


def test_a_recording_comes_back_with_its_labels_to_the_last_bit(made):
    for (one, run), (name, before) in zip(made.runs(), RUNS.items(), strict=True):
        assert one.name == name
        expected = labelled(before, FIELD)
        for column in ("label_nt", "b_map_nt", "b_map_gradient_nt_m"):
            assert_array_equal(run[column], expected[column])
        assert_allclose(run["label_sd_nt"], 20.0)
        for column in ("t", "p_world_base", "imu_q_xyzw", "battery_a", "b_measured_nt", "b_truth_nt"):
            assert_array_equal(run[column], before[column])
        assert "v_base" not in run  # the truth is no signal
        assert one.labelled == run.rows == one.rows


def test_sessions_and_paths_are_the_runs_own_or_their_names(made):
    assert [one.session for one in made.recordings] == ["7-3", "7-4", "c"]
    assert [one.path for one in made.recordings] == ["sine", "figure8", "c"]


def test_rows_are_features_and_labels_in_the_order_of_the_recordings(made):
    rows = made.rows("vector", ["c", "a"])
    assert rows.names == ("c", "a")
    assert_array_equal(np.bincount(rows.recording), [240, 240])
    (_, c), (_, a) = made.runs(["c", "a"])
    assert_array_equal(rows.x, np.vstack([features(c, "vector"), features(a, "vector")]))
    assert_array_equal(rows.y, np.concatenate([c["label_nt"], a["label_nt"]]))
    assert_array_equal(rows.sd, np.full(480, rows.sd[0]))
    speed = made.rows(["odom_v_x"])
    slope = np.polyfit(speed.x[:, 0], speed.y, 1)[0]
    assert slope == pytest.approx(100, abs=1)


def test_rows_without_a_label_or_with_a_nan_input_are_left_out_and_counted(tmp_path):
    run = a_run(3)
    lost, k = run["flag_lost_lock"].copy(), np.arange(run.rows)
    lost[:10] = True
    battery = np.where(k >= 220, np.nan, run["battery_a"])
    found = build_dataset(
        {"a": run.with_columns(flag_lost_lock=lost, battery_a=battery)}, FIELD, tmp_path / "d"
    )
    rows = found.rows("circular")
    assert len(rows.y) == len(rows.x) == 210
    assert np.isfinite(rows.x).all()
    assert found.recordings[0].labelled == 230
    assert len(found.rows("full").y) == 230


def test_the_same_runs_give_the_same_bytes_and_shards_are_runs_for_anyone(made, tmp_path):
    again = build_dataset(RUNS, FIELD, tmp_path / "again")
    for name in ("dataset.json", "runs/a.parquet"):
        assert (made.folder / name).read_bytes() == (again.folder / name).read_bytes()
    run = read_parquet(made.folder / "runs" / "a.parquet")
    assert run.spec("label_nt").unit == "nT"
    assert run.metadata["path"] == "sine"


def test_an_alignment_is_fitted_to_all_runs_together_and_kept(tmp_path):
    late = {k: run.with_columns(b_measured_nt=np.roll(run["b_measured_nt"], 3)) for k, run in RUNS.items()}
    found = build_dataset(late, FIELD, tmp_path / "d", alignment="fit")
    assert found.alignment.latency_s == pytest.approx(0.3, abs=0.05)
    assert open_dataset(found.folder).alignment == found.alignment
    shared = build_dataset(late, FIELD, tmp_path / "j", alignment="fit", jobs=2)
    for name in ("dataset.json", "runs/a.parquet", "runs/c.parquet"):
        assert (shared.folder / name).read_bytes() == (found.folder / name).read_bytes()
    given = build_dataset(late, FIELD, tmp_path / "e", alignment=Alignment(latency_s=0.3))
    assert given.metadata["alignment"] == "given"
    sds = [d.recordings[0].label_sd_nt for d in (given, build_dataset(late, FIELD, tmp_path / "f"))]
    assert sds[0] < sds[1]


@pytest.mark.parametrize("lost", ["field", "lock", "pose"])
def test_a_lower_rate_keeps_labels_where_every_second_reading_is_lost(tmp_path, lost):
    run = RUNS["a"]
    every_second = np.arange(run.rows) % 2 == 0
    gaps = {
        "field": {"b_measured_nt": np.where(every_second, np.nan, run["b_measured_nt"])},
        "lock": {"flag_lost_lock": every_second},
        "pose": {"flag_pose_lost": every_second},
    }
    found = build_dataset({"a": run.with_columns(**gaps[lost])}, FIELD, tmp_path / "d", rate_hz=5.0)
    ((one, made),) = found.runs()
    assert one.rows == 120
    assert one.labelled == np.isfinite(made["label_nt"]).sum() == 119  # the first row is kept as it is
    assert_array_equal(made["t"][1:], run["t"][1:-1:2])


def test_an_input_that_is_no_measurement_is_refused(tmp_path):
    run = RUNS["a"].with_columns(battery_a=np.full(RUNS["a"].rows, 1e300))
    with pytest.raises(InputError, match=r"'a', row 0: input 'battery_a' is 1e\+300"):
        build_dataset({"a": run}, FIELD, tmp_path / "d").rows("circular")


def test_a_source_is_read_when_its_turn_comes_and_names_its_session(tmp_path):
    told = []
    sources = [Source(n, lambda n=n: told.append(n) or RUNS[n], session="monday", path="p") for n in "ab"]
    seen = []
    found = build_dataset(sources, FIELD, tmp_path / "d", progress=lambda *args: seen.append(args))
    assert told == ["a", "b"]
    assert {(one.session, one.path) for one in found.recordings} == {("monday", "p")}
    assert seen == [(0, 2, "a"), (1, 2, "b"), (2, 2, "")]


A = RUNS["a"]


@pytest.mark.parametrize(
    ("runs", "text"),
    [
        ({}, "no recording is named"),
        ({"../a": A}, "a recording is named by letters"),
        ({"a": A, "A": RUNS["b"]}, "two recordings are called 'A'"),
        ({"a": Run({"t": np.arange(3.0)})}, "a: nothing to label.*mocap_p with mocap_q_xyzw"),
        ({"a": A.select("p_world_base", "yaw")}, "a: nothing to label.*b_measured_nt"),
        ({"a": A.with_columns(p_world_base=A["p_world_base"] + 50)}, "a: none of 240 readings has a label"),
        ({"a": A.with_metadata(magnetometer="neural")}, "a: its readings come from a neural magnetometer"),
        ({"a": A.with_columns(b_measured_nt=labelled(A, FIELD)["b_map_nt"])}, "every label .* is 0 nT"),
    ],
)
def test_what_cannot_be_labelled_is_refused_and_leaves_nothing(tmp_path, runs, text):
    with pytest.raises(InputError, match=text):
        build_dataset(runs, FIELD, tmp_path / "d")
    assert list(tmp_path.iterdir()) == []


def test_a_feature_that_the_recordings_lack_is_refused_with_what_can_be_made(tmp_path):
    run = Run({k: v for k, v in RUNS["a"].items() if k not in ("battery_a", "b_vector_measured_nt")})
    found = build_dataset({"a": run, "b": RUNS["b"]}, FIELD, tmp_path / "d")
    with pytest.raises(InputError, match=r"'battery_a' needs column 'battery_a'.*: full, correlated$"):
        found.rows("circular")
    with pytest.raises(InputError, match="no recording 'bb'; did you mean 'b'"):
        found.rows("full", ["bb"])


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda d: d.update(kind="x"), "not the manifest"),
        (lambda d: d.update(version=2), "version 2"),
        (lambda d: d.pop("alignment"), "KeyError: 'alignment'"),
        (lambda d: d["recordings"][0].update(name="../../x"), "named by letters"),
        (lambda d: d["recordings"][0].update(rows=-1), "rows of a recording"),
        (lambda d: d["recordings"][0].update(labelled=10**12), "240 rows and 1000000000000 labels"),
        (lambda d: d["recordings"][0].pop("sha256"), "TypeError"),
        (lambda d: d.update(recordings=[]), "has no recording"),
    ],
)
def test_a_manifest_that_was_tampered_with_is_refused(made, tmp_path, change, text):
    data = json.loads((made.folder / "dataset.json").read_text())
    change(data)
    (tmp_path / "dataset.json").write_text(json.dumps(data))
    with pytest.raises(InputError, match=text):
        open_dataset(tmp_path)


def test_a_shard_that_was_changed_is_refused(tmp_path):
    found = build_dataset({"a": RUNS["a"]}, FIELD, tmp_path / "d")
    shard = found.folder / "runs" / "a.parquet"
    data = bytearray(shard.read_bytes())
    data[1000] ^= 1
    shard.write_bytes(data)
    for read in (found.check, found.rows, lambda: list(found.runs())):
        with pytest.raises(InputError, match=r"its checksum is not that in dataset.json"):
            read()
    shard.unlink()
    with pytest.raises(InputError, match="no such shard of a data set"):
        found.check()
    with pytest.raises(InputError, match="a file; a data set is the folder"):
        open_dataset(found.folder / "dataset.json")
