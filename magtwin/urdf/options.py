"""Options: the user's choices for a conversion."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

from magtwin.errors import InputError

Profile = Literal["general", "diff-drive"]
_Kind = Literal["velocity", "position", "none"]


@dataclass(frozen=True, kw_only=True)
class DriveRule:
    """The drive of all joints whose name matches a pattern."""

    joints: str
    """Shell pattern of joint names, such as `*_wheel_joint`."""

    type: _Kind = "velocity"
    """What the drive holds; "none" leaves the joint free."""

    stiffness: float = 0.0
    """Gain on the position error [N m/rad or N/m]."""

    damping: float = 0.0
    """Gain on the velocity error [N m s/rad or N s/m]."""

    max_force: float | None = None
    """Maximum torque or force [N m or N]. Default: the joint's effort."""

    def __post_init__(self) -> None:
        used = {"velocity": ("damping",), "position": ("stiffness", "damping")}.get(self.type, ())
        for name, figure in (("stiffness", self.stiffness), ("damping", self.damping)):
            if not 0 <= figure < math.inf:
                raise InputError(f"drive {self.joints!r}: {name} must be a number from 0 up, got {figure!r}")
            if figure and name not in used:
                raise InputError(f"drive {self.joints!r}: type {self.type} has no {name}, got {figure:g}")
        if used and not getattr(self, used[0]):
            raise InputError(
                f"drive {self.joints!r}: without {used[0]} it cannot hold a {self.type}; give {used[0]}="
            )
        if self.max_force is not None and not 0 < self.max_force < math.inf:
            raise InputError(f"drive {self.joints!r}: max_force must be above 0, got {self.max_force!r}")

    @classmethod
    def parse(cls, text: str) -> "DriveRule":
        """Parse `PATTERN:TYPE[:stiffness=X][:damping=X][:max_force=X]`.

        Raises:
            InputError: The text does not have that form.
        """
        joints, kind, *figures = text.split(":") if ":" in text else (text, "")
        gains = dict(figure.partition("=")[::2] for figure in figures)
        try:
            if joints and kind in get_args(_Kind) and gains.keys() <= {"stiffness", "damping", "max_force"}:
                return cls(joints=joints, type=kind, **{name: float(x) for name, x in gains.items()})  # type: ignore[arg-type]
        except InputError:
            raise
        except ValueError:
            pass
        raise InputError(
            f"drive {text!r}: expected PATTERN:TYPE[:stiffness=X][:damping=X][:max_force=X], "
            f"TYPE one of {', '.join(get_args(_Kind))}"
        )


@dataclass(frozen=True, kw_only=True)
class Options:
    """Choices that a URDF leaves open."""

    packages: Mapping[str, Path] = field(default_factory=dict)
    """Folders of packages by name; they override packages that are found."""

    arguments: Mapping[str, str] = field(default_factory=dict)
    """Arguments of a xacro."""

    fix_base: bool = False
    """Whether the base is fixed to the world."""

    merge_fixed: bool = False
    """Whether links on fixed joints are merged into the body above; their frames stay as sites."""

    profile: Profile = "general"
    """diff-drive: velocity drives on wheels, low friction on casters, suspensions without springs welded."""

    drives: tuple[DriveRule, ...] = ()
    """Drive rules; the first match wins and overrides the URDF."""

    controllers: Path | None = None
    """YAML with the settings of the robot's controllers (ros_control, ros2_control), for its drive."""

    single_file: bool = False
    """Whether to write one root layer and the meshes, instead of Isaac Sim's layers."""

    density: float = 1000.0
    """Density of links without `<inertial>`, see `physics.link` [kg/m3]."""

    strict: bool = False
    """Whether to refuse a description with faults, which are repaired otherwise."""

    skip_missing_includes: bool = False
    """Whether to skip files and packages that a xacro includes, if they are missing and none of their macros
    is called."""

    proof: bool = False
    """Whether the report lists what became of each element and attribute."""

    metadata: Mapping[str, str] = field(default_factory=dict)
    """Metadata of the asset (author, asset_license, category, ...); overrides that of its package."""

    def __post_init__(self) -> None:
        if not 0 < self.density < math.inf:
            raise InputError(f"density must be above 0 kg/m3, got {self.density!r}", parameter="density")


DEFAULTS = Options()
