import ctypes
import sys

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdShade

from magtwin.errors import InputError
from magtwin.figures import pictures
from magtwin.figures.pictures import BACKGROUND, VEIL, Camera, picture_of_stage
from magtwin.spec.furniture import FurnitureSpec
from magtwin.spec.lab import LabSpec
from magtwin.usd.geometry import srgb_from_linear
from magtwin.usd.info import info_of_stage
from magtwin.usd.lab.furniture import define_furniture
from magtwin.usd.lab.room import define_lab

SIZE = (240, 160)
BEHIND = np.array([int(BACKGROUND[i : i + 2], 16) for i in (1, 3, 5)])


def pixels(path):
    """Red, green, blue of a PNG, shape (height, width, 3)."""
    import matplotlib.image

    return np.round(255 * matplotlib.image.imread(path)[..., :3]).astype(int)


def drawn(image):
    """Where a picture differs from its background, shape (height, width)."""
    return (np.abs(image - BEHIND) > 8).any(axis=-1)


@pytest.fixture
def stage(tmp_path):
    stage = Usd.Stage.CreateNew(str(tmp_path / "stage.usda"))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1)
    return stage


def draw(stage, tmp_path, **options):
    stage.Save()
    return pixels(
        picture_of_stage(tmp_path / "stage.usda", tmp_path / "a.png", size=SIZE, force=True, **options)
    )


def cube(stage, path, colour, place=(0.0, 0.0, 0.0)):
    made = UsdGeom.Cube.Define(stage, path)
    made.CreateSizeAttr(1.0)
    made.CreateDisplayColorAttr([colour])
    made.AddTranslateOp().Set(place)


def test_a_thing_fills_the_picture_without_touching_its_edges(stage, tmp_path):
    cube(stage, "/cube", (1, 0, 0))
    there = drawn(draw(stage, tmp_path))
    rows, columns = np.flatnonzero(there.any(axis=1)), np.flatnonzero(there.any(axis=0))
    assert there.shape == SIZE[::-1]
    assert 0 < rows[0] < 0.15 * SIZE[1]
    assert 0.85 * SIZE[1] < rows[-1] < SIZE[1] - 1
    assert abs(columns.mean() - SIZE[0] / 2) < 0.05 * SIZE[0]


def test_colours_arrive_and_y_is_on_the_right_to_who_looks_at_the_front(stage, tmp_path):
    cube(stage, "/red", (1, 0, 0), (0, -1, 0))
    cube(stage, "/blue", (0, 0, 1), (0, 1, 0))
    image = draw(stage, tmp_path, camera=Camera(azimuth_deg=0, elevation_deg=0))
    red = (image[..., 0] > 80) & (image[..., 2] < 60)
    blue = (image[..., 2] > 80) & (image[..., 0] < 60)
    assert min(red.sum(), blue.sum()) > 1000
    assert np.flatnonzero(red.any(axis=0)).max() < np.flatnonzero(blue.any(axis=0)).min()


def test_a_stage_in_centimetres_with_y_up_is_drawn_upright_as_the_same_one_in_metres(stage, tmp_path):
    for name, up, unit in (("tall", "Z", 1.0), ("same", "Y", 0.01)):
        UsdGeom.SetStageUpAxis(stage, up)
        UsdGeom.SetStageMetersPerUnit(stage, unit)
        stage.RemovePrim("/tall")
        cube(stage, "/tall", (1, 0, 0))
        size = (0.5, 1.0, 2.0) if up == "Z" else (50.0, 200.0, 100.0)
        UsdGeom.XformCommonAPI(stage.GetPrimAtPath("/tall")).SetScale(size)
        image = draw(stage, tmp_path, camera=Camera(distance_m=8.0))
        if name == "tall":
            want = image
    assert np.abs(image - want).max() <= 1
    figures = {figure.name: figure.value for figure in info_of_stage(tmp_path / "stage.usda").figures}
    assert figures["size"] == "0.500 x 2.000 x 1.000"
    UsdGeom.SetStageMetersPerUnit(stage, float("inf"))
    with pytest.raises(InputError, match="metersPerUnit is inf, which is no length"):
        draw(stage, tmp_path)


