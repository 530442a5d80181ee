"""Formats: which functions read and write a Run, by the suffix of the file.

**To add a format**, write a reader `read(path) -> Run` and a writer `write(run, path, *, force)` in a
module of this folder, and add a line to `FORMATS`. Without a fork, register it in your own code or by an
entry point:

    from magtwin.io.formats import FORMATS, Format

    FORMATS.register(".h5")(Format("HDF5", read=read_h5, write=write_h5))

    [project.entry-points."magtwin.formats"]
    ".h5" = "my_package:HDF5"    # a Format
"""

import importlib
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

from magtwin.errors import InputError, hint
from magtwin.extend import Registry
from magtwin.files.kinds import SWEEP, expected, kind_of
from magtwin.run.run import Run, check_clock, check_size_of_numbers

if TYPE_CHECKING:
    from magtwin.path import Path as Planned
    from magtwin.sim.sensors.lidar import Scans
    from magtwin.twin import Twin

Function = Callable[..., Any]


@dataclass(frozen=True, kw_only=True)
class Format:
    """A kind of file that holds a Run."""

    name: str  # Its name, for messages
    read: Function | str
    """The reader, `read(path, **options) -> Run`, or "module:function", which is imported when needed."""

    write: Function | str | None = None
    """The writer, `write(run, path, *, force, **options)`, likewise. None: the format is only read."""

    reads: frozenset[str] = frozenset()  # Options of the reader
    instead: str = ""  # What to write, if the format is only read. Default: one of the others.
    takes: frozenset[str] = frozenset()
    """Arguments of the writer: of `twin`, `planned`, `scans` and `scene_file`, which other formats are not
    given, and options, which other formats refuse."""


_IN, _RERUN = "magtwin.io.tables", "magtwin.io.rerun.file"
_NAMED = frozenset(("columns",))
PARQUET = Format(name="Parquet", read=f"{_IN}:read_parquet", write=f"{_IN}:write_parquet", reads=_NAMED)
CSV = Format(name="CSV", read=f"{_IN}:read_csv", write=f"{_IN}:write_csv", reads=_NAMED)
NPZ = Format(name="npz", read=f"{_IN}:read_npz", write=f"{_IN}:write_npz")
_SHOWN = frozenset(("twin", "planned", "scans"))
RERUN = Format(name="Rerun", read=f"{_RERUN}:read_run", write=f"{_RERUN}:write_rrd", takes=_SHOWN)
RELEASE = Format(name="released package", read="magtwin.io.release:read_release")
BAG = Format(
    name="rosbag2",
    read="magtwin.io.bags.reader:read_bag",
    write="magtwin.io.bags.writer:write_bag",
    reads=frozenset(("topics", "unit", "scale", "survey")),
    takes=frozenset(("twin", "scans", "units")),
)
DB3 = Format(
    name="rosbag2 in SQLite",
    read=BAG.read,
    reads=BAG.reads,
    instead=".mcap, the default of ROS 2; ros2 bag convert makes a .db3 of it",
)
ROS1 = Format(name="bag of ROS 1", read=BAG.read, reads=BAG.reads, instead=".mcap, the default of ROS 2")
USD = Format(
    name="USD",
    read="magtwin.usd.animation:read_animation",
    write="magtwin.usd.animation:write_animation",
    takes=frozenset(("scene_file", "fps")),
)

BAGS = (".mcap", ".db3", ".bag")  # Suffixes of storage files of bags

_SUFFIXES = {".parquet": "PARQUET", ".csv": "CSV", ".npz": "NPZ", ".rrd": "RERUN", ".json": "RELEASE"}
_SUFFIXES |= {".mcap": "BAG", ".db3": "DB3", ".bag": "ROS1", ".usd": "USD", ".usda": "USD", ".usdc": "USD"}

_NAMES = {suffix: f"{__name__}:{name}" for suffix, name in _SUFFIXES.items()}
FORMATS: Registry[Format] = Registry("run format", "formats", _NAMES)
"""Formats by suffix. A name without a suffix is a rosbag2 folder."""


_TOLD: ContextVar[tuple[dict[str, Any], list[Path]] | None] = ContextVar("told", default=None)


@contextmanager
def recordings(**options: Any) -> Iterator[None]:
    """Options (`topics`, `unit`, `scale`) of all robots' bags that are read inside; one must be."""
    used = list[Path]()
    token = _TOLD.set((options, used))
    try:
        yield
    finally:
        _TOLD.reset(token)
    if not used:
        raise InputError(f"no robot's recording was read; drop the option {next(iter(options))!r}")


