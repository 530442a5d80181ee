"""Defaults from a robot's shape: footprint, wheels, and height above the floor."""

import math
from dataclasses import dataclass, replace

from pxr import Gf, Usd, UsdGeom, UsdPhysics

from magtwin.spec.drive import DriveSpec
from magtwin.urdf.physics.mobile_base import backward
from magtwin.usd.attributes import read_pose, write_pose
from magtwin.usd.geometry import ACROSS, axis_of
from magtwin.usd.sensors import joints_of

ALIKE_M = 0.01
"""Largest deviation of two wheels of an axle from mirror images [m]."""

OFF = 0.02
"""Relative difference above which the robot's shape replaces a default."""

FULL_TURN_DEG = 361.0
"""Range of a joint above which it turns without end [deg]; exporters write -180 to 180 rad for no limits."""

SUNK_M = 1e-3
"""Largest distance between wheels and floor of a robot that stands on it [m]."""

_DEFAULTS = DriveSpec()


@dataclass(frozen=True)
class Wheel:
    """A body on a joint without limits."""

    joint: str
    """Name of the joint in USD."""
    x: float
    y: float
    z: float
    """Centre in the robot's axes [m]."""
    radius_m: float

    sense: int = 1
    """-1 if it rolls backward as the joint's angle grows."""

    @property
    def lowest_m(self) -> float:
        """Height of the lowest point [m]."""
        return self.z - self.radius_m


def drive_of(robot: Usd.Prim, given: DriveSpec) -> tuple[DriveSpec, list[str]]:
    """The drive, with values from the robot's shape instead of defaults, and notes of these.

    Wheels that the settings do not name are the only two that mirror each other. Their separation and radius
    come from the shape if the settings have the defaults, those of a TurtleBot 4.

    Args:
        robot: The robot's prim, converted.
        given: The drive of the settings; its joints have the names of the description or of USD.

    Returns:
        The drive, with the joints' names in USD, and the notes.
    """
    wheels, joints = {wheel.joint: wheel for wheel in wheels_of(robot)}, joints_of(robot)
    left, right = (
        joints[n].GetName() if n in joints else n for n in (given.left_wheel_joint, given.right_wheel_joint)
    )
    names, notes = (left, right), list[str]()
    if names == (_DEFAULTS.left_wheel_joint, _DEFAULTS.right_wheel_joint) and not set(names) <= set(wheels):
        axles = _axles(list(wheels.values()))
        if len(axles) == 1:
            names = axles[0][0].joint, axles[0][1].joint
            left, right = (joints[n].GetDisplayName() or n for n in names)
            notes.append(f"wheel joints not given: {left!r} is the left one, {right!r} the right one")
    drive = replace(given, left_wheel_joint=names[0], right_wheel_joint=names[1])
    if not set(names) <= set(wheels):
        return drive, notes
    pair = wheels[names[0]], wheels[names[1]]
    notes += backward([joints[w.joint].GetDisplayName() or w.joint for w in pair if w.sense < 0])
    seen = {"wheel_separation_m": pair[0].y - pair[1].y, "wheel_radius_m": sum(w.radius_m for w in pair) / 2}
    for name, value in seen.items():
        default = getattr(_DEFAULTS, name)
        if value > 0 and getattr(given, name) == default and abs(value / default - 1) > OFF:
            drive = replace(drive, **{name: round(value, 5)})  # type: ignore[arg-type]
            notes.append(f"{name} not given: {value:.5g} m, from the robot's shape")
    return drive, notes


def stand_on_floor(robot: Usd.Prim, drive: DriveSpec) -> list[str]:
    """Raise or lower a robot's bodies so that its wheels touch the floor, z = 0 of its prim; returns a note.

    A URDF whose root is not at the floor, such as a base_link between the wheels, needs this.
    """
    wheels = {wheel.joint: wheel for wheel in wheels_of(robot)}
    lowest = [wheels[n].lowest_m for n in (drive.left_wheel_joint, drive.right_wheel_joint) if n in wheels]
    if len(lowest) < 2 or abs(min(lowest)) < SUNK_M:
        return []
    up = round(-min(lowest), 6)
    for body in robot.GetChildren():
        if body.HasAPI(UsdPhysics.RigidBodyAPI):
            (x, y, z), q = read_pose(body)
            write_pose(body, (x, y, z + up), q)
    moved = "raised" if up > 0 else "lowered"
    return [f"the robot is {moved} by {abs(up):g} m, so that its wheels stand on the floor"]


