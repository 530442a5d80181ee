"""An AnomalyMap as a USD layer: its arrays on one prim, and a coloured floor that any viewer shows."""

import hashlib
import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt

from magtwin.field.map import AnomalyMap
from magtwin.names import RefusedError
from magtwin.usd.geometry import linear_from_srgb
from magtwin.usd.layers import WORLD, new_stage, open_stage
from magtwin.usd.schema import apply_api, attribute_name, only_prim_with, place

MAP = WORLD.AppendChild("AnomalyMap")
HEAT_MAP = MAP.AppendChild("HeatMap")
MATERIAL = MAP.AppendChild("HeatMapMaterial")

HEAT_MAP_HEIGHT_M = 0.004
"""Height of the coloured floor: above the slab, below anything that drives."""

UNKNOWN_COLOUR = (0.2, 0.2, 0.2)
"""Linear colour of nodes without a value."""

UNIT = "nT"
TEXTS = ("name", "method", "source", "licence", "created")


def save_map(field: AnomalyMap, path: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write a map as a layer that any stage can sublayer.

    Values become single precision (steps of 0.004 nT at 42,000 nT).

    Args:
        field: The map.
        path: File to make, .usdc or .usd: arrays do not belong in text.
        force: Whether one that exists is replaced.

    Raises:
        RefusedError: The file exists and `force` was not given, or has another suffix.
    """
    if Path(path).suffix not in (".usdc", ".usd"):
        raise RefusedError(f"{path}: a map layer ends in .usdc or .usd")
    about = f"Magnetic anomaly map {field.name}: total field over x, y and heading. {field.source}"
    with new_stage(path, about, force=force) as stage:
        prim = apply_api(UsdGeom.Xform.Define(stage, MAP).GetPrim(), "anomalyMap")
        _write_arrays(prim, field)
        _define_heat_map(stage, field)


def load_map(path: str | os.PathLike[str]) -> AnomalyMap:
    """The map of a layer, or of a stage that holds one.

    Raises:
        RefusedError: The file is missing, is not USD, holds no map or several, its arrays do not fit
            together, or they are not what the checksum was taken of.
    """
    stage = open_stage(path)
    return read_map(only_prim_with(stage.GetPseudoRoot(), "anomalyMap"))


def read_map(prim: Usd.Prim) -> AnomalyMap:
    """The map of a prim; refusals as for `load_map`."""
    if (unit := _get(prim, "unit")) != UNIT:
        raise RefusedError(f"{place(prim)}: the map is in {unit!r}, magtwin reads {UNIT}; make the map anew")
    checksum = _get(prim, "checksum")
    arrays = {name: np.array(_get(prim, name)) for name in ("values", "valid", "variance")}
    if checksum != _checksum(*arrays.values()):
        raise RefusedError(
            f"{place(prim)}: the map's values are not those that its checksum was taken of; make the map anew"
        )
    shape = tuple(_get(prim, "shape"))
    values, valid, variance = arrays.values()
    if len(shape) != 3 or not values.size == valid.size == np.prod(shape):
        raise RefusedError(
            f"{place(prim)}: shape {list(shape)} does not fit {values.size} values and {valid.size} flags"
        )
    if variance.size not in (0, values.size):
        raise RefusedError(f"{place(prim)}: {values.size} values have {variance.size} variances")
    try:
        return AnomalyMap(
            values_nt=values.reshape(shape).astype(float),
            valid=valid.reshape(shape).astype(bool),
            variance_nt2=variance.reshape(shape).astype(float) if variance.size else None,
            origin_m=tuple(_get(prim, "origin")),
            cell_m=tuple(_get(prim, "cellSize")),
            headings_rad=np.deg2rad(np.array(_get(prim, "headings"), float)),
            **{name: _get(prim, name) for name in TEXTS},
        )
    except RefusedError as error:
        raise RefusedError(f"{place(prim)}: {error}") from error


def _write_arrays(prim: Usd.Prim, field: AnomalyMap) -> None:
    values = field.values_nt.astype(np.float32).ravel()
    valid = np.ascontiguousarray(field.valid).ravel()
    variance = np.empty(0, np.float32)
    if field.variance_nt2 is not None:
        variance = field.variance_nt2.astype(np.float32).ravel()
    written = {
        "values": Vt.FloatArray.FromNumpy(values),
        "valid": Vt.BoolArray.FromNumpy(valid),
        "variance": Vt.FloatArray.FromNumpy(variance),
        "shape": Vt.IntArray(field.values_nt.shape),
        "origin": Gf.Vec2d(*field.origin_m),
        "cellSize": Gf.Vec2d(*field.cell_m),
        "headings": Vt.DoubleArray(np.rad2deg(field.headings_rad).tolist()),
        "unit": UNIT,
        "checksum": _checksum(values, valid, variance),
        **{name: getattr(field, name) for name in TEXTS},
    }
    for name, value in written.items():
        prim.GetAttribute(attribute_name("anomalyMap", name)).Set(value)


def _get(prim: Usd.Prim, name: str):  # type: ignore[no-untyped-def]
    """Value of one of the map's attributes, of the type that the schema says."""
    attribute = prim.GetAttribute(attribute_name("anomalyMap", name))
    value, kind = attribute.Get(), attribute.GetTypeName()
    if not isinstance(value, type(kind.defaultValue)):
        raise RefusedError(f"{place(prim)}: {attribute.GetName()} must be a {kind}")
    return value


def _checksum(values: NDArray, valid: NDArray, variance: NDArray) -> str:
    """SHA-256 over the bytes of the arrays, little-endian float32 and one byte a flag."""
    digest = hashlib.sha256(values.astype("<f4").tobytes())
    digest.update(valid.astype(np.uint8).tobytes())
    digest.update(variance.astype("<f4").tobytes())
    return digest.hexdigest()


def _define_heat_map(stage: Usd.Stage, field: AnomalyMap) -> None:
    """A grid of quads, one vertex a node, coloured by a variant a heading."""
    _, rows, columns = field.values_nt.shape
    x, y = np.meshgrid(field.x_m, field.y_m)
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
    known = field.values_nt[field.valid]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    mesh.GetPrim().SetCustomData(
        {"magtwin": {"colourMap": "viridis", "least": low, "greatest": high, "unit": UNIT}}
    )
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
        "displayColor", Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.vertex
    )
    variants = mesh.GetPrim().GetVariantSets().AddVariantSet("heading")
    names, palette = heading_variants(field.headings_rad), viridis()
    for name, layer, valid in zip(names, field.values_nt, field.valid, strict=True):
        variants.AddVariant(name)
        variants.SetVariantSelection(name)
        with variants.GetVariantEditContext():
            used, index = np.unique(colour_index(layer, valid, low, high), return_inverse=True)
            primvar.Set(Vt.Vec3fArray.FromNumpy(palette[used]))
            primvar.SetIndices(Vt.IntArray.FromNumpy(index.astype(np.int32).ravel()))
    variants.SetVariantSelection(names[0])


