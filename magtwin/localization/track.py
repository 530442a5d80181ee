"""Track: run an algorithm over readings, check every estimate, and keep them as columns."""

import contextlib
import math
import time
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError, RepairWarning, is_termination
from magtwin.frames import yaw_from_quat
from magtwin.localization.problem import Array, Estimate, Localizer, Problem, Reading, Smoother
from magtwin.localization.readings import onboard, readings_of
from magtwin.run.run import Column, Run

EST_COLUMNS = {
    "est_p_world_base": Column("m", "world", "estimated position of base_link", 3, ("x", "y", "z")),
    "est_yaw": Column("rad", "world", "estimated heading of base_link", interpolation="angle"),
    "est_covariance": Column(
        "",
        "world",
        "covariance of the estimate [m^2, m rad, rad^2]; nan if unknown",
        6,
        ("xx", "xy", "x_yaw", "yy", "y_yaw", "yaw_yaw"),
    ),
    "est_bias_nt": Column("nT", "", "estimated offset of the magnetometer; nan if unknown"),
    "est_lost": Column("bool", "", "the localizer does not trust its pose", interpolation="hold"),
}
"""Columns that localization adds to a run."""

LARGEST_YAW = 8 * math.pi
"""Headings up to this are not checked for degrees [rad]."""

_UPPER = np.triu_indices(3)


class LocalizerError(InputError):
    """An algorithm under test raised, or returned what is not an estimate."""


@dataclass(frozen=True, eq=False)
class Track:
    """Estimates at all readings of a run."""

    t: Array
    """[s], shape (N,)."""

    pose: Array
    """x, y [m] and yaw [rad], shape (N, 3)."""

    covariance: Array
    """Shape (N, 3, 3); nan if unknown."""

    bias_nt: Array
    """Shape (N,); nan if unknown."""

    lost: NDArray[np.bool_]
    """Shape (N,)."""

    step_s: float = math.nan
    """Mean processor time of a step [s]."""

    particles: tuple[Array, ...] = ()
    """Samples at each reading, shapes (P, 4): x, y, yaw, weight; () if they were not kept."""

    def columns(self) -> dict[str, NDArray[Any]]:
        """The estimates as the columns `EST_COLUMNS`."""
        zero = np.zeros(len(self.t))
        return {
            "est_p_world_base": np.column_stack([self.pose[:, :2], zero]),
            "est_yaw": np.arctan2(np.sin(self.pose[:, 2]), np.cos(self.pose[:, 2])),
            "est_covariance": self.covariance[:, *_UPPER],
            "est_bias_nt": self.bias_nt,
            "est_lost": self.lost,
        }


def track(
    algorithm: Localizer | Smoother,
    problem: Problem,
    run: Run,
    *,
    keep_particles: bool = False,
    name: str = "",
    progress: Callable[[int, int], Any] | None = None,
) -> Track:
    """Run an algorithm over the on-board columns of a run.

    Args:
        algorithm: A new `Localizer` or `Smoother`.
        problem: What it is told.
        run: The readings. Other columns than those on board are not passed on.
        name: What the algorithm is called in errors. Default: its class.
        keep_particles: Keep the samples of a localizer that has `particles()`.
        progress: Called as progress(readings done, all readings).

    Raises:
        LocalizerError: The algorithm raised; or an estimate is no `Estimate`, is not finite, has another time
            than its reading or a covariance that is not a symmetric, positive semidefinite (3, 3) array.
        InputError: The run lacks a column.
    """
    run = onboard(run)
    clouds: list[Array] = []
    estimates: list[Estimate] = []
    name = name or type(algorithm).__name__
    begin = time.process_time()
    spent = 0.0
    if isinstance(algorithm, Smoother) and not isinstance(algorithm, Localizer):
        made = called(f"{name}.run", lambda: algorithm.run(problem, run))
        if not isinstance(made, Iterable):
            raise LocalizerError(f"{name}.run returned {type(made).__name__}, not a list of Estimates")
        estimates = called(f"{name}.run", lambda: list(made))
        spent = time.process_time() - begin
        if len(estimates) != run.rows:
            raise LocalizerError(f"{name}.run returned {len(estimates)} estimates for {run.rows} readings")
    else:
        called(f"{name}.reset", lambda: algorithm.reset(problem))
        step = algorithm.step
        for k, reading in enumerate(readings_of(run)):
            begin = time.process_time()
            estimates.append(stepped(name, step, reading))
            spent += time.process_time() - begin
            if keep_particles and hasattr(algorithm, "particles"):
                clouds.append(np.array(algorithm.particles(), float))
            if progress is not None:
                progress(k + 1, run.rows)
    checked = checked_estimates(name, estimates, run["t"])
    yaw, turned = checked[0][:, 2], yaw_from_quat(run["odom_q_xyzw"])
    far = np.abs(yaw) > LARGEST_YAW
    if far.any() and _alike(np.radians(yaw), turned) >= _alike(yaw, turned) - 1e-9:
        k = int(np.argmax(far))
        warnings.warn(
            f"{name} returned yaw {yaw[k]:g} rad at t = {run['t'][k]:g} s, and as radians its headings "
            "follow the odometry no better than as degrees: if they are degrees, return radians",
            RepairWarning,
            stacklevel=2,
        )
    return Track(run["t"], *checked, spent / run.rows, tuple(clouds))


