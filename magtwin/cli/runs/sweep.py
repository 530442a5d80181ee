"""`magtwin sweep`."""

from pathlib import Path
from typing import Any

from magtwin.cli import options as opt
from magtwin.cli.app import app
from magtwin.cli.settings import SWEEP, SweepOptions
from magtwin.cli.terminal import Done, continued_by_a_repeat, named, progress, step
from magtwin.errors import InputError

RUNS_A_SESSION = 5
"""Default number of runs per session: one for each default path."""


@app.command
def sweep(
    scene: opt.Scene,
    *,
    out: opt.Folder = Path("runs"),
    count: opt.Whole = 100,
    path: opt.Names = None,
    fit: opt.Flag = False,
    map_layer: opt.MapLayer = None,
    magnetometer: opt.Magnetometer = None,
    plant: opt.Plant = None,
    seed: opt.Seed = 0,
    sessions: opt.Sessions = None,
    duration_s: float | None = None,
    rate_hz: opt.RateHz = None,
    jobs: opt.Jobs = None,
    shard: opt.Shard = None,
    dask: opt.Dask = None,
    settings: SweepOptions = SWEEP,
    force: opt.Force = False,
) -> Done:
    """Drive a scene's robot many times and write a data set: one Parquet file per run, and runs.csv.

    Run k, in run_00000.parquet and so on, has the seed SEED + k and drives the next path in turn. runs.csv
    lists file, path, seed, session, speed and readings. In a scene of several robots the first one drives,
    alone.

    With --jobs, --shard or --dask, other processes make the runs; the files are the same. Until all are there
    they are in OUT.parts, and the same command continues an interrupted sweep.

    Rarer settings, such as speed and keep (the columns to write), are keys of [sweep] in magtwin.toml:
    docs/runs.md.

    Parameters
    ----------
    count
        Number of runs.
    path
        Paths to drive in turn, as for `magtwin run`: names, cases A to E, random, CSV files, runs.
        Default: sine, lawnmower, figure8, continuous_cycle and random.
    fit
        Move and shrink each path until it fits the floor and its obstacles.
    sessions
        Number of sessions. Each has its own charge, IMU offsets, wheels, odometry and robot field, and an
        equal share of the runs, one after the other. survey: drive the robot as it was during the survey of
        the map, in every run. Default: one for every 5 runs.
    duration_s
        Length of each run [s]; more than once along the path gives further laps. Default: once along it.
    jobs
        Number of processes. Default: one, with several threads.
    """
    from magtwin.files.kinds import scene_file
    from magtwin.io.outputs import driven_by
    from magtwin.parallel import parse_shard
    from magtwin.sim.motion.drive_input import check_path, drive_input
    from magtwin.sim.runs.simulate import check_asked
    from magtwin.twin import MIXTURE, open_twin, room_of
    from magtwin.twin import sweep as drive_many
    from magtwin.twin.sweeps import check_count

    scene, speed = scene_file(scene), settings.speed
    for name, value, least in (
        ("count", count, 1),
        ("sessions", 1 if sessions == "survey" else sessions, 1),
        ("seed", seed, 0),
        ("jobs", jobs, 1),
    ):
        if value is not None and value < least:
            raise InputError(f"--{name} must be a whole number from {least} up, got {value}")
    check_count(count)
    check_asked(duration_s, rate_hz, 0.2 if speed is None else speed)
    paths = [driven_by(name) for name in path or MIXTURE]
    for what in paths:
        check_path(what)
    part = None if shard is None else parse_shard(shard)
    out = out if part else named(out, force=force)  # shards share one folder
    step("Opening the scene")
    opened = {name: getattr(settings, name) for name in ("lab", "network", "model_error", "tracking_error")}
    twin = open_twin(scene, map_layer=map_layer, magnetometer=magnetometer, **opened)
    ways = [drive_input(what, room_of(twin), fit=fit) for what in paths]
    how: Any = {"seed": seed, "plant": plant, "duration_s": duration_s, "rate_hz": rate_hz}
    how |= {"columns": settings.keep, "lidar": settings.lidar, "outside": settings.outside}
    how["sessions"] = sessions or max(1, round(count / RUNS_A_SESSION))
    how["speeds"] = speed if speed is not None else 0.2 if sessions == "survey" else "drawn"
    runs = drive_many(twin, ways, count, **how)
    kept = jobs is not None or part is not None or dask is not None
    with continued_by_a_repeat(when=kept), progress("Driving", "runs") as advance:
        made = runs.save(out, force=force, jobs=jobs, shard=part, dask=dask, progress=advance)
    if not out.exists():
        return Done(made, Path(f"{out}.parts"), text="parts; the other shards complete them")
    build = ("magtwin", "dataset", "build", out, "--map", scene, "--out", "set")
    return Done(made, out, next=(build, ("magtwin", "report", out)))
