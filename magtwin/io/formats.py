"""Formats: the one table from a file's name to what reads and writes a Run in it."""

import importlib
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from magtwin.errors import InputError, hint
from magtwin.files import existing
from magtwin.run.run import Run, check_clock

if TYPE_CHECKING:
    from magtwin.path import Path as Planned
    from magtwin.sim.sensors.lidar import Scans
    from magtwin.twin import Twin


@dataclass(frozen=True)
class Format:
    """A kind of file that holds a Run."""

    name: str
    """What people call it."""

    module: str
    """Where its two functions stand; imported when a file of the kind is met."""

    read: str
    """Name of the reader, `read(path) -> Run`."""

    write: str
    """Name of the writer, `write(run, path, *, force, ...)`; "" of a format that is only read."""

    reads: frozenset[str] = frozenset()
    """Options that the reader takes."""

    takes: frozenset[str] = frozenset()
    """What else the writer takes: of `twin`, `planned`, `scans`, which a format that cannot hold them is not
    given, and of the options, which it refuses."""

    def reader(self) -> Callable[..., Run]:
        """The function that reads it."""
        return getattr(importlib.import_module(self.module), self.read)

    def writer(self) -> Callable[..., None]:
        """The function that writes it."""
        return getattr(importlib.import_module(self.module), self.write)


_TABLES = "magtwin.io.tables"
_NAMED = frozenset(("columns",))
_PARQUET = Format("Parquet", _TABLES, "read_parquet", "write_parquet", reads=_NAMED)
_BAG = Format(
    "rosbag2",
    "magtwin.io.bags",
    "read_bag",
    "write_bag",
    reads=frozenset(("topics", "unit")),
    takes=frozenset(("twin", "scans", "storage", "units")),
)
_USD = Format(
    "USD",
    "magtwin.usd.animation",
    "read_animation",
    "write_animation",
    takes=frozenset(("scene_file", "fps")),
)

FORMATS: Mapping[str, Format] = MappingProxyType(
    {
        ".parquet": _PARQUET,
        ".csv": Format("CSV", _TABLES, "read_csv", "write_csv", reads=_NAMED),
        ".npz": Format("npz", _TABLES, "read_npz", "write_npz"),
        ".rrd": Format(
            "Rerun",
            "magtwin.io.rerun.file",
            "read_run",
            "write_rrd",
            takes=frozenset(("twin", "planned", "scans")),
        ),
        ".json": Format("released package", "magtwin.io.release", "read_release", ""),
        ".mcap": _BAG,
        ".db3": _BAG,
        ".usd": _USD,
        ".usda": _USD,
        ".usdc": _USD,
    }
)
"""Formats by the end of a file's name. A name without one is that of a rosbag2 folder."""


def read_run(path: str | os.PathLike[str], **options: Any) -> Run:
    """The run that a file holds, whatever its format.

    Args:
        path: A file whose name ends as one of `FORMATS`; or a folder: a bag's, the part files of a Parquet
            file that was never finished, or the one that `magtwin run --out` makes.
        options: Of single formats: `topics` and `unit` of a robot's own bag, `columns` of a table that
            another program wrote.

    Raises:
        InputError: The file is missing, of no known kind, damaged, holds no run, or its format has no such
            option.
    """
    path = existing(path, "run")
    file, format_ = _found(path) if path.is_dir() else (path, format_of(path))
    if unknown := sorted(options.keys() - format_.reads):
        raise InputError(f"{path}: {format_.name} is read without {unknown[0]}; drop it")
    run = format_.reader()(file, **options)
    check_clock(run, str(path))
    return run


def write_run(
    run: Run,
    path: str | os.PathLike[str],
    twin: "Twin | None" = None,
    *,
    planned: "Planned | None" = None,
    scans: "Scans | None" = None,
    force: bool = False,
    **options: Any,
) -> None:
    """Write a run in the format that its name ends in; `FORMATS` says which hold what.

    Args:
        run: What happened.
        path: The file to make, or the folder of a bag where the name has no ending.
        twin: What it happened in; without it, a file holds what the run alone knows.
        planned: The path that was to be driven, for those that show it.
        scans: What the LiDAR saw, for those that hold it.
        force: Whether what exists is replaced.
        options: Of single formats: `storage` and `units` of bags, `fps` of USD.

    Raises:
        InputError: The name ends in no known way, the format has no such option, the run has no clock that
            ascends, the file exists and `force` was not given, or it cannot be written.
    """
    path = Path(path)
    format_ = format_of(path)
    if not format_.write:
        kinds = ", ".join(suffix for suffix, one in FORMATS.items() if one.write)
        raise InputError(f"{path}: a recording of the {format_.name} is read, not written; write {kinds}")
    if unknown := sorted(options.keys() - format_.takes):
        raise InputError(f"{path}: {format_.name} has no option {unknown[0]!r}; drop it")
    check_clock(run, "the run to write")
    if twin is not None and twin.stage is not None and "scene_file" in format_.takes:
        raise InputError(
            f"{path}: {format_.name} names the scene's file, and this scene has none; author it with "
            "magtwin.author.scene.author_scene and open that, or leave out twin"
        )
    scene_file = None if twin is None else twin.scene_file
    known = {"twin": twin, "planned": planned, "scans": scans, "scene_file": scene_file}
    given = {name: value for name, value in known.items() if name in format_.takes}
    format_.writer()(run, path, force=force, **given, **options)


def format_of(path: Path) -> Format:
    """The format that a file's name asks for; a bag's folder where it has no ending.

    Raises:
        InputError: It ends in no known way.
    """
    if not path.suffix:
        return _BAG
    if path.suffix not in FORMATS:
        raise InputError(f"{path}: no known kind of run file; {hint(path.suffix, FORMATS)}")
    return FORMATS[path.suffix]


def _found(folder: Path) -> tuple[Path, Format]:
    """What is to be read in a folder, and as what."""
    if (folder / "metadata.yaml").exists() or any(folder.glob("*.db3")) or any(folder.glob("*.mcap")):
        return folder, _BAG
    if (folder / "run.parquet").is_file():
        return folder / "run.parquet", _PARQUET
    if any(folder.glob("*.parquet")):
        return folder, _PARQUET
    raise InputError(
        f"{folder}: a folder without a run; name a file ({', '.join(FORMATS)}), or a folder with a bag, "
        "Parquet parts or run.parquet"
    )
