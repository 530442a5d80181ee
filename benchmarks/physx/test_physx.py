"""PhysX: the scenes that ship, every export and a robot of others stand and drive in it (`make physx`)."""

import math
import subprocess
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import physx_drive
import pytest
from physx_drive import STEP_S, find_python, open_world
from physx_drive import physx as driven_in_physx
from physx_robots import driven_table, find_room, read_driven
from pxr import Sdf, Usd, UsdGeom, UsdPhysics

from magtwin.author.scene import author_scene
from magtwin.errors import InputError
from magtwin.export.package import export_scene
from magtwin.export.usdz import unpack
from magtwin.files.file import shipped
from magtwin.path import figure8
from magtwin.sim.engines.newton import Newton
from magtwin.sim.motion.follow import follow
from magtwin.spec.obstacles import Obstacles
from magtwin.twin import open_twin, scene_from_toml
from magtwin.urdf.convert import convert_urdf
from magtwin.urdf.options import Options
from magtwin.usd.lab.obstacles import read_obstacles

PYTHON, VERSION = find_python()

physx = pytest.mark.skipif(not PYTHON, reason=physx_drive.GET_PHYSX)

REAL = Path(__file__).resolve().parents[3] / "shared" / "data"

RATE = 5.594
"""Wheels of a TurtleBot 4 at 0.2 m/s [rad/s]."""


def in_every_form(scene, folder):
    """A scene as it is authored, and in every form that magtwin exports."""
    made = {"scene": scene}
    for profile in ("omniverse", "isaac", "newton"):
        export_scene(scene, folder / profile, profile=profile, trusted=True)
        made[profile] = folder / profile / scene.name
    for name in ("viewer.usdc", "lab.usdz"):
        made[name] = folder / name
        export_scene(scene, made[name], trusted=True)
    return made


@pytest.fixture(scope="module")
def lab_scene(tmp_path_factory):
    """The default lab, as it is authored."""
    folder = tmp_path_factory.mktemp("lab")
    return author_scene(scene_from_toml(shipped("scenes", "lab.toml")), folder / "lab")


@pytest.fixture(scope="module")
def exports(lab_scene, tmp_path_factory):
    """The default lab."""
    return in_every_form(lab_scene, tmp_path_factory.mktemp("physx"))


@pytest.fixture(scope="module")
def aprilab(tmp_path_factory):
    """The APRILab lab, with the map of the default lab: the real one is not at hand everywhere."""
    folder = tmp_path_factory.mktemp("aprilab")
    scene = scene_from_toml(shipped("scenes", "aprilab.toml"), map_layer=shipped("maps", "lab", "lab.usdc"))
    return in_every_form(author_scene(scene, folder / "aprilab"), folder)


FORMS = ["scene", "omniverse", "isaac", "newton", "viewer.usdc", "lab.usdz"]


# Without PhysX


@pytest.mark.parametrize(
    ("code", "said"),
    [("import time; time.sleep(60)", "took longer than 0.5 s"), ("raise ValueError('no floor')", "no floor")],
)
def test_an_engine_that_hangs_or_fails_is_a_finding(lab_scene, monkeypatch, code, said):
    monkeypatch.setattr(physx_drive, "LIMIT_S", 0.5)
    monkeypatch.setattr(physx_drive, "find_python", lambda: (sys.executable, "0"))
    real = physx_drive.WorldProcess
    monkeypatch.setattr(
        physx_drive, "WorldProcess", lambda command, *a, **k: real([command[0], "-c", code], *a, **k)
    )
    if "time" not in code:
        monkeypatch.setattr(physx_drive, "LIMIT_S", 60)
    check = driven_in_physx(lab_scene)
    (finding,) = check.findings
    assert finding.rule == "unfinished"
    assert said in finding.text
    assert check.result == "failed"


def test_a_robot_drives_where_it_has_room():
    box = np.array([[0.5, -0.5], [1.5, -0.5], [1.5, 0.5], [0.5, 0.5]])
    others = np.empty((0, 2))
    assert find_room(Obstacles(), (0, 0, 0), 0.2, others) == (0, 0, 0)
    x, y, yaw = find_room(Obstacles(("box",), (box,)), (0, 0, 0), 0.2, others)
    assert (x, y) == (0, 0)
    assert yaw == pytest.approx(math.pi / 2)  # at 60 degrees, the corner is 0.18 m from the way
    _, _, yaw = find_room(Obstacles(), (0, 0, 0), 0.2, np.array([[1.0, 0.0]]))
    assert abs(yaw) > math.radians(20)
    inside = find_room(Obstacles(("box",), (box,)), (1.0, 0.0, 0.0), 0.2, others)
    assert Obstacles(("box",), (box,)).clearance([inside[:2]])[0][0] > 0.2


def test_the_robot_of_the_lab_is_found_with_its_wheels_and_its_ground(lab_scene):
    stage = Usd.Stage.Open(str(lab_scene))
    table = driven_table(stage)
    (robot,) = table["robots"]
    assert robot["base"] == "/World/turtlebot4/base_link"
    assert robot["joints"] == tuple(f"/World/turtlebot4/joints/{s}_wheel_joint" for s in ("left", "right"))
    assert robot["lowest_m"] == pytest.approx(0, abs=1e-6)
    assert table["ground"]
    assert not driven_table(Usd.Stage.CreateInMemory())["ground"]


