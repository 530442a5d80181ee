"""DriveInput: what a robot can be told to drive, from a name, a file, points, a path, commands or a run."""

import hashlib
from collections.abc import Iterable
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.path import CASES, PATHS, Path, resolve_path
from magtwin.path.room import SWEPT, Room, fit_path, path_in
from magtwin.run.run import Run
from magtwin.sim.motion.commands import Commands

DriveInput = Path | Commands | Run | str
"""A path, commands, a run to drive again, or "random"."""


def drive_input(path: Any, room: Room | None = None, *, fit: bool = False) -> DriveInput:
    """Resolve the `path` argument of `magtwin.simulate`.

    Names, CSV files and points become a `Path`. Named paths are scaled to the floor of a room, and `fit`
    moves and shrinks any path until it is clear of what stands there.
    """
    if isinstance(path, Commands | Run) or (isinstance(path, str) and path == "random"):
        return path
    if isinstance(path, Path):
        return fit_path(path, room) if fit and room is not None else path
    if isinstance(path, str | FilePath | list | tuple | np.ndarray):
        named = isinstance(path, str | FilePath) and room is not None
        resolved = path_in(room, path) if named else resolve_path(path)  # type: ignore[arg-type]
        return fit_path(resolved, room) if fit and room is not None else resolved
    text = "path must be a name, a CSV file, points (N, 2) [m], a Path, Commands or a Run"
    raise InputError(f"{text}, got {type(path).__name__}", parameter="path")


def check_path(path: Any) -> None:
    """Refuse what `drive_input` would, before a scene is opened. A named path is not planned for it."""
    if not (isinstance(path, str) and path in (*PATHS, *CASES)):
        drive_input(path)


def each_input(paths: Any) -> list[Any]:
    """What several runs drive, as for `drive_input`: one for all of them, or several.

    Raises:
        InputError: There is none.
    """
    single = isinstance(paths, str | FilePath | Path | Commands | Run)
    if single or not hasattr(paths, "__iter__"):
        return [paths]
    listed = list(paths)
    if not listed:
        raise InputError("paths must name one path at least", parameter="paths")
    return [listed] if _are_points(listed) else listed


def path_metadata(path: DriveInput) -> dict[str, str | int | float | bool]:
    """File and checksum of what was driven."""
    if isinstance(path, str):
        return {}
    if isinstance(path, Run):
        arrays: Iterable[NDArray[Any]] = (array for _, array in sorted(path.items()))
        kind, file = "replay", ""
    elif isinstance(path, Path):
        arrays, kind, file = (path.p_xy, np.array([path.closed])), "path", path.file
    else:
        arrays, kind, file = (path.rows,), "commands", path.file
    metadata: dict[str, str | int | float | bool] = {f"{kind}_file": file} if file else {}
    if isinstance(path, Path) and path.placing:
        metadata["path_placing"] = " ".join(map(repr, path.placing))
    if isinstance(path, Path) and path.swept is not None and (path.swept < SWEPT or not path.placing):
        metadata["path_swept"] = path.swept
    checksum = hashlib.sha256()
    for array in arrays:
        checksum.update(np.ascontiguousarray(array).tobytes())
    return {**metadata, f"{kind}_sha256": checksum.hexdigest()}


def _are_points(values: list[Any]) -> bool:
    """Whether each is a pair of numbers."""
    return bool(values) and all(
        isinstance(row, np.ndarray | list | tuple)
        and len(row) == 2
        and all(isinstance(number, int | float | np.number) for number in row)
        for row in values
    )
