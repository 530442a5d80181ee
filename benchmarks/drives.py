"""Time and memory of a map fit from a drive, and how well it predicts what it was not shown.

    python benchmarks/drives.py [--minutes 10] [--drives 1] [--method trilinear harmonic]

Each drive is a random one of the default lab, at 17 Hz, with a physical magnetometer: seed 0, 1, ....
Of each, 15 % is left out in pieces of 10 s, and then a tenth of the floor in blocks of 0.6 m. Printed are
the processor time of the whole command `magtwin map fit` on the whole drive, its peak memory, the root of the
mean squared error on both kinds of readings left out, and the share of them in the 90 % intervals, noise
included; the harmonic fit is told the robot's signals there. The ratio is that of the time to the first
method's, so that it carries over to other machines.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from magtwin.field.fit.check import predict_readings
from magtwin.field.fit.fit import fit
from magtwin.field.survey.stuck import mask_stuck
from magtwin.io.surveys.readings import read_readings

SCENE = Path(__file__).resolve().parents[1] / "scenes" / "lab" / "lab.usda"
NINETY = 1.6448536269514722
PIECE_S, PIECES, BLOCK_M, BLOCKS = 10.0, 0.15, 0.6, 0.1


def drive(folder, minutes, seed):
    """A drive's Parquet file."""
    file = folder / f"drive_{seed}.parquet"
    command = [sys.executable, "-m", "magtwin", "run", str(SCENE), "--path", "random"]
    command += ["--duration-s", str(60 * minutes), "--seed", str(seed), "--magnetometer", "physical"]
    rate = {**os.environ, "MAGTWIN_RUN_RATE_HZ": "17"}
    subprocess.run([*command, "--out", str(file)], env=rate, check=True, capture_output=True)
    return file


def left_out(readings, seed):
    """Flags of readings left out in pieces of the drive, and in blocks of the floor."""
    rng = np.random.default_rng(100 + seed)
    piece = np.floor((readings.t - readings.t.min()) / PIECE_S).astype(int)
    count = piece.max() + 1
    pieces = np.isin(piece, rng.permutation(count)[: max(1, round(PIECES * count))])
    cell = np.floor((readings.p_xy + rng.uniform(0, BLOCK_M, 2) + 10) / BLOCK_M).astype(int)
    key = cell[:, 0] * 1000 + cell[:, 1]
    keys = np.unique(key)
    blocks = np.isin(key, rng.permutation(keys)[: max(1, round(BLOCKS * len(keys)))])
    return pieces & readings.good, blocks & ~pieces & readings.good


def predicted(readings, seed, method):
    """Figures of a fit on what it was not shown."""
    pieces, blocks = left_out(readings, seed)
    start = time.process_time()
    model = fit(readings.take(readings.good & ~pieces & ~blocks), method)
    figures = {"fit_s": time.process_time() - start}
    for name, rows in (("pieces", pieces), ("blocks", blocks)):
        value, variance = predict_readings(model, readings.take(rows), method)
        off = readings.b_nt[rows] - value
        known = np.isfinite(off)
        inside = np.abs(off) <= NINETY * np.sqrt(variance)
        figures[name] = float(np.sqrt(np.mean(off[known] ** 2)))
        figures[f"{name} in 90 %"] = float(inside[known].mean())
    return figures


def whole(file, method):
    """Processor time [s] and peak memory [GB] of the command."""
    out = file.with_suffix(f".{method}.usdc")
    command = [
        sys.executable,
        "-m",
        "magtwin",
        "map",
        "fit",
        str(file),
        "--method",
        method,
        "--out",
        str(out),
    ]
    started = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(started.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(command)} failed")
    return used.ru_utime + used.ru_stime, used.ru_maxrss / 1e6


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0, help="length of a drive; 100 is 102,000 rows")
    parser.add_argument("--drives", type=int, default=1, help="number of drives")
    parser.add_argument("--method", nargs="+", default=["trilinear", "harmonic"])
    parser.add_argument("--json", action="store_true", help="print a line of JSON for each drive and method")
    options = parser.parse_args()
    columns = f"{'pieces nT':>11}{'in 90 %':>9}{'blocks nT':>11}{'in 90 %':>9}"
    print(f"{'drive':>6} {'method':10}{'s':>8}{'ratio':>8}{'GB':>7}{columns}")
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(options.drives):
            file = drive(Path(folder), options.minutes, seed)
            readings, _ = mask_stuck(read_readings(file))
            first = None
            for method in options.method:
                seconds, memory = whole(file, method)
                first = first or seconds
                found = predicted(readings, seed, method)
                if options.json:
                    print(json.dumps({"drive": seed, "method": method, "s": seconds, "GB": memory, **found}))
                    continue
                errors = "".join(
                    f"{found[k]:11.0f}{found[f'{k} in 90 %']:9.1%}" for k in ("pieces", "blocks")
                )
                ratio = seconds / first
                print(f"{seed:6} {method:10}{seconds:8.1f}{ratio:8.2f}{memory:7.2f}{errors}", flush=True)


if __name__ == "__main__":
    main()
