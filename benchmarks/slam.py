"""Magnetic SLAM without a map on recorded loops, beside the published figures.

    python benchmarks/slam.py [--data FOLDER] [--runs 20] [--loops 1 2 3 4] [--only NAME ...] [--evidence]

The model ship (Viset, Helmons and Kok 2022, Sensors 22(8), 2833): each run draws the odometry's noise anew.
RMSE is that of x and y against the true position, without alignment; the table has its mean over runs, the
standard deviation over runs, the median, ANEES of x, y and yaw divided by 3, and processor seconds a run.
"published" are the figures of the authors' Results.txt, over 100 runs.

Nothing is chosen on true positions. "EKF, published settings" has the published length scale, standard
deviations, noise and number of functions. The other rows keep the published noise of a reading (0.1) and of
odometry. Their length scale and standard deviation of the field have the greatest marginal likelihood of the
readings on a grid, `--evidence`, which needs no true position. Their priors of the magnetometer's offset and
soft iron are as large as the published noise, and that of odometry's velocity error (5 mm a step) is the
round figure above the published error (3 mm). "The same with drift" replaces the published white noise by
white noise of 0.01 and a drift of 0.05 that lasts 3 s, also of greatest marginal likelihood: errors of the
readings and of the field model last for seconds. Length, standard deviation and noise were compared on one
run of each loop.

The hand-held loops (Kok and Solin 2024) have one run each and a reference that is not exact: the telephone's
own visual-inertial tracking.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from magtwin.bench.magslam import (
    SHIP_FUNCTIONS,
    SHIP_NOISE,
    SHIP_UNIT_NT,
    hand_case,
    ship_case,
    ship_options,
)
from magtwin.localization.odometry import Odometry
from magtwin.localization.slam.ekf_slam import EkfSlam
from magtwin.localization.slam.incremental_slam import IncrementalSlam
from magtwin.localization.slam.slam_smoother import SlamSmoother
from magtwin.localization.track import track

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "magslam"
BIAS_M = 0.005  # prior standard deviation of odometry's error a step
LENGTH_M, SD = 1.2, 0.3125  # greatest marginal likelihood on the grid of `--evidence`
NOISES = ((0.02, 0.1, 3.0), (0.02, 0.05, 3.0), (0.02, 0.03, 6.0), (0.01, 0.05, 3.0))  # white, drift, s
LENGTHS_M, SDS = (0.8, 1.0, 1.2, 1.5), (1.25, 0.625, 0.4375, 0.3125)  # the first are published
PUBLISHED = {"dead reckoning": (1.91, 1.45, 1.69, 1.71), "EKF, published settings": (0.53, 0.52, 0.48, 1.22)}
HAND = {"length_m": 0.8, "sd_nt": 10_000.0, "odometry_axes": "world", "soft_iron_sd": 0.0}


def published(case):
    """The published settings."""
    return ship_options() | {"vertical_std_s": case.vertical_std_s, "tilt_std_s": case.tilt_std_s}


def chosen(case):
    """The published settings, with the length scale, sd and velocity error of the other rows."""
    own = {"length_m": LENGTH_M, "sd_nt": SD * SHIP_UNIT_NT, "velocity_sd_m_s": BIAS_M * case.problem.rate_hz}
    return published(case) | own


def methods(case, loop):
    """The methods of the table by name."""
    options = chosen(case)
    return {
        "dead reckoning": Odometry(),
        "EKF, published settings": EkfSlam(
            **published(case), functions=SHIP_FUNCTIONS[loop], calibrate=False
        ),
        "EKF + velocity error": EkfSlam(**options, calibrate=False),
        "incremental": IncrementalSlam(**options),
        "batch, no calibration": SlamSmoother(**options, calibrate=False),
        "batch + calibration": SlamSmoother(**options),
        "the same with drift": SlamSmoother(**options),
    }


def score(made, truth):
    """RMSE of x and y [m], and ANEES of x, y and yaw a state, without the first pose, which is known."""
    error = made.pose - np.column_stack([truth["p_world_base"][:, :2], truth["yaw"]])
    error[:, 2] = (error[:, 2] + np.pi) % (2 * np.pi) - np.pi
    nees = np.einsum("ni,nij,nj->n", error[1:], np.linalg.inv(made.covariance[1:]), error[1:])
    return float(np.sqrt((error[:, :2] ** 2).sum(axis=1).mean())), float(nees.mean() / 3)


def ship(folder, loop, runs, only):
    """Print the table of one loop."""
    rows = {}
    for seed in range(runs):
        case = ship_case(folder, loop, seed)
        likely = ship_case(folder, loop, seed, noise="likely").problem
        for name, method in methods(case, loop).items():
            if only and name not in only:
                continue
            begin = time.process_time()
            made = track(method, likely if "drift" in name else case.problem, case.readings)
            rows.setdefault(name, []).append((*score(made, case.truth), time.process_time() - begin))
    print(f"\nloop {loop}, {runs} runs")
    print(f"{'':26}{'RMSE m':>8}{'sd':>7}{'median':>8}{'published':>11}{'ANEES':>8}{'s':>7}")
    for name, values in rows.items():
        rmse, anees, seconds = np.array(values).T
        told = f"{PUBLISHED[name][loop - 1]:.2f}" if name in PUBLISHED else ""
        print(
            f"{name:26}{rmse.mean():8.3f}{rmse.std():7.3f}{np.median(rmse):8.3f}{told:>11}"
            f"{anees.mean():8.2f}{seconds.mean():7.2f}",
            flush=True,
        )


def hand(folder):
    """Print the distances of the hand-held loops from the telephone's tracking."""
    print("\nhand-held: RMSE to the telephone's tracking, m")
    for name in ("eight", "square"):
        case = hand_case(folder, name)
        walks = {"vertical_std_s": case.vertical_std_s, "tilt_std_s": case.tilt_std_s}
        for word, method in (
            ("odometry", Odometry()),
            ("EKF", EkfSlam(**HAND, **walks, functions=200)),
            ("incremental", IncrementalSlam(**HAND, **walks, functions=200)),
            ("batch", SlamSmoother(**HAND, **walks, functions=200)),
        ):
            made = track(method, case.problem, case.readings)
            print(f"{name:8}{word:14}{score(made, case.truth)[0]:8.3f}", flush=True)


