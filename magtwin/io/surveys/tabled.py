"""Tabled: the readings in a table, whose columns are known by their names, units and sizes."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.field.grid import FARTHEST_M
from magtwin.field.survey.folder import LARGEST_TURN, USUAL_SPAN_M
from magtwin.field.survey.hold import held
from magtwin.field.survey.readings import TAKEN, Readings
from magtwin.field.survey.steps import LEFT, smooth_within_steps
from magtwin.field.units import NT_PER, check_unit, nt_per, unit_by_size
from magtwin.frames import yaw_from_quat
from magtwin.io.surveys.axes import levelled, other_axes
from magtwin.io.surveys.columns import NO_HEADING, Columns
from magtwin.io.surveys.places import on_tangent_plane
from magtwin.tables.labels import is_on_earth, meaning_of, split_label, unit_of
from magtwin.tables.quantities import ANGLES, CLOCKWISE, DEGREES, FIELDS
from magtwin.tables.table import Table, since_1970

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

LEAST_SPAN_M = 0.01  # Extent below which the report asks whether positions are in degrees [m]
APART = 2.0  # Largest median ratio between vectors and magnitudes of the same table
SAME_LENGTH = 0.01  # Largest median difference of x, y, z from the magnitude by which they are its components


def rows_of_table(table: Table, told: Columns, name: str, source: str) -> tuple[Readings, NDArray[np.bool_]]:
    """The readings in a table, of which the user `told` some columns, and which rows they are in.

    Name and source are those of its files.

    Refused are a column that is missing, with the nearest name; a cell that is no number, with file and line;
    a field that is in no unit, and columns that contradict each other.
    """
    columns, taken = _complete(table, told)
    p, datum = _positions(table, columns, taken)
    turn = _turn(table, columns)
    vector, b = _field(table, columns)
    rounding = 0.0
    if turn is None and columns.heading == NO_HEADING and vector is not None and columns.axes != "world":
        what = f"{columns.field} without" if columns.field else "the magnitude of"
        taken.append(f"{what} {columns.vector}, since a sensor carried by hand has no heading")
        if not columns.field:
            b, rounding = _within_steps(vector, b, taken)
        vector = None
    t = _times(table, columns, told, taken)
    if (zero := int(np.count_nonzero(b == 0))) and 2 * zero < len(b):
        taken.append(f"{zero} readings of 0 left out, as a sensor without a reading writes")
        b = np.where(b == 0, np.nan, b)
    some = [p, b[:, None]] + [v.reshape(len(p), -1) for v in (turn, vector, t) if v is not None]
    known: NDArray[np.bool_] = np.all(np.isfinite(np.hstack(some)), axis=1)
    if not known.any():
        text = f"no row is complete; all {len(known)} have a cell that is empty or nan"
        raise InputError(f"{table.path}: {text}")
    _check_places(table, columns, p, known, taken)
    turn = np.zeros(len(known)) if turn is None else _upright(table, columns, turn, known)
    taken += _check_field(table, columns, told, p[known], b[known], np.flatnonzero(known))
    if vector is not None:
        _check_vectors(table, columns, vector[known], b[known], turn[known])
        vector = levelled(vector, turn, columns.axes or "body")[known]
    notes = [f"; {TAKEN}{note.replace('; ', ', ')}" for note in taken]  # "; " separates them
    readings = Readings(
        p_xy=p[known],
        yaw=(turn if turn.ndim == 1 else yaw_from_quat(turn))[known],
        b_nt=b[known],
        b_body_nt=vector,
        t=None if t is None else t[known],
        rounding_nt=rounding,
        by_hand=columns.heading == NO_HEADING,
        frame="world: x east, y north" if datum else "",
        datum=datum,
        runs=(name,),
        name=name,
        source=source + left_out(known) + "".join(notes),
    )
    return readings, known


def _within_steps(vector: Array, b: Array, taken: list[str]) -> tuple[Array, float]:
    """Magnitudes of vectors of a coarse sensor, smooth within its steps, and the error that is left [nT]."""
    if not np.isfinite(vector).all() or held(b)[0].any():
        return b, 0.0  # a stuck sensor must still show
    parts = [smooth_within_steps(part) for part in vector.T]
    step = max(step for _, step in parts)
    if step:
        taken.append(f"components smooth within the sensor's step of {step:.3g} nT")
        b = np.linalg.norm([values for values, _ in parts], axis=0)
    return b, LEFT * step


def field_of_table(table: Table, told: Columns) -> tuple[Array | None, Array, Array | None, str]:
    """Vectors, magnitudes [nT] and times [s] of a table that may lack positions, and the field's unit."""
    told = told if told.heading or told.quaternion else replace(told, heading=NO_HEADING)
    columns, taken = _complete(table, told, placed=False)
    vector, b = _field(table, columns)
    unit = columns.unit or (f"units of {told.scale:g} nT" if told.scale else "nT")
    return vector, np.where(b == 0, np.nan, b), _times(table, columns, told, taken), unit


