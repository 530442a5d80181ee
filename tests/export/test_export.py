"""Exports: what is handed on holds all it needs, is the same stage, and is the same bytes each time."""

import hashlib
import json
import os
import re
import shutil
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from looking import assert_lit, assert_looks_alike, assert_within_room
from numpy.testing import assert_allclose
from pxr import Sdf, Usd, UsdGeom, UsdPhysics, UsdUtils
from validators import assert_valid

from magtwin.author.scene import author_scene
from magtwin.author.scene_file import scene_from_toml
from magtwin.export.package import PLUGIN, README, export_scene
from magtwin.export.validation.validate import validate
from magtwin.field.survey.nodes import read_survey
from magtwin.files.file import sha256, shipped
from magtwin.run.run import Run
from magtwin.usd.animation import read_animation
from magtwin.usd.geometry import read_shapes
from magtwin.usd.lab.room import LAB as LAB_PRIM
from magtwin.usd.lab.room import read_lab
from magtwin.usd.maps.layer import load_map, save_map
from magtwin.usd.scene import read_scene

LAB = shipped("scenes", "lab", "lab.usda")
ROBOT, HEAT_MAP = "/World/turtlebot4", "/World/AnomalyMap/HeatMap"
MAGNETOMETER = f"{ROBOT}/magnetometer_link/magnetometer"

WEIGHTS = read_scene(LAB).robot.magnetometer.network
"""The default lab's network, whatever it is called."""

BARE = (
    """
import json, sys
from pxr import Plug, Usd, UsdGeom
stage = Usd.Stage.Open(sys.argv[1])
cache = UsdGeom.XformCache()
def place(path):
    return list(cache.GetLocalToWorldTransform(stage.GetPrimAtPath(path)).ExtractTranslation())
meshes = [p for p in stage.Traverse(Usd.TraverseInstanceProxies()) if p.IsA(UsdGeom.Mesh)]
def points(mesh):
    return len(UsdGeom.Mesh(mesh).GetPointsAttr().Get())
print(json.dumps({
    "magtwin": "magtwin" in sys.modules or any("magtwin" in p.name for p in Plug.Registry().GetAllPlugins()),
    "wheel": place("ROBOT/left_wheel"), "magnetometer": place("MAGNETOMETER"),
    "heat_map": points(stage.GetPrimAtPath("HEAT_MAP")),
    "robot": sum(points(m) for m in meshes if str(m.GetPath()).startswith("ROBOT/")),
    "values": len(stage.GetPrimAtPath("/World/AnomalyMap").GetAttribute("magtwin:anomalyMap:valuesNt").Get()),
    "layers": [l.realPath for l in stage.GetUsedLayers() if not l.anonymous],
}))
""".replace("ROBOT", ROBOT)
    .replace("MAGNETOMETER", MAGNETOMETER)
    .replace("HEAT_MAP", HEAT_MAP)
)
"""What a program with usd-core alone sees of a stage."""


@pytest.fixture(scope="module")
def played() -> Run:
    """Two seconds of a robot that drives an arc and turns its wheels."""
    t = np.linspace(0.0, 2.0, 21)
    yaw = 0.5 * t
    return Run(
        {
            "t": t,
            "p_world_base": np.column_stack([np.sin(yaw), 1 - np.cos(yaw), 0 * t]),
            "q_world_base_xyzw": np.column_stack([0 * t, 0 * t, np.sin(yaw / 2), np.cos(yaw / 2)]),
            "wheel_angle": np.column_stack([12.0 * t, 16.0 * t]),
            "b_total_nt": 42000.0 + 100 * t,
        }
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, played: Run) -> Path:
    """The default lab as a folder for Omniverse, with a run."""
    out = tmp_path_factory.mktemp("omniverse") / "lab"
    export_scene(LAB, out, animation=played, trusted=True, to_onnx=write_words)
    return out


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory, played: Run) -> Path:
    """The same as a package."""
    out = tmp_path_factory.mktemp("package") / "lab.usdz"
    export_scene(LAB, out, animation=played, trusted=True, to_onnx=write_words)
    return out


