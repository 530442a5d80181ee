"""`magtwin sweep`."""

from pathlib import Path
from typing import Literal

from magtwin.cli.app import app
from magtwin.cli.options import (
    SENSING,
    Dask,
    Flag,
    Force,
    Jobs,
    Lab,
    MapLayer,
    Names,
    Plant,
    Seed,
    SensingOptions,
    Shard,
    Whole,
)
from magtwin.cli.terminal import Done, announce, continued_by_a_repeat, progress
from magtwin.errors import InputError

RUNS_A_SESSION = 5
"""Default number of runs per session: one for each default path."""


@app.command
def sweep(
    scene: Path,
    *,
    out: Path = Path("runs"),
    count: Whole = 100,
    path: Names = None,
    fit: Flag = False,
    lab: Lab = "",
    map_layer: MapLayer = None,
    seed: Seed = 0,
    sessions: Whole | None = None,
    session: Literal["survey"] | None = None,
    plant: Plant = None,
    speed: float | None = None,
    duration_s: float | None = None,
    keep: Names = None,
    jobs: Jobs = None,
    shard: Shard = None,
    dask: Dask = None,
    sensing: SensingOptions = SENSING,
    force: Force = False,
) -> Done:
    """Drive a scene's robot many times and write a data set: one Parquet file per run, and runs.csv.

    Run k, in run_00000.parquet and so on, has the seed SEED + k and drives the next path in turn. runs.csv
    lists file, path, seed, session, speed and readings. In a scene of several robots the first one drives,
    alone.

    With --jobs, --shard or --dask, other processes make the runs; the files are the same. Until all are there
    they are in OUT.parts, and the same command continues an interrupted sweep.

    Parameters
    ----------
    scene
        USD stage to drive in, or the name of a scene that ships with magtwin: lab.
    out
        Folder to make.
    count
        Number of runs.
    path
        Paths to drive in turn, as for `magtwin run`: names, cases A to E, random, CSV files. Default: sine,
        lawnmower, figure8, continuous_cycle and random.
    fit
        Move and shrink each path until it fits the floor and its obstacles.
    sessions
        Number of sessions. Each has its own charge, IMU offsets, wheels, odometry and robot field, and an
        equal share of the runs, one after the other. Default: one for every 5 runs.
    session
        survey: drive the robot as it was during the survey of the map, in every run.
    speed
        Forward speed on straight parts [m/s]. Default: drawn for each run from 0.2 to 0.3; 0.2 with
        --session survey.
    duration_s
        Length of each run [s]; more than once along the path gives further laps. Default: once along it.
    keep
        Columns to write beside t. Default: all.
    jobs
        Number of processes. Default: one, with several threads.
    """
    from magtwin.files.kinds import scene_file
    from magtwin.files.outputs import check_free
    from magtwin.parallel import parse_shard
    from magtwin.sim.motion.drive_input import drive_input
    from magtwin.sim.runs.simulate import check_asked
    from magtwin.twin import MIXTURE, open_twin, room_of
    from magtwin.twin import sweep as drive_many
    from magtwin.twin.sweeps import check_count

    scene = scene_file(scene)
    for name, value, least in (
        ("count", count, 1),
        ("sessions", sessions, 1),
        ("seed", seed, 0),
        ("jobs", jobs, 1),
    ):
        if value is not None and value < least:
            raise InputError(f"--{name} must be a whole number from {least} up, got {value}")
    check_count(count)
    check_asked(duration_s, sensing.rate_hz, 0.2 if speed is None else speed)
    if sessions is not None and session is not None:
        raise InputError("--session survey is one session; drop --sessions")
    check_free(out, force=force)
    for name in path or MIXTURE:
        drive_input(name)  # refuses a wrong name before the scene is opened
    announce("Opening the scene")
    options = vars(sensing).copy()
    opening = {
        name: options.pop(name) for name in ("network", "magnetometer", "model_error", "tracking_error")
    }
    twin = open_twin(scene, lab=lab, map_layer=map_layer, **opening)
    announce(f"Driving {count} runs")
    runs = drive_many(
        twin,
        [drive_input(name, room_of(twin), fit=fit) for name in path or MIXTURE],
        count,
        seed=seed,
        sessions=session or sessions or max(1, round(count / RUNS_A_SESSION)),
        plant=plant,
        speeds=speed if speed is not None else 0.2 if session else "drawn",
        columns=keep,
        duration_s=duration_s,
        **options,
    )
    part = None if shard is None else parse_shard(shard)
    kept = jobs is not None or part is not None or dask is not None
    with continued_by_a_repeat(when=kept), progress("Driving", "runs") as advance:
        made = runs.save(out, force=force, jobs=jobs, shard=part, dask=dask, progress=advance)
    return Done(made, out if out.exists() else Path(f"{out}.parts"))
