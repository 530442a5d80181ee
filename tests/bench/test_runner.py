"""The runner of benchmarks: the same rows over jobs, shards and interruptions, and localizers that fail."""

import json
import math
import os
import shutil
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import bad_localizers
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from waiting import PATIENCE_S, wait_until

from magtwin.bench import runner
from magtwin.bench.results import begin_results, check_about, read_results
from magtwin.bench.runner import about, benchmark
from magtwin.bench.suite import load_suite
from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.files.file import shipped
from magtwin.parallel import open_pool

SUITE = """
name = "small"
seed = 5
chunk = 2
time_limit_s = {limit}

[[scenario]]
name = "exact"
runs = 5
sessions = 2
duration_s = 4.0

[[scenario]]
name = "global"
runs = 3
duration_s = 4.0
prior = "global"

[[localizer]]
method = "odometry"
"""
MORE = '\n[[localizer]]\nmethod = "bad_localizers:{}"\n'


def suite_in(folder, *bad, limit=20.0):
    file = folder / "small.toml"
    file.write_text(SUITE.format(limit=limit) + "".join(MORE.format(name) for name in bad))
    return file


def files_in(folder, *without):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.relative_to(folder).parts[0] not in without
    }


class Kept:
    """A pool whose workers stay for the next benchmark, which so need not open the scene again."""

    def __init__(self, pool):
        self.pool, self.run = pool, pool.run

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass


@pytest.fixture(scope="module")
def workers():
    with open_pool(2) as pool:
        yield Kept(pool)


@pytest.fixture
def warm(workers, monkeypatch):
    monkeypatch.setattr(runner, "open_pool", lambda *_, **__: workers)


@pytest.fixture(scope="module")
def suite(tmp_path_factory):
    return suite_in(tmp_path_factory.mktemp("suite"), "Raises")


@pytest.fixture(scope="module")
def whole(suite, tmp_path_factory):
    """Results of one process."""
    out = tmp_path_factory.mktemp("whole") / "results"
    benchmark(suite, out, jobs=1)
    return out


def test_a_folder_of_results_has_rows_times_and_tracks_of_every_chunk(whole, suite):
    names = ("exact", "global")
    parts = {f"{s}/part-00000.parquet" for s in names}
    expected = {f"{kind}/{part}" for kind in ("rows", "times", "tracks", "truths") for part in parts}
    assert files_in(whole).keys() == expected | {"suite.toml", "suite.json", "receipt.json"}
    assert (whole / "suite.toml").read_bytes() == suite.read_bytes()
    about = json.loads((whole / "suite.json").read_text())
    assert about["sha256"] == load_suite(suite).sha256


def test_rows_are_in_the_order_of_the_suite_with_one_per_run(whole):
    results = read_results(whole)
    keys = list(zip(*(results.rows[name].tolist() for name in ("scenario", "localizer", "run")), strict=True))
    names = ("odometry", "bad_localizers:Raises")
    assert keys == [
        (s, name, k) for s, n in (("exact", 5), ("global", 3)) for name in names for k in range(n)
    ]
    assert results.missing == 0
    assert (results.rows["seed"] == 5 + results.rows["run"]).all()
    good = results.rows["localizer"] == "odometry"
    assert set(results.rows["status"][good]) == {"ok"}
    assert set(results.rows["status"][~good]) == {"failed"}
    assert "ZeroDivisionError at t = 2.2 s: no particles left" in results.rows["reason"][~good][0]
    assert np.isfinite(results.rows["rmse_m"][good]).all()
    assert np.isnan(results.rows["rmse_m"][~good]).all()
    assert (results.times["step_us"][good] > 0).all()
    assert results.table.num_rows == 16
    assert "8 of them failed" in repr(results)


@pytest.mark.parametrize("shards", [1, 2, 7])
def test_two_jobs_and_any_number_of_shards_give_the_bytes_of_one(warm, suite, whole, tmp_path, shards):
    out = tmp_path / "results"
    for k in reversed(range(shards)):
        benchmark(suite, out, shard=(k, shards))
    assert files_in(out, "times") == files_in(whole, "times")
    assert not [path for path in out.rglob("*") if path.name.startswith(".")]


