"""Meshes, materials and colliders of a URDF: each format and feature from a tiny file made here."""

import json
import re
import struct

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from pxr import Usd, UsdGeom, UsdPhysics, UsdShade
from validators import assert_valid

from magtwin.errors import InputError
from magtwin.files.budget import BUDGETS, Budget
from magtwin.urdf.convert import convert_urdf
from magtwin.urdf.meshes import mesh, polygon, texture
from magtwin.urdf.meshes.mesh import read_mesh
from magtwin.urdf.meshes.piece import Piece
from magtwin.urdf.meshes.polygon import cut_polygons
from magtwin.urdf.options import Options
from magtwin.usd.geometry import linear_from_srgb, read_shapes
from magtwin.usd.robot import read_notes

GREEN = '<material name="green"><color rgba="0 1 0 1"/></material>'

INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'

POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], float)
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
"""A tetrahedron of volume 1, facing outwards."""


def robot(tmp_path, body, head="", options=Options(), name="arm"):  # noqa: B008
    """The stage of a robot of one link whose visuals and colliders are given as XML."""
    path = tmp_path / f"{name}.urdf"
    path.write_text(f'<robot name="{name}">{head}<link name="base_link">{INERTIAL}{body}</link></robot>')
    out = convert_urdf(path, tmp_path / "out" / f"{name}.usda", options=options, force=True)
    stage = Usd.Stage.Open(str(out))
    stage.Reload()
    return stage


def visual(file, material="", scale="1 1 1"):
    return f'<visual><geometry><mesh filename="{file}" scale="{scale}"/></geometry>{material}</visual>'


def collision(file):
    return f'<collision><geometry><mesh filename="{file}"/></geometry></collision>'


def notes_of(stage):
    return read_notes(stage.GetRootLayer().realPath)


def meshes_of(stage, purpose="default"):
    """Meshes of a purpose, those in instances included."""
    prims = stage.Traverse(Usd.TraverseInstanceProxies())
    found = [UsdGeom.Mesh(p) for p in prims if p.IsA(UsdGeom.Mesh)]
    return [m for m in found if m.ComputePurpose() == purpose]


def surface_of(prim):
    """The UsdPreviewSurface that a prim wears."""
    return UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0].ComputeSurfaceSource()[0]


def corners_of(mesh, name):
    """A primvar's values at the corners, shape (F, 3, K), and the corners' points."""
    values = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar(name).ComputeFlattened())
    points = np.array(mesh.GetPointsAttr().Get())[np.array(mesh.GetFaceVertexIndicesAttr().Get())]
    return values.reshape(-1, 3, values.shape[-1]), points.reshape(-1, 3, 3)


def assert_faces_outwards(mesh, volume):
    """Winding encloses the volume, and every normal points the way its face does."""
    normals, corners = corners_of(mesh, "normals")
    a, b, c = np.moveaxis(corners.astype(float), 1, 0)
    assert_allclose(np.sum(a * np.cross(b, c)) / 6, volume, rtol=1e-5)
    assert (np.einsum("fi,fci->fc", np.cross(b - a, c - a), normals) > 0).all()
    assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-3)


def bounds(points):
    return np.array([points.min(0), points.max(0)])


def picture(path, colours=((255, 0, 0), (0, 0, 255))):
    """A PNG of as many pixels as colours, side by side."""
    image = Image.new("RGB", (len(colours), 1))
    image.putdata(colours)
    image.save(path)
    return path


# --- Wavefront ------------------------------------------------------------------------------------

SQUARES = """mtllib paint.mtl
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 2 0 0
v 2 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl red
f 1/1 2/2 3/3 4/4
usemtl blue
f -5/1 -2/2 -1/3 -4/4
"""
"""Two squares side by side, the second by indices from the end."""

MTL = "newmtl red\nKd 1 0 0\nnewmtl blue\nKd 0 0 0.5\nd 0.25\n"


def squares(tmp_path, mtl=MTL):
    (tmp_path / "squares.obj").write_text(SQUARES)
    (tmp_path / "paint.mtl").write_text(mtl)
    return "squares.obj"


def test_two_materials_of_a_wavefront_file_become_two_subsets_of_one_mesh(tmp_path):
    stage = robot(tmp_path, visual(squares(tmp_path)))
    (mesh,) = meshes_of(stage)
    subsets = UsdShade.MaterialBindingAPI(mesh).GetMaterialBindSubsets()
    assert [s.GetPrim().GetName() for s in subsets] == ["red", "blue"]
    assert [list(s.GetIndicesAttr().Get()) for s in subsets] == [[0, 1], [2, 3]]
    kind = UsdGeom.Subset.GetFamilyType(mesh, UsdShade.Tokens.materialBind)
    assert kind == UsdGeom.Tokens.partition
    red, blue = read_shapes(stage)
    assert_allclose(red.colour, [1, 0, 0, 1], atol=1e-5)
    assert_allclose(blue.colour, [0, 0, 0.21404, 0.25], atol=1e-5)
    assert_allclose(bounds(red.vertices), [[0, 0, 0], [1, 1, 0]])
    assert_allclose(bounds(blue.vertices), [[1, 0, 0], [2, 1, 0]])
    colours = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("displayColor").ComputeFlattened()
    assert_allclose(colours, [[1, 0, 0]] * 2 + [[0, 0, 0.21404]] * 2, atol=1e-5)
    assert_valid(stage.GetRootLayer().realPath, tmp_path)


