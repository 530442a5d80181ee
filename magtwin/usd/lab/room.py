"""The room in USD: floor, low walls, motion-capture frame, lights and physics scene."""

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdPhysics, Vt

from magtwin.frames import quat_from_rpy
from magtwin.spec.lab import LabSpec
from magtwin.usd.attributes import write_pose, write_spec
from magtwin.usd.lab.looks import SHAPES, define_box, define_looks, define_shapes, define_visual, hide
from magtwin.usd.lab.walls import define_walls
from magtwin.usd.lab.walls import read_lab as read_lab
from magtwin.usd.layers import WORLD
from magtwin.usd.schema import apply_api
from magtwin.usd.solids import define_triangles

LAB = WORLD.AppendChild("Lab")
PHYSICS_SCENE = WORLD.AppendChild("PhysicsScene")
LOOKS = LAB.AppendChild("Looks")
FLOOR, WALL, POST, CAMERA, LENS = map(LOOKS.AppendChild, ("Floor", "Wall", "Post", "Camera", "Lens"))

STRUCTURE = ("walls", "doors", "windows")  # fields of a room that have prims of their own
GRAVITY_M_S2 = 9.81
FLOOR_THICKNESS_M = 0.1
POST_WIDTH_M = 0.04
"""Width of the aluminium profile of the motion-capture frame."""

CAMERA_SIZE_M = (0.07, 0.09, 0.09)
LENS_SIZE_M = (0.064, 0.064, 0.02)
LAMP_SIZE_M = (1.2, 0.3)
LAMP_HEIGHT_M = 2.8

SKY = 0.5
"""Radiance of the sky. A white surface below it has this radiance, where 1 is the white of a picture without
tone mapping."""

LAMP = 8.0
"""Intensity of a lamp: radiance times area [m2], `inputs:normalize`. Blender has pi times this, in watts."""

KIT_EXPOSURE = 400.0
"""Factor of Kit's camera (`rtx:post:tonemap:cm2Factor`). Its radiances are in cd/m2: with its default
aperture, shutter and film, a white surface shows white at some 400 cd/m2."""


def define_lab(stage: Usd.Stage, spec: LabSpec) -> Usd.Prim:
    """Author the room at /World/Lab and the physics scene at /World/PhysicsScene.

    The top of the floor is at z = 0, its centre at the world's origin. The walls stand outside the floor.
    What carries robots is an infinite plane, because PhysX lets wheels sink into a large thin box.

    Args:
        stage: Written to in its edit target; metres, Z up.
        spec: The room's size.

    Returns:
        The prim of the lab.
    """
    prim = UsdGeom.Xform.Define(stage, LAB).GetPrim()
    lab = write_spec(apply_api(prim, "lab"), "lab", spec, skip=STRUCTURE)
    scene = UsdPhysics.Scene.Define(stage, PHYSICS_SCENE)
    scene.CreateGravityDirectionAttr(Gf.Vec3f(0, 0, -1))
    scene.CreateGravityMagnitudeAttr(GRAVITY_M_S2)
    define_looks(stage, LOOKS, [look.name for look in (FLOOR, WALL, POST, CAMERA, LENS)])
    x0, x1, y0, y1 = spec.extent_m
    edge = spec.wall_thickness_m + spec.apron_m  # walls and posts stand on the slab too
    size, middle = (x1 - x0 + 2 * edge, y1 - y0 + 2 * edge), ((x0 + x1) / 2, (y0 + y1) / 2)
    if spec.floor:
        define_shapes(stage)
        define_floor_shape(stage, spec)
        define_visual(stage, LAB.AppendChild("Floor"), "floor", (0, 0, 0), (1, 1, 1), FLOOR)
    else:
        centre = (0, 0, -FLOOR_THICKNESS_M / 2)
        define_box(stage, LAB.AppendChild("Floor"), centre, (*size, FLOOR_THICKNESS_M), FLOOR)
    _define_ground(stage, size, middle if spec.floor else None)
    if spec.floor or spec.walls or spec.doors or spec.windows:
        define_walls(stage, spec)
    else:
        _define_low_walls(stage, spec)
    _define_frame(stage, spec)
    _define_lights(stage, spec, middle)
    return lab


def expose_for_kit(layer: Sdf.Layer) -> None:
    """Adapt the exposure of programs on Omniverse Kit to the lights of a lab.

    Kit reads these settings from the root layer only. Blender, usdview and others have no exposure in
    cd/m2: there the lights suit as they are.
    """
    settings = {"rtx:post:tonemap:cm2Factor": KIT_EXPOSURE}
    layer.customLayerData = {**layer.customLayerData, "renderSettings": settings}


def define_floor_shape(stage: Usd.Stage, spec: LabSpec) -> None:
    """Author the slab of a floor with corners as a class prim, like the unit shapes of `SHAPES`."""
    path = SHAPES.AppendChild("floor")
    if not spec.floor or stage.GetPrimAtPath(path):
        return
    from manifold3d import CrossSection, FillRule, JoinType, Manifold  # takes 0.05 s

    edge = spec.wall_thickness_m + spec.apron_m
    outline = CrossSection([np.array(spec.corners)], FillRule.Positive).offset(edge, JoinType.Miter, 2.0)
    made = Manifold.extrude(outline, FLOOR_THICKNESS_M).translate((0, 0, -FLOOR_THICKNESS_M)).to_mesh()
    points = np.asarray(made.vert_properties)[:, :3]
    define_triangles(UsdGeom.Mesh.Define(stage, path), points, made.tri_verts, shaded=True)


