"""Growth of a benchmark's results: planning a resume, the journal, its parts on disk, and reading them.

    python benchmarks/results.py [ROWS ...]

Rows are synthetic, of nine localizers, without tracks. Half of the runs are done at random when the resume is
planned. Times are of the processor. Default: 1000 10000 100000 1000000 rows.
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from magtwin.bench.results import begin_results, read_results
from magtwin.bench.runner import Plan, about
from magtwin.bench.store import ROWS, SCHEMAS, TIMES, Journal, Order, done_runs
from magtwin.bench.suite import Suite, load_suite

NAMES = ("odometry", "ekf", "point-mass", "bootstrap", "rbpf", "rbpf-iron", "smoother", "mine", "theirs")
CHUNK = 10


def suite_in(folder: Path, runs: int) -> Suite:
    """A suite of one scenario in a folder of results."""
    text = f'name = "big"\nchunk = {CHUNK}\n[[scenario]]\nname = "tracking"\nruns = {runs}\n'
    text += "".join(f'[[localizer]]\nname = "{name}"\nmethod = "odometry"\n' for name in NAMES)
    file = folder / "big.toml"
    file.write_text(text, encoding="utf-8")
    suite = load_suite(file)
    begin_results(folder / "results", text.encode(), about(suite, suite))
    return suite


KINDS = {kind: [e.name for e in SCHEMAS[ROWS] if str(e.type) == kind] for kind in ("double", "int64", "bool")}
BOUNDS = [name for name in KINDS["double"] if name.startswith("bound_")]


def rows_of(first: int, rng: np.random.Generator) -> dict[str, list[dict[str, object]]]:
    """Rows of a chunk: scores that differ in every digit, and bounds that are the same for all localizers."""
    made: dict[str, list[dict[str, object]]] = {ROWS: [], TIMES: []}
    same = {**dict.fromkeys(KINDS["bool"], False), **dict.fromkeys(KINDS["int64"], 0), "reason": ""}
    same |= {"readings": 450, "status": "ok", "scenario": "tracking"}
    for run in range(first, first + CHUNK):
        same |= dict(zip(BOUNDS, rng.random(len(BOUNDS)).tolist(), strict=True))
        same |= {"run": run, "seed": 1000 + run, "session": run % 50}
        for name in NAMES:
            row = dict(zip(KINDS["double"], rng.random(len(KINDS["double"])).tolist(), strict=True))
            row |= {"converged_s": 0.2 * int(rng.integers(50)), "recovery_s": float("nan"), "lost_share": 0.0}
            row["coverage"] = int(rng.integers(450)) / 450
            made[ROWS].append({**row, **same, "localizer": name})
            key = {"scenario": "tracking", "localizer": name, "run": run}
            made[TIMES].append({**key, "step_us": float(rng.random())})
    return made


def measure(rows: int) -> str:
    """A line of the table."""
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        runs = max(CHUNK, rows // len(NAMES) // CHUNK * CHUNK)
        suite, out = suite_in(folder, runs), folder / "results"
        spent = 0.0
        begin = time.process_time()
        with Journal(out, Order(suite)) as journal:
            for first in range(0, runs, CHUNK):
                begin_make = time.process_time()
                chunk = rows_of(first, rng)
                spent += time.process_time() - begin_make
                journal.add(chunk)
        write = time.process_time() - begin - spent
        files = [file for file in out.rglob("*") if file.is_file()]
        size = sum(file.stat().st_size for file in (out / ROWS).rglob("*.parquet"))
        begin = time.process_time()
        read = read_results(out)
        took = time.process_time() - begin
        begin = time.process_time()
        done = done_runs(out, suite)
        known = time.process_time() - begin
        half = {key: rng.random(runs) < 0.5 for key in done}
        begin = time.process_time()
        plan = Plan(suite, half)
        planned = time.process_time() - begin
        tasks = sum(plan[k].size for k in range(len(plan)))
        made = time.process_time() - begin
        count = len(read.rows["run"])
        assert read.missing == 0
        assert tasks == plan.size
        return (
            f"{count:9,} {1e6 * write / count:9.1f} {len(files):6} {size / count:7.1f} {took:7.2f} "
            f"{known:7.2f} {planned:7.3f} {made:7.2f}"
        )


if __name__ == "__main__":
    print("     rows  us a row  files  B/row  read s  done s  plan s  tasks s")
    for wanted in sys.argv[1:] or (1_000, 10_000, 100_000, 1_000_000):
        print(measure(int(wanted)), flush=True)
