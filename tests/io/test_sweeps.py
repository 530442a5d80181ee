"""Sweeps by processes, shards and a cluster: the same files as from one process, also after interruptions."""

import os
import signal
import subprocess
import sys

import pytest
from waiting import PATIENCE_S, wait_until

from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.io import sweeps
from magtwin.io.sweeps import save_runs
from magtwin.parallel import open_pool
from magtwin.twin import open_twin, sweep


def runs_of(lab_scene, count=10, **options):
    twin = open_twin(lab_scene, magnetometer="neural")
    common = {"duration_s": 2.0, "rate_hz": 20.0, "sessions": 3, "speeds": "drawn"}
    return sweep(twin, seeds=count, **{**common, **options})


@pytest.fixture(scope="module")
def runs(lab_scene):
    return runs_of(lab_scene)


@pytest.fixture(scope="module")
def whole(runs, tmp_path_factory):
    """The folder that one process writes, and its report."""
    out = tmp_path_factory.mktemp("whole") / "runs"
    return out, runs.save(out)


def files_in(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture(scope="module")
def workers():
    with open_pool(2) as pool:
        yield pool


@pytest.fixture
def warm(workers, monkeypatch):
    """Workers that stay, so that a test does not wait for new ones."""

    class Kept:
        def __enter__(self):
            return workers

        def __exit__(self, *_):
            pass

    monkeypatch.setattr(sweeps, "open_pool", lambda *_, **__: Kept())


def test_two_processes_write_what_one_writes(runs, whole, tmp_path):
    out, report = whole
    said = []
    made = runs.save(tmp_path / "runs", jobs=2, progress=lambda *at: said.append(at))
    assert files_in(tmp_path / "runs") == files_in(out)
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]
    assert said == [(k, 10) for k in range(11)]
    told = ("runs", "readings", "driven")
    values = [{f.name: f.value for f in each.figures if f.name in told} for each in (report, made)]
    assert values[0] == values[1]
    assert (made.metadata, made.verdict) == (report.metadata, report.verdict)
    assert "10 runs in 3 sessions" in made.verdict


@pytest.mark.parametrize("shards", [2, 7])
def test_the_last_shard_completes_the_folder(warm, runs, whole, tmp_path, shards):
    for k in reversed(range(shards)):
        assert not (tmp_path / "runs").exists()
        made = save_runs(runs, tmp_path / "runs", shard=(k, shards))
        if k:
            assert made.title.startswith(f"{sum(n % shards >= k for n in range(10))} of 10 runs in ")
    assert files_in(tmp_path / "runs") == files_in(whole[0])
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


def test_a_repeat_makes_only_what_is_missing(warm, workers, runs, whole, tmp_path, monkeypatch):
    save_runs(runs, tmp_path / "runs", shard=(0, 3))
    given = []
    run = workers.run
    monkeypatch.setattr(workers, "run", lambda work, blocks: (given.extend(blocks), run(work, blocks))[1])
    save_runs(runs, tmp_path / "runs", shard=(0, 3))
    assert given == []
    save_runs(runs, tmp_path / "runs", jobs=2)
    assert [block.start for block in given] == [k for k in range(10) if k % 3]
    assert files_in(tmp_path / "runs") == files_in(whole[0])


def test_parts_of_another_sweep_are_refused_and_replaced_by_force(warm, lab_scene, runs, whole, tmp_path):
    for k, other in enumerate(({"seed": 1}, {"rate_hz": 10.0}, {"paths": "sine"}, {"speeds": 0.2})):
        out = tmp_path / f"runs{k}"
        save_runs(runs, out, shard=(0, 5))
        before = files_in(tmp_path / f"runs{k}.parts")
        others = runs_of(lab_scene, **other)
        with pytest.raises(InputError, match="unfinished runs of another sweep"):
            save_runs(others, out, jobs=2)
        assert files_in(tmp_path / f"runs{k}.parts") == before
    assert runs_of(lab_scene).identity == runs.identity
    save_runs(others, out, jobs=2, force=True)
    assert not (tmp_path / f"runs{k}.parts").exists()
    save_runs(runs, out, jobs=2, force=True)
    assert files_in(out) == files_in(whole[0])


def test_what_does_not_fit_is_refused(runs, whole, tmp_path):
    with pytest.raises(InputError, match="exists already"):
        runs.save(whole[0], jobs=2)
    with pytest.raises(InputError, match="drop `force`"):
        runs.save(tmp_path / "runs", shard=(0, 2), force=True)
    with pytest.raises(InputError, match="shard 2 of 2 does not exist"):
        runs.save(tmp_path / "runs", shard=(2, 2))
    with pytest.raises(InputError, match=r"need the runs that magtwin\.sweep gives"):
        save_runs([], tmp_path / "runs", jobs=2)
    assert not list(tmp_path.iterdir())


def test_an_interrupted_command_is_continued(lab_scene, tmp_path):
    out, parts = tmp_path / "runs", tmp_path / "runs.parts"
    options = ["--count", "30", "--duration-s", "2", "--magnetometer", "physical", "--quiet"]
    command = ["sweep", str(lab_scene), "--out", str(out), *options]
    program = subprocess.Popen(
        [sys.executable, "-m", "magtwin", *command, "--jobs", "1"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )
    wait_until(lambda: list(parts.glob("part-*.json")) or program.poll() is not None)
    program.send_signal(signal.SIGINT)
    assert program.wait(PATIENCE_S) == 130
    assert not out.exists()
    done = {path.name: path.stat().st_mtime_ns for path in parts.iterdir() if path.suffix == ".parquet"}
    assert not [path for path in parts.iterdir() if path.name.startswith(".")]
    main([*command, "--shard", "0/1"])
    assert done.items() <= {path.name: path.stat().st_mtime_ns for path in out.iterdir()}.items()
    main(["sweep", str(lab_scene), "--out", str(tmp_path / "again"), *options])
    assert files_in(out) == files_in(tmp_path / "again")
