"""The coloured floor of a map: a mesh of bounded size, with one variant of colours per heading."""

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt

from magtwin.field.maps.map import AnomalyMap
from magtwin.field.maps.statistics import COLOUR_MAP, apart, colour_limits
from magtwin.usd.geometry import linear_from_srgb
from magtwin.usd.layers import WORLD

MAP = WORLD.AppendChild("AnomalyMap")
HEAT_MAP = MAP.AppendChild("HeatMap")
MATERIAL = MAP.AppendChild("HeatMapMaterial")

HEAT_MAP_HEIGHT_M = 0.004
"""Height of the coloured floor [m]: just above the slab."""

UNKNOWN_COLOUR = (0.2, 0.2, 0.2)
"""Linear colour of nodes without a value."""

MOST_QUADS = 60_000
"""Most quads of the coloured floor; a finer map shows every second node, or third, ..."""

UNIT = "nT"


def define_heat_map(stage: Usd.Stage, field: AnomalyMap) -> None:
    """A grid of quads with a vertex at every node, or every few, and a variant of colours per heading."""
    grid, every = field.grid, 1
    while (len(j := _kept(grid.rows, every)) - 1) * (len(i := _kept(grid.columns, every)) - 1) > MOST_QUADS:
        every += 1
    rows, columns = len(j), len(i)
    x, y = np.meshgrid(grid.x_m[i], grid.y_m[j])
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
    low, high = colour_limits(field.values_nt[field.valid])
    scale = {"colourMap": COLOUR_MAP, "least": low, "greatest": high, "unit": UNIT}
    mesh.GetPrim().SetCustomData({"magtwin": scale | {"everyNode": every}})  # stride over the nodes
    here = np.ix_(np.arange(len(field.headings_rad)), j, i)
    values, valid = field.values_nt[here], field.valid[here]
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
        "displayColor", Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.vertex
    )
    variants = mesh.GetPrim().GetVariantSets().AddVariantSet("heading")
    names, palette = heading_variants(field.headings_rad), viridis()
    for h, name in enumerate(names):
        variants.AddVariant(name)
        variants.SetVariantSelection(name)
        with variants.GetVariantEditContext():
            used, index = np.unique(colour_index(values[h], valid[h], low, high), return_inverse=True)
            primvar.Set(Vt.Vec3fArray.FromNumpy(palette[used]))
            primvar.SetIndices(Vt.IntArray.FromNumpy(index.ravel().astype(np.int32)))
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
    low, high = apart(low, high)
    part = (np.where(valid, values, low) - low) / (high - low)
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
