"""Controller: the mobile base in the settings of a ros_control or ros2_control controller.

Follows the parameters of diff_drive_controller, mecanum_drive_controller, ackermann_steering_controller,
bicycle_steering_controller, tricycle_steering_controller and tricycle_controller.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from magtwin.errors import InputError, hint
from magtwin.urdf.description.tag import Tags
from magtwin.urdf.physics.mobile_base import Kind, MobileBase
from magtwin.urdf.physics.plugin import leave_out

SIDES = (("left_wheel_names", "left_wheel"), ("right_wheel_names", "right_wheel"))
"""Keys of the wheels of a differential drive."""

CORNERS = tuple(
    tuple(pattern.format(along=along, side=side) for along in names for pattern in (
        "{along}_{side}_wheel_name",
        "{along}_{side}_wheel_joint",
        "{along}_{side}_wheel_command_joint_name",
    ))
    for names in (("front",), ("rear", "back"))
    for side in ("left", "right")
)  # fmt: skip
"""Keys of the four wheels of a mecanum drive."""

TRACTION = ("traction_joints_names", "rear_wheels_names", "rear_wheel", "traction_joint_name")
STEERING = ("steering_joints_names", "front_wheels_names", "front_steer", "steering_joint_name")
"""Keys of the driven and the steered joints of a car."""

FIGURES = {
    "v_max": "linear.x.{}velocity",
    "w_max": "angular.z.{}velocity",
    "a_max": "linear.x.{}acceleration",
    "alpha_max": "angular.z.{}acceleration",
}
"""Key of each limit; `max_` goes into the gap, and `has_..._limits` may disable it."""

WHEEL_RADIUS = (
    "wheel_radius",
    "kinematics.wheels_radius",
    "traction_wheels_radius",
    "rear_wheels_radius",
    "wheels_radius",
)
SEPARATION = ("wheel_separation", "traction_track_width", "rear_wheel_track", "wheel_track")
WHEELBASE = ("wheelbase", "wheel_separation_h")
HALF_SUM = ("kinematics.sum_of_robot_center_projection_on_X_Y_axis",)
"""Keys of lengths, new and old."""


def base_of_plugin_settings(tags: Tags) -> MobileBase | None:
    """The base in the settings that a ros2_control plugin names; None if there is none, or not completely.

    Raises:
        InputError: The file cannot be read, or is not YAML.
    """
    for block in tags.blocks("gazebo"):
        for plugin in block.findall("plugin"):
            if "ros2_control" not in f"{plugin.get('name', '')} {plugin.get('filename', '')}":
                continue
            for element in tags.read(plugin).findall("parameters"):
                where = tags.description.where(element)
                try:
                    filename = (element.text or "").strip()
                    path = tags.description.source.find_file(filename, "parameter file", element)
                except InputError as error:
                    reason = str(error).removeprefix(f"{where}: ")
                    tags.description.note(f"controllers are unknown, {reason}", lost=True)
                    continue
                tags.read(element)
                from magtwin.urdf.source.settings import read_settings  # needs yaml

                tables = list(read_settings(path))  # reads the file
                try:
                    base = _first(tags, tables, path)
                except InputError as error:
                    text = str(error).replace(str(path), path.name)
                    leave_out(tags, element, InputError(text))
                    continue
                if base is not None:
                    return base
    return None


def base_of_settings(tags: Tags, path: Path) -> MobileBase | None:
    """The base of the first controller in a YAML file that drives wheels, or None.

    Raises:
        InputError: It names an unknown joint, or has an invalid number.
    """
    from magtwin.urdf.source.settings import read_settings  # needs yaml

    return _first(tags, read_settings(path), path)


def _first(tags: Tags, tables: Iterable[dict[str, Any]], path: Path) -> MobileBase | None:
    """The base of the first controller that drives wheels, or None."""
    for table in tables:
        base = _Settings(tags, table, path).base()
        if base is not None:
            return base
    return None


class _Settings:
    """The settings of one controller."""

    def __init__(self, tags: Tags, table: dict[str, Any], path: Path) -> None:
        self._tags, self._table, self._path = tags, table, path

    def base(self) -> MobileBase | None:
        """The base, if the controller drives wheels."""
        if all(any(key in self._table for key in keys) for keys in SIDES):
            wheels = [name for keys in SIDES for name in self._joints(keys)]
            kind: Kind = "differential" if len(wheels) < 3 else "skid-steer"
            return self._made(kind, wheels, separation=self._separation())
        if all(any(key in self._table for key in keys) for keys in CORNERS):
            wheels = [name for keys in CORNERS for name in self._joints(keys)]
            return self._made("mecanum", wheels, separation=self._mecanum_separation())
        if any(key in self._table for key in TRACTION) and any(key in self._table for key in STEERING):
            wheels, steered = list(self._joints(TRACTION)), list(self._joints(STEERING))
            fixed = wheels if len(wheels) > 1 else []  # one wheel in the middle: both are to be found
            return self._made("car", fixed, steered, separation=self._number(*SEPARATION))
        return None

    def _made(
        self, kind: Kind, wheels: list[str], steered: Iterable[str] = (), *, separation: float | None
    ) -> MobileBase:
        radius = self._number(*WHEEL_RADIUS)
        if radius is not None:
            sides = (self._number(f"{side}_wheel_radius_multiplier") or 1.0 for side in ("left", "right"))
            radius *= (self._number("wheel_radius_multiplier") or 1.0) * sum(sides) / 2
        figures = {
            name: self._number(key.format("max_"))
            for name, key in FIGURES.items()
            if self._table.get(key.format("has_") + "_limits", True)
        }
        figures |= {"wheel_separation_m": separation, "wheel_radius_m": radius}
        figures |= {
            "command_timeout_s": self._number("cmd_vel_timeout"),
            "odometry_rate_hz": self._number("publish_rate"),
        }
        wheelbase = self._number(*WHEELBASE)
        return MobileBase(
            kind=kind,
            source=f"the controller in {self._path.name}",
            wheels=tuple(wheels),
            steered=tuple(steered),
            figures={name: figure for name, figure in figures.items() if figure is not None},
            separation_multiplier=self._multiplier() if kind in ("differential", "skid-steer") else 1.0,
            wheelbase_m=None if wheelbase is None else wheelbase * self._multiplier("_h"),
        )

    def _separation(self) -> float | None:
        separation = self._number(*SEPARATION)
        return None if separation is None else separation * self._multiplier()

    def _mecanum_separation(self) -> float | None:
        """Sum of the distances between axles and between wheels [m]."""
        half = self._number(*HALF_SUM)
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
            raise InputError(f"{self._path}: {key} must be a number above 0, got {value!r}")
        return float(value)

    def _joints(self, keys: Iterable[str]) -> list[str]:
        """The joints that the first of the keys that is there names: a name, or a list of names."""
        known = self._tags.description.joint_names
        key = next(key for key in keys if key in self._table)
        value = self._table[key]
        names = [value] if isinstance(value, str) and value else value
        if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
            raise InputError(f"{self._path}: {key} must be a list of joints, got {value!r}")
        missing = next((name for name in names if name not in known), None)
        if missing is not None:
            raise InputError(f"{self._path}: {key}: no joint {missing!r}; {hint(missing, known)}")
        return names
