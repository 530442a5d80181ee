"""Robot: an articulation made from a URDF, and back, for scripts and `magtwin robot`; where links stand."""

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
    """A robot as USD, and how it came about."""

    asset: Path
    """Root layer of the articulation."""

    spec: RobotSpec | None
    """What the simulator needs to drive it; none where no settings were given."""

    report: ConversionReport
    """What became of every link, joint and geometry."""


def from_urdf(
    urdf: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    settings: str | os.PathLike[str] | RobotSettings | None = None,
    force: bool = False,
    thumbnail: Callable[[Path, Path], object] | None = None,
    **choices: Any,
) -> Robot:
    """Convert a URDF or a xacro to a USD articulation that drives.

    Args:
        urdf: The description.
        out: Folder to make, which will hold `<name>.usda` and the layers that it refers to.
        settings: What a URDF cannot say (drive, battery, platform field, sensor mounts), as
            RobotSettings or a TOML of their fields. Without them the articulation alone is made.
        force: Whether a folder that exists is replaced.
        thumbnail: Draws an asset, its first argument, to a PNG, its second, such as
            `magtwin.figures.pictures.picture_of_stage` does; SimReady assets have one, 256 pixels square.
        **choices: Fields of `Options`; they come before the conversion that the settings name.

    Returns:
        The asset, its spec where settings were given, and the report.

    Raises:
        InputError: The description or the settings cannot be used, or the folder
            exists; nothing is written.
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