@pytest.fixture(scope="module")
def isaac(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("isaac") / "lab"
    export_scene(LAB, out, profile="isaac", trusted=True)
    return out


@pytest.fixture(scope="module")
def web(tmp_path_factory: pytest.TempPathFactory, played: Run) -> Path:
    out = tmp_path_factory.mktemp("web") / "lab.glb"
    export_scene(LAB, out, animation=played, trusted=True)
    return out


def write_words(weights: Path, out: Path) -> None:
    """Stands for a writer of ONNX."""
    out.write_bytes(b"ONNX of " + sha256(weights).encode())


def seen_by_usd_core(stage: Path) -> dict:
    """What a process sees that has no plugin path and imports nothing of magtwin."""
    plain = {k: v for k, v in os.environ.items() if k not in ("PXR_PLUGINPATH_NAME", "PYTHONPATH")}
    done = subprocess.run(
        [sys.executable, "-I", "-c", BARE, stage.name],
        capture_output=True,
        check=True,
        text=True,
        cwd=stage.parent,
        env=plain,
    )
    assert not done.stderr, done.stderr
    return json.loads(done.stdout)


def named_in(root: Path) -> list[str]:
    """Every asset path in the layers of a stage, as it is written."""
    stage = Usd.Stage.Open(str(root))
    names: list[str] = []
    for layer in stage.GetUsedLayers():
        copy = Sdf.Layer.CreateAnonymous(".usda")
        copy.TransferContent(layer)
        UsdUtils.ModifyAssetPaths(copy, lambda name: names.append(name) or name)
    return names


@pytest.mark.parametrize("suffix", ["", ".usdz"])
def test_an_export_that_was_moved_shows_robot_map_and_sensors_to_a_program_with_usd_core_alone(
    suffix, folder, package, tmp_path
):
    if suffix:
        moved = Path(shutil.copy(package, tmp_path / "elsewhere.usdz"))
    else:
        moved = shutil.copytree(folder, tmp_path / "elsewhere") / "lab.usda"
    seen = seen_by_usd_core(moved)
    assert not seen["magtwin"]
    stage = Usd.Stage.Open(str(LAB))
    cache = UsdGeom.XformCache()
    for name, path in (("wheel", f"{ROBOT}/left_wheel"), ("magnetometer", MAGNETOMETER)):
        there = cache.GetLocalToWorldTransform(stage.GetPrimAtPath(path)).ExtractTranslation()
        assert_allclose(seen[name], there, atol=1e-12)
    assert seen["heat_map"] == len(UsdGeom.Mesh(stage.GetPrimAtPath(HEAT_MAP)).GetPointsAttr().Get())
    assert seen["values"] == load_map(LAB).values_nt.size
    assert seen["robot"] > 5_000
    assert all(Path(layer).is_relative_to(tmp_path) for layer in seen["layers"])


def test_an_export_names_nothing_by_an_absolute_path_and_nothing_outside(folder, package, isaac):
    for root in (folder / "lab_run.usdc", package, isaac / "lab.usda"):
        names = named_in(root)
        assert len(names) >= 5
        assert all(name.startswith(("./", "../")) for name in names if name)
    for root in (folder / "lab.usda", isaac / "lab.usda"):
        layers, assets, lost = UsdUtils.ComputeAllDependencies(str(root))
        files = [Path(layer.realPath) for layer in layers] + [Path(asset) for asset in assets]
        assert not lost
        assert all(file.is_relative_to(root.parent) for file in files)


def test_a_package_names_no_network_which_lies_beside_it_with_its_onnx(package, played, tmp_path):
    beside = package.with_name("lab_magtwin")
    assert (beside / "weights" / WEIGHTS.name).read_bytes() == WEIGHTS.read_bytes()
    onnx = (beside / "weights" / f"{WEIGHTS.stem}.onnx").read_bytes()
    assert onnx == b"ONNX of " + sha256(WEIGHTS).encode()
    assert (beside / PLUGIN / "plugInfo.json").is_file()
    export_scene(package, tmp_path / "lab", trusted=True)
    magnetometer = read_scene(tmp_path / "lab" / "lab.usda").robot.magnetometer
    assert (magnetometer.network, magnetometer.network_sha256) == (None, sha256(WEIGHTS))
    again = read_animation(tmp_path / "lab" / "lab_run.usdc")
    assert_allclose(again["p_world_base"], played["p_world_base"], atol=0)


def test_a_run_plays_in_a_folder_and_in_a_package(folder, package, played):
    for root in (folder / "lab_run.usdc", package):
        stage = Usd.Stage.Open(str(root))
        assert stage.GetEndTimeCode() / stage.GetTimeCodesPerSecond() == pytest.approx(2.0)
        base = UsdGeom.Xformable(stage.GetPrimAtPath(f"{ROBOT}/base_link"))
        end = base.ComputeLocalToWorldTransform(stage.GetEndTimeCode()).ExtractTranslation()
        assert_allclose(end, played["p_world_base"][-1], atol=1e-9)
        reading = stage.GetAttributeAtPath(f"{MAGNETOMETER}.magtwin:magnetometer:bTotalNt")
        assert reading.Get(stage.GetEndTimeCode()) == pytest.approx(42200.0)


@pytest.mark.parametrize(("what", "rules"), [("folder", 20), ("package", 17), ("isaac", 23)])
def test_exports_pass_the_validators_and_show_meshes_with_materials_lit(what, rules, request, isaac_rules):
    out = request.getfixturevalue(what)
    file = out if out.is_file() else out / "lab.usda"
    core, isaac = validate(file, ["core", "isaac"]).checks
    assert not core.findings
    assert [f for f in isaac.findings if f.severity == "error"] == []
    assert isaac.scope.startswith(f"{rules} of 24 rules of isaacsim.asset.validation 1.3.6")
    stage = assert_looks_alike(file)
    assert_lit(stage)
    if what != "package":  # its run has other times than the default one, at which boxes are taken
        assert_within_room(stage, read_lab(stage.GetPrimAtPath(LAB_PRIM)), top_m=3.0)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["folder", "package", "isaac"])
