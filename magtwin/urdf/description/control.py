"""Control: what drives a robot, from drive plugins, `<ros2_control>`, `<transmission>` and their settings.

After the documentation of gz-sim's DiffDrive, gazebo_plugins' diff_drive, ros2_control's
diff_drive_controller and URDF's `<transmission>`.
"""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Usd

from magtwin.errors import InputError, hint
from magtwin.spec.drive import DriveSpec
from magtwin.urdf.description.model import Link
from magtwin.urdf.description.tag import Element, Tags
from magtwin.urdf.drive import POSITION_STIFFNESS, WHEEL_DAMPING
from magtwin.urdf.mechanism import Mechanism
from magtwin.urdf.options import DriveRule
from magtwin.usd.sensors import define_drive

PLUGINS = ("diff_drive", "diff-drive", "diffdrive")
"""Words in the name or file of a plugin that drives two wheels: Gazebo's old ones and the new one."""

SEPARATION = ("wheel_separation", "wheelSeparation")
RADIUS, DIAMETER = ("wheel_radius",), ("wheel_diameter", "wheelDiameter")
LEFT, RIGHT = ("left_joint", "leftJoint"), ("right_joint", "rightJoint")
V_MAX = ("max_linear_velocity", "max_velocity")
W_MAX = ("max_angular_velocity",)
A_MAX = ("max_linear_acceleration", "max_acceleration", "max_wheel_acceleration", "wheelAcceleration")
ALPHA_MAX = ("max_angular_acceleration",)
RATE = ("odom_publish_frequency", "update_rate", "updateRate")
"""Where a plugin may say each figure."""

COMMANDS = {"velocity": "velocity", "position": "position", "effort": "none"}
"""What a command interface makes a drive hold; torque is given from outside, so it holds nothing."""

SETTINGS_SIZE, SETTINGS_NODES = 1_000_000, 10_000
"""Most bytes and entries of a controller's settings: more is no settings file."""


def read_drive(tags: Tags, mechanism: Mechanism) -> tuple[DriveSpec | None, tuple[str, ...]]:
    """The differential drive that a plugin or controller of the description tells of; none if none does.

    Returns:
        The drive, of one wheel a side; and all joints that it turns, of which there may be more.

    Raises:
        InputError: It names a joint that is not there, or a figure is none; the text gives the line.
    """
    driven = list[str]()
    for block in tags.blocks("gazebo"):
        for plugin in block.findall("plugin"):
            words = f"{plugin.get('name', '')} {plugin.get('filename', '')}".lower()
            if any(word in words for word in PLUGINS):
                tags.read(plugin)
                return _of_plugin(tags, plugin, mechanism, driven), tuple(driven)
    for block in tags.blocks("gazebo"):
        for plugin in block.findall("plugin"):
            if "ros2_control" in f"{plugin.get('name', '')} {plugin.get('filename', '')}":
                tags.read(plugin)
                spec = _of_settings(tags, plugin, mechanism, driven)
                if spec is not None:
                    return spec, tuple(driven)
    return None, ()


