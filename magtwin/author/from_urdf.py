"""From URDF: a robot as USD from a URDF, and back."""

import dataclasses
import os
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magtwin.errors import InputError
from magtwin.files.kinds import expected
from magtwin.files.outputs import output
from magtwin.urdf.convert import convert_with_report
from magtwin.urdf.layout import EDITS
from magtwin.urdf.options import DEFAULTS, DriveRule, Options
from magtwin.urdf.report import ConversionReport

if TYPE_CHECKING:
    from magtwin.author.robot import RobotSettings
    from magtwin.spec.robot import RobotSpec
    from magtwin.urdf.description.kinematics import link_poses
    from magtwin.urdf.write import write_urdf

__all__ = ["DriveRule", "Options", "Robot", "RobotSettings", "from_urdf", "link_poses", "write_urdf"]

LATER = {
    "RobotSettings": "magtwin.author.robot",
    "link_poses": "magtwin.urdf.description.kinematics",
    "write_urdf": "magtwin.urdf.write",
}
"""Modules of names that are imported when they are used: what a conversion without settings does without."""


@dataclass(frozen=True)
class Robot:
    """A robot as USD, with the report of its conversion."""

    asset: Path
    """Root layer of the articulation."""

    spec: "RobotSpec | None"
    """Parameters for the simulator; None without settings."""

    report: ConversionReport
    """Every link and joint before and after."""


def from_urdf(
    urdf: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    settings: "str | os.PathLike[str] | RobotSettings | None" = None,
    force: bool = False,
    thumbnail: Callable[[Path, Path], object] | None = None,
    **choices: Any,
) -> Robot:
    """Convert a URDF or a xacro to a USD articulation that can be driven.

    Args:
        urdf: The description.
        out: Folder to create, with `<name>.usda` and the layers that it references; or one file .usda, with
            its meshes beside it.
        settings: Values that a URDF lacks (drive, battery, platform field, sensor mounts), as RobotSettings
            or a TOML file of their fields. `None` converts the articulation only.
        force: Whether to replace an existing folder.
        thumbnail: Function that draws an asset (first argument) to a PNG (second argument), such as
            `magtwin.figures.pictures.picture_of_stage`; SimReady assets have one of 256 x 256 pixels.
        **choices: Fields of `Options`; they override the conversion in the settings.

    Returns:
        The asset, its spec if settings were given, and the report.

    Raises:
        InputError: The description or the settings are invalid, or the folder exists; nothing is written.
    """
    urdf = expected(urdf, "robot description")
    name = f"{urdf.name.lstrip('.').split('.')[0] or 'robot'}.usda"
    one_file = Path(out).suffix.lower() == ".usda"
    if one_file and not choices.setdefault("single_file", True):
        raise InputError(f"{out}: one file; give a folder for `single_file=False`", parameter="out")
    asset = Path(out) if one_file else Path(out) / name
    equipped = given = None
    if settings is not None:
        equipped = import_module(LATER["RobotSettings"])
        given = settings if isinstance(settings, equipped.RobotSettings) else equipped.read_settings(settings)
    options = dataclasses.replace(DEFAULTS if given is None else given.conversion, **choices)
    with nullcontext() if one_file else output(out, force=force) as folder:
        if folder is not None:
            folder.mkdir()
            if (Path(out) / EDITS).is_file():  # of the asset that this one replaces
                shutil.copyfile(Path(out) / EDITS, folder / EDITS)
        place = asset if folder is None else folder / name
        how: dict[str, Any] = {"options": options, "thumbnail": thumbnail, "force": force}
        if equipped is None:
            return Robot(asset, None, convert_with_report(urdf, place, **how))
        report = equipped.build_robot(urdf, given, place, **how)
        spec = dataclasses.replace(equipped.load_robot(place, own=True), asset=asset.resolve())
    return Robot(asset, spec, report)


def __getattr__(name: str) -> Any:
    """A name of `LATER`."""
    if name not in LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(LATER[name]), name)
