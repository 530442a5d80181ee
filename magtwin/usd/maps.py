"""An AnomalyMap as a USD layer: arrays on one prim, and a coloured floor for viewers."""

import datetime
import hashlib
import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt

from magtwin.errors import InputError
from magtwin.field.days import ORIGIN, day_number
from magtwin.field.maps.epochs import at_date, day_of, in_order
from magtwin.field.maps.made_from import MadeFrom
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.maps.statistics import COLOUR_MAP, colour_limits
from magtwin.field.sources.harmonic import SHAPES as HARMONIC
from magtwin.field.sources.harmonic import HarmonicField
from magtwin.usd.geometry import linear_from_srgb
from magtwin.usd.layers import WORLD, new_stage, open_stage
from magtwin.usd.schema import NOUNS, apply_api, attribute_name, only_prim_with, place, prims_with

MAP = WORLD.AppendChild("AnomalyMap")
HEAT_MAP = MAP.AppendChild("HeatMap")
MATERIAL = MAP.AppendChild("HeatMapMaterial")

HEAT_MAP_HEIGHT_M = 0.004
"""Height of the coloured floor [m]: just above the slab."""

UNKNOWN_COLOUR = (0.2, 0.2, 0.2)
"""Linear colour of nodes without a value."""

MOST_QUADS = 60_000
"""Most quads of the coloured floor; a finer map shows every second node, or third, ..."""

MOST_CHARACTERS = 60
"""Characters of an attribute that an error quotes."""

UNIT = "nT"
TEXTS = ("name", "method", "source", "licence", "created")
PLACES = ("frame", "datum")
MADE_FROM = attribute_name("anomalyMap", "made_from")
RECORDED = ("recorded_nt", "recorded_yaw")
"""What only a survey has: its exact readings, and their headings."""

GRID = ("shape", "origin", "cellSize", "headings")
"""Attributes of the grid, which the checksum covers from version 2 on."""

CHECKSUM_VERSION = 2
"""Version of the checksum of a new map. Version 1, that of an older map, is of the arrays alone."""

DAYS_PER_SECOND = 24.0
"""Time codes (days) that a viewer plays per second; USD's own default."""