def test_a_texture_is_copied_beside_the_asset_and_keeps_its_place_on_the_mesh(tmp_path):
    bytes_in = picture(tmp_path / "tiles.png").read_bytes()
    file = squares(tmp_path, MTL + "map_Kd -s 1 1 1 tiles.png\n")
    stage = robot(tmp_path, visual(file))
    (mesh,) = meshes_of(stage)
    uvs, points = corners_of(mesh, "st")
    assert_allclose(uvs[2:], points[2:, :, :2] - [1, 0], atol=1e-6)  # each square wears the whole picture
    surface = surface_of(mesh.GetPrim().GetChild("blue"))
    texture = UsdShade.Shader(surface.GetInput("diffuseColor").GetConnectedSources()[0][0].source)
    asset = texture.GetInput("file").Get()
    assert asset.path == "./textures/tiles.png"
    assert (tmp_path / "out/payloads/textures/tiles.png").read_bytes() == bytes_in
    assert asset.resolvedPath == str(tmp_path / "out/payloads/textures/tiles.png")
    reader = UsdShade.Shader(texture.GetInput("st").GetConnectedSources()[0][0].source)
    assert (reader.GetIdAttr().Get(), reader.GetInput("varname").Get()) == ("UsdPrimvarReader_float2", "st")
    assert_valid(stage.GetRootLayer().realPath, tmp_path)


LOST = {
    "missing": ("map_Kd no.png", "squares.obj: texture 'no.png' is missing and is left out; looked for"),
    "outside": ("map_Kd ../up.png", "texture '../up.png' lies outside the robot's packages and is left out"),
    "absolute": ("map_Kd /etc/passwd", "texture '/etc/passwd' lies outside the robot's packages"),
    "linked": ("map_Kd link.png", "texture 'link.png' lies outside the robot's packages and is left out"),
    "no picture": ("map_Kd bad.png", "texture 'bad.png' is not a readable image and is left out"),
    "colour": ("Kd red", "squares.obj: material 'blue' has a malformed colour; grey is used"),
    "invisible": ("d 0", "squares.obj: material 'blue' would be invisible; made opaque"),
    "heights": ("map_Bump h.png", "material 'blue': its map of heights 'h.png' is left out"),
    "highlights": ("map_Ks h.png", "material 'blue': its map of highlights (map_ks) is left out"),
    "displacements": ("disp h.png", "material 'blue': its map of displacements (disp) is left out"),
    "emission": ("Ke bright", "material 'blue' has malformed Ke, Ks, Ns, Pr, Pm or Ni; left out"),
}


@pytest.mark.parametrize("case", LOST)
def test_material_errors_are_noted_and_the_mesh_is_kept(tmp_path, case):
    line, note = LOST[case]
    inside = tmp_path / "robot"
    inside.mkdir()
    picture(tmp_path / "up.png")
    picture(inside / "h.png", [(90, 90, 90)])
    (inside / "link.png").symlink_to(tmp_path / "up.png")
    (inside / "bad.png").write_bytes(b"\x89PNG\r\n\x1a\nnothing")
    stage = robot(inside, visual(squares(inside, f"newmtl red\nKd 1 0 0\nnewmtl blue\n{line}\n")))
    assert any(note in each for each in notes_of(stage)), notes_of(stage)
    assert len(read_shapes(stage)) == 2
    assert not list((inside / "out").rglob("*.png"))
    if "left out" in note:
        with pytest.raises(InputError, match=re.escape(note)):
            robot(inside, visual("squares.obj"), options=Options(strict=True))


def test_a_file_has_so_many_notes_and_materials(tmp_path, monkeypatch):
    faces = "".join(f"usemtl m{i}\nf 1 2 3\n" for i in range(1_100))
    (tmp_path / "o.obj").write_text("mtllib no.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nl 1 2\n" + faces)
    read = read_mesh(tmp_path / "o.obj")
    assert len(read.faces) == 1_100
    assert [text for text, _ in read.notes[:3]] == [
        "o.obj: material library 'no.mtl' is missing; shown without it",
        "o.obj: lines, points and curves (l) are left out",
        "o.obj: material 'm0' is in none of its libraries; shown without it",
    ]
    assert len(read.notes) == 1_001
    assert read.notes[-1] == ("o.obj: over 1000 notes; the others are left out", True)
    monkeypatch.setattr(mesh, "MOST_PAINTS", 1)
    with pytest.raises(InputError, match=r"squares\.obj: has over 1 materials; merge those that look alike"):
        read_mesh(tmp_path / squares(tmp_path))


def test_all_images_have_a_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(texture, "BY_BYTE", 0)
    monkeypatch.setattr(texture, "PIXELS", 3)
    picture(tmp_path / "u.png", [(0, 255, 0)] * 2)
    picture(tmp_path / "t.png")
    file = squares(tmp_path, "newmtl red\nmap_Kd t.png\nnewmtl blue\nmap_Kd u.png\n")
    (note, _), *_ = read_mesh(tmp_path / file).notes
    assert "texture 'u.png' is not a readable image and is left out (the images to here have 4 pixels" in note