# In PhysX


@physx
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("place", ["exports", "aprilab"])
def test_the_robot_of_each_lab_and_of_each_export_rests_drives_and_turns(place, form, tmp_path, request):
    made = request.getfixturevalue(place)[form]
    file = made if made.suffix != ".usdz" else unpack(made, tmp_path)
    stage = Usd.Stage.Open(str(file))
    (robot,) = read_driven(stage)
    obstacles, none = read_obstacles(stage), np.empty((0, 2))
    spots = [(0, 0, 0.0), (2, 1, 1.0), (-2, 1, 2.5), (2, -1, -1.0), (-2, -1, -2.5)]
    starts = [find_room(obstacles, spot, 0.2, none) for spot in spots]
    assert len(set(starts)) == 5
    job = {"base": robot.base, "joints": robot.joints, "start": starts[0]}
    moved = []
    with open_world(PYTHON, file, job) as world:
        before = world.seen()
        after = world.ask([[0.0, 0.0]] * round(5 / STEP_S))
        assert math.dist(before[:2], after[:2]) < 0.002
        assert abs(after[7] - robot.height_m) < 0.002
        for start in starts:
            before = world.ask(start)
            assert before[:3] == pytest.approx(start, abs=1e-3)
            after = world.ask([[RATE, RATE]] * round(2 / STEP_S))
            moved.append(math.dist(before[:2], after[:2]))
        before = world.ask(starts[0])
        rate = robot.wheel_separation_m / 2 / robot.wheel_radius_m
        after = world.ask([[-rate, rate]] * round(2 / STEP_S))
    assert min(moved) > 0.37
    assert max(moved) < 0.42
    assert math.remainder(after[2] - before[2], math.tau) == pytest.approx(2, rel=0.03)


@physx
def test_the_robot_of_an_aprilab_scene_passes(aprilab):
    check = driven_in_physx(aprilab["scene"])
    assert check.result == "passed", check.findings


@physx
@pytest.mark.parametrize("merge", [False, True])
@pytest.mark.skipif(not REAL.is_dir(), reason="the real robot is not at hand")
def test_the_real_robot_passes(tmp_path, merge):
    asset = convert_urdf(
        REAL / "turtlebot4" / "turtlebot4.urdf",
        tmp_path / "turtlebot4.usda",
        options=Options(profile="diff-drive", merge_fixed=merge),
    )
    check = driven_in_physx(asset)
    assert [finding.rule for finding in check.findings] == ["stands", "drives", "turns"]
    assert check.result == "passed", check.findings


def wheel(name, parent, x, y, *, steered=False):
    """A wheel of 0.11 m and 45 mm width, on a hinge if it is steered."""
    inertia = '<inertial><mass value="{}"/><inertia ixx="2e-4" iyy="2e-4" izz="2e-4"/></inertial>'
    shape = '<origin rpy="1.5707963 0 0"/><geometry><cylinder radius=".055" length=".045"/></geometry>'
    text, at = "", f"{x} {y} .055"
    if steered:
        hinge = f'<joint name="{name}_steer" type="revolute"><parent link="{parent}"/>'
        text += f"""<link name="{name}_hinge">{inertia.format(0.1)}</link>{hinge}
        <child link="{name}_hinge"/><origin xyz="{at}"/><axis xyz="0 0 1"/>
        <limit lower="-.6" upper=".6" effort="6" velocity="5"/></joint>"""
        parent, at = f"{name}_hinge", "0 0 0"
    return f"""{text}<link name="{name}_wheel">{inertia.format(0.2)}<collision>{shape}</collision></link>
    <joint name="{name}_wheel_joint" type="continuous"><parent link="{parent}"/><child link="{name}_wheel"/>
    <origin xyz="{at}"/><axis xyz="0 1 0"/></joint>"""


@physx
@pytest.mark.parametrize("steered", [False, True])
def test_wide_wheels_go_and_turn_as_far_as_they_are_told_and_a_car_by_its_steering(tmp_path, steered):
    rear = wheel("left", "base_link", 0, 0.12) + wheel("right", "base_link", 0, -0.12)
    front = "".join(wheel(f"front{y}", "base_link", 0.32, 0.12 * y, steered=True) for y in (1, -1))
    caster = """<collision><origin xyz=".2 0 .02"/><geometry><sphere radius=".02"/></geometry></collision>"""
    path = tmp_path / "car.urdf"
    path.write_text(f"""<robot name="car"><link name="base_link">
    <inertial><origin xyz="{0.15 * steered + 0.03} 0 .08"/><mass value="3"/>
    <inertia ixx=".02" iyy=".03" izz=".04"/></inertial>
    {"" if steered else caster}</link>{rear}{front if steered else ""}</robot>""")
    asset = convert_urdf(path, tmp_path / "car.usda", options=Options(profile="diff-drive", single_file=True))
    check = driven_in_physx(asset)
    assert check.result == "passed", check.findings
    described = Usd.Stage.Open(str(asset))
    described.GetDefaultPrim().GetVariantSet("wheelContact").SetVariantSelection("described")
    described.Export(str(tmp_path / "described.usda"))
    turns = driven_in_physx(tmp_path / "described.usda").findings[2]
    assert turns.severity == ("note" if steered else "error")  # it turns at the edges of its wheels


