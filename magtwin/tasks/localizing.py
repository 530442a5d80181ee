"""Localization of runs from files: `magtwin localize` in Python."""

import keyword
import math
import os
import sys
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError, MismatchWarning, find
from magtwin.field.maps.map import AnomalyMap
from magtwin.files.file import existing, sha256
from magtwin.files.outputs import output
from magtwin.frames import wrap_angle, yaw_from_quat
from magtwin.io.formats import read_run
from magtwin.io.map_files import map_file, open_map
from magtwin.localization.bounds import Bounds, bounds
from magtwin.localization.localizers import load_localizer
from magtwin.localization.odometry import Odometry
from magtwin.localization.problem import (
    HEADING_WITHIN,
    Array,
    FieldBelief,
    Localizer,
    OdometryModel,
    Prior,
    Problem,
    SensorModel,
    Smoother,
)
from magtwin.localization.scores import Scores, score, verdict_of
from magtwin.localization.track import EST_COLUMNS, Track, track
from magtwin.report.report import Figure, Report
from magtwin.run.run import Run, numbers_in
from magtwin.run.thinning import field_known, newest
from magtwin.tasks.own_field import with_own_field

if TYPE_CHECKING:
    from magtwin.twin import Twin

RATE_HZ = 5.0
"""Default rate of readings that a localizer gets [Hz]."""

START_SD = (0.1, 0.1, math.radians(5))
"""Standard deviation of a known start: x, y [m] and yaw [rad]."""

ROBOT_NOISE = SensorModel(white_nt=100.0, drift_nt=250.0, drift_s=2.5, offset_nt=500.0, iron_nt=400.0)
"""Default noise model of a magnetometer on a robot: the own field of the shipped TurtleBot 4 in new sessions.
In six simulated drives the difference of the readings from the map had a mean of 190 to 520 nT, 290 to 500 nT
along the heading, and the rest 180 to 280 nT with a correlation of 0.4 to 0.6 after 2 s."""

APART_M = 0.02
"""Distance of two places of the magnetometer that is warned of [m]."""

GAP_S = 1.0
"""Longest gap in the true poses over which they are interpolated for the bounds [s]."""

LEAST_ON_MAP = 0.5
"""Share of the readings that must be on the map."""

FEW = 0.5
"""Share of the intervals with a reading below which the verdict gives the share."""

NO_READING = (
    "Dead reckoning: no row of the run holds a reading of the field (b_measured_nt is nan, or the "
    "magnetometer had lost lock), so the field was not used."
)
"""Verdict on a run without a reading."""

Source = str | os.PathLike[str]


@dataclass(frozen=True, eq=False)
class Localization:
    """A run with its estimates, and what they were made from."""

    run: Run
    """The readings, with the columns `EST_COLUMNS`."""

    problem: Problem
    """What the method was told."""

    track: Track
    """The estimates."""

    method: str
    """Name of the method."""

    intervals: int
    """Number of intervals between readings, at the rate that the method should get them."""

    @property
    def read_share(self) -> float:
        """Share of these intervals that have a reading of the field."""
        return float(np.count_nonzero(field_known(self.run))) / self.intervals

    @cached_property
    def truth(self) -> Array | None:
        """`truth_of` the run."""
        return truth_of(self.run)

    @cached_property
    def dead_reckoning(self) -> Track | None:
        """The start moved by odometry alone; from the true start if the prior has none. None if unknown."""
        start = self.problem.prior
        if any(map(math.isinf, start.sd)):
            if self.truth is None or not np.isfinite(self.truth[0]).all():
                return None
            start = Prior(mean=tuple(self.truth[0].tolist()), sd=START_SD)
        problem = Problem(
            belief=None,
            extent=self.problem.extent,
            prior=start,
            odometry=self.problem.odometry,
            rate_hz=self.problem.rate_hz,
        )
        return track(Odometry(), problem, self.run)

    @cached_property
    def known(self) -> NDArray[np.bool_]:
        """Readings whose true pose is known, shape (N,)."""
        known = self.truth is not None and np.isfinite(self.truth).all(axis=1)
        return np.broadcast_to(known, self.run.rows)

    @cached_property
    def bounds(self) -> Bounds | None:
        """Least standard deviations of any unbiased method; None with no map, or a gap above `GAP_S`."""
        if self.problem.belief is None or self.truth is None or not self.known.any():
            return None
        t, truth = self.track.t, self.truth
        if not self.known.all():
            seen = t[self.known]
            if np.diff(np.concatenate([t[:1], seen, t[-1:]])).max() > GAP_S:
                return None
            parts = (*truth[self.known, :2].T, np.unwrap(truth[self.known, 2]))
            truth = np.column_stack([np.interp(t, seen, part) for part in parts])
        return bounds(self.problem, truth, t, used=field_known(self.run))

    @cached_property
    def scores(self) -> Scores | None:
        """Scores at the readings whose true pose is known; None if there are less than two."""
        if self.truth is None or np.count_nonzero(self.known) < 2:
            return None
        known, limits = self.known, self.bounds
        names = ("t", "pose", "covariance", "bias_nt", "lost")
        made = replace(self.track, **{name: getattr(self.track, name)[known] for name in names})
        if limits is not None:
            limits = Bounds(**{name: values[known] for name, values in vars(limits).items()})
        start = self.problem.prior.is_global
        return score(made, self.truth[known], global_start=start, bounds=limits)

    @property
    def scored_rows(self) -> NDArray[np.bool_]:
        """Readings whose errors count: those of known pose, from convergence on if the start was unknown."""
        after = 0.0
        if (
            self.scores is not None
            and self.problem.prior.is_global
            and math.isfinite(self.scores.converged_s)
        ):
            after = self.scores.converged_s
        t = self.track.t
        return self.known & (t >= t[np.argmax(self.known)] + after)

    def report(self) -> Report:
        """Errors beside their bound and dead reckoning, and a verdict in one line."""
        return _report_of(self)


