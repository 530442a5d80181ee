"""Commands: a script of cmd_vel, from a CSV of t,v,w or from manual driving."""

import math
import os
import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.delimited import QUOTED, number_of, read_delimited
from magtwin.errors import InputError, RepairWarning
from magtwin.kinds import expected
from magtwin.outputs import output
from magtwin.spec.drive import DriveSpec
from magtwin.summary import Summarized, Summary

Array = NDArray[np.float64]

HEADER = "t,v,w"


@dataclass(frozen=True, eq=False, repr=False)
class Commands(Summarized):
    """Commands of a robot, one a row; a command holds until the next, or until it is too old."""

    name: str
    """Name, such as that of the file."""

    rows: Array
    """Time since the start [s], forward speed [m/s], yaw rate [rad/s], shape (K, 3), in order of time."""

    file: str = ""
    """File that they were read from, as the user named it; "" if none."""

    def beyond(self, drive: DriveSpec) -> str:
        """A line on the commands that exceed a drive's limits; "" if none does."""
        parts = []
        for column, name, most, unit in ((1, "v", drive.v_max, "m/s"), (2, "w", drive.w_max, "rad/s")):
            size = np.abs(self.rows[:, column])
            over = np.count_nonzero(size > most)
            if over:
                parts.append(
                    f"{over} of {len(size)} commands have |{name}| above {most:g} {unit} (to {size.max():g})"
                )
        return f"{self.name}: {', and '.join(parts)}; the drive limits them" if parts else ""

    def _summary(self) -> Summary:
        t, v, w = self.rows.T
        return Summary(
            f"Commands {self.name}: {len(t):,} rows, {t[-1] - t[0]:.4g} s"
            if len(t)
            else f"Commands {self.name}",
            (
                ("v", f"{v.min(initial=np.inf):.3g} to {v.max(initial=-np.inf):.3g} m/s" if len(t) else ""),
                ("w", f"{w.min(initial=np.inf):.3g} to {w.max(initial=-np.inf):.3g} rad/s" if len(t) else ""),
                ("file", self.file),
            ),
        )


def read_commands(file: str | os.PathLike[str]) -> Commands:
    """Commands from a text file of t,v,w in s, m/s and rad/s, a command a line, with or without a header.

    A header that names t, v and w puts them in another order, beside other columns. Warns of what was
    repaired.

    Raises:
        InputError: The file is missing or empty, a line is not three finite numbers, or times do not ascend
            from 0 s; the text has the number of the line.
    """
    noun = "file of commands"
    text = read_delimited(expected(file, noun), noun, "text", "t,v,w, a command a line").named()
    file, names = text.path, [name.lower() for name in text.names]
    named = sorted(set(names) & set(HEADER.split(","))) == sorted(HEADER.split(","))
    columns = [names.index(name) for name in HEADER.split(",")] if named else [0, 1, 2]
    if text.width != 3 and not named:
        shown = repr(",".join(text.rows[0])[:QUOTED])
        raise InputError(
            f"{file}:{text.lines[0]}: a command is three numbers, t,v,w in s, m/s and rad/s; got {shown}"
        )
    rows: list[tuple[float, float, float]] = []
    for number, row in zip(text.lines, text.rows, strict=True):
        where, (t, v, w) = f"{file}:{number}", (number_of(row[column]) for column in columns)
        if not (math.isfinite(t) and math.isfinite(v) and math.isfinite(w)):
            shown = repr(",".join(row)[:QUOTED])
            raise InputError(f"{where}: a command is three finite numbers, t,v,w; got {shown}")
        if t < 0 or (rows and t <= rows[-1][0]):
            after = f"after {rows[-1][0]:g} s" if rows else "as the first"
            raise InputError(
                f"{where}: times must ascend from 0 s, got t = {t:g} s {after}; put the lines in order"
            )
        rows.append((t, v, w))
    if notes := [*text.notes, *(["t, v and w by their names"] if columns != [0, 1, 2] else [])]:
        warnings.warn(f"{file}: read {'; '.join(notes)}", RepairWarning, stacklevel=2)
    return Commands(file.name, np.array(rows), file.as_posix())


def write_commands(commands: Commands, file: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write commands so that `read_commands` reads the same numbers.

    Raises:
        InputError: The file exists and `force` was not given, or it cannot be written.
    """
    lines = [HEADER, *(",".join(map(repr, row)) for row in commands.rows.tolist())]
    with output(file, force=force) as aside:
        aside.write_text("\n".join(lines) + "\n", encoding="utf-8")
