"""What each family of plants adds to the field that the default robot reads in the default lab.

    python benchmarks/plants.py [--plants 12] [--sessions 4]

It prints the table of docs/plants.md, in nT. Each session of each plant is driven along two paths, for three
minutes each. Sessions differ between plants too.
"""

import argparse

import numpy as np

from magtwin.sim.plant_families import PLANTS
from magtwin.twin import open_twin, sweep

PATHS = ("lawnmower", "figure8")
OPTIONS = {"duration_s": 180.0, "rate_hz": 20.0, "columns": ("b_truth_nt",)}


def fields_nt(twin, plant, seed, sessions):
    """Exact field, one row per session [nT]."""
    count = sessions * len(PATHS)
    runs = sweep(twin, PATHS, count, seed=seed, sessions=sessions, plant=plant, **OPTIONS)
    return np.array([run["b_truth_nt"] for run in runs]).reshape(sessions, -1)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plants", type=int, default=12, help="plants per family")
    parser.add_argument("--sessions", type=int, default=4, help="sessions per plant")
    given = parser.parse_args()
    twin, seeds = open_twin("lab", network="none"), range(given.plants)
    plain = [fields_nt(twin, "nominal", seed, given.sessions) for seed in seeds]
    print("| plant | RMS over plants: median (range) | mean over plants: range | mean over sessions: sd |")
    print("|---|---|---|---|")
    for name in PLANTS:
        if name == "nominal":
            continue
        added = [fields_nt(twin, f"{name}:{k}", k, given.sessions) - plain[k] for k in seeds]
        rms = [np.sqrt(np.mean(field**2)) for field in added]
        means = np.array([field.mean(axis=1) for field in added])
        worlds, within = means.mean(axis=1), np.sqrt(np.mean(means.var(axis=1, ddof=1)))
        print(
            f"| `{name}` | {np.median(rms):.0f} ({min(rms):.0f} to {max(rms):.0f}) "
            f"| {worlds.min():.0f} to {worlds.max():.0f} | {within:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