def test_exports_pass_the_validators_of_openusd_and_nvidia(what, request, tmp_path):
    out = request.getfixturevalue(what)
    assert_valid(out if out.is_file() else out / "lab.usda", tmp_path)


def test_what_was_exported_exports_again_with_the_same_graphs_its_thumbnail_drawn_anew(isaac, tmp_path):
    def draw(root, picture):
        with open(picture, "xb") as file:
            file.write(root.name.encode())

    first = shutil.copytree(isaac, tmp_path / "first")
    (first / ".thumbs" / "256x256").mkdir(parents=True)
    (first / ".thumbs" / "256x256" / "lab.usda.png").write_bytes(b"old")
    export_scene(first / "lab.usda", tmp_path / "lab", profile="isaac", trusted=True, thumbnail=draw)
    assert (tmp_path / "lab" / ".thumbs" / "256x256" / "lab.usda.png").read_bytes() == b"lab.usda"
    stages = [Usd.Stage.Open(str(file / "lab.usda")) for file in (isaac, tmp_path / "lab")]
    graphs = [
        {str(prop.GetPath()): str(prop.Get()) for node in Usd.PrimRange(stage.GetPrimAtPath("/World/Graphs"))
         for prop in node.GetAuthoredAttributes()}
        for stage in stages
    ]  # fmt: skip
    assert graphs[0] == graphs[1]


def test_for_isaac_the_robot_has_isaac_sims_layers_and_composes_to_the_same_stage(isaac):
    asset = isaac / "turtlebot4" / "turtlebot4.usda"
    assert {f.name for f in (asset.parent / "payloads").iterdir()} >= {
        "base.usda",
        "geometries.usdc",
        "Physics",
    }
    there, here = Usd.Stage.Open(str(LAB)), Usd.Stage.Open(str(isaac / "lab.usda"))
    assert here.GetPrimAtPath(ROBOT).GetVariantSet("Physics").GetVariantSelection() == "physx"
    seen = 0
    for prim in there.Traverse(Usd.TraverseInstanceProxies()):
        other = here.GetPrimAtPath(prim.GetPath())
        assert set(prim.GetAppliedSchemas()) <= set(other.GetAppliedSchemas())
        for attribute in prim.GetAuthoredAttributes():
            if attribute.GetTypeName() not in (Sdf.ValueTypeNames.Asset,):
                assert attribute.Get() == other.GetAttribute(attribute.GetName()).Get(), attribute.GetPath()
                seen += 1
        for relationship in prim.GetAuthoredRelationships():
            assert relationship.GetTargets() == other.GetRelationship(relationship.GetName()).GetTargets()
    assert seen > 2_000
    assert here.GetPrimAtPath("/World/Graphs/turtlebot4").GetTypeName() == "OmniGraph"


