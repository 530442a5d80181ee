"""The layered form of an asset: Isaac Sim's structure, equal to the single file, movable, past the gates."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import trimesh
from made import BALL, BODY, INERTIAL
from numpy.testing import assert_allclose
from pxr import Sdf, Usd, UsdGeom, UsdPhysics, UsdUtils
from validators import assert_valid

from magtwin.errors import InputError
from magtwin.urdf.convert import convert_urdf
from magtwin.urdf.layout import VARIANTS
from magtwin.urdf.options import Options

SIMREADY = "MAGTWIN_SIMREADY"
"""Variable that names the `simready-validate` of an environment of its own, as `make simready` makes it: its
rules would join those of `nvidia_usd_validate` in ours."""

TAGS = """<gazebo reference="hand"><mu1>0.3</mu1><kp>1e6</kp><sensor name="imu" type="imu"><imu/></sensor>
<maxVel>1</maxVel></gazebo>"""


def arm(tmp_path, name="arm", extra=TAGS):
    """A URDF with every kind of thing: meshes, primitives, a moving joint, a site, looks, grips, a sensor."""
    tmp_path.mkdir(exist_ok=True)
    ball = trimesh.creation.icosphere(radius=0.1)
    ball.visual.vertex_colors = np.tile([200, 30, 30, 255], (len(ball.vertices), 1))
    ball.export(tmp_path / "ball.obj")
    mesh = '<geometry><mesh filename="ball.obj"/></geometry>'
    path = tmp_path / f"{name}.urdf"
    path.write_text(
        f"""<robot name="{name}"><link name="base_link">{BODY}<visual>{mesh}</visual></link>
        <link name="hand">{INERTIAL}<visual><origin xyz="0 0 1"/>{mesh}</visual><collision>{mesh}</collision>
        <visual>{BALL}<material name="red"><color rgba="1 0 0 1"/></material></visual></link>
        <link name="tip"/>
        <joint name="j" type="revolute"><parent link="base_link"/><child link="hand"/>
          <origin xyz="0.3 0 0" rpy="0 0.5 0"/><axis xyz="0 1 0"/>
          <limit lower="-1" upper="1" effort="3" velocity="2"/></joint>
        <joint name="t" type="fixed"><parent link="hand"/><child link="tip"/><origin xyz="0 0 0.2"/></joint>
        {extra}</robot>"""
    )
    return path


def composed(path):
    """All that a stage composes to, by prim: type, schemas, values, targets and place in world."""
    stage = Usd.Stage.Open(str(path))
    assert not stage.GetCompositionErrors()
    cache, prims = UsdGeom.XformCache(), {}
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        metadata = {
            "type": prim.GetTypeName(),
            "schemas": sorted(prim.GetPrimTypeInfo().GetAppliedAPISchemas()),
            "kind": Usd.ModelAPI(prim).GetKind(),
            "instance": prim.IsInstance(),
            "custom": prim.GetCustomData(),
            "world": cache.GetLocalToWorldTransform(prim),
        }
        for prop in prim.GetAuthoredProperties():
            if isinstance(prop, Usd.Relationship):
                metadata[prop.GetName()] = tuple(map(str, prop.GetTargets()))
                continue
            value = prop.Get()
            if isinstance(value, Sdf.AssetPath):
                assert value.resolvedPath
                value = Path(value.resolvedPath).read_bytes()
            metadata[prop.GetName()] = (
                str(prop.GetTypeName()),
                value,
                tuple(map(str, prop.GetConnections())),
            )
        prims[str(prim.GetPath())] = metadata
    return prims


def both(urdf, folder, **choices):
    """What the single file and the layered form of a URDF compose to."""
    one = convert_urdf(urdf, folder / "one" / "a.usda", options=Options(single_file=True, **choices))
    two = convert_urdf(urdf, folder / "two" / "a.usda", options=Options(**choices))
    return composed(one), composed(two)


def assert_equal(one, two):
    assert one.keys() == two.keys()
    for path, metadata in one.items():
        assert metadata == two[path], path


def test_the_layers_compose_to_the_single_file_prim_by_prim(tmp_path):
    one, two = both(arm(tmp_path), tmp_path)
    assert len(one) >= 30
    assert_equal(one, two)


@pytest.mark.parametrize("name", ["real_robot", "tagged_robot"])
def test_the_real_robots_layers_compose_to_its_single_file(name, request, tmp_path):
    urdf, out, _ = request.getfixturevalue(name)
    options = Options(single_file=True)
    assert_equal(composed(convert_urdf(urdf, tmp_path / "a.usda", options=options)), composed(out))


def test_the_files_are_those_of_isaac_sims_structure(tmp_path):
    out = convert_urdf(arm(tmp_path), tmp_path / "made" / "arm.usda")
    files = sorted(p.relative_to(out.parent).as_posix() for p in out.parent.rglob("*") if p.is_file())
    names = ("base.usda", "geometries.usdc", "instances.usda", "materials.usda", "robot.usda")
    physics = ("mujoco.usda", "physics.usda", "physx.usda")
    wanted = [f"payloads/{n}" for n in names] + [f"payloads/Physics/{n}" for n in physics]
    assert files == sorted(["arm.usda", "edits.usda", *wanted])
    layer = Sdf.Layer.FindOrOpen(str(out))  # held in a name: a spec does not keep its layer alive
    interface = layer.GetPrimAtPath("/arm")
    assert [r.assetPath for r in interface.referenceList.prependedItems] == ["./payloads/base.usda"]
    assert set(interface.variantSets["Physics"].variants.keys()) == {"none", "physics", "physx", "mujoco"}
    assert not interface.nameChildren  # the interface holds arcs, no opinions


def test_long_arrays_of_a_sensor_are_in_a_binary_layer(tmp_path):
    """usd-validation-nvidia refuses them in text, as of the LiDARs of Neobotix' robots."""
    fan = """<gazebo reference="hand"><sensor name="fan" type="ray"><ray><scan><horizontal>
    <samples>90</samples><min_angle>-1</min_angle><max_angle>1</max_angle></horizontal></scan>
    <range><min>0.1</min><max>9</max></range></ray></sensor></gazebo>"""
    one, two = both(arm(tmp_path, extra=fan), tmp_path)
    assert_equal(one, two)
    out = tmp_path / "two" / "a.usda"
    layer = Sdf.Layer.FindOrOpen(str(out.parent / "payloads" / "arrays.usdc"))
    sensor = next(path for path, metadata in two.items() if metadata["type"] == "OmniLidar")
    kept = set(layer.GetPrimAtPath(sensor).attributes.keys())
    azimuth = "omni:sensor:Core:emitterState:s001:azimuthDeg"
    assert azimuth in kept
    assert_allclose(np.degrees([-1, 1]), np.array(two[sensor][azimuth][1])[[0, -1]], rtol=1e-6)
    assert_valid(out, tmp_path)