def localize(
    run: Run | Source,
    anomaly_map: FieldBelief | Source | None,
    *,
    method: str | Localizer | Smoother = "rbpf-iron",
    options: Mapping[str, Any] | None = None,
    prior: Prior | str | None = None,
    sensor: SensorModel | None = None,
    odometry: OdometryModel | None = None,
    map_length_m: float = 0.3,
    compensator: str = "none",
    calibration: Run | Source | None = None,
    rate_hz: float | None = RATE_HZ,
    seed: int = 0,
    progress: Callable[[int, int], Any] | None = None,
) -> Run:
    """Estimate the pose of a robot along a run from its magnetometer and odometry.

    Args:
        run: A run with the columns `b_measured_nt`, `odom_p` and `odom_q_xyzw`, or its file.
        anomaly_map: The map; its layer, its stage, or the name of a shipped scene ("lab"); or any
            `FieldBelief`. None: no map (SLAM).
        method: A name in `magtwin.localization.localizers.LOCALIZERS`, "module:Class", or an object.
        options: Keyword arguments of the method's class.
        prior: The pose at the first reading, or a text of `prior_of`. Default: "tracking".
        sensor: Noise model of the magnetometer. Default: `ROBOT_NOISE`, with the lever arm in the run's
            metadata.
        odometry: Noise model of the odometry.
        map_length_m: Correlation length of the map's error [m].
        compensator: Model of the robot's own field for methods that use its prediction (rbpf-network):
            "none"; "iron", which is fitted to `calibration`; or the weights of a trained network.
        calibration: A drive earlier in the session with true poses, or its file.
        rate_hz: Readings per second that the method gets [Hz]. None: all.
        seed: Seed of the method and of the prior's error.
        progress: Called as progress(readings done, all readings).

    Returns:
        The run at `rate_hz` with the columns `EST_COLUMNS`.

    Raises:
        InputError: A file or a column is missing, the run is off the map, there is no prior and no true pose,
            or the method fails.
    """
    return localization(**locals()).run


