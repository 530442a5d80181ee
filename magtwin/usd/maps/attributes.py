"""Attributes of a map's prim, one by one."""

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Usd, Vt

from magtwin.errors import InputError
from magtwin.field.grid import Grid
from magtwin.field.maps.made_from import MadeFrom
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.sources.harmonic import SHAPES as HARMONIC
from magtwin.usd.schema import attribute_name, author, has_api, place, type_of, value_of

MOST_CHARACTERS = 60
"""Characters of an attribute that an error quotes."""

TEXTS = ("name", "method", "source", "licence", "created")

PLACES = ("frame", "datum")

MADE_FROM = attribute_name("anomalyMap", "made_from")

GRID = ("shape", "origin", "cellSize", "headings")
"""Attributes of the grid, which the checksum covers."""

CHECKSUM_VERSION = 2
"""Version of the checksum: 1 did not cover the grid, and 3 was of maps in tiles."""


def get(prim: Usd.Prim, name: str) -> Any:
    """Value of one of the map's attributes, of the schema's type."""
    attribute = prim.GetAttribute(attribute_name("anomalyMap", name))
    return check_type(attribute, value_of(attribute))


def check_type(attribute: Usd.Attribute, value: Any) -> Any:
    """`value`, if it is of the attribute's type.

    Raises:
        InputError: It is not; names the prim.
    """
    kind = type_of(attribute)
    if not isinstance(value, type(kind.defaultValue)):
        raise InputError(f"{place(attribute.GetPrim())}: {attribute.GetName()} must be a {kind}")
    return value


def read_height(prim: Usd.Prim) -> float | None:
    """Height of the sensor above the floor [m]; None if unknown."""
    attribute = prim.GetAttribute(attribute_name("anomalyMap", "height_m"))
    height = attribute.Get()
    if height is None:
        return None
    if not isinstance(height, float) or not math.isfinite(height):
        text = f"must be a length [m], got {height!r}; clear it where unknown"
        raise InputError(f"{attribute.GetName()} {text}")
    return height


def read_parameters(text: str) -> dict[str, Any]:
    """Parameters from their JSON; empty if there is none."""
    name = attribute_name("anomalyMap", "parameters")
    got = f"got {text[:MOST_CHARACTERS]!r}; make the map anew"
    try:
        figures = json.loads(text or "{}")
        json.dumps(figures, allow_nan=False)  # refuses NaN, and 1e999, which is infinite
    except (ValueError, RecursionError) as error:
        raise InputError(f"{name} is not JSON ({error}), {got}") from error
    if not isinstance(figures, dict):
        raise InputError(f"{name} must be a JSON object, {got}")
    return figures


def read_made_from(prim: Usd.Prim) -> MadeFrom | None:
    """What a prim's map was made from, or what was authored over it; None if that is not recorded.

    Raises:
        InputError: The attribute holds something else; names the prim.
    """
    text = get(prim, "madeFrom")
    if not text:
        return None
    try:
        return MadeFrom.from_table(json.loads(text))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{place(prim)}: {MADE_FROM}: {error}; make the map anew") from error


def write_made_from(prim: Usd.Prim, made_from: MadeFrom) -> None:
    """Author what a map was made from on its prim, in the stage's edit target."""
    author(prim.GetAttribute(MADE_FROM), _spelled(made_from))


def _spelled(made_from: MadeFrom | None) -> str:
    return "" if made_from is None else json.dumps(made_from.table(), ensure_ascii=False)


def read_harmonic(prim: Usd.Prim) -> dict[str, NDArray] | None:
    """The arrays of the harmonic field in the schema's order; None if there is none."""
    if not has_api(prim, "harmonic"):
        return None
    arrays = {}
    for name, shape in HARMONIC.items():
        attribute = prim.GetAttribute(attribute_name("harmonic", name))
        source = attribute.GetResolveInfo(Usd.TimeCode.Default()).GetSource()
        if source != Usd.ResolveInfoSourceDefault:
            continue
        value = check_type(attribute, attribute.Get())
        arrays[name] = np.array(value, float).reshape([-1 if n < 0 else n for n in shape])
    if arrays and len(arrays) < len(HARMONIC):
        lost = ", ".join(attribute_name("harmonic", name) for name in HARMONIC.keys() - arrays.keys())
        raise InputError(f"{place(prim)}: its harmonic field has no {lost}; make the map anew")
    return arrays or None


def set_values(prim: Usd.Prim, values: Mapping[str, Any]) -> None:
    """Author attributes by name, but those without a value."""
    for name, value in values.items():
        if value is not None:
            author(prim.GetAttribute(name), value)


def grid_values(field: AnomalyMap) -> dict[str, Any]:
    """Values of the attributes of a map's grid and of its place, by name; None if there is no value."""
    grid = field.grid
    values = {
        "shape": Vt.IntArray(grid.shape),
        "origin": Gf.Vec2d(*grid.origin_m),
        "cellSize": Gf.Vec2d(*grid.cell_m),
        "headings": Vt.DoubleArray(np.rad2deg(grid.headings_rad).tolist()),
        "checksumVersion": CHECKSUM_VERSION,
        "height_m": field.height_m,
        **{name: getattr(field, name) for name in PLACES},
    }
    return {attribute_name("anomalyMap", name): value for name, value in values.items()}


def texts_of(field: AnomalyMap) -> dict[str, Any]:
    """Values of the attributes that are texts, by name."""
    parameters = dict(field.parameters or {})
    try:
        text = json.dumps(parameters, allow_nan=False, ensure_ascii=False) if parameters else ""
    except (TypeError, ValueError) as error:
        raise InputError(
            f"parameters of map {field.name!r} must be finite numbers, texts and lists of them ({error})"
        ) from error
    given = {
        "parameters": text,
        "made_from": _spelled(field.made_from),
        **{name: getattr(field, name) for name in TEXTS},
    }
    return {attribute_name("anomalyMap", name): value for name, value in given.items()}


def harmonic_arrays(field: AnomalyMap) -> dict[str, NDArray] | None:
    """Arrays of a map's harmonic field by name; None if there is none."""
    return None if field.harmonic is None else {n: getattr(field.harmonic, n) for n in HARMONIC}


def harmonic_values(harmonic: Mapping[str, NDArray] | None) -> dict[str, Any]:
    """Values of the attributes of a harmonic field, by name; None if there is none."""
    values: dict[str, Any] = {}
    for name, shape in HARMONIC.items():
        value: Any = harmonic[name] if harmonic else None
        if value is not None and -1 in shape:  # any number of rows
            value = Vt.Vec3dArray.FromNumpy(np.ascontiguousarray(value))
        elif value is not None:
            value = (Gf.Matrix3d if len(shape) == 2 else Gf.Vec3d)(*value.ravel().tolist())
        values[attribute_name("harmonic", name)] = value
    return values


def grid_numbers(grid: Grid) -> NDArray[np.float64]:
    """The numbers of a map's grid in the order of `GRID`, as its layer has them."""
    return np.concatenate([grid.shape, grid.origin_m, grid.cell_m, np.rad2deg(grid.headings_rad)])