def test_variants_switch_the_physics_and_leave_the_looks(tmp_path):
    stage = Usd.Stage.Open(str(convert_urdf(arm(tmp_path), tmp_path / "made" / "arm.usda")))
    variants = stage.GetDefaultPrim().GetVariantSets().GetVariantSet("Physics")
    assert variants.GetVariantSelection() == "physx"
    found, shown = {}, set()
    for variant in VARIANTS:
        variants.SetVariantSelection(variant)
        prims = list(stage.Traverse(Usd.TraverseInstanceProxies()))
        bodies = sum(p.HasAPI(UsdPhysics.RigidBodyAPI) for p in prims)
        physx = any(p.GetAttribute("physxArticulation:enabledSelfCollisions") for p in prims)
        found[variant] = bodies, sum(p.IsA(UsdPhysics.Joint) for p in prims), physx
        shown.add(sum(p.IsA(UsdGeom.Gprim) for p in prims))
    plain = (2, 1, False)
    assert found == {"none": (0, 0, False), "physics": plain, "mujoco": plain, "physx": (2, 1, True)}
    assert len(shown) == 1


@pytest.mark.parametrize("single", [True, False])
def test_the_folder_of_an_asset_can_be_moved(tmp_path, single):
    urdf = arm(tmp_path / "source")
    out = convert_urdf(urdf, tmp_path / "made" / "arm.usda", options=Options(single_file=single))
    before = composed(out)
    shutil.rmtree(tmp_path / "source")
    (tmp_path / "made").rename(tmp_path / "elsewhere")
    layers, _, unresolved = UsdUtils.ComputeAllDependencies(str(tmp_path / "elsewhere" / "arm.usda"))
    assert not unresolved
    for layer in layers:
        assert all(not os.path.isabs(path) for path in layer.GetCompositionAssetDependencies())  # noqa: PTH117
    assert_equal(before, composed(tmp_path / "elsewhere" / "arm.usda"))