def localization(
    run: Run | Source,
    anomaly_map: FieldBelief | Source | None,
    *,
    method: str | Localizer | Smoother = "rbpf-iron",
    options: Mapping[str, Any] | None = None,
    prior: Prior | str | None = None,
    sensor: SensorModel | None = None,
    odometry: OdometryModel | None = None,
    map_length_m: float = 0.3,
    compensator: str = "none",
    calibration: Run | Source | None = None,
    rate_hz: float | None = RATE_HZ,
    seed: int = 0,
    keep_particles: bool = False,
    progress: Callable[[int, int], Any] | None = None,
) -> Localization:
    """As `localize`, but also returns what the estimates were made from.

    `keep_particles` keeps the samples of the method; the other arguments and errors are those of `localize`.
    """
    algorithm = load_localizer(method, options) if isinstance(method, str) else method
    if not isinstance(run, Run):
        run = read_run(existing(run, "run"))
    if isinstance(anomaly_map, str | os.PathLike):
        file = map_file(anomaly_map)
        anomaly_map = open_map(file)
        check_map(run, anomaly_map, file)
    if not run.rows or "t" not in run:
        raise InputError("the run has no readings")
    if rate_hz is not None and not rate_hz > 0:
        raise InputError(f"`rate_hz` must be above 0 Hz, got {rate_hz!r}", parameter="rate_hz")
    if seed < 0:
        raise InputError(f"seed must be a whole number from 0 up, got {seed!r}", parameter="seed")
    intervals = run.rows
    if rate_hz is not None and run.rows > 1 and 1.01 * rate_hz < (run.rows - 1) / run.duration_s:
        intervals, run = len(_ticks(run["t"], rate_hz)), thinned(run, rate_hz)
    if calibration is not None:
        calibration = calibration if isinstance(calibration, Run) else read_run(existing(calibration, "run"))
        if rate_hz is not None:
            calibration = thinned(calibration, rate_hz)
    lever_arm = lever_arm_of(run) if sensor is None else sensor.lever_arm_m
    check_lever_arm(run, lever_arm)
    if anomaly_map is not None:
        check_on_map(run, anomaly_map, lever_arm)
    problem = Problem(
        belief=anomaly_map,
        extent=extent_of(run, anomaly_map),
        prior=prior
        if isinstance(prior, Prior)
        else prior_of(run, "tracking" if prior is None else prior, seed=seed),
        sensor=sensor or replace(ROBOT_NOISE, lever_arm_m=lever_arm),
        odometry=odometry or OdometryModel(),
        map_length_m=map_length_m,
        calibration=calibration,
        rate_hz=rate_hz or (run.rows - 1) / max(run.duration_s, 1e-9),
        seed=seed,
    )
    (x, y, yaw), (x0, x1, y0, y1) = problem.prior.mean, problem.extent
    if prior in (None, "tracking"):  # whose error may lie beyond the edge of the map
        x, y = min(max(x, x0), x1), min(max(y, y0), y1)
        problem = replace(problem, prior=replace(problem.prior, mean=(x, y, yaw)))
    if not problem.prior.is_global and not (x0 <= x <= x1 and y0 <= y <= y1):
        text = f"{x:g}, {y:g} m is off the floor, x {x0:g} to {x1:g} m, y {y0:g} to {y1:g} m"
        raise InputError(f"the `prior` x, y = {text}", parameter="prior")
    run = with_own_field(run, compensator, problem)
    made = track(algorithm, problem, run, keep_particles=keep_particles, progress=progress)
    name = method if isinstance(method, str) else type(method).__name__
    estimated = run.with_columns(**made.columns()).with_specs(**EST_COLUMNS)
    estimated = estimated.with_metadata(localizer=name, localizer_seed=seed)
    return Localization(estimated, problem, made, name, intervals)


def live_problem(
    twin: "Twin",
    anomaly_map: FieldBelief | Source | None = None,
    *,
    sensor: Mapping[str, Any] | None = None,
    odometry: OdometryModel | None = None,
    map_length_m: float = 0.3,
    seed: int = 0,
) -> Problem:
    """What a method is told when it localizes the robot of a twin live; its prior is the default one.

    Args:
        twin: Gives the map, the floor and the place of the magnetometer.
        anomaly_map: Map in place of the twin's, as for `localize`; "none": no map (SLAM).
        sensor: Figures of `SensorModel` that differ from `ROBOT_NOISE` and the robot's lever arm.
        odometry: As for `localize`.
        map_length_m: As for `localize`.
        seed: As for `localize`.

    Raises:
        InputError: There is no such map.
    """
    belief: FieldBelief | None = twin.field
    if isinstance(anomaly_map, str | os.PathLike):
        belief = None if str(anomaly_map) == "none" else open_map(anomaly_map)
    elif anomaly_map is not None:
        belief = anomaly_map
    arm = tuple(twin.scene.robot.p_base_magnetometer[:2])
    return Problem(
        belief=belief,
        extent=belief.extent if isinstance(belief, AnomalyMap) else twin.scene.lab.extent_m,
        sensor=replace(ROBOT_NOISE, **{"lever_arm_m": arm, **(sensor or {})}),
        odometry=odometry or OdometryModel(),
        map_length_m=map_length_m,
        seed=seed,
    )