# --- COLLADA --------------------------------------------------------------------------------------


def dae(path, nodes, *, up="Z_UP", unit=1.0, diffuse="<color>1 1 1 1</color>", images="", extra=""):
    """A COLLADA file of the tetrahedron, in nodes that are given as XML; {mesh} stands for it."""
    numbers = " ".join(map(str, POINTS.ravel()))
    index = " ".join(map(str, FACES.ravel()))
    shown = """<instance_geometry url="#g"><bind_material><technique_common>
        <instance_material symbol="s" target="#m"/></technique_common></bind_material></instance_geometry>"""
    path.write_text(f"""<?xml version="1.0"?>
    <COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
    <asset><unit meter="{unit}"/><up_axis>{up}</up_axis></asset><library_images>{images}</library_images>
    <library_effects><effect id="e"><profile_COMMON>{extra}<technique sid="t"><lambert>
    <diffuse>{diffuse}</diffuse></lambert></technique></profile_COMMON></effect></library_effects>
    <library_materials><material id="m" name="skin"><instance_effect url="#e"/></material></library_materials>
    <library_geometries><geometry id="g"><mesh><source id="p"><float_array id="pa" count="12">{numbers}
    </float_array><technique_common><accessor source="#pa" count="4" stride="3"><param name="X" type="float"/>
    <param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
    <source id="u"><float_array id="ua" count="8">0 0 1 0 0 1 1 1</float_array><technique_common>
    <accessor source="#ua" count="4" stride="2"><param name="S" type="float"/><param name="T" type="float"/>
    </accessor></technique_common></source>
    <vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
    <triangles count="4" material="s"><input semantic="VERTEX" source="#v" offset="0"/>
    <input semantic="TEXCOORD" source="#u" offset="0"/><p>{index}</p></triangles></mesh></geometry>
    </library_geometries><library_visual_scenes><visual_scene id="scene">{nodes.format(mesh=shown)}
    </visual_scene></library_visual_scenes><scene><instance_visual_scene url="#scene"/></scene></COLLADA>""")
    return path


NESTED = """<node><translate>0 0 5</translate><rotate>0 0 1 90</rotate><node><scale>2 2 2</scale>
<translate>10 0 0</translate>{mesh}</node></node>"""


def test_nested_collada_nodes_compose_outside_in(tmp_path):
    mesh = read_mesh(dae(tmp_path / "n.dae", NESTED))
    turned = np.add(POINTS, [10, 0, 0]) * 2 @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    assert_allclose(bounds(mesh.points), np.add(bounds(turned), [0, 0, 5]), atol=1e-5)


def test_inches_become_metres_and_an_up_axis_is_left_alone_as_in_rviz(tmp_path):
    dae(tmp_path / "n.dae", "<node>{mesh}</node>", up="Y_UP", unit=0.0254)
    stage = robot(tmp_path, visual("n.dae"))
    (seen,) = read_shapes(stage)
    assert_allclose(bounds(seen.vertices), np.array([[0, 0, 0], [1, 2, 3]]) * 0.0254, atol=1e-7)
    note = "n.dae: its up axis Y_UP is not applied, as in RViz; turn the visual instead"
    assert note in notes_of(stage)


def test_collada_nodes_may_refer_to_others_but_not_to_themselves(tmp_path):
    path = dae(tmp_path / "n.dae", '<node><translate>0 0 1</translate><instance_node url="#part"/></node>')
    shape = '<instance_geometry url="#g"/>'
    library = '<library_nodes><node id="part"><scale>2 2 2</scale>{}</node></library_nodes><library_images>'
    text = path.read_text()
    path.write_text(text.replace("<library_images>", library.format(shape)))
    assert_allclose(bounds(read_mesh(path).points), [[0, 0, 1], [2, 4, 7]])
    path.write_text(text.replace("<library_images>", library.format('<instance_node url="#part"/>')))
    with pytest.raises(InputError, match=r"n\.dae:\d+: node 'part' is within itself; export it again"):
        read_mesh(path)


PRIMITIVES = {
    "triangles": ("<p>0 2 1</p><p>0 1 3</p>", [[0, 2, 1], [0, 1, 3]]),
    "polylist": ("<vcount>4 3</vcount><p>0 1 3 2 0 2 1</p>", [[0, 1, 3], [0, 3, 2], [0, 2, 1]]),
    "polygons": ("<p>0 1 3 2</p><p>0 2 1</p>", [[0, 1, 3], [0, 3, 2], [0, 2, 1]]),
    "tristrips": ("<p>0 1 3 2</p>", [[0, 1, 3], [3, 1, 2]]),
    "trifans": ("<p>0 1 3 2</p>", [[0, 1, 3], [0, 3, 2]]),
}