def heat_map(stage, values):
    """A square whose left half and right half have two colours, with a scale in its customData."""
    mesh = UsdGeom.Mesh.Define(stage, "/World/AnomalyMap/HeatMap")
    mesh.CreatePointsAttr([(x, y, 0) for y in (-1, 1) for x in (-1, 0, 1)])
    mesh.CreateFaceVertexCountsAttr([4, 4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 4, 3, 1, 2, 5, 4])
    mesh.CreateDisplayColorPrimvar("uniform").Set(values)
    scale = {"colourMap": "viridis", "least": 36000.0, "greatest": 52000.0, "unit": "nT"}
    mesh.GetPrim().SetCustomData({"magtwin": scale})
    material = UsdShade.Material.Define(stage, "/World/look")
    surface = UsdShade.Shader.Define(stage, "/World/look/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    reader = UsdShade.Shader.Define(stage, "/World/look/reader")
    reader.CreateIdAttr("UsdPrimvarReader_float3")
    kinds = Sdf.ValueTypeNames
    surface.CreateInput("diffuseColor", kinds.Color3f).ConnectToSource(
        reader.CreateOutput("result", kinds.Float3)
    )
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", kinds.Token))
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)


def test_a_maps_colours_reach_the_screen_unchanged_by_light(stage, tmp_path):
    heat_map(stage, [(0.5, 0.1, 0.0), (0.0, 0.1, 0.5)])
    image = draw(stage, tmp_path, camera=Camera(azimuth_deg=-90, elevation_deg=90), legend=False)
    quarter, middle = SIZE[0] // 4, SIZE[1] // 2
    left, right = image[middle, SIZE[0] // 2 - quarter // 2], image[middle, SIZE[0] // 2 + quarter // 2]
    screen = [188, 89, 0]  # sRGB of linear 0.5, 0.1, 0
    assert np.abs(left - screen).max() <= 2
    assert np.abs(right - screen[::-1]).max() <= 2


@pytest.mark.parametrize(("azimuth_deg", "elevation_deg"), [(-90, 36), (160, 15)])
def test_no_wall_or_column_hides_the_map_from_any_side(
    stage, tmp_path, azimuth_deg, elevation_deg, monkeypatch
):
    heat_map(stage, [(0.9, 0.05, 0.0), (0.0, 0.05, 0.9)])
    camera = Camera(azimuth_deg, elevation_deg, distance_m=9, target=(0, 0, 0))
    bare = draw(stage, tmp_path, camera=camera, legend=False)
    for k, (x, y) in enumerate(((0, -2), (2, 0), (0, 2), (-2, 0), (0.5, 0.5), (-0.5, -0.3))):
        wall = UsdGeom.Cube.Define(stage, f"/wall_{k}")
        wall.CreateSizeAttr(1.0)
        wall.AddTranslateOp().Set((x, y, 1.25))
        wall.AddScaleOp().Set((0.2 + 3 * (abs(y) == 2), 0.2 + 3 * (abs(x) == 2), 2.5))
    veiled = draw(stage, tmp_path, camera=camera, legend=False)
    monkeypatch.setattr("magtwin.figures.pictures.VEIL", 1.0)
    monkeypatch.setattr("magtwin.figures.pictures.hides", lambda *_: False)
    solid = draw(stage, tmp_path, camera=camera, legend=False)
    inks = 255 * srgb_from_linear([(0.9, 0.05, 0.0), (0.0, 0.05, 0.9)])  # edges are mixed with what is beside
    on_map = np.any([np.abs(bare - ink).max(axis=-1) <= 2 for ink in inks], axis=0)
    assert on_map.sum() > 500
    changed = np.abs(veiled - bare)[on_map].max(axis=-1), np.abs(solid - bare)[on_map].max(axis=-1)
    assert np.mean(changed[1] > 100) > 0.2  # without the cutaway, they do
    assert changed[0].max() <= VEIL * 255 + 3


ROOMS = {
    "walls of 2.5 m": (5, 4, "desk 1.5 1.6 -1.57, shelf 2.2 -1.2 3.14, cabinet -2.2 -1 0"),
    "L": (8, 6, "box 2.5 -1.7 0, desk -3 2.4 -1.57, shelf 3.6 1.5 3.14, chair -2 -1 1"),
    "corridor": (12, 2, "cabinet -4 0.7 -1.57, shelf 4 0.7 -1.57, chair 2 -0.6 1.57"),
    "hall": (40, 25, "desk -15 -10 1.57, shelf 10 10 -1.57, desk 15 5 0, cabinet 0 11 0"),
    "cell": (3, 3, "desk -0.9 0.6 0, chair -0.3 1.1 2, cabinet 1.1 -0.9 3.14"),
    "columns": (9, 6, "column -2 1.5 0, column 2 1.5 0, column 2 -1.5 0, desk 3.4 -2.4 1.57"),
}
"""Sides of the floor [m], and kind, x, y [m] and yaw [rad] of each piece. All walls are 2.5 m high."""


@pytest.mark.parametrize("name", ROOMS)
def test_furniture_is_seen_and_whole_in_rooms_with_high_walls(name, tmp_path, monkeypatch):
    """Furniture is drawn in red, the rest in green; then furniture alone, by the same camera."""
    x, y, pieces = ROOMS[name]
    stage = Usd.Stage.CreateNew(str(tmp_path / "room.usda"))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1)
    define_lab(stage, LabSpec(floor_m=(x, y), wall_height_m=2.5, wall_thickness_m=0.1, post_height_m=0))
    furniture = []
    for k, (kind, *numbers) in enumerate(piece.split() for piece in pieces.split(", ")):
        px, py, yaw = map(float, numbers)
        block = {"material": "brick", "size_m": (3.0, 2.5, 2.5)} if kind == "box" else {}
        turn = (0.0, 0.0, float(np.sin(yaw / 2)), float(np.cos(yaw / 2)))
        place = {"p_world": (px, py, 0.0), "q_world_xyzw": turn}
        furniture.append(FurnitureSpec(name=f"{kind}_{k}", kind=kind, **place, **block))
    define_furniture(stage, tuple(furniture))
    stage.Save()

    def is_furniture(shape):
        return "/Furniture/" in shape.prim and "box_" not in shape.prim

    def coloured(shape, vertices, of=pictures.mesh_of, **how):
        mesh = of(shape, vertices, **how)
        mesh["rgb"] = np.tile(
            np.uint8([255, 0, 0] if is_furniture(shape) else [0, 255, 0]), (mesh.n_points, 1)
        )
        return mesh

    def reds(camera=None):
        plotter = pictures.plotter_of((400, 250))
        screens = pictures._draw(plotter, tmp_path / "room.usda", (400, 250), None)
        plotter.camera = camera or plotter.camera
        plotter.renderer.ResetCameraClippingRange()
        shown = pictures.Cutaway(plotter, (400, 250), screens).image().astype(int)
        camera = plotter.camera.copy()
        plotter.close()
        return (shown[..., 0] > 120) & (shown[..., 1] < 120), camera

    monkeypatch.setattr(pictures, "mesh_of", coloured)
    monkeypatch.setattr(pictures, "style_of", lambda flat, of=pictures.style_of: of(True))
    monkeypatch.setattr(pictures, "light", lambda *_, **__: None)
    seen, camera = reds()
    every = pictures.read_shapes
    monkeypatch.setattr(pictures, "read_shapes", lambda stage: [s for s in every(stage) if is_furniture(s)])
    alone, _ = reds(camera)
    assert seen.sum() >= 0.8 * alone.sum() > 16
    assert not any(edge.any() for edge in (alone[0], alone[-1], alone[:, 0], alone[:, -1]))  # whole