def new_localizer(out: Source, *, force: bool = False) -> Path:
    """Write a commented localizer to start from: a particle filter that runs as it is.

    Args:
        out: Python file to write. Its name becomes the module's.
        force: Whether to replace a file that exists.

    Raises:
        InputError: The file exists, or its name cannot name a module.
    """
    out = Path(out)
    if not (out.stem.isidentifier() and not keyword.iskeyword(out.stem)):
        raise InputError(f"{out}: a module's name has letters, digits and _, such as localizer.py")
    if out.stem in sys.stdlib_module_names:
        raise InputError(f"{out}: Python has a module {out.stem!r}; take another name")
    text = Path(__file__).parents[1].joinpath("localization", "starter.py.txt").read_text(encoding="utf-8")
    with output(out, force=force) as aside:
        aside.write_text(text.replace("localizer:MyLocalizer", f"{out.stem}:MyLocalizer"), encoding="utf-8")
    return out


def _report_of(result: Localization) -> Report:
    """Errors of a localization beside their bound and dead reckoning, and a verdict."""
    run, scores, dead = result.run, result.scores, result.dead_reckoning
    belief = result.problem.belief
    read = int(np.count_nonzero(field_known(run)))
    rate = max(read - 1, 0) / max(run.duration_s, 1e-9)
    metadata: dict[str, Any] = {
        "map": "none (SLAM)" if belief is None else getattr(belief, "name", "") or type(belief).__name__,
        "readings": f"{read:,} in {run.duration_s:.1f} s, {rate:.3g} a second",
    }
    if result.scores is not None:
        gaps = "" if result.known.all() else f", known at {result.known.sum():,} of them"
        metadata["errors"] = f"differences from the {truth_name(run)}{gaps}"
    title = f"{result.method} on {', '.join(_origin(run)) or 'a recorded run'}"
    share = result.read_share
    figures = []
    if share < 1:
        note = "share of the intervals; odometry alone carries the pose through the others"
        figures.append(Figure("with a reading", share, note=note))
    if scores is None or dead is None or result.truth is None:
        if share:
            lost = float(result.track.lost.mean())
            figures.append(Figure("flagged lost", lost, note="share of the readings"))
        none = "No verdict: the run has no true pose to compare with."
        return Report(title, tuple(figures), metadata, none if share else NO_READING)
    ratio = scores.ratio.get("correlated", math.nan)
    close = f"{ratio:.2f} of the bound" if share and math.isfinite(ratio) else ""
    off = np.hypot(*(dead.pose - result.truth)[result.scored_rows, :2].T)
    dead_m = float(np.sqrt(np.mean(off**2)))
    expected = f"{scores.anees_low:.2f} to {scores.anees_high:.2f} if the covariance is right"
    figures += [
        Figure("position error, RMSE", scores.rmse_m, "m", note=close),
        Figure("position error, median", scores.median_m, "m"),
        Figure("position error, 95 %", scores.p95_m, "m"),
        Figure("position error, end", scores.end_m, "m"),
        Figure("heading error, RMSE", math.degrees(scores.heading_rad), "deg"),
        Figure("dead reckoning, RMSE", dead_m, "m", note=_dead_start(result)),
    ]
    if not share:
        return Report(title, tuple(figures), metadata, NO_READING)
    if scores.bound_m:
        figures += [
            Figure("bound", scores.bound_m["correlated"], "m", note="map error alike at nearby places"),
            Figure("bound, exact map", scores.bound_m["exact"], "m"),
        ]
    if math.isfinite(scores.anees):
        figures.append(Figure("ANEES per state", scores.anees, note=expected))
        figures.append(Figure("in the 90 % ellipse", scores.coverage, note="share of true positions"))
    if result.problem.prior.is_global and math.isfinite(scores.converged_s):
        figures.append(Figure("converged after", scores.converged_s, "s", note="errors count from then on"))
    figures += [
        Figure("flagged lost", scores.lost_share, note="share of the readings"),
        Figure("time a step", scores.step_us, "us"),
    ]
    few = f" Only {share:.0%} of the intervals have a reading of the field." if share < FEW else ""
    return Report(title, tuple(figures), metadata, verdict_of(scores, dead_m, _dead_start(result)) + few)


def _origin(run: Run) -> list[str]:
    return [f"{key} {run.metadata[key]}" for key in ("scene", "path", "seed") if key in run.metadata]