def read_commands(tags: Tags, mechanism: Mechanism) -> tuple[DriveRule, ...]:
    """How joints are commanded, by `<ros2_control>` and `<transmission>`, as rules after the user's own.

    A velocity or position interface becomes a drive that holds it, with the gains that a drive has
    without a rule; effort leaves the joint free, for torque from outside. Joints that cannot move or
    follow another are left out.

    Raises:
        InputError: A joint is named that is not there; the text gives the line.
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
        rules[name] = DriveRule(joints=_literal(name), type=kind, **gains)  # type: ignore[arg-type]
    return tuple(rules.values())


def define_differential(robot: Usd.Prim, spec: DriveSpec, prim_names: Mapping[str, str]) -> Usd.Prim:
    """Apply a drive whose joints are the URDF's to the robot's prim.

    Args:
        robot: Its joints are authored already.
        spec: Names joints as the URDF does.
        prim_names: What joints are called in USD, by their names.
    """
    named = {
        field: prim_names.get(getattr(spec, field), getattr(spec, field))
        for field in ("left_wheel_joint", "right_wheel_joint")
    }
    return define_drive(robot, DriveSpec(**{**vars(spec), **named}))


def define_safety(tags: Tags, joint_of: Callable[[str], Usd.Prim | None]) -> None:
    """Keep the soft limits of `<safety_controller>` as figures of their joints.

    They bound what the robot's own controller asks for, not how far the joint can go, so no engine has a
    place for them.
    """
    for element in tags.description.xml.findall("joint"):
        safety, name = element.find("safety_controller"), element.get("name", "")
        prim = None if safety is None else joint_of(name)
        if safety is None or prim is None:
            continue
        tags.take(safety)
        for key, value in safety.items():
            prim.SetCustomDataByKey(f"magtwin:safetyController:{key}", float(value))
        tags.description.note(
            f"joint {name!r}: its safety controller is kept as figures; the limits are the joint's own"
        )


def _commands(tags: Tags) -> Iterator[tuple[str, str]]:
    """Joint and kind of drive of each command."""
    for block in tags.blocks("ros2_control"):
        for joint in tags.findall(block, "joint"):
            name = _known(tags, joint.get("name", ""), joint)
            kinds = [e.get("name", "") for e in joint.findall("command_interface")]
            for element in (*joint.findall("command_interface"), *joint.findall("state_interface")):
                tags.read(element)
            wanted = next((kind for kind in COMMANDS if kind in kinds), None)
            if wanted is not None:
                yield name, COMMANDS[wanted]
    for block in tags.blocks("transmission"):
        for joint in tags.findall(block, "joint"):
            interface = tags.text(joint, "hardwareInterface").lower()
            name = _known(tags, joint.get("name", ""), joint)
            wanted = next((kind for kind in COMMANDS if kind in interface), None)
            if wanted is not None:
                yield name, COMMANDS[wanted]


def _of_plugin(tags: Tags, plugin: Element, mechanism: Mechanism, driven: list[str]) -> DriveSpec:
    """The drive of a Gazebo plugin."""
    left, right = (_joint(tags, plugin, names, driven) for names in (LEFT, RIGHT))
    diameter = tags.number(plugin, *DIAMETER, above=0.0)
    radius = tags.number(plugin, *RADIUS, above=0.0)
    return _spec(
        tags,
        mechanism,
        (left, right),
        where=tags.description.where(plugin),
        wheel_radius_m=diameter / 2 if radius is None and diameter is not None else radius,
        wheel_separation_m=tags.number(plugin, *SEPARATION, above=0.0),
        v_max=tags.number(plugin, *V_MAX, above=0.0),
        w_max=tags.number(plugin, *W_MAX, above=0.0),
        a_max=tags.number(plugin, *A_MAX, least=0.0) or None,
        alpha_max=tags.number(plugin, *ALPHA_MAX, above=0.0),
        odometry_rate_hz=tags.number(plugin, *RATE, least=0.0) or None,
    )


def _joint(tags: Tags, plugin: Element, names: tuple[str, ...], driven: list[str]) -> str:
    """The wheel's joint on one side, the first of several; all of them join those that are driven."""
    found = [e for name in names for e in tags.findall(plugin, name)]
    where = tags.description.where(plugin)
    if not found:
        raise InputError(f"{where}: the drive plugin has no <{names[0]}>")
    if len(found) > 1:
        tags.description.note(f"drive plugin: of {len(found)} <{found[0].tag}> the first is the drive's")
    driven += (known := [_known(tags, (e.text or "").strip(), e) for e in found])
    return known[0]


def _of_settings(tags: Tags, plugin: Element, mechanism: Mechanism, driven: list[str]) -> DriveSpec | None:
    """The drive of a diff_drive_controller in the settings that a plugin names; none if it has none."""
    for element in plugin.findall("parameters"):
        named = (element.text or "").strip()
        where = tags.description.where(element)
        try:
            path = tags.description.source.find_file(named, "file of parameters", element)
        except InputError as error:
            tags.description.note(
                f"controllers are unknown, {str(error).removeprefix(f'{where}: ')}", lost=True
            )
            continue
        tags.read(element)
        for table in _tables(_load(path)):
            if "left_wheel_names" in table and "right_wheel_names" in table:
                return _of_controller(tags, table, mechanism, path, driven)
    return None


def _load(path: Path) -> Any:
    """A YAML file, without tags that make objects."""
    import yaml

    from magtwin.urdf.source.settings import Loader

    if path.stat().st_size > SETTINGS_SIZE:
        raise InputError(f"{path}: over {SETTINGS_SIZE} bytes, too big for settings")
    try:
        return yaml.load(path.read_text(encoding="utf-8"), Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # a day of no month is a ValueError
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark is not None else ""
        reason = getattr(error, "problem", None) or str(error).partition(";")[0] or "cannot be read"
        raise InputError(f"{path}{line}: not YAML: {reason}") from error


def _tables(node: Any) -> Iterator[dict[str, Any]]:
    """Every table in nested ones, each with what is below it under dotted keys."""
    pending, seen = [node], 0
    while pending:
        here = pending.pop()
        seen += 1
        if seen > SETTINGS_NODES:
            return  # aliases within aliases, not settings
        if isinstance(here, dict):
            pending += here.values()
            yield dict(_dotted(here, "", 0))


def _dotted(table: dict[Any, Any], prefix: str, depth: int) -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, dict) and depth < 3:
            yield from _dotted(value, f"{prefix}{key}.", depth + 1)
        else:
            yield f"{prefix}{key}", value


