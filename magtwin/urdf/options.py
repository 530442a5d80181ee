"""What a user may ask of a conversion."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

from magtwin.errors import InputError

Collision = Literal["hull", "decomposition", "mesh"]
Profile = Literal["general", "diff-drive"]
_Kind = Literal["velocity", "position", "none"]


@dataclass(frozen=True, kw_only=True)
class DriveRule:
    """How the joints whose name fits a pattern are driven."""

    joints: str
    """Pattern of joint names, as in a shell: `*_wheel_joint`."""

    type: _Kind = "velocity"
    """What the drive holds; none leaves the joint free."""

    stiffness: float = 0.0
    """Gain on the error of position [N m/rad or N/m]."""

    damping: float = 0.0
    """Gain on the error of velocity [N m s/rad or N s/m]."""

    max_force: float | None = None
    """Highest torque or force [N m or N]; the joint's effort unless given."""

    def __post_init__(self) -> None:
        wanted = {"velocity": "damping", "position": "stiffness"}.get(self.type)
        for name, figure in (("stiffness", self.stiffness), ("damping", self.damping)):
            if not 0 <= figure < math.inf:
                raise InputError(f"drive {self.joints!r}: {name} must be a number from 0 up, got {figure!r}")
            if name == wanted and figure == 0:
                raise InputError(
                    f"drive {self.joints!r}: without {name} it holds no {self.type}; give {name}="
                )
            if figure and (self.type == "none" or (self.type == "velocity" and name == "stiffness")):
                raise InputError(f"drive {self.joints!r}: type {self.type} has no {name}, got {figure:g}")
        if self.max_force is not None and not 0 < self.max_force < math.inf:
            raise InputError(f"drive {self.joints!r}: max_force must be above 0, got {self.max_force!r}")

    @classmethod
    def parse(cls, text: str) -> "DriveRule":
        """The rule of `PATTERN:TYPE[:stiffness=X][:damping=X][:max_force=X]`.

        Raises:
            InputError: The text is not of that form.
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
            f"drive {text!r}: PATTERN:TYPE[:stiffness=X][:damping=X][:max_force=X] is wanted, "
            f"TYPE one of {', '.join(get_args(_Kind))}"
        )


@dataclass(frozen=True, kw_only=True)
class Options:
    """What a conversion does where a URDF leaves a choice."""

    packages: Mapping[str, Path] = field(default_factory=dict)
    """Folders of packages by name, before those that are found."""

    arguments: Mapping[str, str] = field(default_factory=dict)
    """Arguments of a xacro."""

    missing_meshes: Literal["refuse", "note"] = "refuse"
    """What is done about a mesh that is not there: note leaves its visual or collider out and says so."""

    collision: Collision = "hull"
    """What a mesh collides as: its convex hull, a convex decomposition (extra `decomposition`), or itself."""

    fix_base: bool = False
    """Whether the base is bolted to the world."""

    merge_fixed: bool = False
    """Whether links on fixed joints become part of the body that they ride on; their frames stay as sites."""

    profile: Profile = "general"
    """diff-drive: velocity drives on wheels, slippery casters, dead suspensions welded."""

    drives: tuple[DriveRule, ...] = ()
    """How joints are driven; the first rule that fits wins, before what the URDF says."""

    density: float | None = None
    """Density of links without inertia [kg/m3]; None leaves them as they are."""

    single_file: bool = False
    """Whether one root layer holds all but the meshes, in place of Isaac Sim's layers."""

    strict: bool = False
    """Whether a conversion that lost anything is refused."""

    mass: float | None = None
    """Mass of a data sheet to hold the robot's against [kg]."""

    metadata: Mapping[str, str] = field(default_factory=dict)
    """What the asset says of itself (author, asset_license, category, ...), before what its package says."""

    def __post_init__(self) -> None:
        for name in ("density", "mass"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise InputError(f"{name} must be above 0, got {value!r}")


DEFAULTS = Options()