def left_out(known: NDArray[np.bool_]) -> str:
    """A note on rows without a value."""
    missing = int(np.count_nonzero(~known))
    return f" ({missing} of {len(known)} rows without a value left out)" if missing else ""


def _complete(table: Table, told: Columns, *, placed: bool = True) -> tuple[Columns, list[str]]:
    """Columns and unit, with missing ones found by name and size; and what was found so."""
    taken = list(table.notes)
    told = _by_place(table, told, taken) if placed and told == Columns() else told
    columns = _placed(table, told, taken) if placed else told
    if not (columns.heading or columns.quaternion):
        columns = replace(columns, heading="".join(table.find("heading")))
    if columns.quaternion:
        columns = _in_order(table, columns, taken)
    if not columns.heading and not columns.quaternion and columns.axes != "world":
        columns = replace(columns, heading=NO_HEADING)
        taken.append("no heading, so the sensor as carried by hand, alike at all headings (--heading)")
    if not columns.field and not columns.vector:
        columns = _with_field(table, columns, taken)
    if placed:
        _check_roles(table, columns)
    if columns.heading_unit is None and columns.heading not in ("", NO_HEADING):
        angle = table.unit(columns.heading, "heading")
        meaning = meaning_of(table.column(columns.heading).name, "heading")
        if meaning and meaning.name in CLOCKWISE:
            columns = replace(columns, heading_unit="compass")
            taken.append(f"{columns.heading} clockwise from north, by its name (--heading-unit)")
        elif angle in ANGLES:
            columns = replace(columns, heading_unit="deg" if angle in DEGREES else "rad")
            taken.append(f"{columns.heading} in {columns.heading_unit}, by its name (--heading-unit)")
    if columns.unit is None and columns.scale is None:
        parts = [columns.field] if columns.field else columns.several("vector")
        factors = {FIELDS.get(table.unit(part, "field")) for part in parts} - {None}
        if len(factors) > 1:
            raise InputError(f"{table.path}: the units of {columns.vector} differ; give all in one unit")
        if factors:
            unit: Any = next(unit for unit, factor in NT_PER.items() if factor in factors)
            return replace(columns, unit=unit), taken
        _, b = _field(table, replace(columns, unit="nT"))
        unit = unit_by_size(b)
        if unit not in (None, "nT"):
            columns = replace(columns, unit=unit)
            taken.append(f"{columns.field or columns.vector} in {unit}, by its size (--unit)")
    return columns, taken