def test_a_stage_for_viewers_is_one_layer_without_instances_or_variants_that_shows_the_same(played, tmp_path):
    out = tmp_path / "lab.usdz"
    export_scene(LAB, out, profile="viewer", animation=played, trusted=True)
    assert Sdf.ZipFile.Open(str(out)).GetFileNames() == ["lab.usdc"]
    assert list(tmp_path.iterdir()) == [out]
    there, here = Usd.Stage.Open(str(LAB)), Usd.Stage.Open(str(out))
    assert not any(prim.IsInstance() or prim.HasVariantSets() for prim in here.TraverseAll())
    before, after = read_shapes(there), read_shapes(here)
    assert [s.prim for s in after] == [s.prim for s in before]
    for a, b in zip(before, after, strict=True):
        assert_allclose(b.vertices, a.vertices, atol=1e-6)
        assert_allclose(b.colour, a.colour, atol=1e-6)
    assert here.GetPrimAtPath("/World/AnomalyMap").GetAttribute("magtwin:anomalyMap:valuesNt").Get()
    base = UsdGeom.Xformable(here.GetPrimAtPath(f"{ROBOT}/base_link"))
    end = base.ComputeLocalToWorldTransform(here.GetEndTimeCode()).ExtractTranslation()
    assert_allclose(end, played["p_world_base"][-1], atol=1e-9)


def test_the_same_inputs_make_the_same_bytes(folder, package, web, played, tmp_path):
    def digest(place: Path) -> dict[str, str]:
        files = [place] if place.is_file() else sorted(f for f in place.rglob("*") if f.is_file())
        return {f.name: hashlib.sha256(f.read_bytes()).hexdigest() for f in files}

    for first in (folder, package, web):
        again = tmp_path / first.name
        export_scene(LAB, again, animation=played, trusted=True, to_onnx=write_words)
        assert digest(again) == digest(first)
        shutil.rmtree(again) if again.is_dir() else again.unlink()


def test_metadata_and_page_say_what_an_export_was_made_from_and_under_which_licences(folder):
    said = Sdf.Layer.FindOrOpen(str(folder / "lab.usda")).customLayerData["magtwin"]["export"]
    assert said["source"] == "lab.usda"
    assert re.fullmatch("[0-9a-f]{64}", said["sourceSha256"])
    parts = ("lab/lab.usdc", "turtlebot4/turtlebot4.usda", f"weights/{WEIGHTS.name}")
    assert said["licences"] == dict.fromkeys(parts, "Apache-2.0")
    page = (folder / README).read_text()
    for word in ("`lab_run.usdc` plays a run", "PXR_PLUGINPATH_NAME", said["sourceSha256"], WEIGHTS.name):
        assert word in page


# glTF


def contents(glb: Path) -> tuple[dict, bytes]:
    """JSON and buffer of a GLB."""
    data = glb.read_bytes()
    magic, version, size = struct.unpack_from("<4sII", data)
    assert (magic, version, size) == (b"glTF", 2, len(data))
    length, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    begin = 20 + length
    buffer, kind = struct.unpack_from("<I4s", data, begin)
    assert (kind, begin + 8 + buffer) == (b"BIN\0", size)
    return json.loads(data[20:begin]), data[begin + 8 :]


def test_trimesh_reads_a_glb_as_what_the_stage_shows_in_metres_with_y_up(web):
    scene = trimesh.load(web)
    points = np.vstack([shape.vertices for shape in world_shapes()])
    low, high = points.min(axis=0), points.max(axis=0)
    turned = np.array([[low[0], low[2], -high[1]], [high[0], high[2], -low[1]]])
    assert_allclose(scene.bounds, turned, atol=1e-5)
    place, _ = scene.graph.get("magnetometer")
    stage = Usd.Stage.Open(str(LAB))
    x, y, z = (
        UsdGeom.XformCache().GetLocalToWorldTransform(stage.GetPrimAtPath(MAGNETOMETER)).ExtractTranslation()
    )
    assert_allclose(place[:3, 3], [x, z, -y], atol=1e-6)
    area = sum(shape_area(shape) for shape in world_shapes())
    assert sum(mesh.area for mesh in scene.geometry.values()) == pytest.approx(area, rel=1e-4)


