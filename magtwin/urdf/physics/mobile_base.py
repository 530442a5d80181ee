"""Mobile base: the wheels of a robot, how it steers, and its drive for the simulator.

The simulator moves every base along its heading, with a speed v and a yaw rate w. The rate of a wheel of
radius r on the left is (v - w b / 2) / r, on the right (v + w b / 2) / r. What b is depends on the steering:

* differential: the distance between the wheels;
* skid steering: this distance times the controller's multiplier, since the wheels scrub;
* four mecanum wheels: the sum of the distances between the axles and between the wheels of an axle. With
  v_y = 0 this is the mecanum equation (Taheri et al. 2015, eq. 20), so that such a robot keeps every motion
  but the sideways one;
* a car: the distance between the wheels of the fixed axle; w is at most v over the turning radius.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.spec.drive import DriveSpec
from magtwin.urdf.description.tag import Element, Tags
from magtwin.urdf.physics.mechanism import Mechanism

Kind = Literal["differential", "skid-steer", "mecanum", "holonomic", "car"]

DRIVEN_AS: Mapping[str, str] = {
    "differential": "a differential drive",
    "skid-steer": "a differential drive, with all wheels of a side turning alike",
    "mecanum": "a differential drive of the separation in the mecanum equation; it does not move sideways",
    "holonomic": "a differential drive; it does not move sideways",
    "car": "a car, which cannot turn on the spot; the motion is that of base_link",
}
"""What the simulator makes of each kind."""

FIGURES = {
    "wheel_separation_m": ("wheel separation", "m"),
    "wheel_radius_m": ("wheel radius", "m"),
    "wheel_rate_max": ("highest wheel rate", "rad/s"),
    "v_max": ("highest speed", "m/s"),
    "w_max": ("highest yaw rate", "rad/s"),
    "turning_radius_m": ("turning radius", "m"),
}
"""Names and units of figures in notes."""

BESIDE = 0.2
"""Largest share of y in the axles of wheels that roll along y."""

BESIDE_M = 0.01
"""Distance from the robot's middle plane above which a wheel is on a side [m]."""


@dataclass(frozen=True, kw_only=True)
class MobileBase:
    """The wheels of a robot and how it steers, as a plugin, a controller or its joints tell."""

    kind: Kind

    source: str
    """What tells it, for notes."""

    element: Element | None = field(default=None, compare=False, repr=False)
    """Tag of the plugin, if it is one."""

    wheels: tuple[str, ...] = ()
    """Joints of the driven wheels; those of the fixed axle if it is a car. Empty: to be found."""

    steered: tuple[str, ...] = ()
    """Joints that steer the wheels of a car."""

    figures: Mapping[str, float] = field(default_factory=dict)
    """Fields of the DriveSpec that are given."""

    separation_multiplier: float = 1.0
    """Effective over measured wheel separation, if the separation is not given."""

    wheelbase_m: float | None = None
    """Distance between the axles [m]; None: that of the joints."""

    steering_limit: float | None = None
    """Largest angle of a steered wheel [rad]; None: that of the joints."""


def drive_spec(base: MobileBase, mechanism: Mechanism, radius_of: Callable[[str], float]) -> DriveSpec:
    """The drive of a base; values that are not given are measured on the robot, with notes.

    Args:
        base: The base, with its wheels.
        mechanism: Joints of the description, which receives notes.
        radius_of: Radius of the wheel on a joint by its shape [m]; 0 if it has none.

    Raises:
        InputError: It has no wheel on one side, or a figure is out of range.
    """
    description, poses = mechanism.description, mechanism.poses()
    joints = {joint.name: joint for joint in description.joints.values()}
    places = {name: poses[joints[name].child][:3, 3] for name in base.wheels}
    axes = [poses[joints[name].child][:3, :3] @ np.asarray(joints[name].axis, float) for name in base.wheels]
    across = [abs(axis[1]) / np.linalg.norm(axis) for axis in axes]
    if across and max(across) < BESIDE:
        raise InputError(
            f"{base.source}: the wheels roll along y of {description.root!r}, but x is ahead (REP 103); "
            "turn the joint of the base by 90 degrees"
        )
    left, right = _sides(base, places)
    wrong = {name for name, axis in zip(base.wheels, axes, strict=True) if axis[1] < 0}
    for note in backward([name for name in (*left, *right) if name in wrong]):
        description.note(note)
    given = _figures(base, mechanism, left, right, radius_of)
    kind = "" if base.kind == "differential" else f" ({base.kind})"
    description.note(f"drive from {base.source}{kind}: simulated as {DRIVEN_AS[base.kind]}")
    try:
        return DriveSpec(
            left_wheel_joint=left[0],
            right_wheel_joint=right[0],
            more_left_wheel_joints=tuple(left[1:]),
            more_right_wheel_joints=tuple(right[1:]),
            **given,
        )
    except InputError as error:
        raise InputError(f"{base.source}: {error}") from error