def _placed(table: Table, told: Columns, taken: list[str]) -> Columns:
    """Columns with those of x and y found by name, else those of longitude and latitude."""
    used = {told.field, *told.several("vector")}
    labels = [told.x or "".join(table.find("x", apart=used)), told.y or "".join(table.find("y", apart=used))]
    if not (told.x or told.y):
        labels = table.find("x", "y", apart=used) or table.find("x", "y")
        labels = table.find("lon", "lat") if not labels or any(map(is_on_earth, labels)) else labels
    if not labels or not all(labels):
        raise InputError(
            f"{table.path}: no column of x and of y {_seen(table)}; name both: --x NAME --y NAME; or write "
            "down when you passed which places, as t,x,y, and give that file: --waypoints FILE"
        )
    columns = replace(told, x=labels[0], y=labels[1])
    if is_on_earth(table.column(columns.x).name):
        return columns
    notes = table.taken({"x": columns.x, "y": columns.y})
    taken += [note for note in notes if "by the units" in note]
    if not (told.x or told.y):
        taken += [f"{note} (--x, --y)" for note in notes if note.endswith(" as x and y")]
    return columns


def _by_place(table: Table, told: Columns, taken: list[str]) -> Columns:
    """Columns x, y, field or t, x, y, field of a table without a header, if the last alone may be a field."""
    count = len(table.columns)
    if any(column.name for column in table.columns) or count not in (3, 4):
        return told
    sizes = [unit_by_size(table.numbers(name)) for name in table.names]
    if sizes[-1] is None or any(sizes[-3:-1]):
        return told
    *time, x, y, field = table.names
    taken.append(
        f"columns {', '.join(table.names)} as {'t, ' * len(time)}x, y and the field (--x, --y, --field)"
    )
    return replace(told, x=x, y=y, field=field, time="".join(time))


def _positions(table: Table, columns: Columns, taken: list[str]) -> tuple[Array, str]:
    """Positions [m], shape (N, 2), and the origin of those that were longitudes and latitudes."""
    if not is_on_earth(table.column(columns.x).name):
        return np.column_stack([table.numbers(columns.x, "x"), table.numbers(columns.y, "y")]), ""
    degrees = [table.numbers(name) for name in (columns.y, columns.x)]
    if not is_on_earth(table.column(columns.y).name) or (np.abs(degrees) > [[90], [360]]).any():
        pair = f"{columns.x} and {columns.y}"
        raise InputError(f"{table.path}: {pair} are no longitude and latitude in degrees; check --x and --y")
    p, datum = on_tangent_plane(*degrees)
    taken.append(f"{columns.x} and {columns.y} as x east and y north on the {datum}")
    return p, datum


def _with_field(table: Table, columns: Columns, taken: list[str]) -> Columns:
    """Columns with that of the magnitude found by name, else those of the components."""
    if found := table.find("field", apart={columns.x, columns.y}):
        return replace(columns, field=found[0])
    units = [label for label in table.names if unit_of(label, "bx") in FIELDS]  # X_uT, Y_uT, Z_uT
    three = table.find("bx", "by", "bz")
    three = three or [n for axis in "xyz" for n in units if split_label(n).words[:1] == (axis,)]
    if len(three) != 3:
        advice = "name the magnitude with --field NAME, or the components with --vector BX,BY,BZ"
        raise InputError(f"{table.path}: no column of the field {_seen(table)}; {advice}")
    columns = replace(columns, vector=",".join(three))
    if columns.axes is None and columns.heading != NO_HEADING:
        taken.append(f"{columns.vector} as the field in the robot's axes, forward, left, up (--axes)")
    return columns


def _seen(table: Table) -> str:
    labels = ", ".join(column.name for column in table.columns if column.name)
    none = f"(no header: name columns by number, 1 to {len(table.columns)})"
    return f"was found by its name (columns: {labels})" if labels else none


def _in_order(table: Table, columns: Columns, taken: list[str]) -> Columns:
    """Columns whose quaternion is xyzw, if its names end in these letters."""
    given = columns.several("quaternion")
    by_letter = {split_label(table.column(name).name).words[-1][-1:]: name for name in given}
    if set(by_letter) != set("xyzw") or list(by_letter) == list("xyzw"):
        return columns
    ordered = ",".join(by_letter[letter] for letter in "xyzw")
    taken.append(f"{columns.quaternion} as {ordered}, by their names (--quaternion)")
    return replace(columns, quaternion=ordered)