def test_what_cannot_be_drawn_is_refused(stage, tmp_path):
    stage.Save()
    source, out = tmp_path / "stage.usda", tmp_path / "a.png"
    with pytest.raises(InputError, match=r"stage\.usda: shows nothing; a picture needs at least one"):
        picture_of_stage(source, out)
    with pytest.raises(InputError, match=r"a\.jpg: pictures are PNG; give it the suffix \.png"):
        picture_of_stage(source, tmp_path / "a.jpg")
    with pytest.raises(InputError, match=r"size must lie in 16\.\.16384 pixels each way, got 0 x 5"):
        picture_of_stage(source, out, size=(0, 5))
    assert not out.exists()


@pytest.mark.parametrize("lacks", ["libX11", "libOSMesa"])
def test_a_machine_without_opengl_is_told_the_packages(lacks, stage, tmp_path, monkeypatch):
    if lacks == "libX11" and sys.platform != "linux":
        pytest.skip("only on Linux VTK loads libX11, and dies without it")
    cube(stage, "/cube", (1, 0, 0))
    stage.Save()

    def load(name, *_, of=ctypes.CDLL, **__):
        if name.startswith(lacks):
            raise OSError(name)
        return of(name)

    monkeypatch.setenv("VTK_DEFAULT_OPENGL_WINDOW", "vtkOSOpenGLRenderWindow")
    monkeypatch.setattr(ctypes, "CDLL", load)
    with pytest.raises(InputError, match=r"no OpenGL here, .*: apt-get install libegl1 libgl1-mesa-dri"):
        picture_of_stage(tmp_path / "stage.usda", tmp_path / "a.png")
    assert not (tmp_path / "a.png").exists()


