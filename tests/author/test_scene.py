"""A Scene through its layers and back; what cannot be a scene is refused by file and prim."""

import math
import re
import runpy
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics
from validators import assert_valid

import magtwin
from magtwin.author.scene import author_scene
from magtwin.author.scene_file import scene_from_toml
from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.sources.earth import earth_field_nt
from magtwin.files.file import sha256, shipped
from magtwin.frames import IDENTITY_XYZW, quat_from_rpy, quat_multiply
from magtwin.spec.drive import DriveSpec
from magtwin.spec.lab import LabSpec
from magtwin.spec.magnetics import EarthFieldSpec, PlatformFieldSpec, SourceSpec
from magtwin.spec.scene import Scene
from magtwin.spec.sensors import BatterySpec, ImuSpec, LidarSpec, MagnetometerSpec
from magtwin.twin import open_twin, simulate
from magtwin.usd import sensors
from magtwin.usd.attributes import write_pose
from magtwin.usd.lab.room import LAB, define_lab
from magtwin.usd.layers import new_stage
from magtwin.usd.maps.layer import save_map
from magtwin.usd.scene import open_alone, read_scene, robots_in

pytestmark = pytest.mark.usefixtures("allow_neighbours")  # scenes by reference

EARTH = EarthFieldSpec(
    b_world_nt=(-2_000.5, 23_000.25, -39_000.125),
    latitude_deg=29.6,
    longitude_deg=-82.3,
    height_m=20.0,
    date="2026-01-01",
)
SOURCES = (
    SourceSpec(name="beam", p_world=(1.0, 0.5, -0.4), m_world=(0.0, 3.0, -8.0)),
    SourceSpec(name="anchor", p_world=(-1.5, -0.25, -0.3), m_world=(0.5, 0.0, 2.0)),
)
LINKS = {
    "base_link": (0.0, 0.0, 0.05),
    "magnetometer_link": (0.03, 0.0, 0.35),
    "imu_link": (0.0, 0.0, 0.1),
    "rplidar_link": (0.0, 0.0, 0.2),
}
TOML = """
name = "small"
map = "map.usdc"

[robot]
asset = "robot/bot.usda"
"""


def define_robot_asset(path: Path) -> None:
    """A robot with every part that magtwin reads, and nothing to look at."""
    with new_stage(path, "a robot of the tests") as stage:
        root = UsdGeom.Xform.Define(stage, "/bot").GetPrim()
        stage.SetDefaultPrim(root)
        stage.RemovePrim("/World")
        for link, p in LINKS.items():
            write_pose(UsdGeom.Xform.Define(stage, f"/bot/{link}").GetPrim(), p)
        UsdPhysics.RigidBodyAPI.Apply(stage.GetPrimAtPath("/bot/base_link"))
        for joint in ("left_wheel_joint", "right_wheel_joint"):
            UsdPhysics.RevoluteJoint.Define(stage, f"/bot/{joint}").CreateBody0Rel().SetTargets(
                ["/bot/base_link"]
            )
        sensors.define_footprint(root, 0.2)
        sensors.define_drive(root, DriveSpec(v_max=0.4))
        sensors.define_on_root(root, "platform", PlatformFieldSpec(hard_iron_nt=(1.0, 2.0, 3.0)))
        sensors.define_battery(stage, "/bot/battery", BatterySpec(load_w=12.0))
        mount = MagnetometerSpec(p_link_sensor=(0.0, 0.0, 0.01))
        sensors.define_magnetometer(stage, "/bot/magnetometer_link/magnetometer", mount)
        sensors.define_imu(stage, "/bot/imu_link/imu", ImuSpec())
        sensors.define_lidar(stage, "/bot/rplidar_link/lidar", LidarSpec())


@pytest.fixture(scope="module")
def parts(tmp_path_factory) -> Path:
    """A folder with a map, a robot, weights and a TOML that names the first two; not to be changed."""
    folder = tmp_path_factory.mktemp("parts")
    define_robot_asset(folder / "robot" / "bot.usda")
    save_map(small_map(), folder / "map.usdc")
    (folder / "net.pth").write_bytes(b"weights")
    (folder / "scene.toml").write_text(TOML)
    return folder


