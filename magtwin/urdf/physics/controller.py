"""Controller: the mobile base that a Gazebo plugin or the settings of a ROS controller define.

Plugins are in the table `extensions`. Settings are the parameters of diff_drive_controller,
mecanum_drive_controller, ackermann_steering_controller, bicycle_steering_controller,
tricycle_steering_controller and tricycle_controller, of ROS 1 or 2.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np

from magtwin.errors import InputError, hint
from magtwin.urdf.description.extensions import DRIVE, PLUGINS, STEERED
from magtwin.urdf.description.tag import Element, Tags
from magtwin.urdf.physics.mobile_base import Kind, MobileBase, leave_out

SIDES = (("left_wheel_names", "left_wheel"), ("right_wheel_names", "right_wheel"))
"""Keys of the wheels of a differential drive."""

CORNERS = tuple(
    tuple(
        f"{along}_{side}_wheel_{what}" for along in names for what in ("name", "joint", "command_joint_name")
    )
    for names in (("front",), ("rear", "back"))
    for side in ("left", "right")
)
"""Keys of the four wheels of a mecanum drive."""

TRACTION = ("traction_joints_names", "rear_wheels_names", "rear_wheel", "traction_joint_name")
STEERING = ("steering_joints_names", "front_wheels_names", "front_steer", "steering_joint_name")
"""Keys of the driven and the steered joints of a car."""

LIMITS = {
    "v_max": "linear.x.{}velocity",
    "w_max": "angular.z.{}velocity",
    "a_max": "linear.x.{}acceleration",
    "alpha_max": "angular.z.{}acceleration",
}
"""Key of each limit; `max_` goes into the gap, and `has_..._limits` may disable it."""

FIGURES = {
    "command_timeout_s": ("cmd_vel_timeout",),
    "odometry_rate_hz": ("publish_rate",),
    "wheel_radius_m": (
        *("wheel_radius", "kinematics.wheels_radius", "traction_wheels_radius", "rear_wheels_radius"),
        "wheels_radius",
    ),
    "wheel_separation_m": ("wheel_separation", "traction_track_width", "rear_wheel_track", "wheel_track"),
    "wheelbase_m": ("wheelbase", "wheel_separation_h"),
}
HALF_SUM = "kinematics.sum_of_robot_center_projection_on_X_Y_axis"
"""Keys of other figures, new and old."""


def base_of_plugin(tags: Tags) -> MobileBase | None:
    """The mobile base that a plugin of the description defines; None if none does, or not completely."""
    for plugin in _plugins(tags):
        label = f"{plugin.get('name', '')} {plugin.get('filename', '')}".lower()
        filename = plugin.get("filename", "").lower()
        if any(word in filename for words, *_ in PLUGINS for word in words):
            label = filename  # it decides where it is one of these; else the name, which users choose
        for words, kind, wheels in PLUGINS:
            if any(word in label for word in words):
                try:
                    return _base(tags, tags.read(plugin), cast("Kind", kind), wheels)
                except InputError as error:
                    leave_out(tags, plugin, error)
                    return None
    return None


def base_of_plugin_settings(tags: Tags) -> MobileBase | None:
    """The base in the settings that a ros2_control plugin names; None if there is none, or not completely.

    Raises:
        InputError: The file cannot be read, or is not YAML.
    """
    for plugin in _plugins(tags):
        if "ros2_control" not in f"{plugin.get('name', '')} {plugin.get('filename', '')}":
            continue
        for element in tags.read(plugin).findall("parameters"):
            where, filename = tags.description.where(element), (element.text or "").strip()
            try:
                path = tags.description.source.find_file(filename, "parameter file", element)
            except InputError as error:
                reason = str(error).removeprefix(f"{where}: ")
                tags.description.note(f"controllers are unknown, {reason}", lost=True)
                continue
            tags.read(element)
            try:
                base = base_of_settings(tags, path)
            except _FaultError as error:
                leave_out(tags, element, InputError(str(error).replace(str(path), path.name)))
                continue
            if base is not None:
                return base
    return None


def base_of_settings(tags: Tags, path: Path) -> MobileBase | None:
    """The base of the first controller in a YAML file that drives wheels, or None.

    Raises:
        InputError: It names an unknown joint, or has an invalid number; or the file is not YAML.
    """
    from magtwin.urdf.source.settings import read_settings  # needs yaml

    bases = (_Settings(tags, table, path).base() for table in list(read_settings(path)))
    return next((base for base in bases if base is not None), None)


def _plugins(tags: Tags) -> Iterator[Element]:
    return (plugin for block in tags.blocks("gazebo") for plugin in block.findall("plugin"))


def _base(tags: Tags, plugin: Element, kind: Kind, corners: tuple[tuple[str, ...], ...]) -> MobileBase:
    """The base of a plugin."""
    where, names = tags.description.where(plugin), tags.description.joint_names

    def joints(*keys: str) -> list[str]:
        found = [(e.tag, (e.text or "").strip()) for key in keys for e in tags.findall(plugin, key)]
        for tag, name in found:
            if name not in names:
                raise InputError(f"<{tag}>: no joint {name!r}; {hint(name, names)}")
        return [name for _, name in found]

    wheels = [name for keys in corners for name in joints(*keys)]
    if kind != "holonomic" and len(wheels) < 2:
        tag = next(keys[0] for keys in corners if all(plugin.find(key) is None for key in keys))
        raise InputError(f"the drive plugin has no <{tag}>")
    given = {name: figure for name, figure in tags.figures(plugin, DRIVE).items() if figure}
    wheelbase, limit = given.pop("wheelbase_m", None), given.pop("steering_limit", None)
    diameter = given.pop("wheel_diameter_m", None)
    if diameter is not None:
        given.setdefault("wheel_radius_m", diameter / 2)
    if kind == "mecanum" and "wheel_separation_m" in given:
        separation = given.pop("wheel_separation_m")
        given |= {} if wheelbase is None else {"wheel_separation_m": separation + wheelbase}
    return MobileBase(
        kind="skid-steer" if kind == "differential" and len(set(wheels)) > 2 else kind,
        source=f"the plugin at {where.rpartition('/')[2]}",
        element=plugin,
        wheels=tuple(dict.fromkeys(wheels)),
        steered=tuple(joints(*STEERED)) if kind == "car" else (),
        figures=given,
        wheelbase_m=wheelbase,
        steering_limit=limit,
    )


class _FaultError(InputError):
    """A value in the settings of a controller is wrong."""


class _Settings:
    """The settings of one controller."""

    def __init__(self, tags: Tags, table: dict[str, Any], path: Path) -> None:
        self._tags, self._table, self._path = tags, table, path

    def base(self) -> MobileBase | None:
        """The base, if the controller drives wheels."""
        if all(any(key in self._table for key in keys) for keys in SIDES):
            wheels = [name for keys in SIDES for name in self._joints(keys)]
            return self._made("differential" if len(wheels) < 3 else "skid-steer", wheels)
        if all(any(key in self._table for key in keys) for keys in CORNERS):
            return self._made("mecanum", [name for keys in CORNERS for name in self._joints(keys)])
        if any(key in self._table for key in TRACTION) and any(key in self._table for key in STEERING):
            wheels = self._joints(TRACTION)  # one wheel in the middle: both are to be found
            return self._made("car", wheels if len(wheels) > 1 else [], self._joints(STEERING))
        return None

    def _made(self, kind: Kind, wheels: list[str], steered: Iterable[str] = ()) -> MobileBase:
        keys = FIGURES | {
            name: (key.format("max_"),)
            for name, key in LIMITS.items()
            if self._table.get(key.format("has_") + "_limits", True)
        }
        figures = {name: self._number(*keys[name]) for name in keys}
        wheelbase, radius = figures.pop("wheelbase_m"), figures["wheel_radius_m"]
        times = self._multiplier() if kind in ("differential", "skid-steer") else 1.0
        if radius is not None:
            sides = (self._number(f"{side}_wheel_radius_multiplier") or 1.0 for side in ("left", "right"))
            figures["wheel_radius_m"] = (
                radius * (self._number("wheel_radius_multiplier") or 1.0) * sum(sides) / 2
            )
        if kind == "mecanum":
            figures["wheel_separation_m"] = self._mecanum_separation()
        given = {name: figure for name, figure in figures.items() if figure is not None}
        if "wheel_separation_m" in given:
            given["wheel_separation_m"] *= times
        return MobileBase(
            kind=kind,
            source=f"the controller in {self._path.name}",
            wheels=tuple(wheels),
            steered=tuple(steered),
            figures=given,
            separation_multiplier=times,
            wheelbase_m=None if wheelbase is None else wheelbase * self._multiplier("_h"),
        )

    def _mecanum_separation(self) -> float | None:
        """Sum of the distances between axles and between wheels [m]."""
        half = self._number(HALF_SUM)
        if half is not None:
            return 2 * half
        along, across = self._number("wheel_separation_x"), self._number("wheel_separation_y")
        if along is None or across is None:
            return None
        return (along * self._multiplier("_x") + across * self._multiplier("_y")) * self._multiplier()

    def _multiplier(self, axis: str = "") -> float:
        return self._number(f"wheel_separation{axis}_multiplier") or 1.0

    def _number(self, *keys: str) -> float | None:
        """The first of the keys that is there: a number above 0."""
        key = next((key for key in keys if self._table.get(key) is not None), None)
        if key is None:
            return None
        value = self._table[key]
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < np.inf:
            raise _FaultError(f"{self._path}: {key} must be a number above 0, got {value!r}")
        return float(value)

    def _joints(self, keys: Iterable[str]) -> list[str]:
        """The joints that the first of the keys that is there names: a name, or a list of names."""
        known = self._tags.description.joint_names
        key = next(key for key in keys if key in self._table)
        value = self._table[key]
        names = [value] if isinstance(value, str) and value else value
        if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
            raise _FaultError(f"{self._path}: {key} must be a list of joints, got {value!r}")
        missing = next((name for name in names if name not in known), None)
        if missing is not None:
            raise _FaultError(f"{self._path}: {key}: no joint {missing!r}; {hint(missing, known)}")
        return names
