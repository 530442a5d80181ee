"""`magtwin localize` and `magtwin ros localize`: estimate the pose along a run, or live."""

import json
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from magtwin.cli import options as opt
from magtwin.cli.app import app
from magtwin.cli.ros import HERE, FramePrefix, WallS, Where, ros_app, spin
from magtwin.cli.terminal import Done, announce, named, progress, step
from magtwin.errors import InputError, hint


@app.command
@opt.reads_recordings
def localize(
    run: opt.AnyRun,
    *,
    map: str,  # noqa: A002 - the option is called --map
    method: opt.Method = "rbpf-iron",
    option: opt.OptionsOf = None,
    out: opt.Folder = Path("localized"),
    prior: str = "tracking",
    rate_hz: float = 5.0,
    sensor: opt.Sensor = None,
    odometry: opt.Odometry = None,
    map_length_m: opt.MapLength = 0.3,
    compensator: str = "none",
    calibration: Path | None = None,
    seed: opt.Seed = 0,
    force: opt.Force = False,
) -> Done:
    """Localize a robot along a run by its magnetometer and odometry, and score the estimate.

    The method gets only the on-board columns, one row after another. The output is a folder with run.parquet
    (the readings with the columns est_*), localize.rrd, localize.png, and estimate.tum and truth.tum for evo.
    docs/localize.md lists the methods and shows how to write one. `magtwin new localizer.py` writes one to
    start from.

    Parameters
    ----------
    map
        Map layer, stage, folder of survey CSVs, or the name of a scene that ships with magtwin (lab). none:
        no map, for the methods of simultaneous localization and mapping, such as incremental-slam.
    prior
        Start that the method is told: tracking (the true pose with errors of 0.1 m and 5 deg), heading (the
        heading within 10 deg; no position), global (nothing), or a pose x,y,yaw [m, m, rad]. For a negative
        x, write --prior=-1,0,0.
    rate_hz
        Readings per second that the method gets [Hz].
    compensator
        Model of the robot's own field, whose prediction the method rbpf-network uses: none; iron,
        fitted to --calibration; or the weights of a trained network (.safetensors, .pth).
    calibration
        Earlier run of the same session, with true poses.
    """
    from magtwin.figures.localization import save_localization
    from magtwin.io.formats import read_run
    from magtwin.localization.problem import OdometryModel, SensorModel
    from magtwin.tasks.localizing import ROBOT_NOISE, lever_arm_of, localization

    step(f"Reading {run}")
    whole = read_run(run)
    told = _values("sensor", sensor, SensorModel)
    out = named(out, force=force)
    with progress("Localizing", "readings") as advance:
        noise: Any = {
            "sensor": replace(ROBOT_NOISE, **{"lever_arm_m": lever_arm_of(whole), **told}),
            "odometry": OdometryModel(**_values("odometry", odometry, OdometryModel)),
            "map_length_m": map_length_m,
        }
        how: Any = {"method": method, "options": _values("option", option), "prior": prior, "seed": seed}
        how |= {"compensator": compensator, "calibration": calibration, "rate_hz": rate_hz}
        on = None if map == "none" else map
        result = localization(whole, on, keep_particles=True, progress=advance, **noise, **how)
    step("Writing the estimate")
    save_localization(result, out, force=force)
    errors = ("position error, RMSE", "heading error, RMSE", "dead reckoning, RMSE")
    look, rest = ("magtwin", "view", out / "localize.rrd"), f"magtwin info {out / 'run.parquet'}"
    return Done(result.report(), out, (*errors, "ANEES per state", "bound"), rest=rest, next=(look,))


@ros_app.command(name="localize", usage="Usage: magtwin ros localize [OPTIONS] SCENE [SETTING...]")
def localize_live(
    scene: opt.Scene,
    *settings: str,
    where: Where = HERE,
    method: opt.Method = "rbpf-iron",
    option: opt.OptionsOf = None,
    map: str | None = None,  # noqa: A002
    sensor: opt.Sensor = None,
    odometry: opt.Odometry = None,
    map_length_m: opt.MapLength = 0.3,
    seed: opt.Seed = 0,
    frame_prefix: FramePrefix = None,
    duration_s: WallS = None,
) -> Done:
    """Localize a robot live by its magnetometer and odometry, with any causal method of `magtwin localize`.

    The node needs qtfm/magnitude and odom; it passes IMU, battery, commands and scans on to the method. It
    publishes estimate/pose (PoseWithCovarianceStamped), estimate/lost (Bool), estimate/particles (PoseArray),
    estimate/path (Path), the transform from map to odom, and /diagnostics. It starts again at each pose on
    /initialpose.

    Settings have the form of ROS, name:=value: rate_hz (5), use_sim_time (false), prior (wait, global or
    x,y,yaw; default wait), max_age_s (0.5), stamps (header, arrival), silent_s (0.5), tf_broadcast
    (true), tf_ahead_s (0.2), cloud_hz (1), particles (500). docs/localize.md explains them.

    Parameters
    ----------
    settings
        Settings, such as prior:=global use_sim_time:=true.
    map
        Map to use instead of the scene's, as for `magtwin localize`. none: no map.
    """
    from magtwin.localization.problem import OdometryModel, SensorModel
    from magtwin.ros.localization.localize import PARAMETERS, LocalizerNode
    from magtwin.ros.parameters import settings as settings_of
    from magtwin.tasks.localizing import live_problem
    from magtwin.twin import open_twin

    values = settings_of(PARAMETERS, settings)
    announce(f"opening {scene}")
    twin = open_twin(scene, magnetometer="map-only")
    told: Any = {"sensor": _values("sensor", sensor, SensorModel), "map_length_m": map_length_m}
    told["odometry"] = OdometryModel(**_values("odometry", odometry, OdometryModel))
    problem = live_problem(twin, map, seed=seed, **told)
    options: Any = {"method": method, "options": _values("option", option), "problem": problem}
    with where.bus("magtwin_localize", sim_time=values["use_sim_time"], duration_s=duration_s) as bus:
        LocalizerNode(twin, bus, values, frame_prefix=frame_prefix or "", say=announce, **options)
        announce(f"localizing by {bus.backend}; Ctrl-C ends")
        spin(bus, duration_s)
    return Done()


def _values(option: str, texts: list[str] | None, model: Any = None) -> dict[str, Any]:
    """NAME=VALUE texts with numbers, true, false and lists as in JSON; other values are texts."""
    values: dict[str, Any] = {}
    for name, text in opt.pairs(option, texts).items():
        try:
            value = json.loads(text)
        except ValueError:
            value = text
        values[name] = tuple(value) if isinstance(value, list) else value
    known = () if model is None else [field.name for field in fields(model)]
    for name, value in values.items() if model is not None else ():
        if name not in known:
            raise InputError(f"--{option} has no {name!r}; {hint(name, known)}")
        arm = name == "lever_arm_m"
        parts = value if arm and isinstance(value, tuple) else (value,)
        numbers = all(isinstance(part, int | float) and not isinstance(part, bool) for part in parts)
        if not numbers or (arm and len(parts) != 2):
            form = "two numbers [m], such as [0.1,0]," if arm else "a number,"
            raise InputError(f"--{option} {name} is {form} got {value!r}")
    if model is not None:
        try:
            model(**values)
        except InputError as error:
            raise InputError(f"--{option} {error}") from error
    return values