@pytest.fixture
def own_parts(parts, tmp_path) -> Path:
    """The same, to be changed."""
    return Path(shutil.copytree(parts, tmp_path / "parts"))


def small_map() -> AnomalyMap:
    rng = np.random.default_rng(0)
    return AnomalyMap(
        values_nt=rng.normal(41_000, 300, (4, 3, 4)).astype(np.float32),
        origin_m=(-3.0, -1.75),
        cell_m=(2.0, 1.75),
        headings_rad=np.arange(4) * np.pi / 2,
        name="small",
    )


def full_scene(parts: Path) -> Scene:
    scene = scene_from_toml(parts / "scene.toml", network=parts / "net.pth")
    return replace(scene, earth=EARTH, sources=SOURCES, start=(1.0, -0.5, 0.0))


def turned_links(parts: Path) -> None:
    """Lean the robot's base, in it yaw imu_link by a quarter and lay magnetometer_link on its back."""
    lean = tuple(quat_from_rpy([0.1, -0.2, 0.3]).tolist())
    turns = {
        "base_link": lean,
        "imu_link": quat_multiply(lean, (0.0, 0.0, 0.5**0.5, 0.5**0.5)),
        "magnetometer_link": quat_multiply(lean, (1.0, 0.0, 0.0, 0.0)),
        "rplidar_link": lean,
    }
    stage = Usd.Stage.Open(str(parts / "robot" / "bot.usda"))
    for link, q in turns.items():
        write_pose(stage.GetPrimAtPath(f"/bot/{link}"), LINKS[link], tuple(map(float, q)))
    stage.Save()


def test_the_axes_of_the_sensors_links_in_the_base_are_read_from_the_stage(own_parts, tmp_path):
    level = scene_from_toml(own_parts / "scene.toml").robot
    assert level.q_base_magnetometer_link_xyzw == level.q_base_imu_link_xyzw == IDENTITY_XYZW
    turned_links(own_parts)
    scene = scene_from_toml(own_parts / "scene.toml")
    assert scene.robot.q_base_imu_link_xyzw == pytest.approx((0, 0, 0.5**0.5, 0.5**0.5), abs=1e-15)
    assert np.abs(scene.robot.q_base_magnetometer_link_xyzw) == pytest.approx((1, 0, 0, 0), abs=1e-15)
    placed = replace(scene, start=(1.0, -0.5, math.pi / 2))
    assert read_scene(author_scene(placed, tmp_path / "s", by_reference=True)).robot == scene.robot


def test_a_scenes_folder_can_be_moved_and_needs_nothing_outside_of_it(own_parts, tmp_path):
    scene = full_scene(own_parts)
    author_scene(scene, tmp_path / "a" / "s")
    shutil.rmtree(own_parts)
    (tmp_path / "a" / "s").rename(tmp_path / "moved")
    read = read_scene(tmp_path / "moved" / "small.usda")
    inside = replace(
        scene,
        map_layer=tmp_path / "moved" / "map" / "map.usdc",
        robot=replace(
            scene.robot,
            asset=tmp_path / "moved" / "robots" / "bot" / "bot.usda",
            magnetometer=replace(
                scene.robot.magnetometer, network=tmp_path / "moved" / "weights" / "net.pth"
            ),
        ),
    )
    assert read == inside
    for layer in (tmp_path / "moved").rglob("*.usda"):
        assert str(tmp_path) not in layer.read_text()


def test_the_root_layer_is_short_text_with_units_axes_and_relative_paths(parts, tmp_path):
    root = author_scene(full_scene(parts), tmp_path / "s")
    text = root.read_text()
    assert len(text.splitlines()) < 65
    stage = Usd.Stage.Open(str(root))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert UsdPhysics.GetStageKilogramsPerUnit(stage) == 1
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert stage.GetDefaultPrim().GetPath() == "/World"
    assert list(stage.GetRootLayer().subLayerPaths) == ["./room.usda", "./magnetics.usda", "./map/map.usdc"]
    assert "@./robots/bot/bot.usda@" in text
    assert "@./weights/net.pth@" in text
    assert stage.GetRootLayer().documentation
    assert stage.GetRootLayer().customLayerData["creator"] == "magtwin"