def _of_controller(
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

    sides = []
    for side in ("left", "right"):
        names = table[f"{side}_wheel_names"]
        if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
            raise InputError(f"{path}: {side}_wheel_names must be a list of joints, got {names!r}")
        known = [joint.name for joint in tags.description.joints.values()]
        missing = next((name for name in names if name not in known), None)
        if missing is not None:
            raise InputError(f"{path}: {side}_wheel_names: no joint {missing!r}; {hint(missing, known)}")
        if len(names) > 1:
            tags.description.note(f"drive: of {len(names)} {side}_wheel_names the first is the drive's")
        sides.append(names[0])
        driven += names
    separation, radius = number("wheel_separation"), number("wheel_radius")
    if separation is not None:
        separation *= number("wheel_separation_multiplier") or 1.0
    if radius is not None:
        scales = [number(f"{side}_wheel_radius_multiplier") or 1.0 for side in ("left", "right")]
        radius *= sum(scales) / 2
    limits = {
        field: number(f"{axis}.max_{what}") if table.get(f"{axis}.has_{what}_limits", True) else None
        for field, axis, what in (
            ("v_max", "linear.x", "velocity"),
            ("w_max", "angular.z", "velocity"),
            ("a_max", "linear.x", "acceleration"),
            ("alpha_max", "angular.z", "acceleration"),
        )
    }
    return _spec(
        tags,
        mechanism,
        (sides[0], sides[1]),
        where=str(path),
        wheel_separation_m=separation,
        wheel_radius_m=radius,
        command_timeout_s=number("cmd_vel_timeout"),
        odometry_rate_hz=number("publish_rate"),
        **limits,
    )


def _spec(
    tags: Tags, mechanism: Mechanism, sides: tuple[str, str], *, where: str, **figures: float | None
) -> DriveSpec:
    """A drive of what was told; what was not is measured on the robot, or guessed with a note."""
    joints = {joint.name: joint for joint in tags.description.joints.values()}
    left, right = (joints[name] for name in sides)
    poses = mechanism.poses()
    given: dict[str, Any] = {k: v for k, v in figures.items() if v is not None}
    if "wheel_separation_m" not in given:
        gap = float(np.linalg.norm(poses[left.child][:3, 3] - poses[right.child][:3, 3]))
        if gap > 0:
            given["wheel_separation_m"] = gap
            tags.description.note(
                f"drive: the wheels' separation is not told: {gap:g} m between their joints"
            )
    if "wheel_radius_m" not in given:
        radius = _radius(tags.description.links[left.child])
        if radius is not None:
            given["wheel_radius_m"] = radius
            tags.description.note(
                f"drive: the wheels' radius is not told: {radius:g} m of the left one's shape"
            )
    if "v_max" not in given and left.limit is not None and left.limit.velocity:
        given["v_max"] = float(left.limit.velocity) * given.get("wheel_radius_m", DriveSpec.wheel_radius_m)
    if "w_max" not in given and "v_max" in given:
        given["w_max"] = 2 * given["v_max"] / given.get("wheel_separation_m", DriveSpec.wheel_separation_m)
    guessed = [
        f"{name} {getattr(DriveSpec, name):g}"
        for name in ("wheel_separation_m", "wheel_radius_m", "v_max", "w_max", "a_max", "alpha_max")
        if name not in given
    ]
    if guessed:
        tags.description.note(f"drive: not told, so as TurtleBot4's: {', '.join(guessed)}")
    try:
        return DriveSpec(left_wheel_joint=sides[0], right_wheel_joint=sides[1], **given)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def _radius(link: Link) -> float | None:
    """Radius of a wheel's round shape [m]."""
    for shape in (*link.collisions, *link.visuals):
        for kind in ("cylinder", "sphere"):
            round_ = getattr(shape.geometry, kind)
            if round_ is not None:
                return float(round_.radius)
    return None


def _known(tags: Tags, name: str, element: Element) -> str:
    """`name` if it is a joint's."""
    names = [joint.name for joint in tags.description.joints.values()]
    if name not in names:
        raise InputError(f"{tags.description.where(element)}: no joint {name!r}; {hint(name, names)}")
    return name


def _literal(name: str) -> str:
    """A pattern that fits one name alone."""
    return "".join(f"[{c}]" if c in "*?[" else c for c in name)
