"""Obstacles of a stage: colliders that stand still, cut at the robot's height."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pxr import Gf, Usd, UsdGeom, UsdPhysics

from magtwin.usd.lab.obstacles import read_obstacles


def stage() -> Usd.Stage:
    made = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(made, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(made, 1.0)
    return made


def box(made: Usd.Stage, path: str, centre, size, *, collides=True) -> UsdGeom.Cube:
    cube = UsdGeom.Cube.Define(made, path)
    cube.CreateSizeAttr(1.0)
    cube.AddTranslateOp().Set(Gf.Vec3d(*centre))
    cube.AddScaleOp().Set(Gf.Vec3f(*size))
    if collides:
        UsdPhysics.CollisionAPI.Apply(cube.GetPrim())
    return cube


def test_a_box_that_collides_is_an_obstacle_with_its_outline_and_surface():
    made = stage()
    box(made, "/Desk", (1, 2, 0.2), (0.6, 0.4, 0.4))
    found = read_obstacles(made)
    assert found.names == ("/Desk",)
    assert_allclose(found.outlines[0], [[0.7, 1.8], [1.3, 1.8], [1.3, 2.2], [0.7, 2.2]], atol=1e-7)
    assert found.triangles.shape == (12, 3, 3)
    assert_allclose(found.triangles.max(axis=(0, 1)), [1.3, 2.2, 0.4], atol=1e-7)


def test_what_does_not_collide_or_is_switched_off_is_none():
    made = stage()
    box(made, "/Ghost", (1, 2, 0.2), (0.6, 0.4, 0.4), collides=False)
    off = box(made, "/Off", (1, 2, 0.2), (0.6, 0.4, 0.4))
    UsdPhysics.CollisionAPI(off.GetPrim()).CreateCollisionEnabledAttr(False)
    assert len(read_obstacles(made)) == 0


def test_a_floor_is_driven_over_and_a_shelf_driven_under_but_a_lidar_may_see_both():
    made = stage()
    box(made, "/Floor", (0, 0, -0.05), (6, 4, 0.1))
    box(made, "/Shelf", (0, 0, 1.0), (1, 1, 0.1))
    found = read_obstacles(made)
    assert found.names == ()
    assert found.triangles.shape == (24, 3, 3)
    assert read_obstacles(made, height_m=1.2).names == ("/Shelf",)


def test_a_thing_is_cut_at_the_robot_s_height():
    made = stage()
    mesh = UsdGeom.Mesh.Define(made, "/Tent")  # a pyramid upside down: 2 m wide at 1 m, a point at 0
    mesh.CreatePointsAttr([(-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1), (0, 0, 0)])
    mesh.CreateFaceVertexCountsAttr([3, 3, 3, 3])
    mesh.CreateFaceVertexIndicesAttr([1, 0, 4, 2, 1, 4, 3, 2, 4, 0, 3, 4])
    UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
    (outline,) = read_obstacles(made, height_m=0.3).outlines
    assert_allclose(np.abs(outline), 0.3, atol=1e-7)


def faces(made: Usd.Stage, path: str, points, quads) -> UsdGeom.Mesh:
    mesh = UsdGeom.Mesh.Define(made, path)
    mesh.CreatePointsAttr(points)
    mesh.CreateFaceVertexCountsAttr([4] * len(quads))
    mesh.CreateFaceVertexIndicesAttr(np.ravel(quads).tolist())
    UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
    return mesh


@pytest.mark.parametrize("apart_m", [0.0, 0.05])  # walls that share their corners, or none
def test_the_walls_of_a_room_in_one_mesh_leave_its_floor_free(apart_m):
    made = stage()
    far = 3 + apart_m
    points, quads = [], []
    for x0, y0, x1, y1 in ((-3, 2, 3, 3), (-3, -3, 3, -2), (far, -3, 4, 3), (-4, -3, -far, 3)):
        sides = [(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]
        quads += [[len(points) + k for k in side] for side in sides]
        points += [(x, y, z) for z in (0, 0.5) for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
    faces(made, "/Room", points, quads)
    found = read_obstacles(made)
    assert set(found.names) == {"/Room"}
    distance, _ = found.clearance(np.array([[0.0, 1.5], [0.0, 0.0], [2.5, 0.0]]))
    assert_allclose(distance, [0.5, 2.0, 0.5 + apart_m], atol=0.001)


def test_a_wall_without_thickness_stops_a_robot():
    made = stage()
    faces(made, "/Sheet", [(0, -1, 0), (1, 1, 0), (1, 1, 1), (0, -1, 1)], [[0, 1, 2, 3]])
    found = read_obstacles(made)
    assert found.names == ("/Sheet",)
    assert_allclose(found.clearance(np.array([[0.5, 0.0], [3.0, 1.0]]))[0], [-0.0005, 2.0], atol=1e-3)


def test_what_a_tall_robot_would_run_into_is_an_obstacle_to_it():
    made = stage()
    box(made, "/Shelf", (0, 0, 1.0), (1, 1, 0.1))
    robot = UsdGeom.Xform.Define(made, "/Robot")
    UsdPhysics.RigidBodyAPI.Apply(robot.GetPrim())
    box(made, "/Robot/Mast", (2, 0, 0.6), (0.1, 0.1, 1.2))
    assert read_obstacles(made).names == ()
    robot.GetPrim().AddAppliedSchema("MagtwinRobotAPI")
    assert read_obstacles(made).names == ("/Shelf",)


def test_the_lab_s_walls_and_posts_surround_its_floor(lab_scene):
    found = read_obstacles(str(lab_scene))
    walls = [name for name in found.names if "/Walls/" in name]
    assert len(walls) == 4
    assert not any("Robot" in name or "turtlebot" in name for name in found.names)
    distance, which = found.clearance(np.array([[2.9, 0.0], [0.0, -1.7]]))
    assert_allclose(distance, [0.1, 0.05], atol=1e-6)
    assert [found.names[i].rsplit("/", 1)[-1] for i in which] == ["East", "South"]