# The lab


def lab_stage(spec: LabSpec) -> Usd.Stage:
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1)
    define_lab(stage, spec)
    return stage


def box_of(stage: Usd.Stage, path: Sdf.Path) -> Gf.Range3d:
    """The box around a prim, shown or a collider."""
    cache = UsdGeom.BBoxCache(0, ["default", "guide"])
    return cache.ComputeWorldBound(stage.GetPrimAtPath(path)).ComputeAlignedRange()


def test_the_floor_ends_at_zero_and_the_walls_stand_just_outside_of_it():
    spec = LabSpec(floor_m=(6.0, 3.5), wall_height_m=0.3, wall_thickness_m=0.05)
    stage = lab_stage(spec)
    floor = box_of(stage, LAB.AppendChild("Floor"))
    assert floor.GetMax()[2] == pytest.approx(0)
    east, south = box_of(stage, LAB.AppendPath("Walls/East")), box_of(stage, LAB.AppendPath("Walls/South"))
    assert (east.GetMin()[0], east.GetMax()[0], east.GetMax()[2]) == pytest.approx((3.0, 3.05, 0.3))
    assert (south.GetMax()[1], south.GetMin()[1], south.GetMin()[2]) == pytest.approx((-1.75, -1.8, 0.0))


def test_what_carries_the_robots_is_a_plane_at_the_top_of_the_floor_and_adds_nothing_to_the_bounds():
    stage = lab_stage(LabSpec())  # PhysX lets wheels sink into a large thin box
    ground = UsdGeom.Plane(stage.GetPrimAtPath(LAB.AppendChild("Ground")))
    assert ground.GetAxisAttr().Get() == "Z"
    assert ground.ComputeLocalToWorldTransform(0) == Gf.Matrix4d(1)
    assert ground.ComputePurpose() == "guide"
    floor = box_of(stage, LAB.AppendChild("Floor"))
    assert (ground.GetWidthAttr().Get(), ground.GetLengthAttr().Get()) == pytest.approx(floor.GetSize()[:2])
    assert not stage.GetPrimAtPath(LAB.AppendChild("Floor")).HasAPI(UsdPhysics.CollisionAPI)


# A scene's TOML


def test_a_toml_gives_room_start_earth_and_sources(own_parts):
    (own_parts / "sources.toml").write_text(
        '[[source]]\nname = "beam"\np_world = [1, 2, -0.5]\nm_world = [0, 0, 4.5]\n'
    )
    (own_parts / "scene.toml").write_text(
        TOML.replace('"map.usdc"', '"map.usdc"\nstart = [1, 0.5, 0.25]')
        + "[lab]\nfloor_m = [5, 4]\n[sources]\nfile = 'sources.toml'\n"
        + "[earth]\nb_world_nt = [0, 20e3, -40e3]\nlatitude_deg = 29\nlongitude_deg = -82\nheight_m = 2\n"
        + 'date = "2026-01-01"\nmeasured = true\n'
    )
    scene = scene_from_toml(own_parts / "scene.toml")
    assert scene.start == (1.0, 0.5, 0.25)
    assert scene.lab == LabSpec(floor_m=(5.0, 4.0))
    assert scene.earth is not None
    assert scene.earth.b_world_nt == (0.0, 20e3, -40e3)
    assert scene.sources == (SourceSpec(name="beam", p_world=(1.0, 2.0, -0.5), m_world=(0.0, 0.0, 4.5)),)
    other = scene_from_toml(own_parts / "scene.toml", map_layer=own_parts / "map.usdc")
    assert (other.earth, other.sources) == (scene.earth, scene.sources), "a map takes nothing away"