def save_map(field: AnomalyMap, path: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write a map as a layer, which any stage can use as a sublayer.

    Values become single precision (steps of 0.004 nT at 42,000 nT). The readings of a survey's nodes and a
    harmonic field keep their precision.

    Args:
        field: The map.
        path: File to make, .usdc or .usd.
        force: Whether to replace an existing file.

    Raises:
        InputError: The file exists and `force` was not given, or has another suffix; or a parameter of the
            map cannot be written as JSON.
    """
    _save((field,), path, force)


def save_map_series(maps: Sequence[AnomalyMap], path: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write the epochs of a map as one layer: one time sample per date, in days since 2000-01-01.

    Shared attributes are written once. The default values are those of the latest epoch. A viewer that plays
    the layer shows the drift of the field.

    Args:
        maps: Two or more maps of one grid, each with its date in `created`, in any order.
        path: File to make, .usdc or .usd.
        force: Whether to replace an existing file.

    Raises:
        InputError: As for `save_map`, and if the maps are no epochs of one map (`magtwin.field.maps.epochs`).
    """
    _save(in_order(maps), path, force)


def _refuse_tables(path: str | os.PathLike[str]) -> None:
    """Refuse a table of readings or a recording in place of a map."""
    if Path(path).suffix in (".csv", ".txt", ".parquet", ".pq", ".mcap", ".db3"):
        fitted = Path(path).with_suffix(".usdc").name
        raise InputError(
            f"{path}: a table of readings or a recording, not a map; fit a map to it first: "
            f"magtwin map fit {Path(path).name} --out {fitted}"
        )


def load_map(path: str | os.PathLike[str], date: str | datetime.date | None = None) -> AnomalyMap:
    """The map of a layer, or of a stage that holds one.

    Args:
        path: The layer or stage.
        date: Date of the map, or its text YYYY-MM-DD; the map is interpolated linearly in time between two
            epochs. Default: the latest epoch.

    Raises:
        InputError: The file is missing or not USD, holds no map or several, or its arrays are inconsistent
            or do not match the checksum; or the date is not valid or outside the epochs.
    """
    _refuse_tables(path)
    if date is not None:
        return at_date(load_epochs(path), date)
    stage = open_stage(path)
    return read_map(only_prim_with(stage.GetPseudoRoot(), "anomalyMap"))


def load_epochs(path: str | os.PathLike[str]) -> tuple[AnomalyMap, ...]:
    """Every epoch of a layer's or stage's map, the earliest first.

    Raises:
        InputError: As for `load_map`, for any of the epochs.
    """
    stage = open_stage(path)
    prim = only_prim_with(stage.GetPseudoRoot(), "anomalyMap")
    epochs = tuple(_read(prim, sample) for sample in _samples(prim))
    if not epochs:
        return (read_map(prim),)
    for sample, epoch in zip(_samples(prim), epochs, strict=True):
        try:
            day = day_of(epoch)
        except InputError as error:
            raise InputError(f"{place(prim)}: at time {sample.time:g}, {error}") from error
        if sample.time != day_number(day):
            raise InputError(
                f"{place(prim)}: its epoch at time {sample.time:g} must be of the day that many days after "
                f"{ORIGIN}, got {attribute_name('anomalyMap', 'created')} {day}; make the map anew"
            )
    return epochs


def is_map_layer(path: str | os.PathLike[str]) -> bool:
    """Whether a USD file is a map: it holds an anomaly map and no robot.

    Raises:
        InputError: The file is missing or not USD.
    """
    _refuse_tables(path)
    stage = open_stage(path)
    root = stage.GetPseudoRoot()
    return len(prims_with(root, "anomalyMap")) == 1 and not prims_with(root, "robot")


def read_map(prim: Usd.Prim) -> AnomalyMap:
    """The map of a prim, its latest epoch; errors as for `load_map`."""
    return _read(prim, None)


def checksums(prim: Usd.Prim) -> list[tuple[str, str]]:
    """The stored and the computed checksum of a map: of the default, then of each epoch.

    Raises:
        InputError: An array is missing or of another type; names the prim.
    """
    pairs, grid = [], _covered_grid(prim)
    for sample in (None, *_samples(prim)):
        values, valid, variance = (np.array(_get(prim, n, sample)) for n in ("values", "valid", "variance"))
        taken = _checksum(values, valid, variance, _read_harmonic(prim, sample), grid)
        pairs.append((_get(prim, "checksum", sample), taken))
    return pairs


def _covered_grid(prim: Usd.Prim) -> NDArray[np.float64] | None:
    """The numbers of the grid in the order of `GRID`; None if the map's checksum does not cover them."""
    version = _get(prim, "checksumVersion")
    if version == 1:
        return None
    if version != CHECKSUM_VERSION:
        raise InputError(
            f"{place(prim)}: its checksum is of version {version}, this magtwin knows 1 to "
            f"{CHECKSUM_VERSION}; read it with a later magtwin, or make the map anew"
        )
    return np.concatenate([np.ravel(np.array(_get(prim, name), float)) for name in GRID])


@dataclass(frozen=True)
class _Sample:
    """A time sample in the layer of a map's epochs, read there so that no layer offset rounds its time."""

    layer: Sdf.Layer
    prim: Sdf.Path
    time: float

    def get(self, attribute: str) -> Any:
        """An attribute's value at exactly this time, or None."""
        value = self.layer.QueryTimeSample(self.prim.AppendProperty(attribute), self.time)
        return None if isinstance(value, Sdf.ValueBlock) else value


def _samples(prim: Usd.Prim) -> list[_Sample]:
    """Time samples of the map's values, the earliest first."""
    for spec in prim.GetAttribute(attribute_name("anomalyMap", "values")).GetPropertyStack():
        if times := spec.layer.ListTimeSamplesForPath(spec.path):
            return [_Sample(spec.layer, spec.path.GetPrimPath(), time) for time in times]
    return []


def _read(prim: Usd.Prim, sample: _Sample | None) -> AnomalyMap:
    """The map of a prim at a time, or its default."""
    if (unit := _get(prim, "unit")) != UNIT:
        raise InputError(f"{place(prim)}: the map is in {unit!r}, magtwin reads {UNIT}; make the map anew")
    checksum = _get(prim, "checksum", sample)
    if not re.fullmatch("[0-9a-f]{64}", checksum):
        raise InputError(
            f"{place(prim)}: {attribute_name('anomalyMap', 'checksum')} must be a SHA-256, 64 digits 0-9a-f, "
            f"got {checksum[:MOST_CHARACTERS]!r}; make the map anew"
        )
    values, valid, variance = (np.array(_get(prim, name, sample)) for name in ("values", "valid", "variance"))
    harmonic = _read_harmonic(prim, sample)
    shape = tuple(_get(prim, "shape"))
    if len(shape) != 3 or min(shape) < 1 or not values.size == valid.size == math.prod(shape):
        raise InputError(
            f"{place(prim)}: shape {list(shape)} does not fit {values.size} values and {valid.size} flags"
        )
    if variance.size not in (0, values.size, 3 * values.size):
        raise InputError(f"{place(prim)}: {values.size} values have {variance.size} variances")
    headings = np.array(_get(prim, "headings"), float)
    if not (headings.size and np.all(np.diff(headings) > 0) and headings[0] >= 0 and headings[-1] < 360):
        raise InputError(
            f"{place(prim)}: {attribute_name('anomalyMap', 'headings')} must ascend in [0, 360) deg, got "
            f"{str(headings.tolist())[:MOST_CHARACTERS]}; make the map anew"
        )
    grid = _covered_grid(prim)
    if checksum != _checksum(values, valid, variance, harmonic, grid):
        also = "" if grid is None else ", which covers its grid too"
        text = f"the map's values do not match its checksum{also}; make the map anew"
        raise InputError(f"{place(prim)}: {text}")
    spreads = variance.reshape(-1, *shape).astype(float)  # of the nodes, and between them
    recorded = _read_recorded(prim, RECORDED[0], sample, shape)
    if recorded is not None and not np.array_equal(recorded.ravel().astype("f4"), values, equal_nan=True):
        raise InputError(
            f"{place(prim)}: the map's values are not those that were recorded, in single precision; make "
            "the map anew"
        )
    try:
        return AnomalyMap(
            values_nt=values.reshape(shape).astype(float) if recorded is None else recorded,
            valid=valid.reshape(shape).astype(bool),
            variance_nt2=spreads[0] if len(spreads) else None,
            between_nt2=spreads[1:] if len(spreads) > 1 else None,
            recorded_yaw=_read_recorded(prim, RECORDED[1], sample, shape),
            origin_m=tuple(_get(prim, "origin")),
            cell_m=tuple(_get(prim, "cellSize")),
            headings_rad=np.deg2rad(headings),
            height_m=_read_height(prim),
            parameters=_read_parameters(_get(prim, "parameters", sample)),
            harmonic=None if harmonic is None else HarmonicField(**harmonic),
            made_from=read_made_from(prim, sample),
            **{name: _get(prim, name) for name in PLACES},
            **{name: _get(prim, name, sample) for name in TEXTS},
        )
    except InputError as error:
        raise InputError(f"{place(prim)}: {error}") from error


def _read_recorded(
    prim: Usd.Prim, name: str, sample: _Sample | None, shape: tuple[int, ...]
) -> NDArray | None:
    """Recorded numbers at the nodes; None if there are none."""
    attribute = prim.GetAttribute(attribute_name("anomalyMap", name))
    value = sample.get(attribute.GetName()) if sample else attribute.Get()
    if value is None or not len(value):
        return None
    recorded = np.array(_check_type(attribute, value), float)
    if recorded.size != math.prod(shape):
        raise InputError(
            f"{place(prim)}: {attribute.GetName()} has {recorded.size} numbers for {math.prod(shape)} values"
        )
    return recorded.reshape(shape)


def _read_height(prim: Usd.Prim) -> float | None:
    attribute = prim.GetAttribute(attribute_name("anomalyMap", "height_m"))
    height = attribute.Get()
    if height is None:
        return None
    if not isinstance(height, float) or not math.isfinite(height):
        raise InputError(
            f"{attribute.GetName()} must be a length [m], got {height!r}; clear it where unknown"
        )
    return height


def _read_parameters(text: str) -> dict[str, Any]:
    """Parameters from their JSON; empty if there is none."""
    name, got = (
        attribute_name("anomalyMap", "parameters"),
        f"got {text[:MOST_CHARACTERS]!r}; make the map anew",
    )
    try:
        figures = json.loads(text or "{}")
        json.dumps(figures, allow_nan=False)  # refuses NaN, and 1e999, which is infinite
    except (ValueError, RecursionError) as error:
        raise InputError(f"{name} is not JSON ({error}), {got}") from error
    if not isinstance(figures, dict):
        raise InputError(f"{name} must be a JSON object, {got}")
    return figures


def read_made_from(prim: Usd.Prim, sample: _Sample | None = None) -> MadeFrom | None:
    """What a prim's map was made from, or what was authored over it; None if that is not recorded.

    Raises:
        InputError: The attribute holds something else; names the prim.
    """
    text = _get(prim, "madeFrom", sample)
    if not text:
        return None
    try:
        return MadeFrom.from_table(json.loads(text))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{place(prim)}: {MADE_FROM}: {error}; make the map anew") from error


def write_made_from(prim: Usd.Prim, made_from: MadeFrom) -> None:
    """Author what a map was made from on its prim, in the stage's edit target."""
    prim.GetAttribute(MADE_FROM).Set(_spelled(made_from))


def _spelled(made_from: MadeFrom | None) -> str:
    return "" if made_from is None else json.dumps(made_from.table(), ensure_ascii=False)


def _read_harmonic(prim: Usd.Prim, sample: _Sample | None) -> dict[str, NDArray] | None:
    """The arrays of the harmonic field in the schema's order; None if there is none at that time."""
    if not prim.HasAPI(NOUNS["harmonic"]):
        return None
    arrays = {}
    for name, shape in HARMONIC.items():
        attribute = prim.GetAttribute(attribute_name("harmonic", name))
        source = attribute.GetResolveInfo(Usd.TimeCode.Default()).GetSource()
        authored = source == Usd.ResolveInfoSourceDefault
        value = sample.get(attribute.GetName()) if sample else attribute.Get() if authored else None
        if value is None:
            continue
        _check_type(attribute, value)
        arrays[name] = np.array(value, float).reshape([-1 if n < 0 else n for n in shape])
    if arrays and len(arrays) < len(HARMONIC):
        lost = ", ".join(attribute_name("harmonic", name) for name in HARMONIC.keys() - arrays.keys())
        raise InputError(f"{place(prim)}: its harmonic field has no {lost}; make the map anew")
    return arrays or None


def _save(maps: Sequence[AnomalyMap], path: str | os.PathLike[str], force: bool) -> None:
    """Write maps of one grid, earliest first: the last as the default, several as time samples."""
    if Path(path).suffix not in (".usdc", ".usd"):
        raise InputError(f"{path}: a map layer ends in .usdc or .usd")
    latest = maps[-1]
    times = [float(day_number(day_of(m))) for m in maps] if len(maps) > 1 else []
    samples = [_epoch_values(m) for m in maps]
    for name in (attribute_name("anomalyMap", field) for field in RECORDED):
        if all(sample[name] is None for sample in samples):
            samples = [{n: value for n, value in sample.items() if n != name} for sample in samples]
    about = f"Magnetic anomaly map {latest.name}: total field over x, y and heading. {latest.source}"
    with new_stage(path, about, force=force) as stage:
        prim = apply_api(UsdGeom.Xform.Define(stage, MAP).GetPrim(), "anomalyMap")
        if any(m.harmonic is not None for m in maps):
            apply_api(prim, "harmonic")
        shared = {
            "shape": Vt.IntArray(latest.values_nt.shape),
            "origin": Gf.Vec2d(*latest.origin_m),
            "cellSize": Gf.Vec2d(*latest.cell_m),
            "headings": Vt.DoubleArray(np.rad2deg(latest.headings_rad).tolist()),
            "unit": UNIT,
            "checksumVersion": CHECKSUM_VERSION,
            "height_m": latest.height_m,
            **{name: getattr(latest, name) for name in PLACES},
        }
        named = {attribute_name("anomalyMap", name): value for name, value in shared.items()}
        for name, value in {**named, **samples[-1]}.items():
            if value is not None:
                prim.GetAttribute(name).Set(value)
        for time, sample in zip(times, samples, strict=bool(times)):
            for name, value in sample.items():
                if attribute := prim.GetAttribute(name):
                    attribute.Set(Sdf.ValueBlock() if value is None else value, time)
        if times:
            stage.SetStartTimeCode(times[0])
            stage.SetEndTimeCode(times[-1])
            stage.SetTimeCodesPerSecond(DAYS_PER_SECOND)
            stage.SetFramesPerSecond(DAYS_PER_SECOND)
        _define_heat_map(stage, maps, times)


def _epoch_values(field: AnomalyMap) -> dict[str, Any]:
    """Values of the attributes that differ between epochs, by name; None if there is no value."""
    values = field.values_nt.astype(np.float32).ravel()
    valid = np.ascontiguousarray(field.valid).ravel()
    variance = np.empty(0, np.float32)
    if field.variance_nt2 is not None:
        parts = [field.variance_nt2, *([] if field.between_nt2 is None else field.between_nt2)]
        variance = np.stack(parts).astype(np.float32).ravel()
    recorded = [None, None]
    if field.recorded_yaw is not None:
        recorded = [Vt.DoubleArray.FromNumpy(a.ravel()) for a in (field.values_nt, field.recorded_yaw)]
        if np.array_equal(values, field.values_nt.ravel(), equal_nan=True):
            recorded[0] = None
    harmonic = {n: getattr(field.harmonic, n) for n in HARMONIC} if field.harmonic is not None else None
    parameters = dict(field.parameters or {})
    try:
        text = json.dumps(parameters, allow_nan=False, ensure_ascii=False) if parameters else ""
    except (TypeError, ValueError) as error:
        raise InputError(
            f"parameters of map {field.name!r} must be finite numbers, texts and lists of them ({error})"
        ) from error
    given = {
        "values": Vt.FloatArray.FromNumpy(values),
        "valid": Vt.BoolArray.FromNumpy(valid),
        "variance": Vt.FloatArray.FromNumpy(variance),
        **dict(zip(RECORDED, recorded, strict=True)),
        "checksum": _checksum(values, valid, variance, harmonic, _grid_of(field)),
        "parameters": text,
        "made_from": _spelled(field.made_from),
        **{name: getattr(field, name) for name in TEXTS},
    }
    return {
        **{attribute_name("anomalyMap", name): value for name, value in given.items()},
        **{
            attribute_name("harmonic", name): _usd_array(harmonic[name], shape) if harmonic else None
            for name, shape in HARMONIC.items()
        },
    }


def _usd_array(array: NDArray, shape: tuple[int, ...]) -> Any:
    """An array of a harmonic field as the type of its attribute; -1 in `shape` is any number of rows."""
    if shape in ((3, 3), (3,)):
        return (Gf.Matrix3d if len(shape) == 2 else Gf.Vec3d)(*array.ravel().tolist())
    return Vt.Vec3dArray.FromNumpy(np.ascontiguousarray(array))


def _get(prim: Usd.Prim, name: str, sample: _Sample | None = None) -> Any:
    """Value of one of the map's attributes, of the schema's type."""
    attribute = prim.GetAttribute(attribute_name("anomalyMap", name))
    return _check_type(attribute, sample.get(attribute.GetName()) if sample else attribute.Get())


def _check_type(attribute: Usd.Attribute, value: Any) -> Any:
    kind = attribute.GetTypeName()
    if not isinstance(value, type(kind.defaultValue)):
        raise InputError(f"{place(attribute.GetPrim())}: {attribute.GetName()} must be a {kind}")
    return value


def _grid_of(field: AnomalyMap) -> NDArray[np.float64]:
    """The numbers of a map's grid in the order of `GRID`, as its layer has them."""
    degrees = np.rad2deg(field.headings_rad)
    return np.concatenate([field.values_nt.shape, field.origin_m, field.cell_m, degrees])


def _checksum(
    values: NDArray,
    valid: NDArray,
    variance: NDArray,
    harmonic: Mapping[str, NDArray] | None,
    grid: NDArray | None,
) -> str:
    """SHA-256 over the bytes of the arrays: float32, one byte a flag, float64; little-endian."""
    digest = hashlib.sha256(values.astype("<f4").tobytes())
    digest.update(valid.astype(np.uint8).tobytes())
    digest.update(variance.astype("<f4").tobytes())
    for array in (*(harmonic or {}).values(), *([] if grid is None else [grid])):
        digest.update(array.astype("<f8").tobytes())
    return digest.hexdigest()


def _define_heat_map(stage: Usd.Stage, maps: Sequence[AnomalyMap], times: Sequence[float]) -> None:
    """A grid of quads with a vertex at every node, or every few, and one colour variant per heading."""
    latest = maps[-1]
    _, rows, columns = latest.values_nt.shape
    every = 1
    while (len(j := _kept(rows, every)) - 1) * (len(i := _kept(columns, every)) - 1) > MOST_QUADS:
        every += 1
    rows, columns = len(j), len(i)
    x, y = np.meshgrid(latest.x_m[i], latest.y_m[j])
    points = np.stack([x, y, np.full_like(x, HEAT_MAP_HEIGHT_M)], axis=-1).reshape(-1, 3).astype(np.float32)
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    quads = np.stack([corner, corner + 1, corner + columns + 1, corner + columns], axis=-1).astype(np.int32)
    mesh = UsdGeom.Mesh.Define(stage, HEAT_MAP)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray([4] * len(quads)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(quads.ravel()))
    mesh.CreateNormalsAttr(Vt.Vec3fArray(len(points), Gf.Vec3f(0, 0, 1)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(True)
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(_define_material(stage))
    low, high = colour_limits(np.concatenate([m.values_nt[m.valid] for m in maps]))
    scale = {"colourMap": COLOUR_MAP, "least": low, "greatest": high, "unit": UNIT}
    mesh.GetPrim().SetCustomData({"magtwin": scale | {"everyNode": every}})  # stride over the nodes
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
        "displayColor", Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.vertex
    )
    variants = mesh.GetPrim().GetVariantSets().AddVariantSet("heading")
    names, palette = heading_variants(latest.headings_rad), viridis()
    for h, name in enumerate(names):
        variants.AddVariant(name)
        variants.SetVariantSelection(name)
        with variants.GetVariantEditContext():
            layers = [colour_index(m.values_nt[h], m.valid[h], low, high)[np.ix_(j, i)] for m in maps]
            used, index = np.unique(np.stack(layers), return_inverse=True)
            index = index.reshape(len(maps), -1).astype(np.int32)
            primvar.Set(Vt.Vec3fArray.FromNumpy(palette[used]))
            primvar.SetIndices(Vt.IntArray.FromNumpy(index[-1]))
            for time, row in zip(times, index, strict=bool(times)):
                primvar.SetIndices(Vt.IntArray.FromNumpy(row), time)
    variants.SetVariantSelection(names[0])


def _kept(count: int, every: int) -> NDArray[np.intp]:
    """Indices of the vertices among `count` nodes: every few from the first, and the last."""
    return np.unique(np.append(np.arange(0, count, every), count - 1))


def heading_variants(headings_rad: NDArray) -> list[str]:
    """Names of the heat-map's variants: degrees, with _ for the point ("0", "22_5")."""
    degrees = [np.format_float_positional(d, precision=6, trim="-") for d in np.rad2deg(headings_rad)]
    names = [d.replace(".", "_") for d in degrees]
    return names if len(set(names)) == len(names) else [f"{n}_{i}" for i, n in enumerate(names)]


def viridis() -> NDArray[np.float32]:
    """Linear colours: 256 of the colour map, then `UNKNOWN_COLOUR`, shape (257, 3)."""
    from matplotlib import colormaps

    linear = linear_from_srgb(colormaps[COLOUR_MAP].colors)  # type: ignore[attr-defined]
    return np.vstack([linear, UNKNOWN_COLOUR]).astype(np.float32)


def colour_index(values: NDArray, valid: NDArray, low: float, high: float) -> NDArray[np.int32]:
    """Rows of `viridis()` for values between `low` and `high`, any shape."""
    part = (np.where(valid, values, low) - low) / max(high - low, np.finfo(float).tiny)
    return np.where(valid, np.clip(256 * part, 0, 255).astype(np.int32), 256).astype(np.int32)


def _define_material(stage: Usd.Stage) -> UsdShade.Material:
    """A matt material that shows the mesh's displayColor."""
    material = UsdShade.Material.Define(stage, MATERIAL)
    reader = UsdShade.Shader.Define(stage, MATERIAL.AppendChild("DisplayColor"))
    reader.CreateIdAttr("UsdPrimvarReader_float3")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("displayColor")
    surface = UsdShade.Shader.Define(stage, MATERIAL.AppendChild("Surface"))
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(1.0)
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(
        reader.CreateOutput("result", Sdf.ValueTypeNames.Float3)
    )
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    return material