def test_the_layers_of_another_robot_are_never_overwritten(tmp_path):
    out = tmp_path / "made"
    convert_urdf(arm(tmp_path), out / "arm.usda")
    before = {p: p.read_bytes() for p in out.rglob("*") if p.is_file()}
    other = arm(tmp_path, name="leg")
    with pytest.raises(InputError, match="exists already"):
        convert_urdf(other, out / "leg.usda")
    with pytest.raises(InputError, match=r"is of arm\.usda; give each robot its own folder"):
        convert_urdf(other, out / "leg.usda", force=True)
    (tmp_path / "own" / "payloads").mkdir(parents=True)
    with pytest.raises(InputError, match="was not made by a conversion"):
        convert_urdf(other, tmp_path / "own" / "leg.usda", force=True)
    with pytest.raises(InputError, match=r"root layer is text; .*\.usda"):
        convert_urdf(other, out / "arm.usdc", force=True)
    assert before == {p: p.read_bytes() for p in out.rglob("*") if p.is_file()}


def test_metadata_come_from_the_package_unless_they_are_given(tmp_path):
    text = "<package><name>arms</name><author>A. Maker</author><license>BSD-3-Clause</license></package>"
    (tmp_path / "package.xml").write_text(text)
    choices = Options(metadata={"category": "toy", "asset_license": "MIT"})
    out = convert_urdf(arm(tmp_path), tmp_path / "made" / "arm.usda", options=choices)
    said = Sdf.Layer.FindOrOpen(str(out)).customLayerData["SimReady_Metadata"]
    names = ("author", "asset_license", "category", "asset_name", "rigid_body_count", "mass")
    assert [said[name] for name in names] == ["A. Maker", "MIT", "toy", "arm", 2, 2]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"autor": "me"}, "metadata 'autor' is unknown; did you mean 'author'"),
        ({"author": " "}, "metadata 'author' is empty"),
        ({"qcode": "robot"}, "metadata 'qcode' must be an item of Wikidata, such as Q11012, got 'robot'"),
    ],
)
def test_invalid_metadata_is_refused(tmp_path, given, message):
    with pytest.raises(InputError, match=message):
        convert_urdf(arm(tmp_path), tmp_path / "made" / "arm.usda", options=Options(metadata=given))


# --- gates ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", sorted(set(VARIANTS) - {"physx"}))  # the default, in every other test
def test_every_variant_passes_the_validators(tmp_path, variant):
    out = convert_urdf(arm(tmp_path), tmp_path / "made" / "arm.usda")
    text = out.read_text()
    assert text.count('string Physics = "physx"') == 1
    out.write_text(text.replace('string Physics = "physx"', f'string Physics = "{variant}"'))
    assert_valid(out, tmp_path)


@pytest.fixture(scope="session")
def simready():
    """The command `simready-validate`, of the environment that MAGTWIN_SIMREADY names."""
    command = os.environ.get(SIMREADY) or shutil.which("simready-validate")
    if not command or not Path(command).is_file():
        pytest.skip(f"simready-validate is not here; {SIMREADY} names that of an environment of its own")
    return command


def failures(simready, asset, profile, version, scratch):
    """Features that a profile demands and the asset fails."""
    report = scratch / "simready.json"
    command = [simready, "--profile", profile, "--version", version, "--output", report, asset]
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    ran = subprocess.run(command, capture_output=True, check=False, text=True, env=clean)
    assert report.exists(), ran.stdout + ran.stderr
    (metadata,) = json.loads(report.read_text()).values()
    assert metadata["features_summary"], "no feature was looked at"
    return {name for name, feature in metadata["features_summary"].items() if feature["blocking_failure"]}


def thumbnail(asset, png):
    from magtwin.figures.pictures import picture_of_stage

    picture_of_stage(asset, png, size=(256, 256))


@pytest.mark.parametrize("name", ["turtlebot4", "turtlebot4_gazebo_tags"])
def test_the_real_robot_is_simready(simready, real_data, tmp_path, name):
    from magtwin.urdf.convert import convert_with_report

    out = tmp_path / "turtlebot4" / "turtlebot4" / "turtlebot4.usda"
    convert_with_report(
        real_data / "turtlebot4" / f"{name}.urdf",
        out,
        options=Options(profile="diff-drive"),
        thumbnail=thumbnail,
    )
    assert not failures(simready, out, "Robot-Body", "3.0.0", tmp_path)
    if name == "turtlebot4_gazebo_tags":
        for profile in ("Sensor-IMU", "Sensor-Camera"):
            assert not failures(simready, out, profile, "1.0.0", tmp_path)
