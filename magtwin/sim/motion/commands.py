"""Commands: a script of cmd_vel, from a CSV of t,v,w or from manual driving."""

import math
import os
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.files import existing_file
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
    """Commands from a CSV of `t,v,w` in s, m/s and rad/s, a command a line, with or without a header.

    Raises:
        InputError: The file is missing or empty, a line is not three finite numbers, or times do not ascend
            from 0 s; the text has the number of the line.
    """
    file = existing_file(expected(file, "file of commands"), "file of commands", "text")
    try:
        lines = file.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: not a text file of t,v,w ({error})") from error
    rows: list[tuple[float, float, float]] = []
    headers = 0
    for number, line in enumerate(lines, 1):
        cells = [cell.strip() for cell in line.split(",")]
        if cells == [""]:
            continue
        where = f"{file}:{number}"
        if len(cells) != 3:
            raise InputError(f"{where}: a command is three numbers, t,v,w in s, m/s and rad/s; got {line!r}")
        try:
            t, v, w = (float(cell) for cell in cells)
        except ValueError:
            if rows or headers:
                raise InputError(f"{where}: not a number in {line!r}; a line is t,v,w") from None
            headers += 1
            continue
        if not (math.isfinite(t) and math.isfinite(v) and math.isfinite(w)):
            raise InputError(f"{where}: a command must be finite, got {line!r}")
        if t < 0 or (rows and t <= rows[-1][0]):
            after = f"after {rows[-1][0]:g} s" if rows else "as the first"
            raise InputError(
                f"{where}: times must ascend from 0 s, got t = {t:g} s {after}; put the lines in order"
            )
        rows.append((t, v, w))
    if not rows:
        raise InputError(f"{file}: no commands in it; a line is t,v,w")
    return Commands(file.name, np.array(rows), file.as_posix())


def write_commands(commands: Commands, file: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write commands so that `read_commands` reads the same numbers.

    Raises:
        InputError: The file exists and `force` was not given, or it cannot be written.
    """
    lines = [HEADER, *(",".join(map(repr, row)) for row in commands.rows.tolist())]
    with output(file, force=force) as aside:
        aside.write_text("\n".join(lines) + "\n", encoding="utf-8")
