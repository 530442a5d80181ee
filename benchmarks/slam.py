"""Magnetic SLAM without a map on recorded loops, beside the published figures.

    python benchmarks/slam.py [--data FOLDER] [--runs 20] [--loops 1 2 3 4] [--only NAME ...]

The model ship (Viset, Helmons and Kok 2022, Sensors 22(8), 2833): each run draws the odometry's noise anew.
RMSE is that of x and y against the true position, without alignment; the table has its mean over runs, the
standard deviation over runs, the median, ANEES of x, y and yaw divided by 3, and processor seconds a run.
"published" are the figures of the authors' Results.txt, over 100 runs.

Nothing is chosen on true positions. "EKF, published settings" has the published length scale, standard
deviations, noise and number of functions; the EKF is the incremental filter that never solves. The other rows
keep the published noise of a reading (0.1) and of odometry. Their length scale and standard deviation of the
field have the greatest marginal likelihood of the readings on a grid (Laplace's approximation, one run of a
loop), which needs no true position. Their priors of the magnetometer's offset and soft iron are as large as
the published noise, and that of odometry's velocity error (5 mm a step) is the round figure above the
published error (3 mm).

The hand-held loops (Kok and Solin 2024) have one run each and a reference that is not exact: the telephone's
own visual-inertial tracking.
"""

import argparse
import time
from pathlib import Path

import numpy as np

from magtwin.bench.magslam import (
    HAND_POSITION_STD_S,
    HAND_TURN_STD_S,
    SHIP_FUNCTIONS,
    SHIP_HEIGHT_VARIANCE_M2,
    SHIP_TURN_VARIANCE,
    SHIP_UNIT_NT,
    hand_case,
    ship_case,
    ship_options,
)
from magtwin.localization.odometry import Odometry
from magtwin.localization.slam.incremental_slam import IncrementalSlam
from magtwin.localization.slam.slam_smoother import SlamSmoother
from magtwin.localization.track import track

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "magslam"
BIAS_M = 0.005  # prior standard deviation of odometry's error a step
LENGTH_M, SD = 1.2, 0.3125  # greatest marginal likelihood
NEVER = 10**9  # readings between two solutions of the EKF
PUBLISHED = {"dead reckoning": (1.91, 1.45, 1.69, 1.71), "EKF, published settings": (0.53, 0.52, 0.48, 1.22)}
HAND = {"length_m": 0.8, "sd_nt": 10_000.0, "odometry_axes": "world", "soft_iron_sd": 0.0}


def published(case):
    """The published settings."""
    rate = case.problem.rate_hz
    walks = {"vertical_std_s": (SHIP_HEIGHT_VARIANCE_M2 * rate) ** 0.5}
    return ship_options() | walks | {"tilt_std_s": (SHIP_TURN_VARIANCE * rate) ** 0.5}


def chosen(case):
    """The published settings, with the length scale, sd and velocity error of the other rows."""
    own = {"length_m": LENGTH_M, "sd_nt": SD * SHIP_UNIT_NT, "velocity_sd_m_s": BIAS_M * case.problem.rate_hz}
    return published(case) | own


def methods(case, loop):
    """The methods of the table by name."""
    options = chosen(case)
    return {
        "dead reckoning": Odometry(),
        "EKF, published settings": IncrementalSlam(
            **published(case), functions=SHIP_FUNCTIONS[loop], calibrate=False, every=NEVER
        ),
        "EKF + velocity error": IncrementalSlam(**options, calibrate=False, every=NEVER),
        "incremental": IncrementalSlam(**options),
        "batch, no calibration": SlamSmoother(**options, calibrate=False),
        "batch + calibration": SlamSmoother(**options),
    }


def score(made, truth):
    """RMSE of x and y [m], and ANEES of x, y and yaw a state, without the first pose, which is known."""
    error = made.pose - truth.pose
    error[:, 2] = (error[:, 2] + np.pi) % (2 * np.pi) - np.pi
    nees = np.einsum("ni,nij,nj->n", error[1:], np.linalg.inv(made.covariance[1:]), error[1:])
    return float(np.sqrt((error[:, :2] ** 2).sum(axis=1).mean())), float(nees.mean() / 3)


def ship(folder, loop, runs, only):
    """Print the table of one loop."""
    rows = {}
    for seed in range(runs):
        case = ship_case(folder, loop, seed)
        for name, method in methods(case, loop).items():
            if only and name not in only:
                continue
            begin = time.process_time()
            made = track(method, case.problem, case.readings)
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
        walks = {"vertical_std_s": HAND_POSITION_STD_S, "tilt_std_s": HAND_TURN_STD_S}
        for word, method in (
            ("odometry", Odometry()),
            ("EKF", IncrementalSlam(**HAND, **walks, functions=200, every=NEVER)),
            ("incremental", IncrementalSlam(**HAND, **walks, functions=200)),
            ("batch", SlamSmoother(**HAND, **walks, functions=200)),
        ):
            made = track(method, case.problem, case.readings)
            print(f"{name:8}{word:14}{score(made, case.truth)[0]:8.3f}", flush=True)


def main():
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--data", type=Path, default=DATA, help="folder with ship/ and 1d/")
    parser.add_argument("--runs", type=int, default=20, help="runs of each loop")
    parser.add_argument("--loops", type=int, nargs="*", default=[1, 2, 3, 4], help="loops of the ship")
    parser.add_argument("--only", nargs="*", help="names of rows")
    given = parser.parse_args()
    for loop in given.loops:
        ship(given.data / "ship", loop, given.runs, given.only)
    if not given.only and (given.data / "1d").is_dir():
        hand(given.data / "1d")


if __name__ == "__main__":
    main()