PLACE = '[earth]\nlatitude_deg = 95\nlongitude_deg = 0\nheight_m = 0\ndate = "2026-01-01"\n[robot]'
DATE = PLACE.replace("95", "9").replace("2026-01-01", "20260101")
NAMED = 'asset = "robot/bot.usda"'
BROKEN_TOML = [
    ("name =", "nmae =", r"scene\.toml:2: unknown key 'nmae'; did you mean 'name'"),
    ("asset =", "aset =", r"scene\.toml:6: \[robot\] unknown key 'aset'; did you mean 'asset'"),
    ("bot.usda", "bott.usda", r"bott\.usda: no such robot asset; did you mean 'bot\.usda'"),
    ("map.usdc", "mapp.usdc", r"mapp\.usdc: no such map layer; did you mean 'map\.usdc'"),
    ('map = "map.usdc"', "", r"scene\.toml: names no map; add map = .*\[earth\].*\[\[furniture\]\]"),
    ("[robot]", "[lab]\nfloor_m = [6]\n[robot]", r"scene\.toml:6: \[lab\] floor_m must be a list of 2"),
    ("[robot]", "[lab]\nfloor_m = [6, -1]\n[robot]", r"scene\.toml:6: \[lab\] floor_m .* above"),
    ("[robot]", "[robot]\nnetwork = 'net'", r"net: no such weights file"),
    ("[robot]", "[sources]\nfile = 'gone.toml'\n[robot]", r"gone\.toml: no such TOML file"),
    ("small", "../small", r"scene '\.\./small' cannot name a file"),
    ('"small"', '""', "scene '' cannot name a file; use letters, digits, - and _"),
    ("[robot]", "start = [0, inf, 0]\n[robot]", r"scene\.toml:5: start must be a number, got inf"),
    ("[robot]", PLACE, r"scene\.toml:6: \[earth\] latitude_deg .* -90\.\.90, got 95"),
    ("[robot]", DATE, r"scene\.toml:9: \[earth\] date .* YYYY-MM-DD, got '20260101'"),
    (NAMED, 'urdf = "bot.urdf"\nfootprint_radius_m = -1', r"scene\.toml:7: .*footprint_radius_m .* above 0"),
]


@pytest.mark.parametrize(("old", "new", "said"), BROKEN_TOML)
def test_a_broken_toml_is_refused_by_line_with_nothing_written(own_parts, tmp_path, old, new, said):
    (own_parts / "scene.toml").write_text(TOML.replace(old, new))
    with pytest.raises(InputError, match=said):
        author_scene(scene_from_toml(own_parts / "scene.toml"), tmp_path / "s")
    assert not (tmp_path / "s").exists()


@pytest.mark.parametrize("name", ["net.safetensors", "net.pth", "net.txt"])
def test_what_is_no_network_is_refused(own_parts, name):
    (own_parts / name).write_bytes(b"none")
    with pytest.raises(InputError, match=name.replace(".", r"\.")):
        magtwin.scene_from_toml(own_parts / "scene.toml", network=own_parts / name)


# Several robots

TWO = """
name = "two"
map = "map.usdc"

[[robot]]
name = "ann"
asset = "robot/bot.usda"
start = [-1, 0.5, 0]
path = "figure8"

[[robot]]
name = "bob"
asset = "robot/bot.usda"
network = "net.pth"
path = "there.csv"

[[robot]]
name = "cleo"
asset = "other/bot.usda"
start = [0, -1, 0]
path = "random"
"""


def two_robots(parts: Path) -> Scene:
    """Three robots of two assets that have one file name."""
    (parts / "other").mkdir()
    define_robot_asset(parts / "other" / "bot.usda")
    (parts / "there.csv").write_text("0,0\n1,0\n")
    (parts / "scene.toml").write_text(TWO)
    return scene_from_toml(parts / "scene.toml")