def world_shapes() -> list:
    """Shapes of the lab whose robot stands at the world's origin, each where it is."""
    stage = Usd.Stage.Open(str(LAB))
    cache, placed = UsdGeom.XformCache(), []
    for shape in read_shapes(stage):
        prim = stage.GetPrimAtPath(shape.prim)
        while prim and not prim.HasAPI(UsdPhysics.RigidBodyAPI):
            prim = prim.GetParent()
        to_world = np.array(cache.GetLocalToWorldTransform(prim)) if prim else np.eye(4)
        vertices = np.column_stack([shape.vertices, np.ones(len(shape.vertices))]) @ to_world[:, :3]
        placed.append(replace(shape, vertices=vertices))
    return placed


def shape_area(shape) -> float:
    a, b, c = (shape.vertices[shape.faces[:, k]] for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def array_of(said: dict, data: bytes, index: int) -> np.ndarray:
    accessor = said["accessors"][index]
    view = said["bufferViews"][accessor["bufferView"]]
    kind = {5126: "<f4", 5125: "<u4", 5121: "u1"}[accessor["componentType"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    values = np.frombuffer(data, kind, accessor["count"] * width, view["byteOffset"])
    return values.reshape(-1, width) if width > 1 else values


def test_a_run_moves_the_nodes_of_a_glb(web, played):
    said, data = contents(web)
    (animation,) = said["animations"]
    moved = {}
    for channel in animation["channels"]:
        sampler = animation["samplers"][channel["sampler"]]
        name = said["nodes"][channel["target"]["node"]]["name"]
        times, values = (array_of(said, data, sampler[end]) for end in ("input", "output"))
        moved[name, channel["target"]["path"]] = times, values
    assert set(moved) == {
        ("turtlebot4", "translation"),
        ("turtlebot4", "rotation"),
        ("left_wheel", "rotation"),
        ("right_wheel", "rotation"),
    }
    times, values = moved["turtlebot4", "rotation"]
    assert times[-1] == pytest.approx(2.0)
    assert_allclose(np.abs(values[-1] @ played["q_world_base_xyzw"][-1]), 1, atol=1e-6)
    for _, values in moved.values():
        if values.shape[1] == 4:
            assert (np.sum(values[1:] * values[:-1], axis=1) > 0).all()


# The real lab


@pytest.fixture(scope="module")
def aprilab(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The APRILab lab with its own map and network."""
    home = tmp_path_factory.mktemp("aprilab")
    save_map(read_survey(real_data / "aprilab" / "maps", name="aprilab", licence="MIT")[0], home / "map.usdc")
    scene = scene_from_toml(
        shipped("scenes", "aprilab.toml"),
        map_layer=home / "map.usdc",
        network=real_data / "aprilab" / "models" / "nn_magnetometer_model_v0.0.1.pth",
    )
    return author_scene(scene, home / "aprilab")


@pytest.mark.parametrize(("out", "profile"), [("a.usdz", "isaac"), ("a", "viewer"), ("a.glb", "viewer")])
def test_the_aprilab_lab_exports_for_every_profile_with_the_licence_of_its_map(
    aprilab, out, profile, tmp_path
):
    made = export_scene(aprilab, tmp_path / out, profile=profile, trusted=True)
    assert "MIT" in made.licences.values()
    if made.root.suffix == ".glb":
        assert "AnomalyMap" in trimesh.load(made.root).graph.nodes
    else:
        stage = Usd.Stage.Open(str(made.root))
        prim = stage.GetPrimAtPath("/World/AnomalyMap")
        assert prim.GetAttribute("magtwin:anomalyMap:licence").Get() == "MIT"
        assert stage.GetPrimAtPath(MAGNETOMETER)
        assert_lit(assert_looks_alike(made.root))