@pytest.mark.parametrize("tag", PRIMITIVES)
def test_all_kinds_of_collada_faces_are_cut_into_triangles(tmp_path, tag):
    body, want = PRIMITIVES[tag]
    path = dae(tmp_path / "n.dae", "<node>{mesh}</node>")
    text = re.sub("<p>.*</p>", f"{body}<!-- of Blender -->", path.read_text())
    text = text.replace('<triangles count="4"', f'<{tag} count="{len(want)}"').replace(
        "</triangles", f"</{tag}"
    )
    path.write_text(text.replace("</mesh>", "<lines><p>0 1</p></lines></mesh>"))
    mesh = read_mesh(path)
    assert_allclose(mesh.points[mesh.faces], POINTS[want])
    assert mesh.notes == (("n.dae: <lines> of geometry 'g' are left out", False),)


def source(name, parts, values):
    """A COLLADA source with a name for each part of its rows."""
    names = "".join(f'<param name="{part}"/>' for part in parts)
    count = len(values) // len(parts)
    return (
        f'<source id="{name}"><float_array>{" ".join(map(str, values))}</float_array><technique_common>'
        f'<accessor count="{count}" stride="{len(parts)}">{names}</accessor></technique_common></source>'
    )


CORNERS = (
    source("n", "XYZ", [0, 0, 2, 0, 3, 0, "nan", "nan", "nan"])
    + source("w", "STP", [0.25, 0.5, 9, 0.75, 1, 9])
    + source("k", "RGBA", [1, 0, 0, 0, 0, 0.5, 1, 0])
    + "<vertices"
)


def test_each_collada_corner_has_its_own_normal_colour_and_bound_texture_coordinates(tmp_path):
    picture(tmp_path / "i.png")
    path = dae(
        tmp_path / "n.dae",
        "<node>{mesh}</node>",
        images='<image id="i"><init_from>i.png</init_from></image>',
        diffuse='<texture texture="i" texcoord="UV"/>',
    )
    text = re.sub("<p>.*</p>", "<p>0 1 1  1 1 0  2 0 1  0 2 0  2 2 0  3 2 0</p>", path.read_text())
    inputs = 'offset="0" set="0"/><input semantic="TEXCOORD" source="#w" offset="2" set="1"/><input semantic='
    inputs += '"NORMAL" source="#n" offset="1"/><input semantic="COLOR" source="#k" offset="2"/><p>'
    text = text.replace('offset="0"/><p>', inputs).replace("<vertices", CORNERS)
    bind = '<bind_vertex_input semantic="UV" input_semantic="TEXCOORD" input_set="1"/></instance_material>'
    path.write_text(text.replace('target="#m"/>', f'target="#m">{bind}'))
    mesh = read_mesh(path)
    assert_allclose(mesh.points[mesh.faces], POINTS[[[0, 1, 2], [0, 2, 3]]])
    nan = np.full(3, np.nan)
    assert_allclose(mesh.normals, [[[0, 1, 0], [0, 1, 0], [0, 0, 1]], [nan, nan, nan]])
    assert_allclose(mesh.shaded()[1], [[1, 0, 0]] * 3)  # computed, where the file has nan
    assert_allclose(mesh.uvs[0], [[0.75, 1], [0.25, 0.5], [0.75, 1]])
    path.write_text(path.read_text().replace(' material="s"', ""))
    blue, red = [0, 0.21404, 1], [1, 0, 0]
    assert_allclose(read_mesh(path).colours, [[blue, red, blue], [red, red, red]], atol=1e-5)


def test_a_collada_id_may_be_that_of_another_kind_or_of_a_source_in_another_geometry(tmp_path):
    """As in a public gripper, whose geometries all name their sources alike."""
    path = dae(tmp_path / "n.dae", '<node id="scene">{mesh}</node>')
    text = path.read_text()
    first, last = text.index("<geometry"), text.index("</library_geometries>")
    twin = text[first:last].replace('id="g"', 'id="h"').replace(" 3.0\n", " 6.0\n")
    assert twin.count("6.0") == 1
    text = text[:last] + twin + text[last:]
    path.write_text(text.replace("<instance_geometry", '<instance_geometry url="#h"/><instance_geometry'))
    mesh = read_mesh(path)
    assert_allclose(mesh.points[mesh.faces[:4]], (POINTS * [1, 1, 2])[FACES])
    assert_allclose(mesh.points[mesh.faces[4:]], POINTS[FACES])


ACCESSOR = 'count="3" offset="3" stride="3"'
DAE_REFUSED = {
    "entities": ("<COLLADA", '<!DOCTYPE x [<!ENTITY a "b">]><COLLADA', r"n\.dae:2: has a DOCTYPE"),
    "nan": (" 3.0\n", " nan\n", "not finite numbers"),
    "offset": ('count="4" stride="3"', ACCESSOR, r"n\.dae:\d+: an <accessor>"),
    "index": ("<p>0 2 1", "<p>0 2 x", r"n\.dae:\d+: geometry 'g' cannot be read"),
    "row": ("<p>0 2 1", "<p>0 2", r"n\.dae:\d+: geometry 'g' cannot be read"),
    "vertex": ("<p>0 2 1", "<p>0 2 9", r"n\.dae:\d+: geometry 'g' cannot be read .*9"),
    "negative": ("<p>0 2 1", "<p>0 2 -1", r"n\.dae:\d+: an index is -1"),
    "source": ('source="#u"', 'source="#gone"', "geometry 'g' cannot be read .*gone"),
    "inputs": ("<p>", "<input/>" * 70 + "<p>", r"n\.dae:\d+: <triangles> has over 64 inputs"),
    "matrix": ("<node>", "<node><matrix>1 2</matrix>", r"n\.dae:\d+: <matrix> needs 16 finite numbers"),
    "flat": ("<node>", "<node><scale>1 1 0</scale>", "transform flattens the mesh"),
    "scene": ("<instance_visual_scene", "<instance_nothing", "has no scene to show"),
    "shown": ('url="#g"', 'url="#gone"', "holds no triangle"),
    "other": ("COLLADA", "KOLLADA", r"n\.dae: begins with <KOLLADA>"),
}