def test_a_repeat_runs_what_is_missing_only(warm, suite, whole, tmp_path, monkeypatch):
    out = tmp_path / "results"
    benchmark(suite, out, localizers=["odometry"], scenarios=["global"], runs=2)
    assert [name for name in files_in(out) if "rows" in name] == ["rows/global/part-00000.parquet"]
    sizes, run = [], runner._run

    def counted(pool, chosen, plan, *more):
        sizes.append(plan.size)
        run(pool, chosen, plan, *more)

    monkeypatch.setattr(runner, "_run", counted)
    results = benchmark(suite, out)
    assert files_in(out, "times") == files_in(whole, "times")
    for name, values in read_results(whole).rows.items():
        np.testing.assert_array_equal(results.rows[name], values)
    benchmark(suite, out)
    assert sizes == [16 - 2]  # and nothing the second time


def test_localizers_that_fail_in_any_way_have_rows_and_the_suite_goes_on(warm, tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "GRACE_S", 4.0)
    reasons = {
        "Hangs": "took longer than",
        "Crashes": "the process was killed by SIGSEGV",
        "Exits": "raised SystemExit at t = ",
        "Nan": "not finite",
        "Future": "from the future",
        "Shape": "shape (2, 2)",
        "Sleeps": "took longer than the time limit of 3 s",
    }
    suite = suite_in(tmp_path, *reasons, limit=3.0)
    results = benchmark(suite, tmp_path / "results", scenarios=["exact"], runs=1)
    rows = dict(
        zip(
            results.rows["localizer"],
            zip(results.rows["status"], results.rows["reason"], strict=True),
            strict=True,
        )
    )
    assert rows.pop("odometry") == ("ok", "")
    assert {name: status for name, (status, _) in rows.items()} == {
        f"bad_localizers:{name}": "failed" for name in reasons
    }
    for name, reason in reasons.items():
        assert reason in rows[f"bad_localizers:{name}"][1]


def _went_on(out, before, program):
    """Whether a program has written to its journal since, or has ended."""
    wrote = any(size > before.get(name, 0) for name, size in _journals(out).items())
    return wrote or program.poll() is not None


def _journals(out):
    return {file.name: file.stat().st_size for file in out.glob("journal-*.log")}


def test_an_interruption_leaves_whole_files_and_a_repeat_goes_on(suite, whole, tmp_path):
    out = tmp_path / "results"
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(Path(bad_localizers.__file__).parent), *sys.path]),
    }
    command = [sys.executable, "-m", "magtwin", "bench", str(suite), "--out", str(out), "--jobs", "2"]
    for end in (signal.SIGINT, signal.SIGKILL):
        program = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, stdout=subprocess.PIPE)
        before = _journals(out)
        wait_until(partial(_went_on, out, before, program))
        program.send_signal(end)
        said = program.communicate(timeout=PATIENCE_S)[1].decode()
        if end == signal.SIGINT:
            assert program.returncode == 130
            assert "magtwin: interrupted; finished work is kept, and the same command continues" in said
            assert "Traceback" not in said
        assert len(read_results(out).rows["run"]) <= 16
    for name in _journals(out):  # as if it had been killed while it wrote
        (out / name).write_bytes((out / name).read_bytes() + b"MTJ1\0half of a frame")
    benchmark(suite, out)
    done = {name: content for name, content in files_in(out, "times").items() if "/." not in name}
    assert done == files_in(whole, "times")


def test_the_command_prints_a_line_per_localizer(warm, suite, tmp_path, capsys):
    out = tmp_path / "results"
    main(["bench", str(suite), "--out", str(out), "--only", "exact", "--runs", "2", "--jobs", "1", "--json"])
    made = json.loads(capsys.readouterr().out)
    assert made["figures"]["runs"] == 4
    assert made["figures"]["failed"] == 2
    assert made["metadata"]["localizers"]["exact, bad_localizers:Raises"].startswith("no run finished")
    main(f"bench {suite} --out {out} --shard 5/7 --jobs 1 --only exact --quiet".split())


def refused(*arguments, capsys):
    with pytest.raises(SystemExit) as end:
        main(["bench", *map(str, arguments)])
    assert end.value.code == 1
    return capsys.readouterr().err


