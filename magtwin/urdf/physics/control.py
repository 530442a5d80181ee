"""Control: the drive and the commands of a robot, from drive plugins, `<ros2_control>` and `<transmission>`.

Follows the documentation of gz-sim's DiffDrive, gazebo_plugins' diff_drive, ros2_control's
diff_drive_controller and URDF's `<transmission>`.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Usd

from magtwin.errors import InputError, hint
from magtwin.spec.drive import DriveSpec
from magtwin.urdf.description.model import Link
from magtwin.urdf.description.tag import Element, Tags
from magtwin.urdf.options import DriveRule
from magtwin.urdf.physics.drive import POSITION_STIFFNESS, WHEEL_DAMPING
from magtwin.urdf.physics.mechanism import Mechanism
from magtwin.usd.sensors import define_drive

PLUGINS = ("diff_drive", "diff-drive", "diffdrive")
"""Words in the name or file of a plugin that drives two wheels, old or new Gazebo."""

RADIUS, DIAMETER = ("wheel_radius",), ("wheel_diameter", "wheelDiameter")
LEFT, RIGHT = ("left_joint", "leftJoint"), ("right_joint", "rightJoint")
FIGURES = {
    "wheel_separation_m": ("wheel_separation", "wheelSeparation"),
    "v_max": ("max_linear_velocity", "max_velocity"),
    "w_max": ("max_angular_velocity",),
    "alpha_max": ("max_angular_acceleration",),
}
OR_ZERO = {
    "a_max": ("max_linear_acceleration", "max_acceleration", "max_wheel_acceleration", "wheelAcceleration"),
    "odometry_rate_hz": ("odom_publish_frequency", "update_rate", "updateRate"),
}
"""Names of each parameter in a plugin; 0 leaves out those in OR_ZERO."""

LIMITS = {
    "v_max": ("linear.x", "velocity"),
    "w_max": ("angular.z", "velocity"),
    "a_max": ("linear.x", "acceleration"),
    "alpha_max": ("angular.z", "acceleration"),
}
"""Axis and quantity of each limit in a controller's settings."""

COMMANDS = {"velocity": "velocity", "position": "position", "effort": "none"}
"""Type of drive by command interface; effort needs no drive, because the torque comes from outside."""


def read_drive(tags: Tags, mechanism: Mechanism) -> tuple[DriveSpec | None, tuple[str, ...]]:
    """The differential drive that a plugin or controller of the description defines.

    Returns:
        The drive, with one wheel on each side, or None; and all joints that it drives.

    Raises:
        InputError: It names an unknown joint, or has an invalid number; the message gives the line.
    """
    driven = list[str]()
    plugins = [plugin for block in tags.blocks("gazebo") for plugin in block.findall("plugin")]
    labels = [f"{plugin.get('name', '')} {plugin.get('filename', '')}" for plugin in plugins]
    for plugin, label in zip(plugins, labels, strict=True):
        if any(word in label.lower() for word in PLUGINS):
            return _from_plugin(tags, tags.read(plugin), mechanism, driven), tuple(driven)
    for plugin, label in zip(plugins, labels, strict=True):
        if "ros2_control" in label:
            spec = _from_settings(tags, tags.read(plugin), mechanism, driven)
            if spec is not None:
                return spec, tuple(driven)
    return None, ()


def read_commands(tags: Tags, mechanism: Mechanism) -> tuple[DriveRule, ...]:
    """Drive rules from `<ros2_control>` and `<transmission>`; the user's rules come before them.

    A velocity or position interface becomes a drive with the default gains; effort leaves the joint free.
    Joints that cannot move or that follow another get no rule. Interfaces of unknown joints are left out.
    """
    rules: dict[str, DriveRule] = {}
    for name, kind in _commands(tags):
        if name in rules or name in mechanism.welded or name in mechanism.mimics:
            continue
        gains: dict[str, float] = {}
        if kind == "velocity":
            gains = {"damping": WHEEL_DAMPING}
        elif kind == "position":
            gains = {"stiffness": POSITION_STIFFNESS, "damping": POSITION_STIFFNESS / 10}
        pattern = "".join(f"[{c}]" if c in "*?[" else c for c in name)  # matches this name only
        rules[name] = DriveRule(joints=pattern, type=kind, **gains)  # type: ignore[arg-type]
    return tuple(rules.values())