@pytest.mark.parametrize("case", DAE_REFUSED)
def test_a_malformed_collada_file_is_refused_with_its_line(tmp_path, case):
    old, new, message = DAE_REFUSED[case]
    path = dae(tmp_path / "n.dae", "<node>{mesh}</node>")
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=message):
        read_mesh(path)


def test_the_only_scene_of_a_collada_file_is_shown_although_it_is_named_wrongly(tmp_path):
    """As in the lamp of Poppy Ergo Jr, whose scene has the id "" and is asked for as #."""
    path = dae(tmp_path / "n.dae", "<node>{mesh}</node>")
    wanted = read_mesh(path)
    path.write_text(path.read_text().replace('id="scene"', 'id=""').replace('url="#scene"', 'url="#"'))
    mesh = read_mesh(path)
    assert_allclose(mesh.points, wanted.points)
    assert ("n.dae: its scene '#' is not there: its only one is shown", False) in mesh.notes


# --- polygons -------------------------------------------------------------------------------------


@settings(max_examples=50, deadline=None)
@given(
    radii=st.lists(st.floats(0.2, 1), min_size=3, max_size=12),
    normal=st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda n: np.linalg.norm(n) > 0.1),
    first=st.integers(0, 11),
)
def test_any_star_of_a_polygon_is_cut_into_triangles_that_fill_it_and_do_not_overlap(radii, normal, first):
    angles = 2 * np.pi * np.arange(len(radii)) / len(radii)
    flat = np.roll(
        np.column_stack([np.cos(angles), np.sin(angles)]) * np.array(radii)[:, None], first, axis=0
    )
    n = np.array(normal) / np.linalg.norm(normal)
    u = np.cross(n, np.eye(3)[np.argmin(np.abs(n))])
    u /= np.linalg.norm(u)
    points = flat @ [u, np.cross(n, u)]
    triangles = cut_polygons(points, np.arange(len(points)), np.array([len(points)]))
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    areas = np.cross(b - a, c - a) @ n / 2
    x, y = flat.T
    assert areas.min() > -1e-9  # the first of equals counts as an ear
    assert_allclose(areas.sum(), np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2, rtol=1e-9)


def test_many_concave_faces_are_cut_at_once_and_too_large_ones_stay_fans_with_a_note(tmp_path, monkeypatch):
    darts = np.array([[0, 0, 1], [1, 0, 1], [0.2, 0.2, 1], [0, 1, 1]]) @ [[0, 1, 0], [0, 0, 1], [1, 0, 0]]
    triangles = cut_polygons(darts, np.tile([1, 2, 3, 0, 3, 2, 1, 0], 1_000), np.full(2_000, 4))
    corners = np.tile([1, 2, 3, 0, 3, 2, 1, 0], 1_000)[triangles]
    a, b, c = np.moveaxis(darts[corners], 1, 0)
    areas = np.cross(b - a, c - a)[:, 0] / 2
    assert_allclose(areas.reshape(-1, 2, 2).sum(axis=2), np.tile([0.2, -0.2], (1_000, 1)))
    assert (areas.reshape(-1, 2, 2) * [[1], [-1]] > 0).all()
    monkeypatch.setattr(polygon, "MOST_CORNERS", 3)
    (tmp_path / "d.obj").write_text("v 0 0 0\nv 1 0 0\nv 0.2 0.2 0\nv 0 1 0\nf 2 3 4 1\n")
    notes = read_mesh(tmp_path / "d.obj").notes
    assert notes == (("d.obj: a concave face of 4 corners is too large to cut: shown as a fan", False),)


# --- glTF -----------------------------------------------------------------------------------------


