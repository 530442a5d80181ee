"""Drive the robots of a stage in NVIDIA's PhysX: whether they stand, drive a metre and turn.

PhysX runs in another process, of another Python: `make physx` makes an environment for it, and
`MAGTWIN_PHYSX` is the path of its Python.
"""

import math
import os
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from physx_robots import AHEAD_M, driven_table
from pxr import Usd

from magtwin.errors import InputError
from magtwin.export.validation.findings import Check, Finding
from magtwin.files.children import run
from magtwin.sim.engines.world_process import WorldProcess

PHYSX = "MAGTWIN_PHYSX"
"""Environment variable with the path of a Python that has ovphysx."""

GET_PHYSX = f"ovphysx is not installed; `make physx` installs it, {PHYSX} is the path of its Python"

OTHER_PYTHON = {"PYTHONPATH": None}
"""What differs in the environment of a Python that need not be this one."""

LIMIT_S = 300.0
"""Time limit for one robot [s]."""

STEP_S = 1 / 120
"""Length of a physics step [s]."""

SPEED_M_S, RATE_RAD_S = 0.2, 1.0
"""Speeds that are commanded [m/s, rad/s], if the drive allows them."""

REST_S, TURN_RAD, STOP_S = 5.0, math.pi, 0.5
"""Time at rest [s], angle of the turn [rad], and time in which the robot stops [s]."""

MOST_MOVED_M, MOST_SUNK_M, LEAST_UPRIGHT = 0.002, 0.005, 0.999
"""A robot at rest moves and sinks or rises by less [m], and the cosine of its tilt is above."""

AHEAD_SHARE, TURN_SHARE = 0.02, 0.03
"""Largest relative error of a distance and of an angle."""

ASIDE_M = 0.08
"""Most that a robot leaves its line, or its place in a turn [m]."""

WIDER = 1.5
"""Radius of a car's turn over the smallest one."""

ADVICE = "look at the colliders of its wheels and of the floor, at their friction, and at its drives"

ROOM = """#usda 1.0
(
    metersPerUnit = 1
    subLayers = [@{stage}@]
    upAxis = "Z"
)
"""
SCENE = """
def PhysicsScene "MagtwinPhysicsScene"
{
}
"""
GROUND = """
def Plane "MagtwinGround" (
    prepend apiSchemas = ["PhysicsCollisionAPI", "MaterialBindingAPI", "PhysicsMaterialAPI"]
)
{{
    uniform token axis = "Z"
    uniform token purpose = "guide"
    double3 xformOp:translate = (0, 0, {height})
    uniform token[] xformOpOrder = ["xformOp:translate"]
}}
"""


def physx(file: Path) -> Check:
    """Drive each robot of a stage.

    Args:
        file: The stage. A robot without a ground is put on a plane.

    Returns:
        Three findings for each robot: `stands`, `drives` and `turns`. They are notes, or errors if they fail.
    """
    python, version = find_python()
    if not python:
        return Check("physx", not_run=GET_PHYSX)
    driven = driven_table(Usd.Stage.Open(str(file)))
    robots = driven["robots"]
    if not robots:
        return Check("physx", not_run="the stage has no robot with a drive")
    findings: list[Finding] = []
    with on_ground(file, driven) as stage:
        for robot in robots:
            job = {key: robot[key] for key in ("base", "joints", "sides", "senses", "start")}
            try:
                with open_world(python, stage, job) as world:
                    findings += [f(world, robot) for f in (_stands, _drives, _turns)]
            except InputError as error:
                findings.append(
                    Finding("unfinished", str(error).replace(str(stage), str(file)), robot["prim"])
                )
    count = f"{len(robots)} robot{'s' * (len(robots) > 1)}"
    return Check("physx", tuple(findings), scope=f"ovphysx {version}: {count} at {1 / STEP_S:g} steps/s")


def find_python() -> tuple[str, str]:
    """Path of a Python that has ovphysx, and the version of ovphysx; empty if there is none."""
    python = os.environ.get(PHYSX) or sys.executable
    code = (
        "from importlib.metadata import version as v;"
        "v('newton-usd-schemas'), v('physx-usd-schemas'), v('ovstage'); print(v('ovphysx'))"
    )
    try:
        done = run([python, "-c", code], limit_s=LIMIT_S, changes=OTHER_PYTHON)
    except OSError:
        return "", ""
    return (python, done.stdout.strip()) if done.returncode == 0 else ("", "")


def open_world(python: str, stage: Path, job: Mapping[str, Any]) -> WorldProcess:
    """A process with a stage in PhysX; `physx_world` describes the job."""
    script = str(Path(__file__).with_name("physx_world.py"))
    whole = {**job, "stage": str(stage.resolve()), "step_s": job.get("step_s", STEP_S)}
    return WorldProcess([python, script], whole, "PhysX", changes=OTHER_PYTHON, limit_s=LIMIT_S)


@contextmanager
def on_ground(file: Path, driven: Mapping[str, Any]) -> Iterator[Path]:
    """The stage itself, or one with a ground below the wheels of its robots."""
    if driven["ground"]:
        yield file
        return
    height = min((robot["lowest_m"] for robot in driven["robots"]), default=0.0)
    with tempfile.TemporaryDirectory() as folder:
        room = Path(folder, "room.usda")
        room.write_text(room_text(file, height, scene=not driven["scene"]), encoding="utf-8")
        yield room


