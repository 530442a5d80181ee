"""The robots of a stage that PhysX drives: their prims, and where each has room for it."""

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from pxr import Gf, Usd, UsdGeom, UsdPhysics

from magtwin.author.shape import drive_of, footprint_of, sense_of, solid_box, wheels_of
from magtwin.spec.drive import DriveSpec
from magtwin.spec.obstacles import Obstacles
from magtwin.usd.attributes import targets
from magtwin.usd.geometry import BASE_LINK, axis_of
from magtwin.usd.lab.obstacles import read_obstacles
from magtwin.usd.schema import attribute_name, has_api
from magtwin.usd.sensors import JOINT_FIELDS, WHEELS_FIELDS, joints_of, read_drive

ROBOT_API = "IsaacRobotAPI"
"""Isaac Sim's applied schema of a robot."""

AHEAD_M = 1.0
"""Distance that a robot drives straight [m]."""

MARGIN_M = 0.05
"""Free space around the footprint [m]."""

FAR_M, SPACING_M, HEADINGS = 10.0, 0.25, 12
"""Places to look for room: up to this distance from the robot, on a grid, in this number of directions."""


Steer = tuple[str, float, float, int]
"""A joint that steers."""


@dataclass(frozen=True)
class DrivenRobot:
    """A robot with a differential drive on a stage."""

    prim: str
    base: str
    """Path of its base, a rigid body."""

    joints: tuple[str, ...]
    """Paths of the joints of the left and the right wheel, then of further driven wheels."""

    sides: tuple[int, ...]
    """Side of each: 0 for left, 1 for right."""

    senses: tuple[int, ...]
    """-1 for each wheel that rolls backward as its joint's angle grows, else 1."""

    turns: bool
    """Whether it turns on the spot without scrubbing: two wheels that are not steered."""

    axle: tuple[float, float]
    """Middle of the driven wheels in the base's axes [m]."""

    steers: tuple[Steer, ...]
    """Joints that steer: path, place ahead and left of `axle` [m], and -1 if the axis points down."""

    turning_radius_m: float

    start: tuple[float, float, float]
    """x [m], y [m] and yaw [rad] of its base: at the robot if there is room for `AHEAD_M`, or near it."""

    height_m: float
    """Height of its base [m]."""

    lowest_m: float
    """Height of the lowest point of its enabled colliders [m]."""

    wheel_radius_m: float
    wheel_separation_m: float
    v_max: float
    w_max: float


def read_driven(stage: Usd.Stage) -> list[DrivenRobot]:
    """The robots of a stage with two driven wheels, in order of their prims.

    The wheels of a robot without a drive of magtwin's schema are the only two that mirror each other.

    Raises:
        InputError: A drive is incomplete.
    """
    found = []
    drives = {}
    for prim in stage.Traverse():
        if ROBOT_API in prim.GetPrimTypeInfo().GetAppliedAPISchemas() or has_api(prim, "drive"):
            drive = _drive(prim)
            if drive is not None:
                drives[prim] = drive
    obstacles = read_obstacles(stage) if drives else Obstacles()
    bases = {prim: _base(prim) for prim in drives}
    places = {prim: _pose(base) for prim, base in bases.items()}
    for prim, base in bases.items():
        spec, joints = drives[prim]
        others = np.array([pose[:2] for other, pose in places.items() if other != prim]).reshape(-1, 2)
        height = _height(base)
        middle = np.mean([_place(stage.GetPrimAtPath(joint), base) for joint in joints], axis=0)
        found.append(
            DrivenRobot(
                prim=str(prim.GetPath()),
                base=str(base.GetPath()),
                joints=joints,
                sides=tuple(spec.sides.values()),
                senses=tuple(sense_of(stage.GetPrimAtPath(joint), base) for joint in joints),
                turns=len(joints) == 2 and not spec.turning_radius_m,
                axle=(float(middle[0]), float(middle[1])),
                steers=_steers(prim, base, middle) if spec.turning_radius_m else (),
                turning_radius_m=spec.turning_radius_m,
                start=find_room(obstacles, places[prim], footprint_of(prim) or 0.0, others),
                height_m=height,
                lowest_m=_height(prim) + float(solid_box(prim, prim).GetMin()[2]),
                wheel_radius_m=spec.wheel_radius_m,
                wheel_separation_m=spec.wheel_separation_m,
                v_max=spec.v_max,
                w_max=spec.w_max,
            )
        )
    return found