def test_a_texture_is_drawn_upright_and_times_its_factor(stage, tmp_path):
    """Seen from x, y is on the right. Without blue, white becomes yellow."""
    from PIL import Image

    image = Image.new("RGB", (64, 64), (255, 0, 0))
    image.paste((255, 255, 255), (32, 0, 64, 32))
    image.paste((0, 255, 0), (32, 32, 64, 64))
    image.save(tmp_path / "t.png")
    mesh = UsdGeom.Mesh.Define(stage, "/sheet")
    mesh.CreatePointsAttr([(0, 0, 0), (0, 1, 0), (0, 1, 1), (0, 0, 1)])
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    mesh.CreateSubdivisionSchemeAttr("none")
    st_ = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "faceVarying")
    st_.Set([(0, 0), (1, 0), (1, 1), (0, 1)])
    material = UsdShade.Material.Define(stage, "/look")
    surface, texture, reader = (UsdShade.Shader.Define(stage, f"/look/{n}") for n in ("s", "t", "r"))
    surface.CreateIdAttr("UsdPreviewSurface")
    texture.CreateIdAttr("UsdUVTexture")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    texture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set("./t.png")
    texture.CreateInput("scale", Sdf.ValueTypeNames.Float4).Set((1, 1, 0, 1))
    texture.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(
        reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    )
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(
        texture.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
    )
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    image = draw(stage, tmp_path, camera=Camera(azimuth_deg=0, elevation_deg=0))
    rows, columns = (np.flatnonzero(drawn(image).any(axis=axis)) for axis in (1, 0))

    def at(across, up):
        row = rows[0] + round((1 - up) * (rows[-1] - rows[0]))
        return image[row, columns[0] + round(across * (columns[-1] - columns[0]))]

    left, upper, lower = at(0.25, 0.5), at(0.75, 0.75), at(0.75, 0.25)
    assert left[0] > 100
    assert left[1:].max() < 40
    assert upper[:2].min() > 100
    assert upper[2] < 40
    assert lower[1] > 100
    assert lower[[0, 2]].max() < 40
