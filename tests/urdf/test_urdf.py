"""Small descriptions and what they become on a stage; names; meshes of every format."""

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from looking import assert_looks_alike
from made import BALL, arm, converted, urdf
from numpy.testing import assert_allclose
from pxr import UsdGeom, UsdPhysics, UsdShade
from validators import assert_valid

from magtwin.errors import InputError
from magtwin.frames import matrix_from_quat, quat_from_rpy
from magtwin.urdf.convert import convert_urdf
from magtwin.urdf.physics.inertia import nearest_possible, principal_axes
from magtwin.usd.geometry import read_shapes


def joint_of(stage):
    return UsdPhysics.Joint(next(p for p in stage.Traverse() if p.IsA(UsdPhysics.Joint)))


# --- what arrives ---------------------------------------------------------------------------------


def test_the_base_floats_and_nothing_is_bolted_to_the_world(tmp_path):
    stage, robot, _report = converted(arm(tmp_path, "fixed|"))
    joint = joint_of(stage)
    assert len(joint.GetBody0Rel().GetTargets()) == len(joint.GetBody1Rel().GetTargets()) == 1
    (root,) = [p for p in stage.Traverse() if p.HasAPI(UsdPhysics.ArticulationRootAPI)]
    assert root.HasAPI(UsdPhysics.RigidBodyAPI)
    assert root == robot.GetChildren()[0]
    assert root.GetAttribute("newton:selfCollisionEnabled").Get() is False


def test_a_name_with_two_looks_is_two_materials_and_colours_are_linear(tmp_path):
    looks = (("red", 1), ("rosso", 1), ("red", 1), ("red", 0.5))
    colour = '<material name="{}"><color rgba="{} 0 0 0.5"/></material>'
    balls = "".join(f"<visual>{BALL}{colour.format(*look)}</visual>" for look in looks)
    stage, *_ = converted(urdf(tmp_path, f'<link name="base_link">{{INERTIAL}}{balls}</link>'))
    named = [prim.GetName() for prim in stage.Traverse() if prim.IsA(UsdShade.Material)]
    assert [name.partition("_")[0] for name in named if name[0] == "r"] == ["red", "rosso", "red"]
    seen = [shape.colour[0] for shape in read_shapes(stage)]
    assert_allclose(seen, [1, 1, 1, 0.21404], atol=1e-4)  # ((0.5 + 0.055) / 1.055) ** 2.4


def tetrahedron(path):
    points = [[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]]
    trimesh.Trimesh(points, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]).export(path)
    return path


@pytest.mark.parametrize("suffix", ["stl", "obj", "glb"])
@pytest.mark.parametrize("scale", [(0.5, 0.5, 0.5), (-1, 1, 1)])
def test_meshes_of_every_format_arrive_scaled_and_facing_outwards(tmp_path, suffix, scale):
    tetrahedron(tmp_path / f"t.{suffix}")
    words = " ".join(map(str, scale))
    shape = f'<geometry><mesh filename="t.{suffix}" scale="{words}"/></geometry>'
    path = urdf(
        tmp_path,
        f"<link name='base_link'>{{INERTIAL}}<visual>{shape}</visual><collision>{shape}</collision></link>",
    )
    stage, robot, _report = converted(path)
    (seen,) = read_shapes(stage)
    corners = np.array([[0, -3, 0], [1, 0, 2]] if suffix == "glb" else [[0, 0, 0], [1, 2, 3]]) * scale
    corners = np.sort(corners, axis=0)  # glTF's Y is up: (x, y, z) lies at (x, -z, y)
    assert_allclose([seen.vertices.min(0), seen.vertices.max(0)], corners, atol=1e-6)
    a, b, c = np.moveaxis(seen.vertices[seen.faces].astype(float), 1, 0)
    assert_allclose(np.sum(a * np.cross(b, c)) / 6, np.prod(np.abs(scale)), rtol=1e-5)
    collider = robot.GetPrimAtPath("base_link/collisions").GetChildren()[0]
    assert len(UsdGeom.Mesh(collider).GetPointsAttr().Get()) == 4
    assert_valid(path.with_suffix(".usda"), tmp_path)