def read_run(path: str | os.PathLike[str], **options: Any) -> Run:
    """Read a run from a file of any format.

    Args:
        path: A file with a suffix of `FORMATS`, or a folder: a bag, the parts of an unfinished Parquet
            file, or the output of `magtwin run --out`.
        options: Options of single formats: `topics`, `unit` and `scale` of a robot's bag, `columns` of a
            table that another program wrote.

    Raises:
        InputError: The file is missing, of unknown format, damaged, or holds no run; or its format has no
            such option.
    """
    path = expected(path, "run")
    file, format_ = _in_folder(path) if path.is_dir() else (path, format_of(path))
    if unknown := sorted(options.keys() - format_.reads):
        raise InputError(f"{path}: {format_.name} has no option {unknown[0]!r}; drop it")
    if (told := _TOLD.get()) is not None and "topics" in format_.reads:
        options = told[0] | options
        told[1].append(file)
    run = _function(format_.read)(file, **options)
    check_clock(run, str(path))
    check_size_of_numbers(run, str(path))
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
    """Write a run in the format of the file's suffix.

    Args:
        run: The run.
        path: The file to make. A name without a suffix is the folder of a bag.
        twin: The twin of the run. Without it, a file holds only the run.
        planned: The path that was to be driven, for formats that show it.
        scans: The LiDAR's scans, for formats that hold them.
        force: Replace an existing file.
        options: Options of single formats: `units` of bags, `fps` of USD.

    Raises:
        InputError: The suffix is unknown, the format has no such option, the run's clock does not ascend, the
            file exists and `force` is not set, or it cannot be written.
    """
    path = Path(path)
    format_ = format_to_write(path)
    assert format_.write is not None
    if unknown := sorted(options.keys() - format_.takes):
        raise InputError(f"{path}: {format_.name} has no option {unknown[0]!r}; drop it")
    check_clock(run, "the run to write")
    if twin is not None and twin.stage is not None and "scene_file" in format_.takes:
        advice = "author it with magtwin.author.scene.author_scene and open that, or leave out twin"
        text = f"{format_.name} names the scene's file, and this scene has none"
        raise InputError(f"{path}: {text}; {advice}")
    known = {"twin": twin, "planned": planned, "scans": scans, "scene_file": twin and twin.scene_file}
    given = {name: value for name, value in known.items() if name in format_.takes}
    _function(format_.write)(run, path, force=force, **given, **options)


def format_of(path: Path) -> Format:
    """The format of a file by its suffix, in any case; a bag if it has none."""
    if not path.suffix:
        return BAG
    suffix = path.suffix if path.suffix in FORMATS else path.suffix.lower()
    if suffix == ".usdz":
        unpack = f"unpack it (magtwin export {quote(str(path))} --out FOLDER)"
        text = f"give the run that was put into it, or {unpack} and give the layer of the run, ..._run.usdc"
        raise InputError(f"{path}: a package; {text}")
    if suffix not in FORMATS:
        raise InputError(f"{path}: unknown format of a run; {hint(path.suffix, dict.fromkeys(FORMATS))}")
    return FORMATS[suffix]


def format_to_write(path: Path) -> Format:
    """The format of a file to write, by its suffix; a bag if it has none. It can be written."""
    written = [suffix for suffix, other in FORMATS.items() if other.write]
    if path.suffix and not {path.suffix, path.suffix.lower()} & {*FORMATS, ".usdz"}:
        raise InputError(f"{path}: unknown format of a run; {hint(path.suffix, written)}")
    format_ = format_of(path)
    if not format_.write:
        instead = format_.instead or f"one of {', '.join(written)}"
        raise InputError(f"{path}: a {format_.name} is read, not written; give {instead}")
    return format_


def _function(function: Function | str) -> Function:
    if not isinstance(function, str):
        return function
    module, _, name = function.partition(":")
    return getattr(importlib.import_module(module), name)


def runs_in(path: Path) -> list[Path]:
    """The runs of a folder, in any format; [path] if it is a file, a bag or a folder of one run."""
    if not os.path.isdir(path):  # noqa: PTH112 - False of a name that is too long
        return [path]
    if kind_of(path) is SWEEP:
        inside = sorted(path.glob("run_*.parquet"))
        if not inside:
            raise InputError(f"{path}: its runs.csv stands alone, without run_*.parquet")
        return inside
    parts = any(next(path.glob(one), None) for one in ("*.db3", "part-*.parquet"))
    inside = [] if parts or kind_of(path) else sorted(path.glob("[!.]*"))
    runs = [file for file in inside if file.suffix.lower() in FORMATS and ".scans." not in file.name]
    known = ("metadata.yaml", "run.parquet")
    runs += [folder for folder in inside if any((folder / name).is_file() for name in known)]
    return sorted({*runs}) or [path]


def is_bag(path: Path) -> bool:
    """Whether a path is a bag: a storage file, or a folder that holds one."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() or any(p.suffix.lower() in BAGS for p in path.iterdir())
    return path.suffix.lower() in BAGS


def _in_folder(folder: Path) -> tuple[Path, Format]:
    """The file to read in a folder, and its format."""
    if is_bag(folder):
        return folder, BAG
    if (folder / "run.parquet").is_file():
        return folder / "run.parquet", PARQUET
    if any(folder.glob("*.parquet")):
        return folder, PARQUET
    advice = f"name a file ({', '.join(FORMATS)}), or a folder with a bag, Parquet parts or run.parquet"
    raise InputError(f"{folder}: a folder without a run; {advice}")
