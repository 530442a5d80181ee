import numpy as np
import pytest
from numpy.testing import assert_allclose
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade

from magtwin.errors import InputError
from magtwin.usd.geometry import read_links, read_shapes


@pytest.fixture
def stage():
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1)
    return stage


def volume(shape):
    """Enclosed volume by the divergence theorem: negative if the triangles face inwards."""
    a, b, c = np.moveaxis(shape.vertices[shape.faces].astype(float), 1, 0)
    return np.sum(a * np.cross(b, c)) / 6


@pytest.mark.parametrize(
    ("kind", "set_up", "exact"),
    [
        ("Cube", {"size": 0.2}, 0.2**3),
        ("Sphere", {"radius": 0.1}, 4 / 3 * np.pi * 0.1**3),
        ("Cylinder", {"radius": 0.1, "height": 0.3}, np.pi * 0.1**2 * 0.3),
        ("Cone", {"radius": 0.1, "height": 0.3}, np.pi * 0.1**2 * 0.1),
        ("Capsule", {"radius": 0.1, "height": 0.3}, np.pi * 0.1**2 * (0.3 + 0.4 / 3)),
    ],
)
@pytest.mark.parametrize("axis", ["X", "Y", "Z"])
def test_a_solid_encloses_its_volume_and_faces_outwards(stage, kind, set_up, exact, axis):
    prim = stage.DefinePrim("/solid", kind)
    for name, value in set_up.items():
        prim.GetAttribute(name).Set(value)
    if prim.GetAttribute("axis"):
        prim.GetAttribute("axis").Set(axis)
    (shape,) = read_shapes(stage)
    assert_allclose(volume(shape), exact, rtol=0.02)  # a 32-gon holds 0.994 of its circle
    extent = UsdGeom.Boundable.ComputeExtentFromPlugins(UsdGeom.Boundable(prim), Usd.TimeCode.Default())
    assert_allclose([shape.vertices.min(0), shape.vertices.max(0)], extent, atol=1e-6)


@pytest.mark.parametrize("axis", ["X", "Y", "Z"])
def test_a_plane_faces_along_its_axis(stage, axis):
    plane = UsdGeom.Plane.Define(stage, "/plane")
    plane.CreateWidthAttr(6.0)
    plane.CreateLengthAttr(3.5)
    plane.CreateAxisAttr(axis)
    (shape,) = read_shapes(stage)
    a, b, c = np.moveaxis(shape.vertices[shape.faces], 1, 0)
    areas = np.cross(b - a, c - a).sum(axis=0) / 2
    assert_allclose(areas, 21 * np.eye(3)["XYZ".index(axis)], atol=1e-5)
    assert_allclose(
        [shape.vertices.min(0), shape.vertices.max(0)],
        plane.ComputeExtentFromPlugins(plane, Usd.TimeCode.Default()),
        atol=1e-6,
    )


def quad(stage, path="/mesh"):
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0, 0), (2, 1, 0)])
    mesh.CreateFaceVertexCountsAttr([4, 4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3, 1, 4, 5, 2])
    return mesh


def normals(shape):
    a, b, c = np.moveaxis(shape.vertices[shape.faces], 1, 0)
    return np.cross(b - a, c - a)[:, 2]


def test_polygons_become_fans_of_triangles_and_holes_stay_open(stage):
    mesh = quad(stage)
    assert len(read_shapes(stage)[0].faces) == 4
    mesh.CreateHoleIndicesAttr([0])
    (shape,) = read_shapes(stage)
    assert_allclose(shape.vertices.min(0), [1, 0, 0])


def test_left_handed_and_mirrored_meshes_face_as_usd_says(stage):
    mesh = quad(stage)
    assert (normals(read_shapes(stage)[0]) > 0).all()
    mesh.CreateOrientationAttr(UsdGeom.Tokens.leftHanded)
    assert (normals(read_shapes(stage)[0]) < 0).all()
    mesh.AddScaleOp().Set(Gf.Vec3f(-1, 1, 1))  # a mirror turns the faces over once more
    assert (normals(read_shapes(stage)[0]) < 0).all()
    mesh.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
    assert (normals(read_shapes(stage)[0]) > 0).all()


