"""Choice of noise models for magnetic-data, by leaving out each run of the map in turn.

The runs to localize have no part in these computations. But the criterion itself (log loss over all starts,
and the one-standard-error rule of `preferred`) was settled after results on runs 2 and 4 had been seen, so
that these two runs are no blind test of it.
"""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.bench.draws import Start
from magtwin.bench.magnetic_data import (
    OFFSET_NT,
    TRAINING,
    Noise,
    magnetic_data_case,
    read_recording,
    recorded_field,
)
from magtwin.localization.bounds import map_correlation
from magtwin.localization.localizers import load_localizer
from magtwin.localization.scores import nees
from magtwin.localization.track import track

Array = NDArray[np.float64]
Progress = Callable[[int, int, str], Any]

KAPPAS = (2.0, 4.0, 8.0, 16.0, 32.0)
"""Divisors of the log likelihood that are tried."""

RATE_HZ = 5.0
"""Rate of the residuals [Hz]."""

STARTS: tuple[Start, ...] = ("tracking", "heading", "global")
"""Priors from which every candidate starts: one choice has to serve all of them."""

STEPS = 150
"""Most evaluations of the likelihood of the residuals."""


@dataclass(frozen=True)
class Candidate:
    """A choice and how well it did."""

    noise: Noise
    """Noise model of the problem."""

    kappa: float
    """Option `kappa` of the particle filter."""

    log_loss: float
    """Mean over starts, runs and readings of -log N(true position; estimate, covariance) [nats]."""

    log_loss_se: float
    """Standard error of `log_loss`, from its scatter between tracks [nats]."""

    rmse_m: float
    """Pooled RMSE of the position from a known start [m]."""


def choose(
    folder: str | os.PathLike[str],
    *,
    training: tuple[int, ...] = TRAINING,
    seeds: int = 2,
    method: str = "rbpf",
    progress: Progress = lambda done, total, what: None,
) -> list[Candidate]:
    """Try noise models and temperings on each run of a map, with a map of the others.

    The noise models are the likeliest with and without drift (`likeliest_noise`). The map's whole error
    counts as correlated.

    Args:
        folder: Folder of magnetic-data.
        training: Runs of the map, two or more.
        seeds: Draws of the odometry of each run.
        method: A localizer with the options `kappa` and `map_correlated`.
        progress: Called as progress(done, total, what).

    Returns:
        All candidates, the one of least log loss first. `preferred` picks one of them.
    """
    folds = [(tuple(n for n in training if n != left), left) for left in training]
    total = 2 + 2 * len(KAPPAS)
    done, candidates = 0, []
    for drift in (True, False):
        progress(done, total, "noise with drift" if drift else "noise without drift")
        noise = likeliest_noise(folder, training=training, drift=drift)
        done += 1
        for kappa in KAPPAS:
            progress(done, total, f"kappa {kappa:g}")
            losses, squares = [], []
            for start, (rest, left), seed in product(STARTS, folds, range(seeds)):
                case = magnetic_data_case(folder, left, seed, start=start, training=rest, noise=noise)
                algorithm = load_localizer(method, {"kappa": kappa, "map_correlated": 1.0})
                made = track(algorithm, case.problem, case.readings)
                off, P = (made.pose - case.truth.pose)[:, :2], made.covariance[:, :2, :2]
                losses.append(np.mean(nees(off, P) + np.linalg.slogdet(2 * np.pi * P)[1]) / 2)
                if start == "tracking":
                    squares.append(np.mean(np.sum(off**2, axis=1)))
            rmse = float(np.sqrt(np.mean(squares)))
            error = float(np.std(losses, ddof=1) / np.sqrt(len(losses)))
            candidates.append(Candidate(noise, kappa, float(np.mean(losses)), error, rmse))
            done += 1
    progress(total, total, "")
    return sorted(candidates, key=lambda candidate: candidate.log_loss)


def preferred(candidates: Sequence[Candidate]) -> Candidate:
    """The least tempering within one standard error of the best.

    That is the one-standard-error rule (Breiman, Friedman, Olshen and Stone 1984, Classification and
    Regression Trees, section 3.4.3): candidates so close cannot be told apart, and kappa = 1 is the model
    itself. Between candidates of one kappa the log loss decides.

    Args:
        candidates: Results of `choose`.
    """
    best = min(candidates, key=lambda candidate: candidate.log_loss)
    close = [c for c in candidates if c.log_loss <= best.log_loss + best.log_loss_se]
    return min(close, key=lambda candidate: (candidate.kappa, candidate.log_loss))


def likeliest_noise(
    folder: str | os.PathLike[str], *, training: tuple[int, ...] = TRAINING, drift: bool = True
) -> Noise:
    """The noise model that makes the readings of runs left out likeliest, about maps of the others.

    The residuals are Gaussian with covariance offset^2 + white^2 + drift^2 exp(-dt / drift_s)
    + f^2 sd sd' exp(-d^2 / 2 l^2), with sd that of the map; the maximum is found by Nelder and Mead's method.

    Args:
        folder: Folder of magnetic-data.
        training: Runs of the map, two or more.
        drift: Whether there is a drift.
    """
    from scipy.linalg import cholesky, solve_triangular
    from scipy.optimize import minimize
    from scipy.spatial.distance import cdist

    parts = []
    for left in training:
        t, p, off, sd = residuals(folder, tuple(n for n in training if n != left), left)
        parts.append((np.abs(t[:, None] - t), cdist(p, p), off, np.outer(sd, sd)))

    def loss(logs: Array) -> float:
        white, factor, length, *more = np.exp(logs).tolist()
        total = 0.0
        for apart, far, off, sds in parts:
            matrix = factor**2 * sds * map_correlation(far, length) + OFFSET_NT**2
            if more:
                matrix += more[0] ** 2 * np.exp(-apart / more[1])
            matrix.flat[:: len(off) + 1] += white**2
            try:
                lower = cholesky(matrix, lower=True, overwrite_a=True, check_finite=False)
            except np.linalg.LinAlgError:
                return 1e12
            whitened = solve_triangular(lower, off, lower=True, check_finite=False)
            total += float(whitened @ whitened) / 2 + float(np.log(np.diag(lower)).sum())
        return total

    start = np.log([400.0, 1.0, 0.25, *([500.0, 2.0] if drift else [])])
    options = {"xatol": 0.01, "fatol": 0.05, "maxfev": STEPS}
    found = np.exp(minimize(loss, start, method="Nelder-Mead", options=options).x).tolist()
    white, factor, length, *more = (float(f"{value:.3g}") for value in found)
    return Noise(
        white_nt=white,
        map_factor=factor,
        map_length_m=length,
        drift_nt=more[0] if more else 0.0,
        drift_s=more[1] if more else 1.0,
    )


def residuals(
    folder: str | os.PathLike[str], training: tuple[int, ...], number: int
) -> tuple[Array, Array, Array, Array]:
    """Readings of a run about the map of others.

    Returns:
        Times [s], places of the sensor [m], residuals [nT] and standard deviations of the map [nT], shapes
        (N,), (N, 2), (N,), (N,), at `RATE_HZ`, on the map.
    """
    field = recorded_field(folder, training)
    part = read_recording(folder, number)
    rows = np.unique(np.searchsorted(part.t, np.arange(part.t[0], part.t[-1], 1 / RATE_HZ)))
    p = part.sensor(field.arm_m)[rows]
    value, sd = field.map.lookup_with_sd(p, 0.0)
    off = part.calibrated_nt(field.iron_nt)[rows] - value
    known = np.isfinite(off)
    return part.t[rows][known], p[known], off[known], sd[known]
