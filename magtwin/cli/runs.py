"""`magtwin runs`: many seeded runs of a scene's robot into one folder, as a data set."""

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from magtwin.cli.app import app
from magtwin.cli.terminal import Force, Json, Seed, Whole, announcer, print_report, progress, say
from magtwin.errors import InputError

Names = Annotated[list[str] | None, Parameter(consume_multiple=True, negative="")]

RUNS_A_SESSION = 5
"""Default number of runs per session: one for each default path."""


@app.command
def runs(
    scene: Path,
    *,
    out: Path = Path("runs"),
    count: Whole = 100,
    path: Names = None,
    fit: Annotated[bool, Parameter(negative="")] = False,
    seed: Seed = 0,
    sessions: Whole | None = None,
    session: Literal["survey"] | None = None,
    speed: float | None = None,
    duration: float | None = None,
    rate_hz: float | None = None,
    columns: Names = None,
    net: Path | None = None,
    magnetometer: Literal["physical", "neural", "map-only"] | None = None,
    model_error: bool = True,
    lidar: Literal["schedule", "on", "off"] = "schedule",
    outside: Literal["nan", "clamp", "raise"] = "nan",
    force: Force = False,
    json: Json = False,
) -> None:
    """Drive a scene's robot many times and write a data set: a Parquet file a run, and a list of them.

    Run k, in run_00000.parquet and so on, has the seed SEED + k and drives the next path in turn. runs.csv
    lists file, path, seed, session, speed and readings. In a scene of several robots the first one drives,
    alone.

    Parameters
    ----------
    scene
        USD stage to drive in.
    out
        Folder to make.
    count
        How many runs.
    path
        Paths to drive in turn, as for `magtwin run`: names, cases A to E, random, CSV files. Default: sine,
        lawnmower, figure8, continuous_cycle and random.
    fit
        As for `magtwin run`.
    seed
        Seed of the first run; each next one's is one more.
    sessions
        Number of sessions. In each, charge, IMU zero, wheels, odometry and the robot's own field are drawn
        from the seed; each takes as many runs, one after the other. Default: one for every 5 runs.
    session
        "survey" drives the robot as it was when the map was surveyed, in every run.
    speed
        Forward speed where the path is straight [m/s]. Default: drawn for each run from 0.2 to 0.3; 0.2 with
        --session survey.
    duration
        How long each run is [s]; once along its path unless given, longer gives further laps.
    rate_hz
        Magnetometer readings a second [Hz]; the scene's unless given.
    columns
        Columns to keep beside t; all unless given.
    net
        As for `magtwin run`.
    magnetometer
        As for `magtwin run`.
    model_error
        As for `magtwin run`.
    lidar
        Whether the LiDAR follows its schedule, or stays on or off.
    outside
        What the map reads outside its extent: nan, the nearest value inside, or a refusal.
    force
        Replace the folder if it exists.
    json
        Print the summary as JSON.
    """
    from magtwin.files import check_free, existing
    from magtwin.sim.motion.way import way_of
    from magtwin.twin import MIXTURE, open_twin, room_of, sweep

    existing(scene, "scene")
    for name, value, least in (("count", count, 1), ("sessions", sessions, 1), ("seed", seed, 0)):
        if value is not None and value < least:
            raise InputError(f"--{name} must be a whole number from {least} up, got {value}")
    if sessions is not None and session is not None:
        raise InputError("--session survey is one session; drop --sessions")
    check_free(out, force=force)
    for name in path or MIXTURE:
        way_of(name)  # refuses a wrong name before the scene is opened
    steps = announcer(quiet=json)
    steps("Opening the scene")
    twin = open_twin(scene, network=net, magnetometer=magnetometer, model_error=model_error)
    steps(f"Driving {count} runs")
    made = sweep(
        twin,
        [way_of(name, room_of(twin), fit=fit) for name in path or MIXTURE],
        count,
        seed=seed,
        sessions=session or sessions or max(1, round(count / RUNS_A_SESSION)),
        speeds=speed if speed is not None else 0.2 if session else "drawn",
        columns=columns,
        duration_s=duration,
        rate_hz=rate_hz,
        lidar=lidar,
        outside=outside,
    )
    with progress("Driving", "runs") as advance:
        report = made.save(out, force=force, progress=advance)
    print_report(report, json)
    if not json:
        say(f"Wrote {out}")
