"""Magnetic SLAM without a map on recorded loops, beside the published figures.

    python benchmarks/slam.py [--data FOLDER] [--runs 20] [--loops 1 2 3 4] [--only NAME ...] [--evidence]

The model ship (Viset, Helmons and Kok 2022, Sensors 22(8), 2833): each run draws the odometry's noise anew.
RMSE is that of x and y against the true position, without alignment; the table has its mean over runs, the
standard deviation over runs, the median, ANEES of x, y and yaw divided by 3, and processor seconds a run.
"published" are the figures of the authors' Results.txt, over 100 runs.

Nothing is chosen on true positions. Length scale, both prior standard deviations, noise, and the EKF's number
of functions are published values. The priors of the magnetometer's offset and soft iron are as large as the
published noise of one reading (0.1). That of odometry's velocity error (5 mm a step) is the round figure
above the published error (3 mm). `--evidence` prints the Laplace approximation of -log p(y) for other values,
which needs no true position.

The hand-held loops (Kok and Solin 2024) have one run each and a reference that is not exact: the telephone's
own visual-inertial tracking.
"""

import argparse
import time
from pathlib import Path

import numpy as np

from magtwin.bench.magslam import SHIP_FUNCTIONS, hand_case, ship_case, ship_options
from magtwin.localize.odometry import Odometry
from magtwin.localize.slam.ekf_slam import EkfSlam
from magtwin.localize.slam.incremental_slam import IncrementalSlam
from magtwin.localize.slam.slam_smoother import SlamSmoother
from magtwin.localize.track import track

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "magslam"
BIAS_M = 0.005  # prior standard deviation of odometry's error a step
PUBLISHED = {"dead reckoning": (1.91, 1.45, 1.69, 1.71), "EKF, published settings": (0.53, 0.52, 0.48, 1.22)}
HAND = {"length_m": 0.8, "sd_nt": 10_000.0, "odometry_axes": "world", "soft_iron_sd": 0.0}


def methods(case, loop):
    """The methods of the table by name."""
    walks = {"vertical_std_s": case.vertical_std_s, "tilt_std_s": case.tilt_std_s}
    shared = ship_options() | walks
    velocity = {"velocity_sd_m_s": BIAS_M * case.problem.rate_hz}
    return {
        "dead reckoning": Odometry(),
        "EKF, published settings": EkfSlam(**shared, functions=SHIP_FUNCTIONS[loop], calibrate=False),
        "EKF + velocity error": EkfSlam(**shared, **velocity, functions=100, calibrate=False),
        "incremental": IncrementalSlam(**shared, **velocity),
        "batch, no calibration": SlamSmoother(**shared, **velocity, calibrate=False),
        "batch + calibration": SlamSmoother(**shared, **velocity),
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
    """Print -log p(y) of the batch for other priors, less that of the table's settings; lower is better."""
    print("\n-log p(y) less that of the table's settings, mean of 2 runs of each loop; lower is better")
    changes = {
        "no soft iron": {"soft_iron_sd": 0.0},
        "no offset, no soft iron": {"calibrate": False},
        "velocity error 1 mm a step": {"velocity_sd_m_s": 0.001},
        "velocity error 2.5 mm a step": {"velocity_sd_m_s": 0.0025},
        "velocity error 10 mm a step": {"velocity_sd_m_s": 0.01},
        "length 0.6 m": {"length_m": 0.6},
        "length 1.0 m": {"length_m": 1.0},
        "200 functions": {"functions": 200},
        "100 functions": {"functions": 100},
    }
    sums = dict.fromkeys(changes, 0.0)
    for loop in loops:
        for seed in (0, 1):
            case = ship_case(folder, loop, seed)
            options = ship_options() | {
                "vertical_std_s": case.vertical_std_s,
                "tilt_std_s": case.tilt_std_s,
                "velocity_sd_m_s": BIAS_M * case.problem.rate_hz,
                "starts": 2,
            }

            def cost(case, options):
                method = SlamSmoother(**options)
                method.run(case.problem, case.readings)
                return method.evidence

            base = cost(case, options)
            for name, change in changes.items():
                changed = {k: v * case.problem.rate_hz if k == "velocity_sd_m_s" else v for k, v in change.items()}
                sums[name] += (cost(case, options | changed) - base) / (2 * len(loops))
    for name, value in sums.items():
        print(f"{name:32}{value:8.1f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
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