def test_what_cannot_run_is_refused_before_anything_is_written(suite, whole, tmp_path, capsys):
    out = tmp_path / "results"
    for options, text in (
        (("--only", "exat"), "did you mean 'exact'"),
        (("--localizer", "odometri"), "did you mean 'odometry'"),
        (("--localizer", "bad_localizers:None"), "there is no 'None'"),
        (("--shard", "2/2"), "--shard goes from 0/2 to 1/2"),
        (("--shard", "0/2", "--force"), "drop --force"),
        (("--jobs", "0"), "--jobs must be a whole number from 1 up"),
        (("--runs", "0"), "--runs must be at least 1"),
        (("--jobs", "2", "--dask", "tcp://127.0.0.1:9"), "drop --jobs"),
    ):
        assert text in refused(suite, "--out", out, *options, capsys=capsys)
        assert not out.exists()
    other = tmp_path / "other.toml"
    other.write_text(suite.read_text().replace("duration_s = 4.0", "duration_m = 4.0", 1))
    assert "other.toml:11: " in refused(other, "--out", out, capsys=capsys)
    other.write_text(suite.read_text().replace("duration_s = 4.0", "duration_s = 5.0", 1))
    before = files_in(whole)
    assert "another content of the suite" in refused(other, "--out", whole, capsys=capsys)
    other.write_text(suite.read_text().replace("seed = 5", "seed = 5\nversion = 2", 1))
    text = refused(other, "--out", whole, capsys=capsys)
    assert "another version of the suite (1, not 2); give another folder, or --force" in text
    assert "another seeds" in refused(suite, "--out", whole, "--seeds", "held-out", capsys=capsys)
    (tmp_path / "holiday.jpg").touch()
    assert "holds no results" in refused(suite, "--out", tmp_path, "--force", capsys=capsys)
    assert files_in(whole) == before


def test_results_on_other_inputs_are_refused(suite, tmp_path):
    shutil.copytree(shipped("scenes", "lab"), tmp_path / "room")
    points = tmp_path / "way.csv"
    points.write_text("x,y\n0,0\n1,0\n1,1\n")
    file = tmp_path / "own.toml"
    text = suite.read_text().replace(
        'name = "exact"', 'name = "exact"\nscene = "room/lab.usda"\npaths = ["way.csv"]'
    )
    file.write_text(text)
    inputs = about(load_suite(file), load_suite(file))["data"]
    assert inputs.keys() == {"scene room/lab.usda", "path way.csv"}
    assert about(load_suite(suite), load_suite(suite))["data"] == {}
    results_folder = tmp_path / "results"
    begin_results(results_folder, file.read_bytes(), about(load_suite(file), load_suite(file)))
    for changed, named in (
        (points, "path way.csv"),
        (tmp_path / "room" / "room.usda", "scene room/lab.usda"),
    ):
        before = changed.read_bytes()
        changed.write_bytes(before + b"\n")
        with pytest.raises(InputError, match=f"another content of '{named}'"):
            check_about(results_folder, about(load_suite(file), load_suite(file)))
        changed.write_bytes(before)


def test_a_folder_without_results_is_refused(tmp_path):
    with pytest.raises(InputError, match="no results of magtwin bench"):
        read_results(tmp_path)
    with pytest.raises(InputError, match="no such folder of results"):
        read_results(tmp_path / "none")


ODD = [
    ("rows", "diverged", pa.array([1e300, 1.0]), "'diverged' does not hold flags"),
    ("rows", "kidnapped", pa.array([math.nan, 1.0]), "'kidnapped' does not hold whole numbers from 0"),
    ("rows", "session", pa.array([None, 1]), "'session' does not hold whole numbers from 0"),
    ("rows", "anees", pa.array([-1.0, 1.0]), "'anees' does not hold numbers from 0"),
    ("rows", "reason", pa.array([["x"], []]), "'reason' does not hold texts"),
    ("tracks", "lost", pa.array([["x"], []]), "'lost' does not hold lists of numbers"),
    ("tracks", "lost", pa.array([[1.0], []], pa.list_(pa.float32())), "curves of unequal length"),
]


@pytest.mark.parametrize(("kind", "column", "values", "said"), ODD)
def test_rows_of_other_kinds_are_refused(whole, tmp_path, kind, column, values, said):
    out = shutil.copytree(whole, tmp_path / "results")
    part = next(out.glob(f"{kind}/exact/*.parquet"))
    table = pq.read_table(part)[:2]
    pq.write_table(table.set_column(table.column_names.index(column), column, values), part)
    with pytest.raises(InputError, match=f"damaged results .*{said}"):
        read_results(out).tracks()


def test_a_description_of_other_kinds_is_refused(whole, tmp_path):
    out = shutil.copytree(whole, tmp_path / "results")
    file = out / "suite.json"
    about = json.loads(file.read_text())
    for change in ({"sha256": 3}, {"data": ["x"]}, {"seeds": "other"}, {"version": None}):
        file.write_text(json.dumps({**about, **change}))
        with pytest.raises(InputError, match="no results of magtwin bench"):
            read_results(out)