def _check_roles(table: Table, columns: Columns) -> None:
    """Refuse a column of two roles, and x and y that are components of the field."""
    roles = [("position", columns.x), ("position", columns.y), ("time", columns.time)]
    roles += [("heading", columns.heading)] if columns.heading != NO_HEADING else []
    roles += [("orientation", name) for name in columns.several("quaternion")]
    roles += [("field", name) for name in (columns.field, *columns.several("vector"))]
    seen = dict[int, str]()
    for role, name in roles:
        if not name:
            continue
        column = table.column(name)
        if other := seen.get(id(column)):
            both = f"{role} twice" if other == role else f"{other} and {role} at once"
            advice = "--x, --y, --heading, --quaternion, --field, --vector or --time"
            text = f"column {column.name or name!r} cannot be {both}; name other columns with {advice}"
            raise InputError(f"{table.path}: {text}")
        seen[id(column)] = role
    z = next((label for label in table.names if split_label(label).words == ("z",)), "")
    places = [split_label(table.column(name).name).words for name in (columns.x, columns.y)]
    if not (columns.field and z) or places != [("x",), ("y",)]:
        return
    try:
        length = np.linalg.norm([table.numbers(name) for name in (columns.x, columns.y, z)], axis=0)
    except InputError:
        return  # texts
    b = table.numbers(columns.field)
    known = np.isfinite(length) & (b > 0)
    if known.any() and np.median(np.abs(length[known] / b[known] - 1)) < SAME_LENGTH:
        text = f"{columns.x}, {columns.y} and {z} are the components of {columns.field}, no positions"
        raise InputError(f"{table.path}: {text}; name those with --x and --y")


def _times(table: Table, columns: Columns, told: Columns, taken: list[str]) -> Array | None:
    """Times [s]; None if there are none, or they cannot be read and nobody asked for them."""
    try:
        if name := columns.time or "".join(table.find("t")):
            t, note = since_1970(table, name)
            taken += [note] if note else []
            return t
    except InputError as error:
        if told.time:
            raise
        taken.append(f"no times: {error}")
    return None


def _check_places(table: Table, columns: Columns, p: Array, known: Flags, taken: list[str]) -> None:
    """Refuse positions that are too far away; a note on ones whose unit is in doubt."""
    if (away := known & (np.abs(p) > FARTHEST_M).any(axis=1)).any():
        row = int(away.argmax())
        where = table.column(columns.x).where(row)
        raise InputError(f"{where}: x and y are metres, within {FARTHEST_M:g} of the origin, got {p[row]}")
    if table.unit(columns.x, "x") or table.unit(columns.y, "y"):
        return
    span = float(np.ptp(p[known], axis=0).max())
    if span > USUAL_SPAN_M:
        doubt = f"{span:,.0f} m: if these are cm, write x [cm],y [cm] in the header"
        taken.append(f"x and y in metres, over {doubt}")
    elif 0 < span < LEAST_SPAN_M and np.abs(p[known]).max() > 1:
        doubt = f"{1e3 * span:.3g} mm only: if these are degrees, call them lon and lat"
        taken.append(f"x and y in metres, over {doubt}")


def _upright(table: Table, columns: Columns, turn: Array, known: NDArray[np.bool_]) -> Array:
    """Headings, or quaternions of length 1."""
    if turn.ndim == 1:
        return turn
    length = np.linalg.norm(turn, axis=1)
    if (off := known & (np.abs(length - 1) > 0.01)).any():
        where = table.column(columns.several("quaternion")[0]).where(int(off.argmax()))
        raise InputError(f"{where}: a quaternion's length is 1, got {length[off.argmax()]:.4g}")
    return np.asarray(turn / length[:, None])