def evidence(folder, loops):
    """Print -log p(y) of the batch on a grid of length scales and standard deviations; lower is better."""
    print("\n-log p(y), by Laplace's approximation, less that of the published values; lower is better")
    heads = "".join(f"{word:>8}" for word in ("length", "sd", "white", "drift", "s"))
    print(heads + "".join(f"{f'loop {loop}':>10}" for loop in loops) + f"{'sum':>10}")
    rows = {}
    settings = [(length, sd, (SHIP_NOISE, 0.0, 1.0)) for length in LENGTHS_M for sd in SDS]
    settings += [(LENGTH_M, SD, noise) for noise in NOISES]
    for loop in loops:
        case = ship_case(folder, loop, seed=1)
        for length, sd, noise in settings:
            white, drift, drift_s = noise
            sensor = replace(
                case.problem.sensor,
                white_nt=white * SHIP_UNIT_NT,
                drift_nt=drift * SHIP_UNIT_NT,
                drift_s=drift_s,
            )
            options = chosen(case) | {"length_m": length, "sd_nt": sd * SHIP_UNIT_NT, "starts": 1}
            method = SlamSmoother(**options)
            method.run(replace(case.problem, sensor=sensor), case.readings)
            rows.setdefault((length, sd, *noise), []).append(method.evidence)
    base = np.array(rows[settings[0][0], settings[0][1], *settings[0][2]])
    for setting, values in rows.items():
        less = np.array(values) - base
        words = "".join(f"{value:8.4g}" for value in setting)
        print(words + "".join(f"{v:10.1f}" for v in less) + f"{less.sum():10.1f}", flush=True)


def main():
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--data", type=Path, default=DATA, help="folder with ship/ and 1d/")
    parser.add_argument("--runs", type=int, default=20, help="runs of each loop")
    parser.add_argument("--loops", type=int, nargs="*", default=[1, 2, 3, 4], help="loops of the ship")
    parser.add_argument("--only", nargs="*", help="names of rows")
    parser.add_argument("--evidence", action="store_true", help="compare priors by marginal likelihood")
    given = parser.parse_args()
    if given.evidence:
        evidence(given.data / "ship", given.loops)
        return
    for loop in given.loops:
        ship(given.data / "ship", loop, given.runs, given.only)
    if not given.only and (given.data / "1d").is_dir():
        hand(given.data / "1d")


if __name__ == "__main__":
    main()