def test_a_toml_of_several_robots_gives_each_its_name_start_path_and_network(own_parts):
    scene = two_robots(own_parts)
    assert [p.robot.name for p in scene.robots] == ["ann", "bob", "cleo"]
    assert [p.start for p in scene.robots] == [(-1.0, 0.5, 0.0), (0.0, 0.0, 0.0), (0.0, -1.0, 0.0)]
    assert [p.path for p in scene.robots] == ["figure8", own_parts / "there.csv", "random"]
    assert [p.robot.magnetometer.kind for p in scene.robots] == ["physical", "neural", "physical"]
    assert (scene.robot, scene.start, scene.path) == (scene.robots[0].robot, (-1.0, 0.5, 0.0), "figure8")
    led = scene.led_by("bob")
    assert [p.robot.name for p in led.robots] == ["bob", "ann", "cleo"]
    assert led.led_by("ann") == scene
    with pytest.raises(InputError, match="no robot 'bobby'; did you mean 'bob'"):
        scene.led_by("bobby")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('name = "bob"', 'name = "ann"', "different names, got \"'ann' twice"),
        ('name = "bob"\n', "", r"scene\.toml: \[\[robot\]\] '' needs name = "),
        ('name = "bob"', 'name = "Lab"', "'Lab' has a name that scenes reserve"),
        ('"figure8"', '"figure9"', r"\[\[robot\]\] 'ann' path: no path 'figure9' \(did you mean"),
        ('"there.csv"', '"their.csv"', r"'bob' path: .*their\.csv: no such path file; did you"),
        ("start = [0, -1, 0]", "start = [0, -1]", r"start must be a list of 3"),
        ("start = [0, -1, 0]", "strat = [0, -1, 0]", r"unknown key 'strat'; did you mean 'start'"),
        ("start = [0, -1, 0]", "conversion = {}", r"'cleo' conversion goes with urdf"),
    ],
)
def test_a_toml_of_several_robots_that_do_not_fit_is_refused(own_parts, tmp_path, old, new, said):
    two_robots(own_parts)
    (own_parts / "scene.toml").write_text(TWO.replace(old, new))
    with pytest.raises(InputError, match=said):
        author_scene(scene_from_toml(own_parts / "scene.toml"), tmp_path / "s")
    assert not (tmp_path / "s").exists()


def test_robots_that_read_different_maps_are_refused_by_prim(own_parts, tmp_path):
    root = author_scene(two_robots(own_parts), tmp_path / "s")
    stage = Usd.Stage.Open(str(root))
    other = stage.GetPrimAtPath("/World/bob/magnetometer_link/magnetometer")
    other.GetAttribute(sensors.MAP_CHECKSUM).Set("0" * 64)
    stage.Save()
    with pytest.raises(InputError, match="</World/bob/magnetometer_link/magnetometer>: reads another map"):
        read_scene(root)


# What ships


def build_lab(folder: Path) -> Path:
    """`scenes/build.py` run for another folder."""
    return runpy.run_path(str(shipped("scenes", "build.py")))["build"](folder)


def without_ways(layer: Path) -> str:
    """A layer's text, each relative path without the way up to where the project's folders part."""
    text = Sdf.Layer.OpenAsAnonymous(str(layer)).ExportToString()
    return re.sub(r"@(\.\./)[^@]*?((maps|robots|weights)/[^@]*)@", r"@\2@", text)


def test_the_labs_stage_is_what_a_fresh_build_gives(tmp_path):
    fresh, committed = build_lab(tmp_path / "lab").parent, shipped("scenes", "lab")
    assert sorted(p.name for p in fresh.iterdir()) == sorted(p.name for p in committed.iterdir())
    for layer in fresh.iterdir():
        assert without_ways(layer) == without_ways(committed / layer.name), (
            f"run scenes/build.py: {layer.name}"
        )


def test_the_lab_passes_the_gates(tmp_path, lab_scene):
    assert_valid(lab_scene, tmp_path)


def test_the_labs_earth_is_the_igrfs_to_a_tenth_of_a_nanotesla():
    earth = scene_from_toml(shipped("scenes", "lab.toml")).earth
    assert earth is not None
    field = earth_field_nt(earth.latitude_deg, earth.longitude_deg, earth.height_m, earth.date)
    assert earth.b_world_nt == pytest.approx(field, abs=0.06)


def test_the_real_lab_asks_for_its_map():
    with pytest.raises(InputError, match=r"aprilab\.toml: names no map; .*give `map_layer=FILE\.usdc`"):
        scene_from_toml(shipped("scenes", "aprilab.toml"))


# What cannot be authored


