"""The particle filter with 100,000 particles: plain numpy and magtwin, one process.

Both do the same steps of the same drive on the shipped map: 12 readings, in which resampling happens as often
as it does. The plain filter is that of the tests, with numpy's random numbers and numpy's own map lookups;
with the compiled filter's random numbers it gives the same estimates, which is checked first. The ways take
turns reading by reading, so that a busy machine slows all alike. The columns are the median time of a step;
the median over all steps of how many times faster it is than the same step in numpy; the same over the steps
of the best round, which a busy machine spoils least; and the median ratio of processor times, of all threads
together. On a busy machine, read the last for one thread.

    python benchmarks/localize.py [rounds]
"""

import copy
import math
import os
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "localization"))

from drives import drive
from plain_particles import PlainFilter

from magtwin import compiled
from magtwin.field.maps.lookup import LOOPS
from magtwin.localization.localizers import load_localizer
from magtwin.localization.problem import Problem, Reading, SensorModel
from magtwin.twin.maps import open_map

PARTICLES = 100_000
READINGS = 12
WANTED = {"compiled, one thread": 6, "compiled, two threads": 9}
"""How many times faster than numpy."""

CASES = {"rbpf": (SensorModel(), 0.0), "rbpf-iron": (SensorModel(iron_nt=400.0), 150.0)}
"""Sensor, and standard deviation of the map [nT], by method."""


def case(method: str) -> tuple[Problem, list[Reading]]:
    sensor, error = CASES[method]
    field = open_map(Path(__file__).parents[1] / "maps" / "lab" / "lab.usdc")
    spread = np.full(field.values_nt.shape, error**2)
    belief = type(field)(
        values_nt=field.values_nt,
        origin_m=field.origin_m,
        cell_m=field.cell_m,
        headings_rad=field.headings_rad,
        variance_nt2=spread if error else None,
    )
    u = np.arange(READINGS) * 0.04
    pose = np.column_stack([u - 1.0, 0.3 * np.sin(u), np.arctan(0.3 * np.cos(u))])
    return drive(belief, pose, 1, sensor=sensor, prior_sd=(0.1, 0.1, 0.05))


def check(method: str, problem: Problem, readings: list[Reading]) -> None:
    """Stop if the two filters differ."""
    fast = load_localizer(method, {"particles": 1000, "resets": False})
    fast.reset(problem)
    plain = PlainFilter(fast, hashed=True)
    plain.uniform = copy.deepcopy(fast._rng).random
    for reading in readings:
        a, b = fast.step(reading), plain.step(reading)
        if math.hypot(a.x - b.x, a.y - b.y) > 1e-9:
            sys.exit(f"{method}: the filters differ by {math.hypot(a.x - b.x, a.y - b.y):.1e} m")


def measure(method: str, rounds: int) -> dict[str, list[tuple[float, float]]]:
    """Seconds and processor seconds of each step, by way."""
    problem, readings = case(method)
    check(method, problem, readings)
    seconds: dict[str, list[tuple[float, float]]] = {"numpy": [], **{name: [] for name in WANTED}}
    for _ in range(rounds):
        filters = {}
        for name in seconds:
            made = load_localizer(method, {"particles": PARTICLES, "resets": False})
            made.reset(problem)
            filters[name] = PlainFilter(made, hashed=False) if name == "numpy" else made
        for reading in readings:
            for name, made in filters.items():
                compiled.MOST_THREADS = 2 if "two" in name else 1
                LOOPS.code = None  # numpy's own lookups
                start, busy = time.perf_counter(), time.process_time()
                made.step(reading)
                seconds[name].append((time.perf_counter() - start, time.process_time() - busy))
    return seconds


def main(rounds: int = 5) -> None:
    LOOPS.pays = float("inf")
    print(f"{PARTICLES:,} particles, {READINGS} readings, {rounds} rounds, load {os.getloadavg()[0]:.1f}")
    for method in CASES:
        seconds = measure(method, rounds)
        print(f"\n{method:24}{'ns a particle':>14}{'cpu, ns':>9}{'x numpy':>10}{'best':>8}{'cpu':>8}")
        steps = {name: np.array(took).reshape(rounds, READINGS, 2) for name, took in seconds.items()}
        for name, took in steps.items():
            ratio = steps["numpy"] / took
            seconds_each, busy_each = (np.median(took.reshape(-1, 2), axis=0) * 1e9 / PARTICLES).tolist()
            wall, busy = np.median(ratio.reshape(-1, 2), axis=0).tolist()
            best = np.median(ratio[:, :, 0], axis=1).max()
            wanted = f"  wanted: {WANTED[name]} times numpy" if name in WANTED else ""
            print(f"{name:24}{seconds_each:14.1f}{busy_each:9.1f}{wall:10.1f}{best:8.1f}{busy:8.1f}{wanted}")
    print(f"load at the end {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