def heading_variants(headings_rad: NDArray) -> list[str]:
    """Names of the heat-map's variants: degrees, with _ for the point ("0", "22_5")."""
    degrees = [np.format_float_positional(d, precision=6, trim="-") for d in np.rad2deg(headings_rad)]
    names = [d.replace(".", "_") for d in degrees]
    return names if len(set(names)) == len(names) else [f"{n}_{i}" for i, n in enumerate(names)]


def viridis() -> NDArray[np.float32]:
    """Linear colours: the 256 of the colour map, then that of nodes without a value, shape (257, 3)."""
    from matplotlib import colormaps

    linear = linear_from_srgb(colormaps["viridis"].colors)  # type: ignore[attr-defined]
    return np.vstack([linear, UNKNOWN_COLOUR]).astype(np.float32)


def colour_index(values: NDArray, valid: NDArray, low: float, high: float) -> NDArray[np.int32]:
    """Rows of `viridis()` for values between `low` and `high`, any shape."""
    part = (np.where(valid, values, low) - low) / max(high - low, np.finfo(float).tiny)
    return np.where(valid, np.clip(256 * part, 0, 255).astype(np.int32), 256).astype(np.int32)


def _define_material(stage: Usd.Stage) -> UsdShade.Material:
    """A matt material that shows the mesh's own displayColor."""
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
