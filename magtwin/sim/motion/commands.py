"""Commands: a script of cmd_vel, from a CSV of t,v,w or from manual driving."""

import os
import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError, RepairWarning
from magtwin.files.kinds import expected
from magtwin.files.outputs import output
from magtwin.report.summary import Summarized, Summary, span
from magtwin.spec.drive import DriveSpec
from magtwin.tables.delimited import QUOTED
from magtwin.tables.labels import split_label
from magtwin.tables.table import Table, read_table, since_1970

Array = NDArray[np.float64]

HEADER = "t,v,w"

WHEELS = frozenset({"left", "right", "l", "r", "rpm", "steering", "steer"})
"""Words of columns of other commands."""

LATEST_START_S = 1e6
"""Later first times are on a clock that does not start with the run [s]."""


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
                above = f"above {most:g} {unit} (to {size.max():g})"
                parts.append(f"{over} of {len(size)} commands have |{name}| {above}")
        return f"{self.name}: {', and '.join(parts)}; the drive limits them" if parts else ""

    def _summary(self) -> Summary:
        t, v, w = self.rows.T
        title, file = f"Commands {self.name}", ("file", self.file)
        if not len(t):
            return Summary(title, (file,))
        spans = (
            ("v", span(v.min(), v.max(), "m/s", form=".3g")),
            ("w", span(w.min(), w.max(), "rad/s", form=".3g")),
        )
        return Summary(f"{title}: {len(t):,} rows, {t[-1] - t[0]:.4g} s", (*spans, file))


def read_commands(file: str | os.PathLike[str]) -> Commands:
    """Commands from a table of t,v,w in s, m/s and rad/s, a command a row, with or without a header.

    A header names t, v and w, in any order and beside other columns, by any name of
    `magtwin.tables.quantities`, and perhaps their units: `time,linear.x,angular.z`, `t [ms],v [mm/s],w
    [deg/s]`, `v_kmh`. Times count from the first row if that is later than `LATEST_START_S`. Warns of what
    was repaired.

    Raises:
        InputError: The file is missing or empty, its header names no t, v and w or another unit, a row is
            not three finite numbers, or times do not ascend from 0 s; the text has the number of the line.
    """
    noun = "file of commands"
    table = read_table(expected(file, noun), noun, "t,v,w, a command a line")
    columns = _columns(table)
    named = columns["t"] != "1" or table.columns[0].name
    notes = [*table.notes, *(table.taken(columns) if named else [])]
    t, unit = since_1970(table, columns["t"])
    notes += [unit] if unit else []
    rows = np.column_stack([t, table.numbers(columns["v"], "v"), table.numbers(columns["w"], "w")])
    where = table.columns[0].where
    if len(wrong := np.flatnonzero(~np.isfinite(rows).all(axis=1))):
        raise InputError(f"{where(int(wrong[0]))}: a command is three finite numbers, t,v,w; one is missing")
    if rows[0, 0] > LATEST_START_S:
        notes.append(f"times as counted from the first line, at {rows[0, 0]:.13g} s")
        rows[:, 0] -= rows[0, 0]
    early = np.flatnonzero(np.diff(rows[:, 0], prepend=-np.inf) <= 0)
    if rows[0, 0] < 0 or len(early):
        k = 0 if rows[0, 0] < 0 else int(early[0])
        after = f"after {rows[k - 1, 0]:g} s" if k else "as the first"
        raise InputError(
            f"{where(k)}: times must ascend from 0 s, got t = {rows[k, 0]:g} s {after}; put the "
            "lines in order"
        )
    if notes:
        warnings.warn(f"{table.path}: read {'; '.join(notes)}", RepairWarning, stacklevel=2)
    return Commands(table.path.name, rows, table.path.as_posix())


def _columns(table: Table) -> dict[str, str]:
    """Columns of t, v and w."""
    labels = [column.name for column in table.columns if column.name]
    if not labels:
        if len(table.columns) != 3:
            shown = ",".join(column.cells[0] for column in table.columns)[:QUOTED]
            raise InputError(
                f"{table.columns[0].where(0)}: a command is three numbers, t,v,w in s, m/s and rad/s; got "
                f"{shown!r}"
            )
        return dict(zip("tvw", "123", strict=True))
    found = {symbol: table.find(symbol) for symbol in "tvw"}
    for symbol, columns in found.items():
        if not columns:
            words = {word for label in labels for word in split_label(label).words}
            other = "; wheel speeds and steering angles are not read" if words & WHEELS else ""
            raise InputError(
                f"{table.path}: no column of {symbol} in {','.join(labels)[:QUOTED]!r}{other}; name time, "
                "forward speed and yaw rate in the header: t,v,w"
            )
    return {symbol: columns[0] for symbol, columns in found.items()}


def write_commands(commands: Commands, file: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write commands so that `read_commands` reads the same numbers.

    Raises:
        InputError: The file exists and `force` was not given, or it cannot be written.
    """
    lines = [HEADER, *(",".join(map(repr, row)) for row in commands.rows.tolist())]
    with output(file, force=force) as aside:
        aside.write_text("\n".join(lines) + "\n", encoding="utf-8")