def stepped(name: str, step: Callable[[Reading], Estimate], reading: Reading) -> Estimate:
    """What an algorithm makes of a reading.

    Raises:
        LocalizerError: It raised.
    """
    try:
        return step(reading)
    except (Exception, SystemExit) as error:  # whatever the algorithm under test does wrong
        if is_termination(error):
            raise
        raise LocalizerError(
            f"{name}.step raised {type(error).__name__} at t = {reading.t:g} s: {error}"
        ) from error


def _alike(yaw: Array, other: Array) -> float:
    """Agreement of two headings up to a constant and whole turns: 1 if they turn alike, near 0 if not."""
    return float(np.abs(np.exp(1j * (yaw - other)).mean()))


def called(what: str, work: Callable[[], Any]) -> Any:
    """The result of a method under test; whatever it raises is a LocalizerError."""
    try:
        return work()
    except LocalizerError:
        raise
    except InputError as error:  # it says itself what is wrong
        raise LocalizerError(f"{what.partition('.')[0]}: {error}") from error
    except (Exception, SystemExit) as error:
        if is_termination(error):
            raise
        raise LocalizerError(f"{what} raised {type(error).__name__}: {error}") from error


def checked_estimates(
    name: str, estimates: list[Any], t: Array
) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Pose, covariance, bias and lost of all estimates."""
    count = len(estimates)
    pose, covariance = np.empty((count, 3)), np.full((count, 3, 3), np.nan)
    bias, lost = np.full(count, math.nan), np.zeros(count, bool)
    for k, (e, when) in enumerate(zip(estimates, t.tolist(), strict=True)):
        at = f"at t = {when:g} s"
        if not isinstance(e, Estimate):
            raise LocalizerError(f"{name} returned {type(e).__name__} {at}, not an Estimate")
        if (time_of := _number(name, "t", e.t, when)) != when:
            which = "from the future" if time_of > when else "of another reading"
            raise LocalizerError(f"{name} returned an estimate {which} {at}: its t is {time_of:g} s")
        pose[k] = [_number(name, part, getattr(e, part), when) for part in ("x", "y", "yaw")]
        if not np.isfinite(pose[k]).all():
            raise LocalizerError(f"{name} returned a pose that is not finite {at}")
        if e.bias_nt is not None:
            bias[k] = _number(name, "bias_nt", e.bias_nt, when)
        try:
            lost[k] = bool(e.lost)
        except ValueError:
            raise LocalizerError(_not(name, "lost", "true or false", e.lost, when)) from None
        if e.covariance is not None:
            try:
                matrix = np.asarray(e.covariance, float)
            except (TypeError, ValueError):
                text = _not(name, "covariance", "an array of numbers", e.covariance, when)
                raise LocalizerError(text) from None
            if matrix.shape != (3, 3):
                raise LocalizerError(f"{name} returned a covariance of shape {matrix.shape} {at}, not (3, 3)")
            covariance[k] = matrix
    known = np.flatnonzero(~np.isnan(covariance).all(axis=(1, 2)))
    some, symmetric = covariance[known], covariance[known].transpose(0, 2, 1)
    finite = np.isfinite(some).all(axis=(1, 2))
    scale = np.abs(some).max(axis=(1, 2)) + 1e-300
    with np.errstate(invalid="ignore"):
        even = np.abs(some - symmetric).max(axis=(1, 2)) <= 1e-6 * scale
    if not (finite & even).all():
        k = int(np.argmin(finite & even))
        fault = "symmetric" if finite[k] else "finite"
        text = f"{name} returned a covariance that is not {fault} at t = {t[known][k]:g} s"
        raise LocalizerError(f"{text}: {some[k].tolist()}")
    if (bad := np.linalg.eigvalsh(some)[:, 0] < -1e-9 * scale).any():
        when = t[known][np.argmax(bad)]
        raise LocalizerError(
            f"{name} returned a covariance that is not positive semidefinite at t = {when:g} s"
        )
    return pose, covariance, bias, lost


def _number(name: str, part: str, value: Any, t: float) -> float:
    """A part of an estimate as a number."""
    if not isinstance(value, str) and np.shape(value) == ():
        with contextlib.suppress(TypeError, ValueError):
            return float(value)
    raise LocalizerError(_not(name, part, "a number", value, t))


def _not(name: str, part: str, wanted: str, value: Any, t: float) -> str:
    """What is said of a part of an estimate that is not what it should be."""
    if isinstance(value, np.ndarray):
        seen = f"an array of shape {value.shape}"
    else:
        seen = f"{type(value).__name__} {value!r:.40}"
    return f"{name} returned {part} that is not {wanted} at t = {t:g} s: {seen}"
