"""Do the stated errors of a fitted lever arm and latency hold the truth? Data sets of the default lab.

Each data set is driven by a robot in new sessions, whose markers were attached anew and whose motion capture
lags, and is aligned to the shipped map. Printed for forward, left [mm] and latency [ms]: mean error, spread
of the errors over data sets, mean stated standard deviation, RMS of error over standard deviation, and the
share of truths within the intervals of 90 %.

    python benchmarks/alignment.py [data sets]
"""

import sys

import numpy as np

import magtwin
from magtwin.files.file import shipped
from magtwin.learn.data.alignment import fit_alignment

TRUTH = np.array([55.0, -30.0, -75.2])
"""Offset of the markers [mm]; latency of motion capture with its jitter and half a sample [ms]."""

KINDS = ((12, 4, 40.0), (8, 1, 40.0), (4, 2, 40.0), (48, 12, 60.0))
"""Recordings, sessions and length of a recording [s]."""


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 3
    twin = magtwin.open_twin(shipped("scenes", "lab", "lab.usda"), magnetometer="physical")
    field = magtwin.load_map(shipped("maps", "lab", "lab.usdc"))
    for runs, sessions, duration_s in KINDS:
        errors, sds = [], []
        for k in range(count):
            swept = magtwin.sweep(
                twin, None, runs, seed=10_000 + 1000 * k, sessions=sessions, duration_s=duration_s, rate_hz=10
            )
            found = fit_alignment(list(swept), field)
            errors.append(1e3 * np.array([*found.lever_arm_m, found.latency_s]) - TRUTH)
            sds.append(1e3 * np.array([*found.lever_arm_sd_m, found.latency_sd_s]))
        error, sd = np.array(errors), np.array(sds)
        figures = {
            "bias": error.mean(axis=0),
            "spread": error.std(axis=0, ddof=1),
            "stated": sd.mean(axis=0),
            "rms z": np.sqrt(np.mean((error / sd) ** 2, axis=0)),
            "within 90 %": np.mean(np.abs(error / sd) < 1.645, axis=0),
        }
        print(f"{runs} recordings of {duration_s:g} s, {sessions} sessions, {count} data sets")
        for name, values in figures.items():
            print(f"  {name:12s}" + "".join(f"{value:9.2f}" for value in values))


if __name__ == "__main__":
    main()