def _define_ground(
    stage: Usd.Stage, size: tuple[float, float], middle: tuple[float, float] | None = None
) -> None:
    """The collider of the floor, with the floor's size in viewers that show it, and its middle [m]."""
    plane = UsdGeom.Plane.Define(stage, LAB.AppendChild("Ground"))
    plane.CreateAxisAttr(UsdGeom.Tokens.z)
    plane.CreateWidthAttr(size[0])
    plane.CreateLengthAttr(size[1])
    half = Gf.Vec3f(size[0] / 2, size[1] / 2, 0)
    plane.CreateExtentAttr(Vt.Vec3fArray([-half, half]))
    if middle is not None:
        write_pose(plane.GetPrim(), (*middle, 0.0))
    UsdPhysics.CollisionAPI.Apply(plane.GetPrim())
    hide(plane, FLOOR)


def _define_low_walls(stage: Usd.Stage, spec: LabSpec) -> None:
    if not spec.wall_height_m:
        return
    (x, y), thick, high = spec.floor_m, spec.wall_thickness_m, spec.wall_height_m
    walls = {
        "East": ((x + thick) / 2, 0, thick, y),
        "West": (-(x + thick) / 2, 0, thick, y),
        "North": (0, (y + thick) / 2, x + 2 * thick, thick),
        "South": (0, -(y + thick) / 2, x + 2 * thick, thick),
    }
    for name, (at_x, at_y, size_x, size_y) in walls.items():
        path = UsdGeom.Xform.Define(stage, LAB.AppendChild("Walls")).GetPath().AppendChild(name)
        define_box(stage, path, (at_x, at_y, high / 2), (size_x, size_y, high), WALL, collides=True)


def _define_frame(stage: Usd.Stage, spec: LabSpec) -> None:
    """Posts at the corners and in the middle of the long sides, rails on top, a camera on each post.

    A floor with corners has none.
    """
    if not spec.post_height_m or spec.floor:
        return
    half = np.array(spec.floor_m) / 2 + spec.wall_thickness_m + POST_WIDTH_M / 2
    corners = [(sx * half[0], sy * half[1]) for sx in (-1, 1) for sy in (-1, 1)]
    along_x = spec.floor_m[0] >= spec.floor_m[1]
    amid = [(0.0, s * half[1]) if along_x else (s * half[0], 0.0) for s in (-1, 1)]
    root = UsdGeom.Xform.Define(stage, LAB.AppendChild("CaptureFrame")).GetPath()
    high, width = spec.post_height_m, POST_WIDTH_M
    for i, (x, y) in enumerate(corners + amid):
        size = (width, width, high)
        define_box(stage, root.AppendChild(f"Post_{i}"), (x, y, high / 2), size, POST, collides=True)
        _camera(stage, root.AppendChild(f"Camera_{i}"), np.array([x, y, high]))
    rail = high - width / 2
    for name, x, y in (("South", 0, -1), ("North", 0, 1), ("West", -1, 0), ("East", 1, 0)):
        size = (width, 2 * half[1] - width, width) if x else (2 * half[0] - width, width, width)
        define_box(stage, root.AppendChild(f"Rail_{name}"), (x * half[0], y * half[1], rail), size, POST)


def _camera(stage: Usd.Stage, path: Sdf.Path, post_top: np.ndarray) -> None:
    """A camera below the top of a post, which looks at the middle of the floor."""
    inward = -post_top[:2] / np.linalg.norm(post_top[:2])
    at = post_top + np.array([*(0.1 * inward), -0.08])
    yaw = np.arctan2(-at[1], -at[0])
    pitch = np.arctan2(at[2], np.hypot(at[0], at[1]))  # a positive turn about y looks down
    prim = UsdGeom.Xform.Define(stage, path).GetPrim()
    write_pose(prim, tuple(at), tuple(quat_from_rpy((0.0, pitch, yaw))))  # type: ignore[arg-type]
    define_box(stage, path.AppendChild("Body"), (0, 0, 0), CAMERA_SIZE_M, CAMERA)
    at_lens = ((CAMERA_SIZE_M[0] + LENS_SIZE_M[2]) / 2, 0.0, 0.0)
    quarter = quat_from_rpy((0.0, np.pi / 2, 0.0))
    lens, turn = path.AppendChild("Lens"), tuple(quarter.tolist())
    define_visual(stage, lens, "cylinder", at_lens, LENS_SIZE_M, LENS, q_xyzw=turn)


def _define_lights(stage: Usd.Stage, spec: LabSpec, middle: tuple[float, float]) -> None:
    """An even sky, and four lamps in two rows above the floor."""
    root = UsdGeom.Xform.Define(stage, LAB.AppendChild("Lights")).GetPath()
    sky = UsdLux.DomeLight.Define(stage, root.AppendChild("Sky"))
    sky.CreateIntensityAttr(SKY)
    sky.CreateColorAttr(Gf.Vec3f(0.92, 0.96, 1.0))
    x0, x1, y0, y1 = spec.extent_m
    quarter = np.array([x1 - x0, y1 - y0]) / 4
    for i, (sx, sy) in enumerate([(-1, -1), (-1, 1), (1, -1), (1, 1)]):
        lamp = UsdLux.RectLight.Define(stage, root.AppendChild(f"Lamp_{i}"))  # shines along -z
        lamp.CreateWidthAttr(LAMP_SIZE_M[0])
        lamp.CreateHeightAttr(LAMP_SIZE_M[1])
        lamp.CreateIntensityAttr(LAMP)
        lamp.CreateNormalizeAttr(True)
        lamp.CreateColorAttr(Gf.Vec3f(1.0, 0.97, 0.92))
        x, y = middle + quarter * (sx, sy)
        lamp.AddTranslateOp().Set(Gf.Vec3d(x, y, LAMP_HEIGHT_M))
