"""Commands: a script of cmd_vel, from a CSV of t,v,w or from manual driving."""

import math
import os
import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError, RepairWarning
from magtwin.files.kinds import expected
from magtwin.files.outputs import output
from magtwin.report.summary import Summarized, Summary, listed
from magtwin.spec.drive import DriveSpec
from magtwin.tables.delimited import QUOTED, Delimited, number_of, read_delimited
from magtwin.tables.labels import split_label, words_of

Array = NDArray[np.float64]

HEADER = "t,v,w"

COLUMNS = {
    "t": (
        ("t", "time", "stamp", "timestamp", "times", "seconds", "elapsed", "elapsed_time", "time_s"),
        {
            **dict.fromkeys(("s", "sec", "second", "seconds"), 1.0),
            **dict.fromkeys(("ms", "msec", "millisecond", "milliseconds"), 1e-3),
            **dict.fromkeys(("us", "usec", "microseconds"), 1e-6),
            **dict.fromkeys(("ns", "nsec", "nanoseconds"), 1e-9),
        },
    ),
    "v": (
        (
            *("v", "v_cmd", "cmd_v", "vx", "v_x", "linear", "linear_x", "lin", "lin_x", "lin_vel", "v_lin"),
            *("linear_velocity", "linear_velocity_x", "linear_speed", "speed", "velocity", "vel", "vel_x"),
            *("velocity_x", "forward", "forward_speed", "forward_velocity"),
        ),
        {
            **dict.fromkeys(("m_s", "mps", "m_s_1"), 1.0),
            **dict.fromkeys(("mm_s", "mmps", "mm_s_1"), 1e-3),
            **dict.fromkeys(("cm_s", "cmps", "cm_s_1"), 1e-2),
            **dict.fromkeys(("km_h", "kmh", "kmph", "kph"), 1 / 3.6),
        },
    ),
    "w": (
        (
            *("w", "w_cmd", "cmd_w", "wz", "w_z", "omega", "omega_z", "angular", "angular_z", "ang", "ang_z"),
            *("ang_vel", "w_ang", "angular_velocity", "angular_velocity_z", "angular_speed", "yaw_rate"),
            *("yawrate", "yaw_speed", "turn_rate", "turn", "rotation_rate"),
        ),
        {
            **dict.fromkeys(("rad_s", "radps", "rad_s_1"), 1.0),
            **dict.fromkeys(("deg_s", "degps", "dps", "deg_s_1"), math.pi / 180),
        },
    ),
}
"""Names of the columns of t, v and w, the best first, and units with their factors to SI."""

CARRIERS = frozenset({"field", "twist", "cmd", "vel", "msg", "data", "header"})
"""Words before a name that say where it comes from, as in `field.twist.linear.x`."""

WHEELS = frozenset({"left", "right", "l", "r", "rpm", "steering", "steer"})
"""Words of columns of other commands."""

LONGEST_NAME = 10
"""Most words of a name."""

LATEST_START_S = 1e6
"""Later first times are on a clock that does not start with the run [s]."""