@physx
def test_a_robot_with_hindered_wheels_fails(exports, tmp_path):
    stage = Usd.Stage.Open(str(exports["viewer.usdc"]))
    stage.GetRootLayer().Export(str(tmp_path / "stuck.usda"))
    stage = Usd.Stage.Open(str(tmp_path / "stuck.usda"))
    drive = UsdPhysics.DriveAPI(stage.GetPrimAtPath("/World/turtlebot4/joints/left_wheel_joint"), "angular")
    drive.GetMaxForceAttr().Set(1e-6)
    stage.Save()
    check = driven_in_physx(tmp_path / "stuck.usda")
    found = {finding.rule: finding.severity for finding in check.findings}
    assert found == {"stands": "note", "drives": "error", "turns": "error"}


@physx
def test_a_robot_above_a_hole_falls_and_fails(exports, tmp_path):
    stage = Usd.Stage.Open(str(exports["viewer.usdc"]))
    stage.GetRootLayer().Export(str(tmp_path / "hole.usda"))
    stage = Usd.Stage.Open(str(tmp_path / "hole.usda"))
    stage.RemovePrim("/World/Lab/Ground")  # walls and furniture still collide
    stage.Save()
    check = driven_in_physx(tmp_path / "hole.usda")
    assert check.findings[0].rule in ("stands", "unfinished")
    assert check.result == "failed"


@dataclass(frozen=True)
class Physx(Newton):
    """A robot in PhysX, behind the engine's interface."""

    step_s: float = 0.01
    name = "physx"

    def world(self, closed_loop, step_s):
        root, drive = f"/World/{self.robot.name}", closed_loop.drive
        wheels = (drive.left_wheel_joint, drive.right_wheel_joint)
        return open_world(
            PYTHON,
            Path(self.stage),
            {
                "base": f"{root}/base_link",
                "joints": [f"{root}/joints/{wheel}" for wheel in wheels],
                "start": list(closed_loop.pose0),
                "step_s": step_s,
            },
        )


@physx
def test_kinematic_newton_and_physx_follow_the_figure_of_eight_alike(lab_scene, monkeypatch):
    monkeypatch.setattr("magtwin.sim.engines.newton.check_installed", lambda: None)
    twin = open_twin(lab_scene, network="none")
    engines = {"kinematic": None, "physx": Physx(twin.scene_file, twin.scene.robot)}
    if find_spec("newton") is not None:
        engines["newton"] = Newton(twin.scene_file, twin.scene.robot)
    drive = twin.scene.robot.drive
    motions = {
        name: follow(figure8(), drive, speed=0.2, **({} if engine is None else {"engine": engine}))
        for name, engine in engines.items()
    }
    t = np.arange(0, min(motion.duration_s for motion in motions.values()), 0.05)
    assert t[-1] > 70
    seen = {name: motion.at(t).pose[:, :2] for name, motion in motions.items()}
    for first in seen:
        for second in seen:
            assert np.sqrt(np.mean(np.sum((seen[first] - seen[second]) ** 2, axis=1))) < 0.05, (first, second)


@physx
def test_a_stage_that_has_no_articulation_is_refused_in_a_line(tmp_path, lab_scene):
    stage = Usd.Stage.CreateNew(str(tmp_path / "empty.usda"))
    UsdGeom.Xform.Define(stage, "/World")
    stage.Save()
    with (
        pytest.raises(InputError, match=r"PhysX cannot run it: .*no articulation with /World/base"),
        open_world(
            PYTHON, tmp_path / "empty.usda", {"base": "/World/base", "joints": ["/a", "/b"], "start": None}
        ) as world,
    ):
        world.seen()


@physx
def test_every_attribute_of_physx_is_in_its_schemas(exports):
    """Those of `physx-usd-schemas`; PhysxJointAPI was in them until 2025 and Isaac Sim 6 reads it."""
    path = "physx_usd_schemas/PhysxSchema/resources/generatedSchema.usda"
    found = f"distribution('physx-usd-schemas').locate_file('{path}')"
    code = f"from importlib.metadata import distribution; print({found})"
    file = subprocess.check_output([PYTHON, "-c", code], text=True).strip()
    layer = Sdf.Layer.FindOrOpen(file)  # held in a name: a spec does not keep its layer alive
    known = {
        name.replace("__INSTANCE_NAME__:", ""): spec.typeName
        for schema in layer.rootPrims
        for name, spec in schema.attributes.items()
    }
    stage = Usd.Stage.Open(str(exports["isaac"]))
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        for attribute in prim.GetAuthoredAttributes():
            name = attribute.GetName()
            if name.startswith("physx") and not name.startswith("physxJoint:"):
                assert known.get(name) == attribute.GetTypeName(), name