def room_text(stage: Path, height: float | None, *, scene: bool) -> str:
    """A layer with a robot's stage in a room.

    Args:
        stage: The robot's asset.
        height: Height of the ground [m]; None adds no ground.
        scene: Whether to add a physics scene.
    """
    text = ROOM.format(stage=stage.resolve().as_posix()) + (SCENE if scene else "")
    return text if height is None else text + GROUND.format(height=height)


def _stands(world: WorldProcess, robot: Mapping[str, Any]) -> Finding:
    """Whether a robot stays where it is, at the height at which it is on the stage."""
    before = world.seen()
    after = world.ask(_steps(REST_S, 0.0, 0.0))
    moved, sunk = math.dist(before[:2], after[:2]), after[7] - robot["height_m"]
    good = moved < MOST_MOVED_M and abs(sunk) < MOST_SUNK_M and after[8] > LEAST_UPRIGHT
    tilt = math.degrees(math.acos(min(1.0, after[8])))
    text = (
        f"at rest for {REST_S:g} s it moved {1e3 * moved:.2f} mm and its height changed by "
        f"{1e3 * sunk:.2f} mm; tilt {tilt:.1f} deg"
    )
    return _finding("stands", text, robot, good)


def _drives(world: WorldProcess, robot: Mapping[str, Any]) -> Finding:
    """Whether a robot goes as far as its wheels turn."""
    x, y, yaw, *_ = world.ask(robot["start"])
    speed = min(SPEED_M_S, robot["v_max"])
    rate = speed / robot["wheel_radius_m"]
    world.ask(_steps(AHEAD_M / speed, rate, rate))
    end = world.ask(_steps(STOP_S, 0.0, 0.0))
    ahead = (end[0] - x) * math.cos(yaw) + (end[1] - y) * math.sin(yaw)
    aside = abs((end[1] - y) * math.cos(yaw) - (end[0] - x) * math.sin(yaw))
    text = f"went {ahead:.3f} m of {AHEAD_M:g} m at {speed:g} m/s, {1e3 * aside:.1f} mm to a side"
    return _finding("drives", text, robot, abs(ahead / AHEAD_M - 1) < AHEAD_SHARE and aside < ASIDE_M)


def _turns(world: WorldProcess, robot: Mapping[str, Any]) -> Finding:
    """Whether a robot turns in place as much as its wheels turn; a car, on a circle by its steering."""
    last = world.ask(robot["start"])
    start, turned, w, ahead = last, 0.0, min(RATE_RAD_S, robot["w_max"]), 0.0
    if robot["steers"]:
        circle = WIDER * robot["turning_radius_m"]
        ahead = min(SPEED_M_S, robot["v_max"])
        w = ahead / circle
        world.ask({path: sense * math.atan2(x, circle - y) for path, x, y, sense in robot["steers"]})
        last = world.ask(_steps(2 * STOP_S, 0.0, 0.0))
    apart = w * robot["wheel_separation_m"] / 2
    rates = [(ahead + side * apart) / robot["wheel_radius_m"] for side in (-1, 1)]
    seconds, parts = TURN_RAD / w, 8 * math.ceil(TURN_RAD / w * max(map(abs, rates)) / 80)
    for part in range(parts + 1):
        left = _steps(seconds / parts, *rates) if part < parts else _steps(STOP_S, 0.0, 0.0)
        seen = world.ask(left)
        turned += (seen[2] - last[2] + math.pi) % math.tau - math.pi
        last = seen
    moved, share = math.dist(_axle(start, robot), _axle(last, robot)), turned / TURN_RAD
    if robot["steers"]:
        moved -= 2 * circle
    room = ASIDE_M + 0.1 * ahead / w  # a car ends on the other side of its circle
    text = f"turned {turned:.3f} rad of {TURN_RAD:.3f} rad at {w:g} rad/s, and moved {1e3 * moved:.1f} mm"
    if not (robot["turns"] or robot["steers"]):  # its wheels scrub, by how much depends on the floor
        return _finding("turns", f"{text}; its wheels scrub as it turns", robot, good=True)
    return _finding("turns", text, robot, abs(share - 1) < TURN_SHARE and abs(moved) < room)


def _axle(seen: list[float], robot: Mapping[str, Any]) -> tuple[float, float]:
    """Where the middle of the axle is [m]."""
    c, s, (x, y) = math.cos(seen[2]), math.sin(seen[2]), robot["axle"]
    return seen[0] + c * x - s * y, seen[1] + s * x + c * y


def _steps(seconds: float, left: float, right: float) -> list[list[float]]:
    """The rates of both wheels [rad/s] for each physics step of a time."""
    return [[left, right]] * round(seconds / STEP_S)


def _finding(rule: str, text: str, robot: Mapping[str, Any], good: bool) -> Finding:
    where = robot["prim"]
    return Finding(rule, text, where, "" if good else ADVICE, "note" if good else "error")