def _check_field(
    table: Table, columns: Columns, told: Columns, p: Array, b: Array, rows: NDArray[np.intp]
) -> list[str]:
    """Refuse magnitudes that cannot be a field; a note on a median that the Earth's field does not have."""
    magnitude = table.column(columns.field or columns.several("vector")[0])
    if b.min() <= 0:
        k = int(np.argmax(b <= 0))
        raise InputError(f"{magnitude.where(int(rows[k]))}: a magnitude is above 0, got {b[k]:g} nT")
    warning = check_unit(
        b,
        str(table.path),
        magnitude.name or columns.field or columns.vector,
        columns.unit or "nT",
        lambda k: magnitude.where(int(rows[k])),
        columns.scale,
        told=columns.unit is not None or columns.scale is not None,
        p_xy=None if told.unit is not None or told.scale is not None else p,
    )
    return [warning] if warning else []


def _check_vectors(table: Table, columns: Columns, vector: Array, b: Array, turn: Array) -> None:
    """Refuse vectors of another size than the magnitudes, and in other axes or headings than those given."""
    ratio = float(np.median(np.linalg.norm(vector, axis=1) / b))
    if not 1 / APART <= ratio <= APART:
        text = f"{columns.vector} is {ratio:.3g} times as long as {columns.field} (median)"
        advice = "give both in one unit, and the components of the whole field"
        raise InputError(f"{table.path}: {text}; {advice}")
    said = columns.axes or "body"
    best, kept = other_axes(vector, turn, said)
    if not best:
        return
    they = f"{table.path}: {columns.vector} are taken to be in {said} axes, but they keep one direction"
    they += f" ({100 * kept:.0f} % of them)"
    if best != "mirrored":
        advice = f"give --axes {best}, or correct the headings or the order of the components"
        raise InputError(f"{they} in {best} axes, as the Earth's field does: {advice}")
    turned = "give --heading-unit compass for headings clockwise from north"
    if columns.quaternion:
        turned = "change the signs of x, y and z of a quaternion that turns world to body"
    elif columns.heading_unit == "compass":
        turned = "give --heading-unit deg for headings counter-clockwise from +x"
    turned = f"give --axes body, and {turned}" if said == "world" else turned
    turned += ", or change the signs of the second and third component in the file"
    raise InputError(f"{they} if headings turn the other way, or if they are forward, right, down: {turned}")


def _turn(table: Table, columns: Columns) -> Array | None:
    """Headings [rad], shape (N,), or quaternions xyzw, shape (N, 4); None if there is no such column."""
    if columns.quaternion:
        return np.column_stack([table.numbers(name) for name in columns.several("quaternion")])
    if columns.heading in ("", NO_HEADING):
        return None
    heading = table.numbers(columns.heading)
    if columns.heading_unit == "deg":
        return np.radians(heading)
    if columns.heading_unit == "compass":
        return np.radians(90.0 - heading)
    if columns.heading_unit is None and (beyond := np.abs(heading) > LARGEST_TURN).any():
        k = int(beyond.argmax())
        text = f"heading {heading[k]:g} is beyond a full turn in radians; give --heading-unit deg"
        text += " (counter-clockwise from +x), compass (clockwise from north) or, if it counts turns, rad"
        raise InputError(f"{table.column(columns.heading).where(k)}: {text}")
    return heading


def _field(table: Table, columns: Columns) -> tuple[Array | None, Array]:
    """Vectors, if there are any, and magnitudes [nT], shapes (N, 3) and (N,)."""
    factor, names = nt_per(columns.unit, columns.scale), columns.several("vector")
    vector = factor * np.column_stack([table.numbers(name) for name in names]) if names else None
    if vector is not None and not columns.field:
        return vector, np.linalg.norm(vector, axis=1)
    return vector, factor * table.numbers(columns.field)
