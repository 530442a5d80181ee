"""Edits that a user of usdview, Kit or Blender makes with bare usd-core: each is read right, told or refused.

docs/scenes.md has the table of these edits.
"""

import shutil
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pxr import Gf, Usd, UsdGeom

import magtwin
from magtwin.errors import InputError, MismatchWarning
from magtwin.sim.at_rest import field_at_rest_nt
from magtwin.spec.base import ZERO3
from magtwin.twin import simulate_robots
from magtwin.twin.maps import survey_scene
from magtwin.usd.layers import open_stage
from magtwin.usd.scene import open_scene, read_scene

ROBOT = "/World/turtlebot4"
MAGNETOMETER = f"{ROBOT}/magnetometer_link"
DESK = "/World/Furniture/desk"
AT = [[0.3, 0.2], [-0.8, 0.6]]
TOML = """
name = "room"
[robot]
asset = "turtlebot4"
[lab]
floor_m = [4.0, 3.0]
post_height_m = 0.0
[earth]
latitude_deg = 29.65
longitude_deg = -82.35
height_m = 50.0
date = "2026-11-21"
[survey]
spacing_m = 0.5
readings = 1
[[furniture]]
name = "desk"
kind = "desk"
p_world = [-0.2, 1.0, 0.0]
[[furniture]]
name = "table"
kind = "box"
material = "wood"
size_m = [0.4, 0.4, 0.7]
p_world = [1.6, -1.2, 0.0]
[[source]]
name = "pipe"
shape = "cylinder"
p_world = [0.5, -0.3, -0.4]
size_m = [0.1, 0.1, 0.8]
magnetization = [4000.0, 0.0, 2000.0]
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made")
    (folder / "room.toml").write_text(TOML)
    return magtwin.author_scene(folder / "room.toml", folder / "room")


@pytest.fixture
def room(made, tmp_path) -> Path:
    """A copy of the room, to edit."""
    return shutil.copytree(made.parent, tmp_path / "room") / made.name


def edited(file: Path) -> tuple[Usd.Stage, Usd.Prim]:
    stage = Usd.Stage.Open(str(file))
    return stage, stage.GetPrimAtPath(DESK)


def readings(file, **options) -> np.ndarray:
    """A short run of the physical magnetometer."""
    twin = magtwin.open_twin(file, network="none", **options)
    return magtwin.simulate(twin, "sine", seed=3, session="survey", duration_s=2.0)["b_measured_nt"]


def field(file) -> np.ndarray:
    """Exact field at two places."""
    return field_at_rest_nt(read_scene(file), AT, 0.4)


def told(file, **options) -> str:
    """What opening warns of."""
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always", MismatchWarning)
        magtwin.open_twin(file, network="none", **options)
    return "\n".join(str(w.message) for w in heard)


def building(folder: Path, room: Path, *, metres=1.0, up="Z", **labs) -> Path:
    """A stage that references the room, once for each keyword: its transform ops by name."""
    stage = Usd.Stage.CreateNew(str(folder / "building.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, metres)
    UsdGeom.SetStageUpAxis(stage, up)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/Building").GetPrim())
    for name, ops in labs.items():
        xform = UsdGeom.Xform.Define(stage, f"/Building/{name}")
        xform.GetPrim().GetReferences().AddReference(str(room))
        for op, value in ops.items():
            getattr(xform, f"Add{op}Op")().Set(value)
    stage.Save()
    return folder / "building.usda"


TURNED = {"Translate": Gf.Vec3d(12.5, -7.25, 3.0), "RotateZ": 37.0}
BLENDER = {"Translate": Gf.Vec3d(900, 250, -40), "RotateX": -90.0, "RotateZ": 20.0, "Scale": Gf.Vec3f(100)}


# What is not edited, and what does not matter


def test_an_unedited_room_warns_of_nothing_nor_does_one_with_a_wooden_table_moved(room):
    assert told(room) == ""
    stage, _ = edited(room)
    stage.GetPrimAtPath("/World/Furniture/table").GetAttribute("xformOp:translate").Set(Gf.Vec3d(1.5, -1, 0))
    stage.Save()
    assert told(room) == ""


# A desk


def test_a_moved_desk_is_read_at_its_new_place_and_the_map_is_told_stale(room):
    before, scene = field(room), read_scene(room)
    stage, desk = edited(room)
    desk.GetAttribute("xformOp:translate").Set(Gf.Vec3d(-0.5, 0.9, 0.0))
    stage.Save()
    moved = replace(
        scene, furniture=(replace(scene.furniture[0], p_world=(-0.5, 0.9, 0.0)), scene.furniture[1])
    )
    assert_allclose(field(room), field_at_rest_nt(moved, AT, 0.4), rtol=1e-12)
    assert np.abs(field(room) - before).max() > 10
    text = told(room)
    assert "room.usda: has changed since its map 'room' was made: desk is moved" in text
    assert "nT rms over" in text
    assert f"magtwin map survey {room} --out MAP.usdc --adopt" in text
    twin = magtwin.open_twin(room, network="none")
    run = magtwin.simulate(twin, "sine", seed=1, duration_s=1.0)
    assert "desk is moved" in run.metadata["map_mismatch"]
    del stage, desk, twin  # and the named command makes the map fit again
    options = {"spacing_m": 0.5, "headings_rad": [0.0, np.pi / 2, np.pi, 3 * np.pi / 2], "readings": 1}
    survey_scene(room, room.parent / "new.usdc", adopt=True, **options)
    assert told(room) == ""
    assert read_scene(room).map_layer == (room.parent / "new.usdc").resolve()
    assert open_scene(room).map.name == "new"


def test_a_map_that_comes_by_reference_is_not_adopted(room, tmp_path):
    file = building(tmp_path, room, LabA=TURNED)
    with pytest.raises(InputError, match="no sublayer of this stage, so it cannot be replaced here"):
        survey_scene(file, tmp_path / "new.usdc", adopt=True, headings_rad=[0.0])
    with pytest.raises(InputError, match="write the map into"):
        survey_scene(room, tmp_path / "new.usdc", adopt=True, headings_rad=[0.0])
    assert not (tmp_path / "new.usdc").exists()


def test_a_deleted_and_a_new_source_are_told_by_name(room):
    stage, desk = edited(room)
    desk.SetActive(False)
    copy = stage.OverridePrim("/World/Sources/pipe2")
    copy.GetReferences().AddInternalReference("/World/Sources/pipe")
    copy.GetAttribute("xformOp:translate").Set(Gf.Vec3d(1, 1, -0.5))
    stage.Save()
    assert "desk is gone; pipe2 is new" in told(room)


# The robot


def test_a_magnetometer_mounted_elsewhere_reads_there_and_the_map_is_told_stale(room):
    stage, _ = edited(room)
    link = stage.GetPrimAtPath(MAGNETOMETER)
    old = link.GetAttribute("xformOp:translate").Get()
    link.GetAttribute("xformOp:translate").Set(old + Gf.Vec3d(0.1, 0.0, 0.05))
    stage.Save()
    scene = read_scene(room)
    assert_allclose(scene.robot.p_base_magnetometer[0], old[0] + 0.1, atol=1e-9)
    bare = replace(scene, robot=replace(scene.robot, platform=type(scene.robot.platform)()))
    there = [[0.0, 0.0, 0.0]]
    place = np.array(scene.robot.p_base_magnetometer) + there
    without = replace(bare, robot=replace(bare.robot, p_base_magnetometer=ZERO3))
    assert_allclose(field_at_rest_nt(bare, there, 0.0), field_at_rest_nt(without, place, 0.0), rtol=1e-12)
    assert "the magnetometer of turtlebot4 is at (" in told(room)


def test_a_second_robot_by_reference_needs_its_map(room):
    stage, _ = edited(room)
    second = stage.DefinePrim("/World/second", "Xform")
    (asset,) = Usd.PrimCompositionQuery.GetDirectReferences(stage.GetPrimAtPath(ROBOT)).GetCompositionArcs()
    second.GetReferences().AddReference(asset.GetTargetLayer().realPath)
    UsdGeom.XformCommonAPI(second).SetTranslate((-1.2, -0.9, 0))
    stage.Save()
    del stage, second
    with pytest.raises(InputError, match=r"</World/second/.*map must point to one prim.*/World/AnomalyMap"):
        read_scene(room)
    stage, _ = edited(room)
    sensor = stage.GetPrimAtPath("/World/second/magnetometer_link/magnetometer")
    sensor.GetRelationship("magtwin:magnetometer:map").SetTargets(["/World/AnomalyMap"])
    stage.Save()
    twin = magtwin.open_twin(room, network="none")
    assert [placed.robot.name for placed in twin.scene.robots] == ["turtlebot4", "second"]
    runs = simulate_robots(twin, {"second": "random"}, seed=1, duration_s=1.0)
    assert_allclose(runs["second"]["p_world_base"][0, :2], [-1.2, -0.9], atol=0.05)


# Layers


def test_unsaved_changes_are_neither_lost_nor_overlooked(room):
    stage, desk = edited(room)
    desk.GetAttribute("xformOp:translate").Set(Gf.Vec3d(-0.5, 0.9, 0.0))
    with pytest.raises(InputError, match="has changes in this process that are not saved"):
        open_stage(room)
    assert desk.GetAttribute("xformOp:translate").Get() == Gf.Vec3d(-0.5, 0.9, 0.0)
    stage.Save()
    assert "desk is moved" in told(room)


# The lab in another place


def test_a_moved_and_turned_lab_reads_the_same_bytes(room):
    stage, _ = edited(room)
    here, xform = readings(room), UsdGeom.Xformable(stage.GetPrimAtPath("/World"))
    for op, value in TURNED.items():
        getattr(xform, f"Add{op}Op")().Set(value)
    stage.Save()
    assert np.array_equal(readings(room), here)
    assert told(room) == ""


def test_a_lab_without_an_earth_takes_that_of_the_building_into_its_axes(room, tmp_path):
    file = building(tmp_path, room, LabA={"RotateZ": 90.0})
    stage = Usd.Stage.Open(str(file))
    own = stage.GetPrimAtPath("/Building/LabA/Earth")
    stage.DefinePrim("/Building/Earth", "Xform").GetReferences().AddReference(str(room), "/World/Earth")
    own.SetActive(False)
    stage.Save()
    x, y, z = read_scene(room).earth.b_world_nt
    assert_allclose(read_scene(file).earth.b_world_nt, (y, -x, z), atol=1e-9)
    assert "the Earth's field differs by" in told(file)


def test_steel_of_the_building_counts_in_the_labs_axes(room, tmp_path):
    file = building(tmp_path, room, LabA=TURNED)
    stage = Usd.Stage.Open(str(file))
    world = UsdGeom.XformCache().GetLocalToWorldTransform(stage.GetPrimAtPath("/Building/LabA"))
    beam = stage.OverridePrim("/Building/Beam")
    beam.GetReferences().AddReference(str(room), "/World/Sources/pipe")
    local = Gf.Matrix4d().SetTranslate(Gf.Vec3d(0.5, 1.0, -0.6))
    UsdGeom.Xformable(beam).MakeMatrixXform().Set(local * world)
    stage.Save()
    scene = read_scene(room)
    both = replace(
        scene, sources=(*scene.sources, replace(scene.sources[0], name="b", p_world=(0.5, 1.0, -0.6)))
    )
    assert_allclose(field(file), field_at_rest_nt(both, AT, 0.4), rtol=1e-9)
    assert "was made: Building_Beam is new" in told(file)


@pytest.mark.parametrize(
    ("ops", "said"),
    [
        ({"RotateX": 2.0}, "</Building/LabA>: is tilted by 2 deg, and its lab with it"),
        ({"Scale": Gf.Vec3f(1.1)}, "</Building/LabA>: is scaled by 1.1, 1.1, 1.1"),
        ({"Scale": Gf.Vec3f(-1, 1, 1)}, "</Building/LabA>: is mirrored"),
    ],
)
def test_a_lab_that_does_not_stand_level_in_its_size_is_refused_by_prim(room, tmp_path, ops, said):
    file = building(tmp_path, room, LabA=ops)
    with pytest.raises(InputError, match=said) as refused:
        readings(file)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("path", "change", "words"),
    [
        ("/World/Lab", lambda p: UsdGeom.XformCommonAPI(p).SetTranslate((1, 0, 0)), "Lab>: is moved"),
        (ROBOT, lambda p: UsdGeom.Xformable(p).AddScaleOp().Set(Gf.Vec3f(2)), "the robot is scaled"),
        ("/World/AnomalyMap", lambda p: p.SetActive(False), "magnetometer:map must point to one prim"),
    ],
)
def test_an_edit_that_takes_the_lab_apart_is_refused_by_prim(room, path, change, words):
    stage, _ = edited(room)
    change(stage.GetPrimAtPath(path))
    stage.Save()
    with pytest.raises(InputError, match=words):
        readings(room)


# A stage in centimetres with Y up


def test_a_stage_in_centimetres_with_y_up_that_scales_and_turns_the_lab_reads_the_same_bytes(room, tmp_path):
    file = building(tmp_path, room, metres=0.01, up="Y", LabA=BLENDER)
    assert np.array_equal(readings(file), readings(room))
    pose = open_scene(file).pose
    assert_allclose((*pose.p, pose.yaw), (9, 0.4, 2.5, np.radians(20)), atol=1e-9)
    (tmp_path / "bare").mkdir()
    words = "reference the lab with scale 100 and rotateX -90"
    with magtwin.allow(tmp_path), pytest.raises(InputError, match=words):
        readings(building(tmp_path / "bare", room, metres=0.01, up="Y", LabA={}))


def test_a_thing_in_centimetres_in_our_stage_is_refused_until_it_is_scaled(room):
    thing = Usd.Stage.CreateNew(str(room.parent / "thing.usda"))
    UsdGeom.SetStageMetersPerUnit(thing, 0.01)
    UsdGeom.SetStageUpAxis(thing, "Y")
    thing.SetDefaultPrim(UsdGeom.Cube.Define(thing, "/Thing").GetPrim())
    thing.Save()
    stage, _ = edited(room)
    xform = UsdGeom.Xform.Define(stage, "/World/Thing")
    xform.GetPrim().GetReferences().AddReference("./thing.usda")
    stage.Save()
    with pytest.raises(InputError, match=r"</World/Thing>: brings in .*give it scale 0.01 and rotateX 90"):
        read_scene(room)
    xform.AddRotateXOp().Set(90.0)
    xform.AddScaleOp().Set(Gf.Vec3f(0.01))
    stage.Save()
    read_scene(room)