def _dead_start(result: Localization) -> str:
    known = all(map(math.isfinite, result.problem.prior.sd))
    return "" if known else "from the true start"


def thinned(run: Run, rate_hz: float) -> Run:
    """The newest reading between ticks of a slower clock, which starts at the first row of a run.

    If there is no reading of the field between two ticks, the latest row is taken.
    """
    ends = np.unique(np.searchsorted(run["t"], _ticks(run["t"], rate_hz) + 1e-9, side="right") - 1)
    return run.take(newest(ends, field_known(run)))


def _ticks(t: Array, rate_hz: float) -> Array:
    return np.asarray(t[0] + np.arange(int((t[-1] - t[0]) * rate_hz + 1e-9) + 1) / rate_hz)


def truth_of(run: Run) -> Array | None:
    """True x, y [m] and yaw [rad], else those of motion capture, shape (N, 3); None if unknown.

    A pose is nan where motion capture had lost the robot.
    """
    if _has_true_pose(run):
        pose = np.column_stack([run["p_world_base"][:, :2], run["yaw"]])
        captured = _is_captured(run)
    elif "mocap_p" in run and "mocap_q_xyzw" in run and np.isfinite(run["mocap_p"]).any():
        pose = np.column_stack([run["mocap_p"][:, :2], yaw_from_quat(run["mocap_q_xyzw"])])
        captured = True
    else:
        return None
    if captured and "flag_pose_lost" in run:
        pose[run["flag_pose_lost"]] = np.nan
    return pose


def truth_name(run: Run) -> str:
    """What `truth_of` gives: "true pose", or "pose of motion capture" with its column or topic."""
    if not _has_true_pose(run):
        return "pose of motion capture (mocap_p)"
    return f"pose of {run.metadata['truth']}" if _is_captured(run) else "true pose"


def _has_true_pose(run: Run) -> bool:
    return "p_world_base" in run and "yaw" in run and bool(np.isfinite(run["p_world_base"]).any())


def _is_captured(run: Run) -> bool:
    """Whether the true pose of a recorded run is that of motion capture, as its metadata say."""
    return str(run.metadata.get("truth", "")).startswith(("motion capture", "topic "))


def prior_of(run: Run, text: str = "tracking", *, seed: int = 0) -> Prior:
    """What is known of the pose at the first reading of a run.

    | text | position | heading |
    |---|---|---|
    | "tracking" | the true one with an error of 0.1 m sd each axis | the true one with an error of 5 deg sd |
    | "heading" | unknown | the true one with a uniform error within 10 deg |
    | "global" | unknown | unknown |
    | "x,y,yaw" | x, y [m], known to 0.1 m | yaw [rad], known to 5 deg |

    Args:
        run: The run, whose first true pose is used for "tracking" and "heading".
        text: One of the texts above.
        seed: Seed of the error.

    Raises:
        InputError: The text is none of these, or the run has no true pose.
    """
    if "," in text:
        try:
            x, y, yaw = map(float, text.split(","))
        except ValueError:
            x = y = yaw = math.nan
        if not all(map(math.isfinite, (x, y, yaw))):
            raise InputError(f"a `prior` is x,y,yaw [m, m, rad], got {text!r}", parameter="prior")
        return Prior(mean=(x, y, yaw), sd=START_SD)
    find("prior", text, dict.fromkeys(("tracking", "heading", "global", "x,y,yaw")))
    if text == "global":
        return Prior(sd=(math.inf, math.inf, math.inf))
    truth = truth_of(run)
    if truth is None or not np.isfinite(truth[0]).all():
        where = "" if truth is None else " at its first reading"
        raise InputError(
            f"the run has no true pose{where} to start from; give a `prior` x,y,yaw or global",
            parameter="prior",
        )
    rng = np.random.default_rng([seed, 1])
    if text == "heading":
        yaw = float(wrap_angle(truth[0, 2] + rng.uniform(-1, 1) * math.radians(10)))
        return Prior(mean=(0.0, 0.0, yaw), sd=(math.inf, math.inf, HEADING_WITHIN))
    x, y, yaw = (truth[0] + rng.normal(0, START_SD)).tolist()
    return Prior(mean=(x, y, float(wrap_angle(yaw))), sd=START_SD)