# --- inertia and normals --------------------------------------------------------------------------


@given(
    sizes=st.lists(st.floats(0.1, 2), min_size=3, max_size=3),
    rpy=st.lists(st.floats(-3, 3), min_size=3, max_size=3),
)
def test_principal_axes_give_back_the_tensor_of_a_turned_box(sizes, rpy):
    a, b, c = np.square(sizes)
    R = matrix_from_quat(quat_from_rpy(rpy))
    tensor = R @ np.diag([b + c, a + c, a + b]) @ R.T / 12
    moments, q = principal_axes(tensor)
    axes = matrix_from_quat(q)
    assert_allclose(axes @ np.diag(moments) @ axes.T, tensor, atol=1e-9)
    assert nearest_possible(tensor) is tensor


# --- refusals -------------------------------------------------------------------------------------


SHOWN = '<link name="b"><visual><geometry><{}/></geometry></visual></link>'
REFUSED = {
    'mesh filename="t.stl" scale="1 0 1"': r"mesh 't\.stl' has scale .*0\.0",
    'sphere radius="1e200"': r":3: link 'b': radius of <sphere> .*1e200",
}


@pytest.mark.parametrize("shape", REFUSED)
def test_a_shape_of_no_size_or_beyond_all_is_refused_in_one_line_and_nothing_is_written(tmp_path, shape):
    path = urdf(tmp_path, SHOWN.format(shape))
    tetrahedron(tmp_path / "t.stl")
    with pytest.raises(InputError, match=REFUSED[shape]) as refusal:
        convert_urdf(path, tmp_path / "out" / "arm.usda")
    assert "\n" not in str(refusal.value)
    assert not list(tmp_path.glob("out/**/*"))


NAMED = """
<link name="底座">{BODY}</link> <link name="a-b">{BODY}</link> <link name="a_b">{BODY}</link>
<link name="visuals"/> <link name="joints">{BODY}</link> <link name="1st wheel">{BODY}</link>
<joint name="右" type="fixed"><parent link="底座"/><child link="a-b"/></joint>
<joint name="j.1" type="fixed"><parent link="底座"/><child link="a_b"/></joint>
<joint name="j_1" type="fixed"><parent link="a-b"/><child link="visuals"/><origin xyz="0 0 1"/></joint>
<joint name="joints" type="continuous"><parent link="底座"/><child link="joints"/></joint>
<joint name="w 1" type="continuous"><parent link="底座"/><child link="1st wheel"/></joint>"""


def test_any_name_is_accepted_and_invalid_usd_names_become_display_names(tmp_path):
    stage, robot, report = converted(urdf(tmp_path, NAMED, "my robot"))
    renamed = {
        "my_robot": "my robot",
        "a_b_2": "a-b",
        "visuals_2": "visuals",
        "joints_2": "joints",
        "_1st_wheel": "1st wheel",
        "j_1_2": "j.1",
        "w_1": "w 1",
    }
    shown = {p.GetName(): p.GetDisplayName() for p in stage.Traverse() if p.GetDisplayName()}
    assert shown == renamed
    for name, was in renamed.items():
        assert any(note.endswith(f"{was!r} is called {name!r} in USD") for note in report.notes)
    assert {p.GetName() for p in robot.GetChild("joints").GetChildren()} == {"右", "j_1_2", "joints", "w_1"}
    for link in ("底座", "a_b", "a_b_2", "a_b_2/visuals_2", "joints_2", "_1st_wheel"):
        assert robot.GetPrimAtPath(link), link
    height = UsdGeom.BBoxCache(0, ["default"]).ComputeWorldBound(robot).ComputeAlignedRange().GetMax()[2]
    assert_allclose(height, 0.1, rtol=1e-6)  # no frame moves the shapes beside it
    assert_valid(tmp_path / "my robot.usda", tmp_path)


def test_the_real_robot_shows_meshes_with_materials_and_hides_its_colliders(real_robot):
    assert_looks_alike(real_robot[1])