def gltf(
    path, *, nodes=None, material=None, pictures=(), colours=None, mode=4, index=None, binary=True, **more
):
    """A glTF file of the tetrahedron, binary or with its buffer in a file of its own."""
    chunks, views, accessors = [], [], []

    def add(values, dtype, kind):
        data = np.asarray(values, dtype).tobytes()
        views.append({"buffer": 0, "byteOffset": sum(map(len, chunks)), "byteLength": len(data)})
        chunks.append(data + b"\0" * (-len(data) % 4))
        code = {"<f4": 5126, "<u2": 5123, "<u1": 5121}[dtype]
        accessor = {"bufferView": len(views) - 1, "componentType": code, "type": kind, "count": len(values)}
        accessors.append(accessor)
        return len(accessors) - 1

    at = {
        "POSITION": add(POINTS, "<f4", "VEC3"),
        "TEXCOORD_0": add([[0, 0], [1, 0], [0, 1], [1, 1]], "<f4", "VEC2"),
    }
    if colours is not None:
        at["COLOR_0"] = add(colours, "<u1", "VEC4")
        accessors[-1]["normalized"] = True
    primitive = {
        "attributes": at,
        "mode": mode,
        "indices": add(FACES.ravel() if index is None else index, "<u2", "SCALAR"),
    }
    table = {"asset": {"version": "2.0"}, "meshes": [{"primitives": [primitive]}], **more}
    for image in pictures:
        views.append({"buffer": 0, "byteOffset": sum(map(len, chunks)), "byteLength": len(image)})
        chunks.append(image + b"\0" * (-len(image) % 4))
        table["images"] = [{"bufferView": len(views) - 1, "mimeType": "image/png", "name": "skin"}]
        table["textures"] = [{"source": 0}]
    if material is not None:
        table["materials"], primitive["material"] = [material], 0
    table["nodes"] = nodes or [{"mesh": 0}]
    table["scenes"], table["scene"] = [{"nodes": [0]}], 0
    body = b"".join(chunks)
    table |= {"buffers": [{"byteLength": len(body)}], "bufferViews": views, "accessors": accessors}
    if not binary:
        table["buffers"][0]["uri"] = "shape.bin"
        (path.parent / "shape.bin").write_bytes(body)
        path.write_text(json.dumps(table))
        return path
    text = json.dumps(table).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(body))
    head += struct.pack("<II", len(text), 0x4E4F534A) + text
    path.write_bytes(head + struct.pack("<II", len(body), 0x004E4942) + body)
    return path


def test_what_nodes_show_counts_as_often_as_they_show_it(tmp_path, monkeypatch):
    monkeypatch.setitem(BUDGETS, "mesh", Budget(count=500))
    nodes = [{"mesh": 0, "children": [i + 1]} for i in range(300)] + [{"mesh": 0}]
    for path in (gltf(tmp_path / "m.glb", nodes=nodes), dae(tmp_path / "m.dae", "<node>{mesh}</node>" * 300)):
        with pytest.raises(InputError, match="shows over 500 nodes; export it again"):
            read_mesh(path)


HALF = float(np.sqrt(0.5))

TREE = [
    {"children": [1], "translation": [1, 2, 3], "rotation": [0, 0, HALF, HALF]},
    {"mesh": 0, "matrix": [2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 0, 0, 1]},
]


@pytest.mark.parametrize("binary", [True, False])
def test_gltf_nodes_are_where_trimesh_has_them_turned_to_z_up(tmp_path, binary):
    path = gltf(tmp_path / f"t.{'glb' if binary else 'gltf'}", nodes=TREE, binary=binary)
    x, y, z = np.moveaxis(trimesh.load_scene(path).to_geometry().vertices, -1, 0)
    (seen,) = read_shapes(robot(tmp_path, visual(path.name)))
    assert_allclose(bounds(seen.vertices), bounds(np.column_stack([x, -z, y])), atol=1e-5)