LATEST_S = 1e11
"""Greatest time since 1970 that is in s; greater ones are in ms, us or ns."""


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

    A header names t, v and w, in any order and beside other columns, by these or other usual names
    (`COLUMNS`), and perhaps their units: `time,linear.x,angular.z`, `t [ms],v [mm/s],w [deg/s]`, `v_kmh`.
    Times count from the first line if that is later than `LATEST_START_S`. Warns of what was repaired.

    Raises:
        InputError: The file is missing or empty, its header names no t, v and w or another unit, a line is
            not three finite numbers, or times do not ascend from 0 s; the text has the number of the line.
    """
    noun = "file of commands"
    text = read_delimited(expected(file, noun), noun, "text", "t,v,w, a command a line").named()
    file, notes = text.path, list(text.notes)
    columns, factors = _columns(text, notes)
    first = number_of(text.rows[0][columns[0]])
    if not factors[0]:  # a time without a unit
        factors = (_by_size(first), *factors[1:])
        if factors[0] != 1:
            notes.append(f"{text.names[columns[0]] if text.names else 't'} in {factors[0]:g} s, by its size")
    start = first if math.isfinite(first) and first * factors[0] > LATEST_START_S else 0.0
    if start:
        notes.append(f"times as counted from the first line, at {start * factors[0]:.13g} s")
    rows: list[tuple[float, float, float]] = []
    for number, row in zip(text.lines, text.rows, strict=True):
        where, (t, v, w) = f"{file}:{number}", (number_of(row[column]) for column in columns)
        if not (math.isfinite(t) and math.isfinite(v) and math.isfinite(w)):
            shown = repr(",".join(row)[:QUOTED])
            raise InputError(f"{where}: a command is three finite numbers, t,v,w; got {shown}")
        t, v, w = (t - start) * factors[0], v * factors[1], w * factors[2]
        if t < 0 or (rows and t <= rows[-1][0]):
            after = f"after {rows[-1][0]:g} s" if rows else "as the first"
            raise InputError(
                f"{where}: times must ascend from 0 s, got t = {t:g} s {after}; put the lines in order"
            )
        rows.append((t, v, w))
    if notes:
        warnings.warn(f"{file}: read {'; '.join(notes)}", RepairWarning, stacklevel=2)
    return Commands(file.name, np.array(rows), file.as_posix())


def _columns(text: Delimited, notes: list[str]) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Columns of t, v and w, and their factors to SI, 0 for a time without a unit; `notes` gets the rest."""
    if not text.names:
        if text.width != 3:
            shown = repr(",".join(text.rows[0])[:QUOTED])
            raise InputError(
                f"{text.path}:{text.lines[0]}: a command is three numbers, t,v,w in s, m/s and rad/s; got "
                f"{shown}"
            )
        return (0, 1, 2), (0.0, 1.0, 1.0)
    header = ",".join(text.names)[:QUOTED]
    meanings = [_meaning(name) for name in text.names]
    columns, factors, in_units = [], [], []
    for role, (names, units) in COLUMNS.items():
        found = sorted((names.index(name), k) for k, (of, name, _) in enumerate(meanings) if of == role)
        if not found:
            words = {word for name in text.names for word in split_label(name)[0]}
            other = "; wheel speeds and steering angles are not read" if words & WHEELS else ""
            raise InputError(
                f"{text.path}: no column of {role} in {header!r}{other}; name time, forward speed and yaw "
                "rate in the header: t,v,w"
            )
        if len(found) > 1 and found[0][0] == found[1][0]:
            raise InputError(f"{text.path}: several columns of {role} in {header!r}; keep one")
        column = found[0][1]
        unit = meanings[column][2]
        if unit and unit not in units:
            usual = {factor: name.replace("_", "/") for name, factor in reversed(units.items())}
            known = ", ".join(reversed(usual.values()))
            raise InputError(f"{text.path}: {text.names[column]!r} is in no unit of {role}; known: {known}")
        columns.append(column)
        factors.append(units[unit] if unit else 0.0 if role == "t" else 1.0)
        in_units += [text.names[column]] if factors[-1] not in (0.0, 1.0) else []
    plain = [meanings[column][1] for column in columns] == list(COLUMNS)
    if not plain:
        notes.append(f"{', '.join(text.names[column] for column in columns)} as t, v and w")
    elif columns != [0, 1, 2]:
        notes.append("t, v and w by their names")
    if in_units:
        notes.append(f"{listed(in_units)} by the units in their names")
    if left := [name for k, name in enumerate(text.names) if k not in columns]:
        notes.append(f"t, v and w, and left out {listed(left)}")
    return tuple(columns), tuple(factors)


def _meaning(label: str) -> tuple[str, str, str]:
    """What a label names, t, v or w, by which name, and its unit; "" if none."""
    words, text = split_label(label)
    bracket = "_".join(word for word in words_of(text) if word != "per")
    words = words if len(words) <= LONGEST_NAME else ()
    for begin in range(len(words)):
        if not CARRIERS.issuperset(words[:begin]):
            break
        for end in range(len(words), begin, -1):
            name = "_".join(words[begin:end])
            unit = bracket or "_".join(word for word in words[end:] if word != "per")
            for role, (names, units) in COLUMNS.items():
                if name in names and (end == len(words) or (unit in units and not bracket)):
                    return role, name, unit
    return "", "", ""


def _by_size(t: float) -> float:
    """Seconds per unit of a time without a unit: since 1970, it is in s, ms, us or ns by its size."""
    power = 0
    while power < 3 and t * 1e-3**power > LATEST_S:
        power += 1
    return float(f"1e-{3 * power}")


def write_commands(commands: Commands, file: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write commands so that `read_commands` reads the same numbers.

    Raises:
        InputError: The file exists and `force` was not given, or it cannot be written.
    """
    lines = [HEADER, *(",".join(map(repr, row)) for row in commands.rows.tolist())]
    with output(file, force=force) as aside:
        aside.write_text("\n".join(lines) + "\n", encoding="utf-8")
