"""From URDF: a robot as USD from a URDF, and back."""

import dataclasses
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from magtwin.author.robot import RobotSettings, build_robot, read_settings
from magtwin.files import existing, output
from magtwin.spec.robot import RobotSpec
from magtwin.urdf.convert import convert_with_report
from magtwin.urdf.description.kinematics import link_poses
from magtwin.urdf.options import DEFAULTS, DriveRule, Options
from magtwin.urdf.report import ConversionReport
from magtwin.urdf.write import write_urdf
from magtwin.usd.robot import load_robot

__all__ = ["DriveRule", "Options", "Robot", "RobotSettings", "from_urdf", "link_poses", "write_urdf"]


@dataclass(frozen=True)
class Robot:
    """A robot as USD, with the report of its conversion."""

    asset: Path
    """Root layer of the articulation."""

    spec: RobotSpec | None
    """Parameters for the simulator; None without settings."""

    report: ConversionReport
    """Every link, joint and geometry before and after."""


def from_urdf(
    urdf: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    settings: str | os.PathLike[str] | RobotSettings | None = None,
    force: bool = False,
    thumbnail: Callable[[Path, Path], object] | None = None,
    **choices: Any,
) -> Robot:
    """Convert a URDF or a xacro to a USD articulation that can be driven.

    Args:
        urdf: The description.
        out: Folder to create, with `<name>.usda` and the layers that it references.
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
    urdf = existing(urdf, "URDF")
    if settings is not None and not isinstance(settings, RobotSettings):
        settings = read_settings(settings)
    options = dataclasses.replace(settings.conversion if settings else DEFAULTS, **choices)
    name = f"{urdf.name.lstrip('.').split('.')[0] or 'robot'}.usda"
    with output(out, force=force) as folder:
        folder.mkdir()
        if settings is None:
            report = convert_with_report(urdf, folder / name, options=options, thumbnail=thumbnail)
        else:
            report = build_robot(urdf, settings, folder / name, options=options, thumbnail=thumbnail)
    asset = Path(out) / name
    return Robot(asset, load_robot(asset) if settings else None, report)