def test_a_folder_that_exists_is_refused_and_kept(parts, tmp_path):
    root = author_scene(full_scene(parts), tmp_path / "s")
    before = root.read_bytes()
    with pytest.raises(InputError, match="exists already; give `force=True`"):
        author_scene(replace(full_scene(parts), start=(0.0, 0.0, 0.0)), tmp_path / "s")
    assert root.read_bytes() == before
    author_scene(replace(full_scene(parts), start=(0.0, 0.0, 0.0)), tmp_path / "s", force=True)
    assert read_scene(root).start == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda s: {"map_layer": s.robot.asset}, r"bot\.usda </>: needs one prim with MagtwinAnomalyMapAPI"),
        (lambda s: {"robot": replace(s.robot, asset=s.map_layer)}, "needs one prim"),
        (lambda s: {"robot": replace(s.robot, name="Lab")}, "'Lab' has a name that scenes reserve"),
        (lambda s: {"robot": replace(s.robot, name="my bot")}, "'my bot' cannot name a prim"),
        (lambda s: {"sources": (SOURCES[0], SOURCES[0])}, "two sources are called 'beam'"),
        (
            lambda s: {"robot": replace(s.robot, imu=replace(s.robot.imu, link="base_link"))},
            "sits on 'base_link', so its prim must be a child of it",
        ),
    ],
)
def test_a_scene_that_does_not_fit_is_refused_with_nothing_written(parts, tmp_path, change, said):
    scene = full_scene(parts)
    with pytest.raises(InputError, match=said):
        author_scene(replace(scene, **change(scene)), tmp_path / "s")
    assert list(tmp_path.iterdir()) == []


# Broken stages


BROKEN = [
    ("./robots/bot/bot.usda", "./robots/bot/gone.usda", r"gone\.usda@ for reference.*</World/bot>"),
    ("./map/map.usdc", "./map/gone.usdc", r"Could not load sublayer.*gone\.usdc"),
    ("@./map/map.usdc@", "", r"</World/bot/.*/magnetometer>: magtwin:magnetometer:map must"),
    ("@./room.usda@,", "", "needs one prim with MagtwinLabAPI below it, found none"),
    ("./weights/net.pth", "./weights/gone", r"</.*magnetometer>: .*network names .*gone"),
    ("</World/AnomalyMap>", "</World/Lab>", "</World/Lab>: has no MagtwinAnomalyMapAPI"),
    ("metersPerUnit = 1", "metersPerUnit = 0.01", "0.01 m a unit and Z up; magtwin reads metres"),
    ('upAxis = "Z"', 'upAxis = "Y"', "1 m a unit and Y up; magtwin reads metres with Z up"),
    ("{\n", "{{{\n", "cannot be opened as USD"),
    ("translate = (1,", "translate = (inf,", "</World/bot>: start of placed robot must be finite, got"),
]


@pytest.mark.parametrize(("old", "new", "said"), BROKEN)
def test_a_broken_stage_is_refused_in_one_line_by_file_and_prim(parts, tmp_path, capfd, old, new, said):
    root = author_scene(full_scene(parts), tmp_path / "s")
    text = root.read_text()
    assert old in text
    root.write_text(text.replace(old, new, 1) if new.startswith("{") else text.replace(old, new))
    with pytest.raises(InputError, match=said) as refused:
        read_scene(root)
    assert "small.usda" in str(refused.value)
    assert "\n" not in str(refused.value)
    assert capfd.readouterr().err == "", "USD's own warnings stay off the terminal"


def test_another_map_in_the_place_of_the_scenes_own_is_refused_naming_both(parts, tmp_path):
    scene = full_scene(parts)
    assert scene.map_sha256 == sha256(parts / "map.usdc")
    root = author_scene(scene, tmp_path / "s")
    own = tmp_path / "s" / "map" / "map.usdc"
    save_map(replace(small_map(), origin_m=(-2.5, -1.75)), own, force=True)
    with pytest.raises(InputError, match=r"small\.usda </World/bot/.*/magnetometer>: .*map\.usdc: has") as e:
        read_scene(root)
    assert sha256(own) in str(e.value)
    assert scene.map_sha256 in str(e.value)
    root.write_text(root.read_text().replace(f'mapSha256 = "{scene.map_sha256}"', 'mapSha256 = ""'))
    assert read_scene(root).map_sha256 == "", "any map will do where the scene says no checksum"