@pytest.mark.parametrize(("mode", "index"), [(5, [0, 2, 1, 3]), (6, [0, 2, 1, 3])])
def test_gltf_strips_and_fans_are_cut_as_the_specification_says(tmp_path, mode, index):
    mesh = read_mesh(gltf(tmp_path / "t.glb", mode=mode, index=index))
    want = [[0, 2, 1], [2, 3, 1]] if mode == 5 else [[2, 1, 0], [1, 3, 0]]
    y_up = mesh.points[mesh.faces] @ [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    assert_allclose(y_up, POINTS[want], atol=1e-6)


# --- STL ----------------------------------------------------------------------------------


def test_ascii_and_binary_stl_give_the_same_mesh(tmp_path):
    solid = trimesh.Trimesh(POINTS, FACES, process=False)
    (tmp_path / "a.stl").write_text(trimesh.exchange.stl.export_stl_ascii(solid))
    (tmp_path / "b.stl").write_bytes(trimesh.exchange.stl.export_stl(solid))
    a, b = (read_mesh(tmp_path / f"{name}.stl") for name in "ab")
    assert_array_equal(a.points, b.points)
    assert_array_equal(a.faces, b.faces)
    assert_allclose(bounds(a.points), [[0, 0, 0], [1, 2, 3]])


# --- scale, normals, sharing ----------------------------------------------------------------------


@pytest.mark.parametrize("scale", [(-1, 1, 1), (-2, -1, -1), (-1, -1, 1), (3, 1, 0.5)])
def test_a_scaled_or_mirrored_mesh_keeps_its_pictures_and_colours_and_faces_outwards(tmp_path, scale):
    picture(tmp_path / "t.png")
    obj = "".join(f"v {x} {y} {z}\n" for x, y, z in POINTS) + "vt 0 0\nvt 1 0\nvt 0 1\nvt 1 1\n"
    obj += (
        "mtllib p.mtl\nusemtl red\nf 1/1 3/3 2/2\nf 1/1 2/2 4/4\nusemtl skin\nf 2/2 3/3 4/4\nf 1/1 4/4 3/3\n"
    )
    (tmp_path / "t.obj").write_text(obj)
    (tmp_path / "p.mtl").write_text("newmtl red\nKd 1 0 0\nnewmtl skin\nmap_Kd t.png\n")
    stage = robot(tmp_path, visual("t.obj", scale=" ".join(map(str, scale))))
    (mesh,) = meshes_of(stage)
    assert_faces_outwards(mesh, np.prod(np.abs(scale)))
    uvs, corners = corners_of(mesh, "st")
    for point, uv in zip(POINTS * scale, [[0, 0], [1, 0], [0, 1], [1, 1]], strict=True):
        assert_allclose(uvs[np.all(np.isclose(corners, point), axis=-1)], np.tile(uv, (3, 1)), atol=1e-6)
    red = mesh.GetPrim().GetChild("red")
    assert list(UsdGeom.Subset(red).GetIndicesAttr().Get()) == [0, 1]


def test_visuals_of_one_mesh_share_its_arrays_and_none_is_an_instance(tmp_path):
    trimesh.creation.icosphere().export(tmp_path / "ball.stl")
    look = '<material name="{}"><color rgba="{} 0 0 1"/></material>'
    body = visual("ball.stl", look.format("a", 1)) + visual("ball.stl", look.format("b", 0.5))
    stage = robot(tmp_path, body + visual("ball.stl", scale="2 2 2"))
    meshes = meshes_of(stage)
    sources = [m.GetPointsAttr().GetPropertyStack()[-1].path for m in meshes]
    assert len(sources) == 3
    assert sources[0] == sources[1] != sources[2]
    assert not any(m.GetPrim().IsInstanceProxy() for m in meshes)  # Blender drops looks bound above
    assert_allclose([s.colour[0] for s in read_shapes(stage)], [1, 0.21404, 0.21404], atol=1e-4)
    layer = Usd.Stage.Open(str(tmp_path / "out/payloads/geometries.usdc"))
    assert len([p for p in layer.Traverse() if p.IsA(UsdGeom.Mesh)]) == 2
    assert_valid(stage.GetRootLayer().realPath, tmp_path)


@settings(max_examples=30, deadline=None)
@given(
    arrays(float, (3, 3), elements=st.sampled_from(np.linspace(-2, 2, 41))).filter(
        lambda A: abs(np.linalg.det(A)) > 0.05
    )
)
def test_a_piece_under_any_map_encloses_its_volume_and_its_normals_stand_on_its_faces(A):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = A, [1, 2, 3]
    flat = trimesh.Trimesh(POINTS, FACES, process=False).face_normals
    piece = Piece(POINTS, FACES, normals=np.repeat(flat[:, None], 3, axis=1)).moved(T)
    a, b, c = np.moveaxis(piece.points[piece.faces], 1, 0)
    assert_allclose(np.sum(a * np.cross(b, c)) / 6, abs(np.linalg.det(A)), rtol=1e-7)
    outwards = np.cross(b - a, c - a)
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    made = piece.normals / np.linalg.norm(piece.normals, axis=-1, keepdims=True)
    assert_allclose(made, np.repeat(outwards[:, None], 3, axis=1), atol=1e-8)


# --- materials of the URDF ------------------------------------------------------------------------


def test_a_urdf_material_applies_to_parts_without_a_material(tmp_path):
    trimesh.Trimesh(POINTS, FACES, process=False).export(tmp_path / "t.stl")
    (tmp_path / "half.obj").write_text(SQUARES.replace("usemtl blue\n", "").replace("usemtl red\n", ""))
    (tmp_path / "paint.mtl").write_text(MTL)
    mixed = SQUARES.replace("usemtl red\n", "").replace("mtllib", "mtllib")
    (tmp_path / "mixed.obj").write_text(mixed)
    stage = robot(
        tmp_path,
        visual("t.stl", GREEN) + visual("half.obj", GREEN) + visual("mixed.obj", GREEN) + visual("t.stl"),
    )
    stl, bare, plain, blue, none = read_shapes(stage)
    for shape in (stl, bare, plain):
        assert_allclose(shape.colour, [0, 1, 0, 1], atol=1e-5)
    assert_allclose(blue.colour, [0, 0, 0.21404, 0.25], atol=1e-5)
    assert_allclose(none.colour[:3], [0.21404] * 3, atol=1e-5)
    mesh = next(m for m in meshes_of(stage) if m.GetPrim().GetChild("blue"))
    colours = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("displayColor").ComputeFlattened()
    assert_allclose(colours, [[0, 1, 0]] * 2 + [[0, 0, 0.21404]] * 2, atol=1e-5)


SKIN = '<material name="skin"><texture filename="{}"/></material>'


def test_a_urdf_texture_lies_on_a_mesh_with_coordinates_and_gives_others_its_mean(tmp_path):
    picture(tmp_path / "t.png")
    (tmp_path / "bare.obj").write_text(SQUARES.replace("mtllib paint.mtl\n", "").replace("usemtl", "#"))
    box = f'<visual><geometry><box size="1 1 1"/></geometry>{SKIN.format("t.png")}</visual>'
    stage = robot(tmp_path, visual("bare.obj", SKIN.format("t.png")) + box)
    mesh, cube = meshes_of(stage)
    assert surface_of(mesh).GetInput("diffuseColor").HasConnectedSource()
    assert_allclose(
        surface_of(cube).GetInput("diffuseColor").Get(), linear_from_srgb([0.5, 0, 0.5]), atol=0.01
    )
    assert "material 'skin': a primitive shows the mean colour of its texture" in notes_of(stage)


# --- primitives and colliders ---------------------------------------------------------------------


def volume(mesh):
    points = np.array(mesh.GetPointsAttr().Get(), float)
    a, b, c = np.moveaxis(points[np.array(mesh.GetFaceVertexIndicesAttr().Get())].reshape(-1, 3, 3), 1, 0)
    return np.sum(a * np.cross(b, c)) / 6


# --- what is missing or damaged -------------------------------------------------------------------


def test_a_mesh_collides_as_its_hull(tmp_path):
    solid = trimesh.boolean.difference(
        [trimesh.creation.box((3, 1, 3)), trimesh.creation.box((1, 2, 3.5))], engine="manifold"
    )
    solid.export(tmp_path / "u.stl")
    stage = robot(tmp_path, collision("u.stl"))
    (mesh,) = meshes_of(stage, "guide")
    assert_allclose(volume(mesh), solid.convex_hull.volume, rtol=1e-6)
    assert UsdPhysics.MeshCollisionAPI(mesh).GetApproximationAttr().Get() == "convexHull"
    assert_valid(stage.GetRootLayer().realPath, tmp_path)


def nan_stl(path):
    solid = trimesh.Trimesh(POINTS, FACES, process=False)
    data = bytearray(trimesh.exchange.stl.export_stl(solid))
    data[96:100] = struct.pack("<f", np.nan)
    path.write_bytes(data)


def cut(path, write, part=0.5):
    write(path)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * part)])


