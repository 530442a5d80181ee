"""Long runs are made and written block by block; the bytes are those of a run that is made at once."""

import importlib
import os
import signal
import traceback

import numpy as np
import pytest

import magtwin as mt
from magtwin.errors import InputError
from magtwin.io.formats import read_run, write_run
from magtwin.io.outputs import Outputs
from magtwin.run import mapped
from magtwin.run.spool import Spool, blocks

ROWS = 2160
"""Readings of a run of 16 s at 135 Hz."""


@pytest.fixture(scope="module")
def twin():
    return mt.open_twin("lab")


def drive(twin, **options):
    return mt.simulate(twin, "figure8", seed=3, duration_s=ROWS / 135, **options)


def content(run):
    return {name: values.tobytes() for name, values in run.items()}, dict(run.metadata)


@pytest.fixture
def long_runs(monkeypatch):
    """Runs of more than 500 rows count as long."""
    monkeypatch.setattr(mapped, "LONG", 500)
    monkeypatch.setattr(mapped, "BLOCK", 384)


@pytest.mark.parametrize("kind", ["neural", "physical", "plant"])
def test_the_size_of_a_block_changes_no_bit(kind, monkeypatch):
    twin = mt.open_twin("lab", magnetometer="physical" if kind == "physical" else None)
    options = {"plant": "all"} if kind == "plant" else {}
    whole = content(drive(twin, **options))
    monkeypatch.setattr(mapped, "LONG", 500)
    for block in (97, 384, 1024):
        monkeypatch.setattr(mapped, "BLOCK", block)
        seen = []
        assert content(drive(twin, each=lambda run, seen=seen: seen.append(run), **options)) == whole
        assert sum(run.rows for run in seen) == ROWS
        assert len(seen) > 2


def test_runs_of_a_sweep_are_made_in_blocks_too(twin, long_runs, monkeypatch):
    made = [content(run) for run in mt.sweep(twin, ["sine", "random"], 2, duration_s=16.0)]
    assert made == [content(mt.sweep(twin, ["sine", "random"], 2, duration_s=16.0)[k]) for k in (0, 1)]
    monkeypatch.setattr(mapped, "LONG", 1 << 19)
    assert made == [content(run) for run in mt.sweep(twin, ["sine", "random"], 2, duration_s=16.0)]


@pytest.fixture(scope="module")
def run(twin):
    return drive(twin)


@pytest.mark.parametrize("suffix", [".parquet", ".csv", ".npz", ".mcap", ".rrd"])
def test_a_long_run_is_written_as_one_that_is_written_at_once(run, twin, tmp_path, monkeypatch, suffix):
    once, long = tmp_path / f"once{suffix}", tmp_path / f"long{suffix}"
    write_run(run, once, twin)
    monkeypatch.setattr(mapped, "LONG", 500)
    monkeypatch.setattr(mapped, "BLOCK", 384)
    write_run(run, long, twin)
    assert content(read_run(long)) == content(read_run(once))
    if suffix in (".csv", ".npz", ".mcap"):  # others have row groups, pages and ids of their own
        assert once.read_bytes() == long.read_bytes()


def in_child(work):
    """Run a function in a forked process; its exit status."""
    child = os.fork()
    if child == 0:
        try:
            work()
        except BaseException:
            traceback.print_exc()
        os._exit(1)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


@pytest.mark.parametrize(("suffix", "writer"), [(".mcap", "bags.writer"), (".csv", "tables")])
def test_a_run_that_is_killed_while_it_is_written_is_whole_in_its_parts(
    run, tmp_path, monkeypatch, long_runs, suffix, writer
):
    def until_killed(run, *rows):
        for number, block in enumerate(blocks(run)):  # of 384 rows
            if number == 2:
                os.kill(os.getpid(), signal.SIGKILL)
            yield block

    file, module = tmp_path / f"a{suffix}", importlib.import_module(f"magtwin.io.{writer}")
    outputs = Outputs.of([file])

    def work():
        with outputs.kept() as keep, outputs.aside() as places:
            for block in blocks(run):
                keep(block)
            monkeypatch.setattr(module, "blocks", until_killed)
            write_run(run, places.files[0])

    assert in_child(work) == -signal.SIGKILL
    assert not file.exists()
    assert content(read_run(f"{file}.parts")) == content(run)


def resident_mb():
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) for line in status if line.startswith("VmRSS")) / 1e3


def test_columns_of_a_long_run_take_disk_and_no_memory(run, long_runs):
    before, count = resident_mb(), 400
    spool = Spool(count * run.rows)  # 0.5 GB
    for k in range(count):
        spool.append(run.with_columns(t=run["t"] + 100.0 * k))
    whole = spool.run
    assert sum(values.nbytes for values in whole.values()) > 4e8
    assert resident_mb() - before < 100
    assert np.array_equal(whole["b_total_nt"][-run.rows :], run["b_total_nt"])
    assert np.array_equal(whole["odom_p"][run.rows : 2 * run.rows], run["odom_p"])


def test_a_long_run_without_room_is_refused_by_the_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    with pytest.raises(InputError, match=f"{tmp_path}: no room for .* GB of a long run; set TMPDIR"):
        mapped.zeros(1 << 50)