def define_differential(robot: Usd.Prim, spec: DriveSpec, prim_names: Mapping[str, str]) -> Usd.Prim:
    """Author a drive on the robot's prim.

    Args:
        robot: Its joints exist already.
        spec: The drive, with the joint names of the URDF.
        prim_names: Joint names in USD by their URDF names.
    """
    fields = ("left_wheel_joint", "right_wheel_joint")
    named = {field: prim_names.get(getattr(spec, field), getattr(spec, field)) for field in fields}
    return define_drive(robot, DriveSpec(**{**vars(spec), **named}))


def _commands(tags: Tags) -> Iterator[tuple[str, str]]:
    """Joint and type of drive of each command."""
    for tag in ("ros2_control", "transmission"):
        for block in tags.blocks(tag):
            for joint in tags.findall(block, "joint"):
                interfaces = tags.findall(joint, "command_interface")
                tags.findall(joint, "state_interface")
                text = [e.get("name", "") for e in interfaces]
                if tag == "transmission":
                    text = [
                        kind for kind in COMMANDS if kind in tags.text(joint, "hardwareInterface").lower()
                    ]
                name = joint.get("name", "")
                if all(name != known.name for known in tags.description.joints.values()):
                    fault = f"<{tag}> names no joint {name!r}: its interfaces are left out"
                    tags.description.repair("name-unknown", fault, joint)
                    continue
                kind = next((kind for kind in COMMANDS if kind in text), None)
                if kind is not None:
                    yield name, COMMANDS[kind]


def _from_plugin(tags: Tags, plugin: Element, mechanism: Mechanism, driven: list[str]) -> DriveSpec:
    """The drive of a Gazebo plugin."""
    where, sides = tags.description.where(plugin), []
    for tag_names in (LEFT, RIGHT):
        elements = [e for name in tag_names for e in tags.findall(plugin, name)]
        if not elements:
            raise InputError(f"{where}: the drive plugin has no <{tag_names[0]}>")
        if len(elements) > 1:
            tags.description.note(f"drive plugin: the first of {len(elements)} <{elements[0].tag}> is used")
        sides.append([_known(tags, (e.text or "").strip(), e) for e in elements])
    driven += sides[0] + sides[1]
    diameter = tags.number(plugin, *DIAMETER, above=0.0)
    radius = tags.number(plugin, *RADIUS, above=0.0)
    figures = {field: tags.number(plugin, *names, above=0.0) for field, names in FIGURES.items()}
    figures |= {field: tags.number(plugin, *names, least=0.0) or None for field, names in OR_ZERO.items()}
    figures["wheel_radius_m"] = diameter / 2 if radius is None and diameter is not None else radius
    return _spec(tags, mechanism, (sides[0][0], sides[1][0]), where, figures)


def _from_settings(tags: Tags, plugin: Element, mechanism: Mechanism, driven: list[str]) -> DriveSpec | None:
    """The drive of a diff_drive_controller in the settings that a plugin names; None if there is none."""
    from magtwin.urdf.source.settings import read_settings  # needs yaml

    for element in plugin.findall("parameters"):
        where = tags.description.where(element)
        try:
            filename = (element.text or "").strip()
            path = tags.description.source.find_file(filename, "parameter file", element)
        except InputError as error:
            reason = str(error).removeprefix(f"{where}: ")
            tags.description.note(f"controllers are unknown, {reason}", lost=True)
            continue
        tags.read(element)
        for table in read_settings(path):
            if "left_wheel_names" in table and "right_wheel_names" in table:
                return _from_controller(tags, table, mechanism, path, driven)
    return None