def lever_arm_of(run: Run) -> tuple[float, float]:
    """Place of the magnetometer in base_link from the metadata of a run; (0, 0) if it is unknown."""
    x, y, _ = numbers_in(run.metadata, "sensor_m", 3) or (0.0, 0.0, 0.0)
    by_tf = numbers_in(run.metadata, "tf_sensor_m", 3)
    if by_tf and "sensor_m" not in run.metadata and math.hypot(*by_tf[:2]) > APART_M:
        x, y, _ = by_tf  # as `magtwin.io.surveys.readings` places the readings of a map
    return x, y


def check_lever_arm(run: Run, lever_arm_m: tuple[float, float]) -> None:
    """Warn if /tf_static of a recording has the magnetometer at another place than the method is told."""
    x, y, _ = numbers_in(run.metadata, "tf_sensor_m", 3) or (*lever_arm_m, 0.0)
    if math.dist((x, y), lever_arm_m) > APART_M:
        told = ", ".join(f"{part:.3f}" for part in lever_arm_m)
        warnings.warn(
            f"/tf_static of the recording has the magnetometer at x, y = {x:.3f}, {y:.3f} m in base_link, "
            f"and the lever arm is {told} m; give --sensor lever_arm_m=[{x:.3f},{y:.3f}]",
            MismatchWarning,
            stacklevel=3,
        )


def extent_of(run: Run, belief: FieldBelief | None) -> tuple[float, float, float, float]:
    """Extent of a map; else that of the true poses, or of the odometry, with 1 m around it."""
    if isinstance(belief, AnomalyMap):
        return belief.extent
    p = run["p_world_base" if "p_world_base" in run else "odom_p"][:, :2]
    (x0, y0), (x1, y1) = np.nanmin(p, axis=0) - 1.0, np.nanmax(p, axis=0) + 1.0
    return float(x0), float(x1), float(y0), float(y1)


def check_map(run: Run, anomaly_map: AnomalyMap, file: Path) -> None:
    """Warn if a map is not the one of the run's scene, by the checksum in the run's metadata."""
    made, layer = str(run.metadata.get("map_sha256", "")), _layer_of(file)
    if anomaly_map.frame and not anomaly_map.frame.startswith("world"):
        warnings.warn(
            f"the map {anomaly_map.name!r} is in the frame {anomaly_map.frame!r}; poses are taken to be in "
            "that frame",
            MismatchWarning,
            stacklevel=3,
        )
    if made and layer is not None and sha256(layer) != made:
        theirs = f"{run.metadata.get('map', '')!r} of scene {run.metadata.get('scene', '')!r}"
        warnings.warn(
            f"{file}: map {anomaly_map.name!r} is not the map {theirs} that the run was made with; their "
            "difference adds to the errors",
            MismatchWarning,
            stacklevel=3,
        )


def check_on_map(run: Run, belief: FieldBelief, lever_arm_m: tuple[float, float] = (0.0, 0.0)) -> None:
    """Refuse a run most of whose readings are off the map; warn if some are.

    Raises:
        InputError: Less than half of the readings at known poses are on the map.
    """
    truth = truth_of(run)
    if truth is None:
        return
    known = np.isfinite(truth).all(axis=1)
    x, y, yaw = truth[known].T
    c, s, (along, left) = np.cos(yaw), np.sin(yaw), lever_arm_m
    p = np.column_stack([x + c * along - s * left, y + s * along + c * left])
    on_map = np.isfinite(np.asarray(belief.mean(p, yaw), float))
    share = float(on_map.mean()) if len(on_map) else 1.0
    if share < LEAST_ON_MAP:
        name = getattr(belief, "name", "") or "belief"
        where = f"x {x.min():.2f} to {x.max():.2f} m, y {y.min():.2f} to {y.max():.2f} m"
        extent = ""
        if isinstance(belief, AnomalyMap):
            x0, x1, y0, y1 = belief.extent
            extent = f", which covers x {x0:.2f} to {x1:.2f} m, y {y0:.2f} to {y1:.2f} m"
        raise InputError(
            f"the run is off the map: {share:.0%} of its readings, in {where}, are on map {name!r}{extent}; "
            "give the map of the run's place and frame"
        )
    if share < 1:
        text = f"{1 - share:.1%} of the run's readings are off the map or on masked nodes"
        warnings.warn(text, MismatchWarning, stacklevel=3)


def _layer_of(file: Path) -> Path | None:
    """The layer that holds the map of a file; None for a folder of CSVs, or a stage of several maps."""
    from magtwin.usd.maps.layer import layer_of_map

    return None if file.is_dir() else layer_of_map(file)