def wheels_of(robot: Usd.Prim) -> list[Wheel]:
    """The bodies of a robot on joints that turn without end."""
    found = []
    for prim in Usd.PrimRange(robot):
        joint = UsdPhysics.RevoluteJoint(prim)
        if not joint or not _range(joint) > FULL_TURN_DEG:
            continue
        bodies = joint.GetBody1Rel().GetTargets()
        box = solid_box(robot, prim.GetStage().GetPrimAtPath(bodies[0])) if bodies else None
        if box is None or box.IsEmpty():
            continue
        (x, y, z), size = box.GetMidpoint(), box.GetSize()
        found.append(Wheel(prim.GetName(), x, y, z, max(size[0], size[2]) / 2, sense_of(prim, robot)))
    return found


def sense_of(joint: Usd.Prim, frame: Usd.Prim) -> int:
    """-1 if the axis of a wheel points right, so that it rolls backward as its joint's angle grows, else 1.

    Args:
        joint: The wheel's joint.
        frame: Robot or base, with x ahead and y to the left.
    """
    bodies, axis = UsdPhysics.Joint(joint).GetBody1Rel().GetTargets(), axis_of(UsdPhysics.Joint(joint))
    body = joint.GetStage().GetPrimAtPath(bodies[0]) if bodies else None
    if not body or axis is None:
        return 1
    to_base, _ = UsdGeom.XformCache().ComputeRelativeTransform(body, frame)
    return -1 if to_base.TransformDir(Gf.Vec3d(*axis))[1] < -ACROSS else 1


def _range(joint: UsdPhysics.RevoluteJoint) -> float:
    """Range of a joint [deg], which may be infinite."""
    low, high = joint.GetLowerLimitAttr().Get(), joint.GetUpperLimitAttr().Get()
    return (0.0 if high is None else high) - (0.0 if low is None else low)


def footprint_of(robot: Usd.Prim) -> float | None:
    """Radius of the smallest circle about the robot's origin that contains its shape from above [m].

    Rounded up to 1 mm; None if the robot has no shapes.
    """
    box = _box(robot, robot)
    if box.IsEmpty():
        return None
    low, high = box.GetMin(), box.GetMax()
    far = math.hypot(max(-low[0], high[0]), max(-low[1], high[1]))
    return math.ceil(far * 1e3 - 1e-6) / 1e3


def _axles(wheels: list[Wheel]) -> list[tuple[Wheel, Wheel]]:
    """Pairs of wheels that mirror each other, left and right."""
    return [
        (left, right)
        for left in wheels
        for right in wheels
        if left.y > ALIKE_M
        and max(abs(left.x - right.x), abs(left.y + right.y), abs(left.z - right.z)) < ALIKE_M
    ]


def solid_box(robot: Usd.Prim, prim: Usd.Prim) -> Gf.Range3d:
    """The bounding box of the enabled colliders below a prim, along the robot's axes; without, of all."""
    box = Gf.Range3d()
    for each in Usd.PrimRange(prim, Usd.TraverseInstanceProxies()):
        api = UsdPhysics.CollisionAPI(each)
        if api and api.GetCollisionEnabledAttr().Get():
            box.UnionWith(_box(robot, each))
    return _box(robot, prim) if box.IsEmpty() else box


def _box(robot: Usd.Prim, prim: Usd.Prim) -> Gf.Range3d:
    """The bounding box of everything below a prim, along the robot's axes."""
    purposes = [UsdGeom.Tokens.default_, UsdGeom.Tokens.render, UsdGeom.Tokens.guide]
    boxes, places = UsdGeom.BBoxCache(Usd.TimeCode.Default(), purposes), UsdGeom.XformCache()
    bound = boxes.ComputeWorldBound(prim)
    bound.Transform(places.GetLocalToWorldTransform(robot).GetInverse())
    return bound.ComputeAlignedRange()