def _from_controller(
    tags: Tags, table: dict[str, Any], mechanism: Mechanism, path: Path, driven: list[str]
) -> DriveSpec:
    """The drive of a diff_drive_controller's settings."""

    def number(key: str) -> float | None:
        value = table.get(key)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < np.inf:
            raise InputError(f"{path}: {key} must be a number above 0, got {value!r}")
        return float(value)

    known, sides = [joint.name for joint in tags.description.joints.values()], []
    for key in ("left_wheel_names", "right_wheel_names"):
        names = table[key]
        if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
            raise InputError(f"{path}: {key} must be a list of joints, got {names!r}")
        missing = next((name for name in names if name not in known), None)
        if missing is not None:
            raise InputError(f"{path}: {key}: no joint {missing!r}; {hint(missing, known)}")
        if len(names) > 1:
            tags.description.note(f"drive: the first of {len(names)} {key} is used")
        sides.append(names[0])
        driven += names
    separation, radius = number("wheel_separation"), number("wheel_radius")
    if separation is not None:
        separation *= number("wheel_separation_multiplier") or 1.0
    if radius is not None:
        radius *= sum(number(f"{side}_wheel_radius_multiplier") or 1.0 for side in ("left", "right")) / 2
    figures = {
        field: number(f"{axis}.max_{what}")
        for field, (axis, what) in LIMITS.items()
        if table.get(f"{axis}.has_{what}_limits", True)
    }
    figures |= {"wheel_separation_m": separation, "wheel_radius_m": radius}
    figures |= {"command_timeout_s": number("cmd_vel_timeout"), "odometry_rate_hz": number("publish_rate")}
    return _spec(tags, mechanism, (sides[0], sides[1]), str(path), figures)


def _spec(
    tags: Tags, mechanism: Mechanism, sides: tuple[str, str], where: str, figures: dict[str, float | None]
) -> DriveSpec:
    """A drive; missing values are measured on the robot, or the defaults are used with a note."""
    description = tags.description
    joints = {joint.name: joint for joint in description.joints.values()}
    left, right = (joints[name] for name in sides)
    given: dict[str, Any] = {k: v for k, v in figures.items() if v is not None}
    if "wheel_separation_m" not in given:
        poses = mechanism.poses()
        gap = float(np.linalg.norm(poses[left.child][:3, 3] - poses[right.child][:3, 3]))
        if gap > 0:
            given["wheel_separation_m"] = gap
            description.note(f"drive: no wheel separation given: {gap:g} m between the wheel joints is used")
    if "wheel_radius_m" not in given:
        radius = _radius(description.links[left.child])
        if radius is not None:
            given["wheel_radius_m"] = radius
            description.note(
                f"drive: no wheel radius given: {radius:g} m from the left wheel's shape is used"
            )
    if "v_max" not in given and left.limit is not None and left.limit.velocity:
        given["v_max"] = float(left.limit.velocity) * given.get("wheel_radius_m", DriveSpec.wheel_radius_m)
    if "w_max" not in given and "v_max" in given:
        given["w_max"] = 2 * given["v_max"] / given.get("wheel_separation_m", DriveSpec.wheel_separation_m)
    guessed = [
        f"{name} {getattr(DriveSpec, name):g}"
        for name in ("wheel_separation_m", "wheel_radius_m", *LIMITS)
        if name not in given
    ]
    if guessed:
        description.note(f"drive: TurtleBot 4's values are used for {', '.join(guessed)}")
    try:
        return DriveSpec(left_wheel_joint=sides[0], right_wheel_joint=sides[1], **given)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def _radius(link: Link) -> float | None:
    """Radius of a wheel's first cylinder or sphere [m]."""
    forms = (part.geometry for part in (*link.collisions, *link.visuals))
    return next((form.radius for form in forms if form.kind in ("cylinder", "sphere")), None)


def _known(tags: Tags, name: str, element: Element) -> str:
    """`name`, if a joint has it."""
    names = [joint.name for joint in tags.description.joints.values()]
    if name not in names:
        raise InputError(f"{tags.description.where(element)}: no joint {name!r}; {hint(name, names)}")
    return name