def find_room(
    obstacles: Obstacles, at: tuple[float, float, float], radius_m: float, others: np.ndarray
) -> tuple[float, float, float]:
    """The nearest pose from which a robot can drive `AHEAD_M` straight.

    Args:
        obstacles: What stands in the way.
        at: x [m], y [m] and yaw [rad] from where to look; the result if no pose has room.
        radius_m: Radius of the robot's footprint [m].
        others: Places of other robots of its size [m], shape (N, 2).
    """
    steps = np.arange(-FAR_M, FAR_M + SPACING_M, SPACING_M)
    offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    offsets = offsets[np.argsort(np.hypot(*offsets.T), kind="stable")]
    yaws = at[2] + math.tau / HEADINGS * np.arange(HEADINGS)
    along = np.linspace(0, AHEAD_M, 21)
    ways = np.stack([np.cos(yaws), np.sin(yaws)], axis=-1)[:, None] * along[:, None]
    for offset in offsets:
        place = np.array(at[:2]) + offset
        if obstacles.clearance(place[None], reach_m=radius_m + MARGIN_M)[0][0] < radius_m + MARGIN_M:
            continue
        points = (place + ways).reshape(-1, 2)
        clear, _ = obstacles.clearance(points, reach_m=radius_m + MARGIN_M)
        free = clear > radius_m + MARGIN_M
        for other in others:
            free &= np.hypot(*(points - other).T) > 2 * radius_m + MARGIN_M
        whole = np.flatnonzero(free.reshape(HEADINGS, -1).all(axis=1))
        if len(whole):
            return float(place[0]), float(place[1]), math.remainder(float(yaws[whole[0]]), math.tau)
    return at


def has_ground(stage: Usd.Stage) -> bool:
    """Whether a stage has a collider that no rigid body carries, on which a robot can stand."""
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        if prim.HasAPI(UsdPhysics.CollisionAPI) and not any(
            stage.GetPrimAtPath(path).HasAPI(UsdPhysics.RigidBodyAPI)
            for path in prim.GetPath().GetAncestorsRange()
        ):
            return True
    return False


def driven_table(stage: Usd.Stage) -> dict[str, Any]:
    """The robots and the ground of a stage as plain data, for another process."""
    return {
        "robots": [asdict(robot) for robot in read_driven(stage)],
        "ground": has_ground(stage),
        "scene": any(prim.IsA(UsdPhysics.Scene) for prim in stage.Traverse()),
    }


def _drive(robot: Usd.Prim) -> tuple[DriveSpec, tuple[str, ...]] | None:
    """The drive of a robot and the paths of its wheels' joints; None if it does not have two wheels."""
    if has_api(robot, "drive"):
        wheels = [attribute_name("drive", field) for field in (*JOINT_FIELDS, *WHEELS_FIELDS)]
        joints = [joint for name in wheels for joint in targets(robot, name)]
        return read_drive(robot), tuple(str(joint.GetPath()) for joint in joints)
    drive, _ = drive_of(robot, DriveSpec())
    names = drive.left_wheel_joint, drive.right_wheel_joint
    if not set(names) <= {wheel.joint for wheel in wheels_of(robot)}:
        return None
    prims = joints_of(robot)
    return drive, tuple(str(prims[name].GetPath()) for name in names)


def _place(joint: Usd.Prim, base: Usd.Prim) -> np.ndarray:
    """Place of a joint's child in the base's axes [m], shape (3,)."""
    body = joint.GetStage().GetPrimAtPath(UsdPhysics.Joint(joint).GetBody1Rel().GetTargets()[0])
    return np.array(UsdGeom.XformCache().ComputeRelativeTransform(body, base)[0].ExtractTranslation())


def _steers(robot: Usd.Prim, base: Usd.Prim, middle: np.ndarray) -> tuple[Steer, ...]:
    """The joints of a car that steer: driven, with limits, about a vertical axis, carrying a wheel."""
    stage, found = robot.GetStage(), []
    joints = [p for p in Usd.PrimRange(robot) if p.IsA(UsdPhysics.RevoluteJoint)]
    held = {str(t) for p in joints for t in UsdPhysics.Joint(p).GetBody0Rel().GetTargets()}
    for prim in joints:
        (body,) = UsdPhysics.Joint(prim).GetBody1Rel().GetTargets()
        way = UsdGeom.XformCache().ComputeRelativeTransform(stage.GetPrimAtPath(body), base)[0]
        up = way.TransformDir(Gf.Vec3d(*axis_of(UsdPhysics.Joint(prim))))[2]
        high = UsdPhysics.RevoluteJoint(prim).GetUpperLimitAttr().Get()
        if abs(up) > 0.8 and str(body) in held and high is not None and math.isfinite(high):
            x, y, _ = _place(prim, base) - middle
            found.append((str(prim.GetPath()), float(x), float(y), 1 if up > 0 else -1))
    return tuple(found)


def _base(robot: Usd.Prim) -> Usd.Prim:
    """The body of a robot called base_link, or else its first body, or else its prim."""
    bodies = [prim for prim in Usd.PrimRange(robot) if prim.HasAPI(UsdPhysics.RigidBodyAPI)]
    return next((p for p in bodies if p.GetName() == BASE_LINK), bodies[0] if bodies else robot)


def _height(prim: Usd.Prim) -> float:
    """Height of a prim's origin in world [m]."""
    return float(UsdGeom.XformCache().GetLocalToWorldTransform(prim).ExtractTranslation()[2])


def _pose(prim: Usd.Prim) -> tuple[float, float, float]:
    """Place of a prim in world: x [m], y [m] and yaw [rad]."""
    T = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(prim))
    return float(T[3, 0]), float(T[3, 1]), math.atan2(T[0, 1], T[0, 0])