def _figures(
    base: MobileBase,
    mechanism: Mechanism,
    left: list[str],
    right: list[str],
    radius_of: Callable[[str], float],
) -> dict[str, Any]:
    """The figures of a drive: those given, and those measured on the robot, with notes."""
    description, poses = mechanism.description, mechanism.poses()
    joints = {joint.name: joint for joint in description.joints.values()}
    places = {name: poses[joints[name].child][:3, 3] for name in base.wheels}
    given: dict[str, Any] = dict(base.figures)

    def guess(name: str, value: float | None, how: str) -> None:
        if name not in given and value is not None and 0 < value < np.inf:
            given[name] = float(value)
            what, unit = FIGURES[name]
            description.note(f"drive: {what} {value:.5g} {unit}, {how}")

    gap = abs(places[left[0]][1] - places[right[0]][1])
    if base.kind == "mecanum":
        reach = float(np.ptp([place[0] for place in places.values()]))
        how = "not given: the sum of both distances between wheel joints"
        guess("wheel_separation_m", gap + reach, how)
    times = base.separation_multiplier
    scaled = "" if times == 1 else f", times the multiplier {times:g}"
    guess("wheel_separation_m", times * gap, f"not given: the distance between the wheel joints{scaled}")
    radii = [radius for name in (left[0], right[0]) if (radius := radius_of(name)) > 0]
    guess("wheel_radius_m", sum(radii) / len(radii) if radii else None, "not given: from the wheels' shape")
    limit = joints[left[0]].limit
    rate = None if limit is None or not limit.velocity else float(limit.velocity)
    radius = given.get("wheel_radius_m", DriveSpec.wheel_radius_m)
    separation = given.get("wheel_separation_m", DriveSpec.wheel_separation_m)
    guess("wheel_rate_max", rate, "from the wheel joint's limit")
    guess("v_max", None if rate is None else rate * radius, "from the wheel joint's limit")
    v = given.get("v_max", np.nan)
    if base.kind == "car":
        tightest = _turning_radius(base, mechanism)
        if tightest is None:
            text = "drive: the steering angle has no limit, so that the turning radius is not limited"
            description.note(text)
        guess("turning_radius_m", tightest, "from the wheelbase and the steering angle")
        around = given.get("turning_radius_m", np.nan)
        guess("w_max", v / around, "the highest speed over the turning radius")
    else:
        guess("w_max", 2 * v / separation, "with the wheels at the highest speed in opposite directions")
    turning = given.get("w_max", DriveSpec.w_max) * separation / 2 / radius
    guess("wheel_rate_max", v / radius + turning, "for the highest speed and yaw rate at once")
    default = ("wheel_separation_m", "wheel_radius_m", "v_max", "w_max", "a_max", "alpha_max")
    unknown = [f"{name} {getattr(DriveSpec, name):g}" for name in default if name not in given]
    if unknown:
        description.note(f"drive: TurtleBot 4's values are used for {', '.join(unknown)}")
    return given


def leave_out(tags: Tags, element: Element | None, error: InputError) -> None:
    """Report a drive that cannot be used, and let its tag be kept as text."""
    tags.description.repair("drive-incomplete", f"{error}: the drive is kept as text", element)
    if element is not None:
        tags.forget(element)


def backward(joints: list[str]) -> list[str]:
    """A note on wheel joints whose axes point right, so that a positive angle rolls them backward."""
    if not joints:
        return []
    return [
        f"drive: the axis of {', '.join(map(repr, joints))} points right, so that a positive rate rolls it "
        "backward. magtwin allows for that; Isaac Sim's graph and ROS 2's diff_drive_controller do not: "
        "negate the <axis>"
    ]


def _sides(base: MobileBase, places: Mapping[str, NDArray]) -> tuple[list[str], list[str]]:
    """The wheels on the left and on the right, in their order; wheels in the middle are left out."""
    middle = float(np.mean([place[1] for place in places.values()])) if places else 0.0
    left = [name for name in base.wheels if places[name][1] - middle > BESIDE_M]
    right = [name for name in base.wheels if middle - places[name][1] > BESIDE_M]
    if not left or not right:
        listed = ", ".join(base.wheels) or "none"
        raise InputError(f"{base.source}: a drive needs wheels on the left (y > 0) and right; found {listed}")
    return left, right


def _turning_radius(base: MobileBase, mechanism: Mechanism) -> float | None:
    """Smallest turning radius of a car about the middle of its fixed axle [m]; None if nothing limits it.

    R = L / tan(angle) + d / 2, because the inner one of two steered wheels at a distance d reaches the limit
    first (Ackermann's condition); d = 0 for one steered wheel.
    """
    poses = mechanism.poses()
    joints = {joint.name: joint for joint in mechanism.description.joints.values()}
    steered = [poses[joints[name].child][:3, 3] for name in base.steered]
    fixed = [poses[joints[name].child][:3, 3] for name in base.wheels]
    wheelbase = base.wheelbase_m
    if wheelbase is None and steered and fixed:
        wheelbase = abs(float(np.mean(steered, axis=0)[0] - np.mean(fixed, axis=0)[0]))
    limits = [joints[name].limit for name in base.steered]
    angles = [
        min(abs(limit.lower), abs(limit.upper))
        for limit in limits
        if limit is not None and limit.lower is not None and limit.upper is not None
    ]
    angle = base.steering_limit if base.steering_limit is not None else min(angles, default=None)
    if not wheelbase or not angle or not 0 < angle < np.pi / 2:
        return None
    apart = max((float(p[1]) for p in steered), default=0.0) - min(
        (float(p[1]) for p in steered), default=0.0
    )
    return wheelbase / float(np.tan(angle)) + apart / 2
