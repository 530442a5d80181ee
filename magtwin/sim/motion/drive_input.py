"""Way: what is to be driven, from whatever a user names it by."""

from pathlib import Path as FilePath
from typing import Any

import numpy as np

from magtwin.errors import InputError
from magtwin.path import Path, resolve_path
from magtwin.placement import Room, fitted, path_in
from magtwin.run.run import Run
from magtwin.sim.motion.commands import Commands

Way = Path | Commands | Run | str


def way_of(way: Any, room: Room | None = None, *, fit: bool = False) -> Way:
    """What is to be driven, from all that `magtwin.simulate` takes as its path.

    Args:
        way: The name of a path, a CSV file, or points (N, 2) [m], which become a `Path`; "random", a `Path`,
            `Commands` or a `Run`, which stay as they are.
        room: Where it is driven: named paths are scaled to its floor, see `magtwin.placement.path_in`.
            Default: the floor that they are made for.
        fit: Whether a path that does not fit into the room is moved and made smaller until it does.

    Raises:
        InputError: There is no such path, no room for it, or it is nothing that can be driven.
    """
    if isinstance(way, Commands | Run) or (isinstance(way, str) and way == "random"):
        return way
    if isinstance(way, Path):
        return fitted(way, room) if fit and room is not None else way
    if isinstance(way, str | FilePath | list | tuple | np.ndarray):
        named = isinstance(way, str | FilePath) and room is not None
        path = path_in(room, way) if named else resolve_path(way)  # type: ignore[arg-type]
        return fitted(path, room) if fit and room is not None else path
    raise InputError(
        "path must be a name, a CSV file, points (N, 2) [m], a Path, Commands or a Run, got "
        f"{type(way).__name__}"
    )


def ways_of(paths: Any, room: Room | None = None) -> Way | list[Way]:
    """One way for several runs, or a way for each; a name or file that comes again is read once.

    Args:
        paths: What `way_of` takes, or an iterable of it. Points (N, 2) are one path.
        room: As for `way_of`.
    """
    single = isinstance(paths, str | FilePath | Path | Commands | Run)
    if single or not hasattr(paths, "__iter__"):
        return way_of(paths, room)
    given = list(paths)
    if _are_points(given):
        return way_of(given, room)
    known: dict[Any, Way] = {}
    for path in given:
        key = path if isinstance(path, str | FilePath) else id(path)
        if key not in known:
            known[key] = way_of(path, room)
    return [known[path if isinstance(path, str | FilePath) else id(path)] for path in given]


def _are_points(values: list[Any]) -> bool:
    """Whether each is a pair of numbers."""
    return bool(values) and all(
        isinstance(row, np.ndarray | list | tuple)
        and len(row) == 2
        and all(isinstance(number, int | float | np.number) for number in row)
        for row in values
    )