def stl(path):
    trimesh.Trimesh(POINTS, FACES, process=False).export(path)


ZEROS = json.dumps(
    {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"componentType": 5126, "type": "VEC3", "count": 10**12}],
    }
)
DOUBLES = "".join(
    f'<node id="n{i}"><instance_node url="#n{i + 1}"/><instance_node url="#n{i + 1}"/></node>'
    for i in range(60)
)


def wrote(text):
    return lambda path: path.write_text(text)


CUT_TEXT = "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1"
PACKED = {"extensionsRequired": ["KHR_draco_mesh_compression"]}
RING = [{"children": [1]}, {"mesh": 0, "children": [0]}]
DAMAGED = {
    "m.stl": (nan_stl, "has vertices that are not finite numbers; export it again"),
    "cut.stl": (lambda p: cut(p, stl), "cut short: its size does not fit its count; export it again"),
    "cut_text.stl": (wrote(CUT_TEXT), "(holds no triangle, or is cut short|cannot be read as a mesh)"),
    "empty.stl": (wrote(""), "holds no triangle, or is cut short"),
    "none.obj": (wrote("v 0 0 0\n"), "holds no triangle; export it again, or use"),
    "line.obj": (wrote("v 0 0 0\nv 1 1 1\nf 1 2 1\n"), "holds no triangle with an area"),
    "face.obj": (wrote("v 0 0 0\nf 1 2 3\n"), "a face names vertex 3 of 1; export"),
    "word.obj": (wrote("v 0 0 0\nf 1 x 3\n"), "2: face '1 x 3' is malformed; export"),
    "rows.obj": (wrote("v 0 0\nf 1 1 1\n"), "its v are not 3 numbers each; export"),
    "cut.glb": (lambda p: cut(p, gltf), "is cut short; export it again"),
    "old.glb": (lambda p: gltf(p, asset={"version": "1.0"}), r"is glTF version 1\.0; only 2\.0"),
    "small.glb": (lambda p: gltf(p, **PACKED), "without KHR_draco_mesh_compression; export it without"),
    "ring.glb": (lambda p: gltf(p, nodes=RING), "node 0 has two parents; export it again"),
    "index.glb": (lambda p: gltf(p, index=[0, 1, 9]), "a face names vertex 9 of 4; export it again"),
    "zeros.gltf": (wrote(ZEROS), "accessor 0 is sparse or has no buffer.+; export it again"),
    "json.gltf": (wrote("{"), "cannot be read as a mesh: .+; export it again"),
    "doubles.dae": (lambda p: dae(p, DOUBLES), r"\d+: shows over 50000 nodes; export it again"),
    "cut.dae": (lambda p: cut(dae(p, "<node>{mesh}</node>"), lambda _: None), r"\d+: not XML: .+"),
    "m.blend": (wrote("BLENDER"), r"is of no known format \(\.dae, \.glb, \.gl"),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_mesh_is_refused_in_one_line(tmp_path, name):
    write, words = DAMAGED[name]
    write(tmp_path / name)
    with pytest.raises(InputError, match=rf"{re.escape(name)}.*{words}") as refusal:
        robot(tmp_path, visual(name), options=Options(strict=True))
    assert "\n" not in str(refusal.value)
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").iterdir())


def test_a_buffer_outside_the_package_is_refused(tmp_path):
    inside = tmp_path / "robot"
    inside.mkdir()
    path = gltf(inside / "t.gltf", binary=False)
    (inside / "shape.bin").rename(tmp_path / "shape.bin")
    path.write_text(path.read_text().replace("shape.bin", "../shape.bin"))
    with pytest.raises(InputError, match=r"buffer '\.\./shape\.bin' lies outside the robot's packages; move"):
        robot(inside, visual("t.gltf"))
