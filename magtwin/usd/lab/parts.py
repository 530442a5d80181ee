"""Parts of furniture and walls on a stage: colliders, magnetised if of steel, and what shows them."""

from pxr import Sdf, Usd, UsdGeom, Vt

from magtwin.spec.furniture import Part
from magtwin.spec.magnetics import SourceSpec
from magtwin.usd.attributes import write_pose
from magtwin.usd.lab.looks import define_box, define_visual, hide, visual_path, wear
from magtwin.usd.lab.sources import LOOKS, define_source
from magtwin.usd.solids import define_triangles


def define_part(stage: Usd.Stage, piece: Sdf.Path, part: Part, source: SourceSpec | None) -> Usd.Prim:
    """The collider of a part, and a mesh that shows it; a steel part is a source."""
    path, look = piece.AppendChild(part.name), piece.AppendChild(LOOKS).AppendChild(part.look)
    if source is not None:
        return define_source(stage, piece, named_source(source, part.name), look=part.look)
    if part.shape == "cuboid":
        return define_box(stage, path, part.p, part.size_m, look, collides=True)
    if part.shape == "mesh":
        mesh = UsdGeom.Mesh.Define(stage, path)
        define_triangles(mesh, part.vertices_m, part.faces)
        write_pose(mesh.GetPrim(), part.p)
        wear(mesh, look)
        return mesh.GetPrim()
    cylinder = UsdGeom.Cylinder.Define(stage, path)
    radius, half = part.size_m[0] / 2, part.size_m[2] / 2
    cylinder.CreateRadiusAttr(radius)
    cylinder.CreateHeightAttr(2 * half)
    cylinder.CreateAxisAttr(UsdGeom.Tokens.z)
    cylinder.CreateExtentAttr(Vt.Vec3fArray([(-radius, -radius, -half), (radius, radius, half)]))
    write_pose(cylinder.GetPrim(), part.p)
    hide(cylinder, look)
    define_visual(stage, visual_path(path), part.shape, part.p, part.size_m, look)
    return cylinder.GetPrim()


def named_source(source: SourceSpec, name: str) -> SourceSpec:
    """A source under another name."""
    return SourceSpec(**{**vars(source), "name": name})