def test_a_scene_is_not_authored_over_another_map_than_it_names(own_parts, tmp_path):
    scene = full_scene(own_parts)
    save_map(replace(small_map(), name="other"), own_parts / "map.usdc", force=True)
    with pytest.raises(InputError, match=r"map\.usdc: has SHA-256 .* but scene 'small' was made with a map"):
        author_scene(scene, tmp_path / "s")
    assert not (tmp_path / "s").exists()


def test_a_flattened_scene_is_read_though_it_is_its_own_map(parts, tmp_path):
    scene = full_scene(parts)
    stage = Usd.Stage.Open(str(author_scene(scene, tmp_path / "s")))
    stage.Flatten().Export(str(tmp_path / "flat.usdc"))
    flat = read_scene(tmp_path / "flat.usdc")
    assert flat.map_layer == tmp_path / "flat.usdc"
    assert (flat.earth, flat.sources, flat.robot.drive) == (scene.earth, scene.sources, scene.robot.drive)


def test_a_twin_is_opened_with_other_weights_or_none_where_the_scenes_own_are_gone(parts, tmp_path):
    root = author_scene(full_scene(parts), tmp_path / "s")
    weights = tmp_path / "s" / "weights" / "net.pth"
    weights.unlink()
    assert read_scene(root, check_network=False).robot.magnetometer.network == weights
    others = shipped("weights", "turtlebot4_hybrid.safetensors")
    assert open_twin(root, network=others).scene.robot.magnetometer.network == others
    assert open_twin(root, network="none").magnetometer is None
    for opened in (open_twin, read_scene):
        with pytest.raises(InputError, match=r"magnetometer:network names .*net\.pth, which is not there"):
            opened(root)


def test_a_toml_names_the_kind_of_magnetometer_and_a_network_makes_it_neural(own_parts):
    def kind(robot: str, **options) -> str:
        (own_parts / "scene.toml").write_text(TOML + robot)
        return scene_from_toml(own_parts / "scene.toml", **options).robot.magnetometer.kind

    assert kind("") == "physical"
    assert kind('network = "net.pth"') == "neural"
    assert kind('kind = "map-only"') == "map-only"
    assert kind('network = "net.pth"\nkind = "physical"') == "physical"
    assert kind('kind = "map-only"', network=own_parts / "net.pth") == "neural"  # weights asked for are used
    with pytest.raises(InputError, match=r'\[robot\] kind = "neural" needs network = "FILE"'):
        kind('kind = "neural"')
    with pytest.raises(InputError, match=r"scene\.toml"):
        kind('kind = "magnetic"')


def test_a_twin_loads_a_network_only_for_a_neural_magnetometer(lab_scene, tmp_path):
    assert open_twin(lab_scene).magnetometer is not None
    for kind in ("physical", "map-only"):
        twin = open_twin(lab_scene, magnetometer=kind)
        assert twin.magnetometer is None
        assert twin.scene.robot.magnetometer.kind == kind
    assert open_twin(lab_scene, network="none").scene.robot.magnetometer.kind == "physical"
    with pytest.raises(InputError, match="a neural magnetometer without a network"):
        open_twin(lab_scene, network="none", magnetometer="neural")
    with pytest.raises(InputError, match=r"kind of magnetometer must be a known kind .*'physical'"):
        open_twin(lab_scene, magnetometer="physicall")  # type: ignore[arg-type]
    run = simulate(open_twin(lab_scene, magnetometer="map-only"), duration_s=1.0)
    np.testing.assert_array_equal(run["b_total_nt"], run["b_map_nt"])
    assert run.metadata["magnetometer"] == "map-only"
    assert "network" not in run.metadata


def test_a_stage_can_be_opened_with_one_of_its_robots_alone(own_parts, tmp_path):
    root = author_scene(two_robots(own_parts), tmp_path / "s")
    before = root.read_bytes()
    stage = open_alone(root, "bob")
    active = [name for name in ("ann", "bob", "cleo") if stage.GetPrimAtPath(f"/World/{name}").IsActive()]
    assert active == ["bob"]
    assert robots_in(root) == {
        "ann": "figure8",
        "bob": tmp_path / "s" / "paths" / "there.csv",
        "cleo": "random",
    }
    assert root.read_bytes() == before
