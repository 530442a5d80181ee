"""A run as files: a recording against a call a row and against numpy's savez; every format of ten minutes.

A table of 81,000 rows and 30 columns (ten minutes at 135 Hz) is written as a Rerun recording by
`magtwin.io.rerun.file.write_rrd`, by `rerun.log` once a row and column as its quick start shows it (a part of
the rows, scaled), and by `numpy.savez`, each to a file that is not there yet. All are measured in turn in
one process, after a warm-up; ratios are medians over repetitions. Beside them stands what the Rerun SDK
takes for the same columns with nothing around it, which no use of it can go below.

    python benchmarks/logs.py [repetitions]
"""

import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import rerun as rr

from magtwin.files.file import shipped
from magtwin.io.rerun.file import read_run, write_rrd
from magtwin.run.run import Run
from magtwin.twin import Twin, open_twin, simulate

ROWS, COLUMNS, RATE_HZ = 81_000, 30, 135.0
LOOP_ROWS = 2000
"""Rows that the loop is timed on."""


def seconds(work: Callable[[Path], object], path: Path) -> float:
    path.unlink(missing_ok=True)
    start = time.perf_counter()
    work(path)
    return time.perf_counter() - start


def a_table() -> Run:
    """Columns such as a run has: random walks, and noise on them."""
    rng = np.random.default_rng(0)
    walks = np.cumsum(rng.normal(size=(COLUMNS - 1, ROWS)), axis=1) + rng.normal(size=(COLUMNS - 1, ROWS))
    names = ["b_map_nt", "b_total_nt", "b_measured_nt", "b_disturbance_nt", "yaw", "battery_v"]
    names += [f"est_{k}" for k in range(COLUMNS - 1 - len(names))]
    return Run({"t": np.arange(ROWS) / RATE_HZ, **dict(zip(names, walks, strict=True))}, {"seed": 0})


def by_loop(run: Run) -> Callable[[Path], None]:
    """A call a row and column, as a logger in a robot's loop does it."""
    columns = {name: values[:LOOP_ROWS].tolist() for name, values in run.items()}

    def work(path: Path) -> None:
        rec = rr.RecordingStream("loop", send_properties=False)
        rec.save(path)
        for row, t in enumerate(columns["t"]):
            rec.set_time("sim_time", duration=t)
            for name, values in columns.items():
                rec.log(name, rr.Scalars(values[row]))
        rec.flush()
        rec.disconnect()

    return work


def by_columns(run: Run) -> Callable[[Path], None]:
    """The SDK's own way for whole columns, with nothing around it."""
    table = np.column_stack(list(run.values()))
    times = [rr.TimeColumn("sim_time", duration=np.rint(run["t"] * 1e9).astype("timedelta64[ns]"))]

    def work(path: Path) -> None:
        rec = rr.RecordingStream("columns", send_properties=False)
        rec.save(path)
        rec.send_columns("run", times, rr.Scalars.columns(scalars=table))
        rec.flush()
        rec.disconnect()

    return work


def table_of_formats(repetitions: int, folder: Path) -> None:
    """Every format of a run of ten minutes in the lab that ships."""
    from magtwin.io.formats import read_run as read_any
    from magtwin.io.formats import write_run

    twin: Twin = open_twin(shipped("scenes", "lab", "lab.usda"))
    run = simulate(twin, "figure8", seed=0, duration_s=ROWS / RATE_HZ)
    names = ("run.rrd", "run.parquet", "run.csv", "run.npz", "run.mcap", "run.usdc")
    took: dict[str, list[float]] = {name: [] for name in names}
    for repetition in range(repetitions + 1):
        for name in names:
            spent = seconds(lambda path: write_run(run, path, twin), folder / name)
            if repetition:
                took[name].append(spent)
    print(f"\na run of {run.duration_s:.0f} s, {run.rows:,} rows, {len(run)} columns, in its lab")
    total = 0.0
    for name in names:
        median = statistics.median(took[name])
        total += median
        size = (folder / name).stat().st_size / 1e6
        start = time.perf_counter()
        rows = read_any(folder / name).rows
        read = time.perf_counter() - start
        print(f"{name:14s} write {median:7.3f} s  {size:6.1f} MB  read {read:7.3f} s  {rows:,} rows")
    print(f"{'all together':14s} write {total:7.3f} s; wanted: below 5 s")


def main(repetitions: int = 5) -> None:
    run = a_table()
    works = {
        "write_rrd": lambda path: write_rrd(run, path),
        "numpy.savez": lambda path: np.savez(path, **run),
        "the SDK, bare": by_columns(run),
        "call a row": by_loop(run),
    }
    took: dict[str, list[float]] = {name: [] for name in works}
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        for repetition in range(repetitions + 1):
            for name, work in works.items():
                spent = seconds(work, place / ("table.npz" if name == "numpy.savez" else "table.rrd"))
                if repetition:
                    took[name].append(spent * (ROWS / LOOP_ROWS if name == "call a row" else 1.0))
                if name == "write_rrd" and not repetition:
                    assert all(np.array_equal(read_run(place / "table.rrd")[key], run[key]) for key in run)
        print(f"{ROWS:,} rows x {len(run)} columns, {repetitions} repetitions; medians")
        for name in works:
            print(f"{name:14s} {statistics.median(took[name]):8.3f} s")
        ours = np.array(took["write_rrd"])
        for name, wanted in (
            ("call a row", "over 100"),
            ("numpy.savez", "at most 2"),
            ("the SDK, bare", "-"),
        ):
            peer = np.array(took[name])
            ratio = np.median(peer / ours if name == "call a row" else ours / peer)
            what = "times the rate of a call a row" if name == "call a row" else f"times the time of {name}"
            print(f"write_rrd: {ratio:6.1f} {what}; wanted: {wanted}")
        table_of_formats(max(1, repetitions // 2), place)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
