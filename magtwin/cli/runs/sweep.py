"""`magtwin runs`: many seeded runs of a scene's robot into one folder, as a data set."""

import csv
import time
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from magtwin.cli.app import app
from magtwin.cli.options import Force, Json, Seed, Whole
from magtwin.cli.terminal import announce, print_report, progress, say

Names = Annotated[list[str] | None, Parameter(consume_multiple=True, negative="")]

MIXTURE = ("sine", "lawnmower", "figure8", "continuous_cycle", "random")
"""Default paths: a model that learns from one kind of path does not know the others."""

RUNS_A_SESSION = 5
"""Default number of runs in each session, as many as there are paths."""


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
    import numpy as np

    from magtwin.errors import InputError
    from magtwin.files import existing, output
    from magtwin.io.tables import write_parquet
    from magtwin.report import Figure, Report
    from magtwin.sim.motion.way import way_of
    from magtwin.sim.session import draw_speed
    from magtwin.twin import in_session, open_twin, room_of, simulate_many
    from magtwin.verdict import HOLDS, HOLDS_ONE, Tally

    existing(scene, "scene")
    for name, value, least in (("count", count, 1), ("sessions", sessions, 1), ("seed", seed, 0)):
        if value is not None and value < least:
            raise InputError(f"--{name} must be a whole number from {least} up, got {value}")
    if sessions is not None and session is not None:
        raise InputError("--session survey is one session; drop --sessions")
    for name in path or MIXTURE:
        way_of(name)  # refuses a name or file that is none before the scene is opened
    steps = announce
    with output(out, force=force) as folder:
        steps("Opening the scene")
        twin = open_twin(scene, net=net, magnetometer=magnetometer, model_error=model_error)
        paths = [way_of(name, room_of(twin), fit=fit) for name in path or MIXTURE]
        robot = twin.scene.robot
        if session is not None:
            drawn = [in_session(twin, session)]
        else:
            most = min(sessions or max(1, round(count / RUNS_A_SESSION)), count)
            drawn = [in_session(twin, k, seed=seed) for k in range(most)]
        of_run = [drawn[k * len(drawn) // count] for k in range(count)]
        speeds = [0.2 if speed is None else speed] * count
        if session is None and speed is None:
            draws = np.random.default_rng((seed, 1)).spawn(2)[1]  # which no run draws from
            speeds = [draw_speed(robot.drive, rng) for rng in draws.spawn(count)]
        steps(f"Driving {count} runs")
        made = simulate_many(
            twin,
            [paths[k % len(paths)] for k in range(count)],
            range(seed, seed + count),
            speeds=speeds,
            robots=of_run,
            columns=columns,
            duration_s=duration,
            rate_hz=rate_hz,
            lidar=lidar,
            outside=outside,
        )
        folder.mkdir()
        tally = Tally()
        readings, seconds, start = 0, 0.0, time.monotonic()
        with (
            progress("Driving", "runs") as advance,
            open(folder / "runs.csv", "w", encoding="utf-8", newline="") as listing,
        ):
            table: Any = csv.writer(listing, lineterminator="\n")
            table.writerow(("file", "path", "seed", "session", "speed_m_s", "readings"))
            advance(0, count)
            for k, run in enumerate(made):
                file = f"run_{k:05d}.parquet"
                write_parquet(run, folder / file)
                run.add_to(tally)
                listed = (run.metadata[name] for name in ("path", "seed", "session", "speed_m_s"))
                table.writerow((file, *listed, run.rows))
                readings, seconds = readings + run.rows, seconds + float(run.metadata["duration_s"])
                advance(k + 1, count)
    took = time.monotonic() - start
    report = Report(
        f"{count} runs in {scene}",
        (
            Figure("runs", count),
            Figure("readings", readings),
            Figure("driven", seconds, "s"),
            Figure("took", round(took, 3), "s"),
            Figure("rate", count / took, "runs/s"),
        ),
        {
            "paths": ", ".join(getattr(one, "name", "random") for one in paths),
            "sessions": session or len(drawn),
        },
        tally.verdict(
            f"the exact field of {count} runs in {len(drawn)} sessions",
            holds=HOLDS_ONE if len(drawn) == 1 else HOLDS,
        ),
    )
    print_report(report, json)
    if not json:
        say(f"Wrote {out}")