def material(stage, path, colour, opacity=1.0):
    made = UsdShade.Material.Define(stage, path)
    shader = UsdShade.Shader.Define(stage, f"{path}/surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(colour)
    shader.CreateInput("opacity", Sdf.ValueTypeNames.Float).Set(opacity)
    made.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    return made


def bind(prim, made):
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(made)


def test_each_material_of_a_mesh_makes_a_shape_of_its_colour(stage):
    mesh = quad(stage)
    red, blue = material(stage, "/red", (1, 0, 0)), material(stage, "/blue", (0, 0, 1), 0.5)
    bind(mesh.GetPrim(), red)
    subset = UsdShade.MaterialBindingAPI(mesh).CreateMaterialBindSubset("right", [1])
    bind(subset.GetPrim(), blue)
    left, right = read_shapes(stage)
    assert (left.prim, left.colour) == ("/mesh", (1, 0, 0, 1))
    assert (right.prim, right.colour) == ("/mesh/right", (0, 0, 1, 0.5))
    assert_allclose([left.vertices[:, 0].max(), right.vertices[:, 0].min()], 1)


@pytest.mark.parametrize(
    ("kind", "count"), [("constant", 1), ("uniform", 2), ("vertex", 6), ("faceVarying", 8)]
)
def test_display_colours_of_every_interpolation_reach_the_right_points(stage, kind, count):
    mesh = quad(stage)
    where = {"constant": [0.5], "uniform": [0.5, 1.5], "vertex": [0, 1, 1, 0, 2, 2],
             "faceVarying": [0, 1, 1, 0, 1, 2, 2, 1]}[kind]  # fmt: skip
    primvar = mesh.CreateDisplayColorPrimvar(kind)
    primvar.Set([(x / 2, 0, 0) for x in where])
    assert len(where) == count
    (shape,) = read_shapes(stage)
    if kind == "constant":
        assert shape.vertex_colours is None
        assert_allclose(shape.colour, (0.25, 0, 0, 1))
    elif kind == "uniform":
        mean = shape.vertices[shape.faces][..., 0].mean(axis=1)
        assert_allclose(
            shape.vertex_colours[shape.faces][..., 0], np.where(mean < 1, 0.25, 0.75)[:, None] + [[0] * 3]
        )
    else:
        assert_allclose(shape.vertex_colours[:, 0], shape.vertices[:, 0] / 2)


def test_colliders_and_hidden_things_are_not_shown(stage):
    UsdGeom.Cube.Define(stage, "/guide").CreatePurposeAttr("guide")
    UsdGeom.Cube.Define(stage, "/proxy").CreatePurposeAttr("proxy")
    UsdGeom.Cube.Define(stage, "/shown").CreatePurposeAttr("render")
    UsdGeom.Xform.Define(stage, "/hidden").CreateVisibilityAttr("invisible")
    UsdGeom.Cube.Define(stage, "/hidden/cube")
    assert [s.prim for s in read_shapes(stage)] == ["/shown"]


def test_instances_are_shown_each_in_its_place(stage):
    stage.CreateClassPrim("/_post")
    UsdGeom.Cube.Define(stage, "/_post/cube").CreateSizeAttr(1.0)
    for x in (1.0, 4.0):
        post = UsdGeom.Xform.Define(stage, f"/post_{x:.0f}")
        post.AddTranslateOp().Set((x, 0, 0))
        post.GetPrim().GetReferences().AddInternalReference("/_post")
        post.GetPrim().SetInstanceable(True)
    assert_allclose([s.vertices.mean(0)[0] for s in read_shapes(stage)], [1, 4], atol=1e-6)


def arm(stage):
    """A robot at (5, 0, 1), turned by 90 degrees, with a wheel on its left that turns about its own z."""
    robot = UsdGeom.Xform.Define(stage, "/world/robot")
    robot.AddTranslateOp().Set((5, 0, 1))
    robot.AddRotateZOp().Set(90)
    for name, p in (("base_link", (0, 0, 0.1)), ("wheel", (0, 0.2, 0.1))):
        body = UsdGeom.Xform.Define(stage, f"/world/robot/{name}")
        body.AddTranslateOp().Set(p)
        UsdPhysics.RigidBodyAPI.Apply(body.GetPrim())
    stage.GetPrimAtPath("/world/robot/wheel").GetAttribute("xformOp:translate")
    UsdGeom.Xformable(stage.GetPrimAtPath("/world/robot/wheel")).AddRotateXOp().Set(-90)
    joint = UsdPhysics.RevoluteJoint.Define(stage, "/world/robot/wheel_joint")
    joint.CreateBody0Rel().SetTargets(["/world/robot/base_link"])
    joint.CreateBody1Rel().SetTargets(["/world/robot/wheel"])
    joint.CreateAxisAttr("X")
    joint.CreateLocalRot1Attr(Gf.Quatf(Gf.Rotation((1, 0, 0), (0, 0, 1)).GetQuat()))
    tyre = UsdGeom.Cylinder.Define(stage, "/world/robot/wheel/visuals/tyre")
    tyre.CreateRadiusAttr(0.05)
    tyre.CreateHeightAttr(0.02)
    return stage


def test_shapes_and_links_come_in_the_frames_they_name(stage):
    links = read_links(arm(stage))
    assert list(links) == ["base_link", "wheel"]
    wheel = links["wheel"]
    assert_allclose(wheel.p_base_link, [0, 0.2, 0], atol=1e-9)
    assert_allclose(wheel.q_base_link_xyzw, [-np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-9)
    assert_allclose(wheel.axis_link, [0, 0, 1], atol=1e-6)
    assert_allclose(wheel.p_world_link, [4.8, 0, 1.1], atol=1e-9)
    assert wheel.joint == "wheel_joint"
    assert links["base_link"].axis_link is None
    (tyre,) = read_shapes(stage)
    assert tyre.link == "wheel"
    assert_allclose(tyre.vertices.max(0), [0.05, 0.05, 0.01], atol=1e-6)


def wrong_corner(stage):
    quad(stage).GetFaceVertexIndicesAttr().Set([0, 1, 2, 3, 1, 4, 5, 9])


def wrong_colours(stage):
    quad(stage).CreateDisplayColorPrimvar("vertex").Set([(0, 0, 0)] * 5)


def circle(stage):
    arm(stage)
    back = UsdPhysics.FixedJoint.Define(stage, "/world/robot/back")
    back.CreateBody0Rel().SetTargets(["/world/robot/wheel"])
    back.CreateBody1Rel().SetTargets(["/world/robot/base_link"])


@pytest.mark.parametrize(
    ("make", "read", "words"),
    [
        (wrong_corner, read_shapes, "/mesh: its 8 corners, 8 indices and 6 points do not fit"),
        (wrong_colours, read_shapes, "/mesh: 5 displayColor values of interpolation 'vertex'"),
        (circle, read_links, "form a loop"),
    ],
)
def test_geometry_that_contradicts_itself_is_refused_by_prim(stage, make, read, words):
    make(stage)
    with pytest.raises(InputError, match=words):
        read(stage)


def test_a_stage_that_is_missing_or_broken_is_refused_in_one_line(tmp_path):
    (tmp_path / "robot.usda").write_text("#usda 1.0\ndef Xform {\n")
    with pytest.raises(InputError, match=r"robto\.usda: no such USD file; did you mean 'robot\.usda'"):
        read_shapes(tmp_path / "robto.usda")
    with pytest.raises(InputError, match=r"robot\.usda: cannot be opened as USD: .*") as refusal:
        read_links(tmp_path / "robot.usda")
    assert "\n" not in str(refusal.value)
