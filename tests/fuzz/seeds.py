"""Seeds: the smallest file of each format, written by magtwin or in its place, and how each is read.

A seed is a folder. One file of it is damaged, the others stay as they are.
"""

import contextlib
import hashlib
import importlib
import io
import json
import shutil
import sqlite3
import sys
import types
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

XACRO = """<?xml version="1.0"?>
<robot name="b" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:property name="w" value="0.3"/>
  <xacro:property name="s" value="${xacro.load_yaml('s.yaml')}"/>
  <xacro:macro name="leg" params="n x:=1"><link name="leg_${n}"><inertial><mass value="${w * x}"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link></xacro:macro>
  <xacro:if value="${w > 0}"><xacro:leg n="1"/></xacro:if>
</robot>
"""
URDF = """<?xml version="1.0"?>
<robot name="cart">
  <link name="base_link">
    <inertial><origin xyz="0 0 0.1" rpy="0 0 0"/><mass value="2"/>
      <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><box size="0.4 0.3 0.1"/></geometry>
      <material name="red"><color rgba="1 0 0 1"/></material></visual>
    <collision><geometry><mesh filename="m.stl" scale="0.1 0.1 0.1"/></geometry></collision>
  </link>
  <link name="left_wheel"><inertial><mass value="0.1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4"
    ixy="0" ixz="0" iyz="0"/></inertial><collision><geometry><cylinder radius="0.05" length="0.02"/>
    </geometry></collision></link>
  <link name="right_wheel"><inertial><mass value="0.1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4"
    ixy="0" ixz="0" iyz="0"/></inertial><collision><geometry><cylinder radius="0.05" length="0.02"/>
    </geometry></collision></link>
  <link name="mag"/>
  <joint name="left" type="continuous"><parent link="base_link"/><child link="left_wheel"/>
    <origin xyz="0 0.15 0" rpy="-1.5708 0 0"/><axis xyz="0 0 1"/><limit effort="1" velocity="10"/></joint>
  <joint name="right" type="continuous"><parent link="base_link"/><child link="right_wheel"/>
    <origin xyz="0 -0.15 0" rpy="-1.5708 0 0"/><axis xyz="0 0 1"/><dynamics damping="0.1"/></joint>
  <joint name="held" type="fixed"><parent link="base_link"/><child link="mag"/><origin xyz="0 0 0.3"/></joint>
  <transmission name="t"><type>transmission_interface/SimpleTransmission</type>
    <joint name="left"><hardwareInterface>VelocityJointInterface</hardwareInterface></joint></transmission>
  <gazebo reference="left_wheel"><mu1>1.0</mu1><material>Gazebo/Grey</material></gazebo>
</robot>
"""
CONTROLLERS = """controller_manager:
  ros__parameters: {update_rate: 50}
drive:
  ros__parameters:
    left_wheel_names: ["left"]
    right_wheel_names: ["right"]
    wheel_separation: 0.3
    wheel_radius: 0.05
    linear.x.max_velocity: 0.5
"""
ROBOT = """name = "cart"
footprint_radius_m = 0.25
[drive]
left_wheel_joint = "left"
right_wheel_joint = "right"
[platform]
hard_iron_nt = [10.0, 20.0, 30.0]
[magnetometer]
link = "mag"
rate_hz = 135.0
[imu]
link = "base_link"
rate_hz = 62.0
"""
SCENE = """name = "room"
map = "map.usdc"
[robot]
asset = "cart.usda"
[lab]
floor_m = [3.0, 2.0]
wall_height_m = 0.3
[earth]
latitude_deg = 29.65
longitude_deg = -82.35
height_m = 50.0
date = "2026-11-21"
[[furniture]]
name = "crate"
kind = "box"
material = "wood"
size_m = [0.2, 0.2, 0.2]
p_world = [1.2, 0.8, 0.0]
[[source]]
name = "anchor"
shape = "cuboid"
p_world = [0.9, -0.5, -0.4]
size_m = [0.15, 0.15, 0.15]
magnetization = [1000.0, 500.0, -4000.0]
"""
SUITE = """name = "tiny"
version = 1
seed = 3
[[scenario]]
name = "a"
runs = 2
sessions = 1
[[localizer]]
method = "odometry"
[[localizer]]
method = "ekf"
name = "own"
options = {}
"""
STAGE = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    upAxis = "Z"
    kilogramsPerUnit = 1
    timeCodesPerSecond = 24
    customLayerData = { dictionary a = { int b = 1 } }
)
def Xform "World" {
    def Cube "box" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI", "PhysicsCollisionAPI"]) {
        float physics:mass = 2
        double size = 0.5
        float3[] extent = [(-0.25, -0.25, -0.25), (0.25, 0.25, 0.25)]
        double3 xformOp:translate = (0, 1, 2)
        quatf xformOp:orient = (1, 0, 0, 0)
        float xformOp:rotateX:tilt.timeSamples = { 0: 10, 1: 20.5 }
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:orient", "xformOp:rotateX:tilt"]
    }
    def Cylinder "arm" (
        kind = "component"
        prepend apiSchemas = ["PhysicsRigidBodyAPI"]
    ) {
        uniform token axis = "Z"
        double height = 1
        double radius = 0.1
    }
    def PhysicsRevoluteJoint "joint" {
        uniform token physics:axis = "Z"
        rel physics:body0 = </World/box>
        rel physics:body1 = </World/arm>
        point3f physics:localPos0 = (0, 0, 0.25)
        quatf physics:localRot1 = (1, 0, 0, 0)
        float physics:lowerLimit = -90
    }
    def Mesh "m" (
        prepend references = </Part>
        prepend apiSchemas = ["MaterialBindingAPI"]
        variants = { string look = "red" }
        prepend variantSets = "look"
    ) {
        int[] faceVertexCounts = [3, 4]
        int[] faceVertexIndices = [0, 1, 2, 0, 1, 3, 2]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
        texCoord2f[] primvars:st = [(0, 0), (1, 0), (0, 1), (0, 0), (1, 0), (0, 1), (1, 1)] (
            interpolation = "faceVarying")
        rel material:binding = </World/red>
        uniform token subdivisionScheme = "none"
        def GeomSubset "half" (prepend apiSchemas = ["MaterialBindingAPI"]) {
            uniform token elementType = "face"
            uniform token familyName = "materialBind"
            int[] indices = [1]
            rel material:binding = </World/red>
        }
        variantSet "look" = {
            "red" {
                color3f[] primvars:displayColor = [(1, 0, 0)]
            }
            "none" {
            }
        }
    }
    def Material "red" {
        token outputs:surface.connect = </World/red/s.outputs:surface>
        def Shader "s" {
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor.connect = </World/red/t.outputs:rgb>
            float inputs:opacity = 0.5
            token outputs:surface
        }
        def Shader "t" {
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @t.png@
            float4 inputs:scale = (1, 1, 1, 1)
            float2 inputs:st.connect = </World/red/r.outputs:result>
            float3 outputs:rgb
        }
        def Shader "r" {
            uniform token info:id = "UsdPrimvarReader_float2"
            string inputs:varname = "st"
            float2 outputs:result
        }
    }
    def Xform "twice" (
        instanceable = true
        prepend references = </Part>
    ) {}
}
class "Part" {
    def Sphere "ball" {
        double radius = 0.2
        color3f[] primvars:displayColor = [(0, 1, 0)]
    }
}
"""
OBJ = """mtllib m.mtl
v 0 0 0
v 1 0 0
v 0 1 0
v 0 0 1
vt 0 0
vt 1 0
vn 0 0 1
usemtl red
f 1/1/1 2/2/1 3/1/1
f 1 -2 -1
"""
MTL = "newmtl red\nKd 1 0 0\nd 0.5\nmap_Kd t.png\n"


def call(name: str, /, *arguments: Any, **options: Any) -> Any:
    """Call "module:function" of magtwin."""
    module, _, function = name.partition(":")
    return getattr(importlib.import_module(f"magtwin.{module}"), function)(*arguments, **options)


def _run(rows: int = 8) -> Any:
    from magtwin.run.run import Column, Run

    t, level = np.arange(rows) * 0.1, np.tile([0.0, 0.0, 0.0, 1.0], (rows, 1))
    columns = {
        "t": t,
        "b_total_nt": 5e4 + t,
        "b_measured_nt": 5e4 + 10 * t,
        "p_world_base": np.column_stack([t, t / 2, 0 * t]),
        "q_world_base_xyzw": level,
        "yaw": 0 * t,
        "lidar_on": t > 0.3,
        "battery_v": 15 + t,
        "battery_a": t,
        "battery_fraction": 1 - t,
        "mocap_p": np.column_stack([t, t / 2, 0 * t]),
        "mocap_q_xyzw": level,
        "imu_q_xyzw": level,
        **{name: np.column_stack([t, t, 0 * t]) for name in ("odom_v", "odom_w", "imu_w", "imu_a")},
        "volts": t.astype(np.float32),
    }
    return Run(columns, {"scene": "lab", "seed": 1}, {"volts": Column("V", "", "a voltage")})


def _map(name: str = "hills") -> Any:
    from magtwin.field.maps.map import AnomalyMap

    values = 41e3 + 1.0 * np.arange(48).reshape(4, 3, 4) ** 2
    return AnomalyMap(
        values_nt=values,
        origin_m=(-1.5, -1.0),
        cell_m=(1.0, 1.0),
        headings_rad=np.radians([0.0, 90.0, 180.0, 270.0]),
        variance_nt2=np.full(values.shape, 4.0),
        name=name,
    )


def _saved_run(file: Path) -> None:
    _run().save(file)


def _db3(file: Path) -> None:
    sys.path.append(str(Path(__file__).resolve().parents[1]))
    from recordings import as_db3

    whole = file.with_name("whole.mcap")
    _saved_run(whole)
    as_db3(whole, file)
    whole.unlink()


def _plain_bag(file: Path) -> None:
    """A bag without compression and checksums, whose messages a change reaches."""
    from mcap.reader import make_reader
    from mcap.writer import CompressionType, Writer

    whole = file.with_name("whole.mcap")
    _saved_run(whole)
    with whole.open("rb") as source, file.open("wb") as out:
        reader = make_reader(source)
        writer = Writer(out, compression=CompressionType.NONE, enable_crcs=False, use_statistics=False)
        writer.start(reader.get_header().profile)
        summary = reader.get_summary()
        schemas = {
            number: writer.register_schema(schema.name, schema.encoding, schema.data)
            for number, schema in sorted(summary.schemas.items())
        }
        channels = {
            number: writer.register_channel(
                channel.topic, channel.message_encoding, schemas[channel.schema_id], channel.metadata
            )
            for number, channel in sorted(summary.channels.items())
        }
        for about in reader.iter_metadata():
            writer.add_metadata(about.name, about.metadata)
        for _, channel, message in reader.iter_messages():
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time, message.sequence
            )
        writer.finish()
    whole.unlink()


def _bag_folder(file: Path) -> None:
    _run().save(file.parent.parent / "bag")
    for path in (file.parent.parent / "bag").iterdir():
        shutil.move(path, file.parent / path.name)
    (file.parent.parent / "bag").rmdir()


def _stage(file: Path) -> None:
    from pxr import Sdf

    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.ImportFromString(STAGE)
    layer.Export(str(file))
    _picture(file.with_name("t.png"))


def _package(file: Path) -> None:
    _stage(file.with_name("s.usda"))
    call("export.usdz:pack", file.with_name("s.usda"), file)
    file.with_name("s.usda").unlink()


def _map_layer(file: Path) -> None:
    if file.suffix == ".usda":
        from pxr import Sdf

        call("usd.maps.layer:save_map", _map(), file.with_suffix(".usdc"))
        Sdf.Layer.FindOrOpen(str(file.with_suffix(".usdc"))).Export(str(file))
        file.with_suffix(".usdc").unlink()
    else:
        call("usd.maps.layer:save_map", _map(), file)


def _robot(file: Path) -> None:
    _urdf(file.with_name("cart.urdf"))
    file.with_name("robot.toml").write_text(ROBOT)
    options = call("urdf.options:Options", single_file=True)
    call(
        "author.robot:build_robot",
        file.with_name("cart.urdf"),
        file.with_name("robot.toml"),
        file,
        options=options,
    )
    file.with_name("robot.toml").unlink()


def _urdf(file: Path) -> None:
    file.write_text(URDF)
    _mesh(file.with_name("m.stl"))
    file.with_name("c.yaml").write_text(CONTROLLERS)


def _scene_toml(file: Path) -> None:
    _robot(file.with_name("cart.usda"))
    _map_layer(file.with_name("map.usdc"))
    file.write_text(SCENE)


def _scene(file: Path) -> None:
    """The folder of a scene; `file` is one of its layers."""
    workshop = file.parent / "workshop"
    workshop.mkdir()
    _scene_toml(workshop / "room.toml")
    made = call("author.scene_file:scene_from_toml", workshop / "room.toml", workshop=workshop)
    call("author.scene:author_scene", made, file.parent / "room")
    for path in (file.parent / "room").iterdir():
        shutil.move(path, file.parent / path.name)
    shutil.rmtree(workshop)
    (file.parent / "room").rmdir()


def _mesh(file: Path) -> None:
    import trimesh

    if file.stem == "triangle":
        shape = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False)
    else:
        shape = trimesh.creation.box()
    shape.visual.vertex_colors = [200, 10, 10, 255]
    if file.suffix == ".gltf":
        for name, data in shape.export(file_type="gltf").items():
            (file if name.endswith(".gltf") else file.with_name(name)).write_bytes(data)
    else:
        kind = {"ascii": "stl_ascii"}.get(file.stem, file.suffix[1:])
        data = shape.export(file_type=kind)
        file.write_bytes(data.encode() if isinstance(data, str) else data)


def _textured(file: Path) -> None:
    """A mesh with its material and texture; `file` is one of them."""
    (file.parent / "m.obj").write_text(OBJ)
    texture = f"t{file.suffix}" if file.stem == "t" else "t.png"
    (file.parent / "m.mtl").write_text(MTL.replace("t.png", texture))
    _picture(file.parent / texture)


def _picture(file: Path) -> None:
    from PIL import Image

    Image.new("RGB", (5, 4), (200, 10, 10)).save(file)


def _readings(file: Path) -> None:
    call(
        "field.survey.saved:save_readings",
        call("io.surveys.readings:readings_of_run", _run(), name="drive"),
        file,
    )


def _table(file: Path) -> None:
    rows = "".join(f"{x},{y},{h},{50000 + x}\n" for x in range(3) for y in range(3) for h in (0, 1.5))
    file.write_text(f"x,y,theta,b\n{rows}")


def _survey(file: Path) -> None:
    folder = file.parent / "survey"
    call("field.survey.nodes:write_survey", _map(), folder)
    for path in folder.iterdir():
        shutil.move(path, file.parent / path.name)
    folder.rmdir()


def _scans(file: Path) -> None:
    scans = call(
        "sim.sensors.lidar:Scans",
        t=np.arange(2.0),
        arrival=np.arange(2.0) + 0.1,
        p_world_lidar=np.zeros((2, 3)),
        q_world_lidar_xyzw=np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)),
        ranges_m=np.ones((2, 5), np.float32),
    )
    call("io.scans:write_scans", scans, file)


def _recording(file: Path) -> None:
    from magtwin.io.release import _SHAPES

    def value(shape: Any) -> Any:
        if shape == 1:
            return 1.0
        return [0.5] * shape if isinstance(shape, int) else [value(part) for part in shape]

    frame = {key: value(shape) for key, shape in _SHAPES.items()}
    frame |= {"nn_magnetic_magnitude": 45000.0, "timestamp": 1.5}
    file.write_text(json.dumps([frame, frame | {"timestamp": 1.6}]))


def _checkpoint(file: Path) -> None:
    import torch

    home = "sklearn.preprocessing._data"
    kind = type("StandardScaler", (), {"__module__": home})
    modules = {name: types.ModuleType(name) for name in ("sklearn", "sklearn.preprocessing", home)}
    modules[home].StandardScaler = kind

    def scaler(mean: Any, scale: Any) -> Any:
        made = kind()
        made.mean_, made.scale_, made.n_samples_seen_ = (
            np.array(mean, float),
            np.array(scale, float),
            np.int64(7),
        )
        return made

    torch.manual_seed(0)
    state = {
        "a.weight": torch.randn(4, 20),
        "a.bias": torch.randn(4),
        "b.weight": torch.randn(1, 4),
        "b.bias": torch.randn(1),
    }
    held = {
        "model_state_dict": state,
        "scaler_X": scaler(np.arange(20), np.ones(20)),
        "scaler_y": scaler([3.0], [5.0]),
    }
    with mock.patch.dict(sys.modules, modules):
        torch.save(held, file)


def _network(file: Path) -> None:
    from magtwin.files.file import shipped

    if file.stem == "net":  # a small perceptron
        _checkpoint(file.with_suffix(".pth"))
        call("learn.models.network:convert", file.with_suffix(".pth"), file)
        file.with_suffix(".pth").unlink()
    else:
        shutil.copyfile(shipped("weights", "turtlebot4_hybrid.safetensors"), file)


def _onnx(file: Path) -> None:
    _network(file.with_name("net.safetensors"))
    call("learn.inference.onnx:export_onnx", file.with_name("net.safetensors"), file)
    file.with_name("net.safetensors").unlink()


_SETTINGS = {"model": "mlp", "epochs": 3, "layers": [4]}


def _tensors() -> Any:
    import torch

    return {"module.a": torch.zeros(2, 3), "best.a": torch.ones(2, 3)}


def _state(file: Path) -> None:
    call("learn.training.state:save_state", file, _tensors(), _SETTINGS, [{"epoch": 1, "loss": 0.5}])


def _tolles_lawson(file: Path) -> None:
    from magtwin.learn.compensation.tolles_lawson import TollesLawson

    TollesLawson(("permanent",), (1.0, 2.0, 3.0), (0.1, 0.9), 0.0, 1.5).save(file)


def _dataset(file: Path) -> None:
    """A data set; `file` is its manifest, or its shard in the folder runs."""
    root = file.parent.parent if file.suffix == ".parquet" else file.parent
    file.parent.rmdir() if file.suffix == ".parquet" else None
    call("learn.data.dataset:build_dataset", {"a": _run(40)}, _map(), root / "set")
    for path in (root / "set").iterdir():
        shutil.move(path, root / path.name)
    (root / "set").rmdir()


def _results(file: Path) -> None:
    """Results of a benchmark; `file` is any file of them."""
    root = next(folder for folder in file.parents if folder.name == "results-seed")
    from magtwin.bench.results import begin_results, write_part

    about = {"name": "tiny", "version": 1, "sha256": "0", "seeds": None, "magtwin": "1", "data": {}}
    from magtwin.bench.suite import load_suite

    shutil.rmtree(root / "rows", ignore_errors=True)
    (root / "suite.toml").write_text(SUITE)
    about["seeds"] = load_suite(root / "suite.toml").seeds
    begin_results(root, SUITE.encode(), about)
    from magtwin.localization.scores import Scores

    rows, times = [], []
    for run in range(2):
        for name in ("odometry", "own"):
            key = {"scenario": "a", "localizer": name, "run": run}
            row = Scores(failed="").row()
            times.append({**key, "step_us": row.pop("step_us")})
            reason = row.pop("failed")
            more = {"seed": 3 + run, "session": 0, "status": "ok", "reason": reason, "readings": 5}
            more |= {"smoother": False, "global_start": False, "recovered_in_time": 0}
            rows.append({**key, **more, **row})
    write_part(root, "a", "part-00000.parquet", rows, times=times)


def _magnetic_data(file: Path) -> None:
    rows = range(12)
    (file.parent / "1-time.csv").write_text("".join(f"{0.1 * i}\n" for i in rows))
    (file.parent / "1-loc.csv").write_text("".join(f"{0.1 * i},0\n" for i in rows))
    (file.parent / "1-mag.csv").write_text("".join(f"20,{i},-40\n" for i in rows))


def _matlab(file: Path) -> None:
    from scipy.io import savemat

    n = 6
    q = np.tile([[1.0], [0], [0], [0]], n)
    held = {"p": np.arange(3 * n).reshape(3, n) * 0.1, "q": q, "p_0": np.zeros((3, 1)), "q_0": q[:, :1]}
    savemat(file, {**held, "T": 0.1, "y_mag": np.ones((3, n))})


def text(content: str) -> Callable[[Path], object]:
    """A writer of a text."""
    return lambda file: file.write_text(content)


# Readers: as a command reads the file.


def _read_run(file: Path) -> None:
    run = call("io.formats:read_run", file)
    json.dumps(str(run.report("x")))
    call("io.info:info_of", file)


def _read_survey_bag(file: Path) -> None:
    call("io.surveys.readings:read_readings", file, field_topic="/robot/qtfm/magnitude")


def _read_recorded(file: Path) -> None:
    """As a robot's own recording."""
    call("io.formats:read_run", file, topics={"/robot/qtfm/magnitude": "/robot/qtfm/magnitude"})


def _read_stage(file: Path) -> None:
    call("usd.info:info_of_stage", file)
    for name in ("usd.geometry:read_shapes", "usd.geometry:read_links", "usd.lab.obstacles:read_obstacles"):
        _refusable(name, file)
    _refusable("export.glb:write_glb", file, file.with_suffix(".out.glb"))


def _refusable(name: str, *arguments: Any, **options: Any) -> Any:
    """A call whose refusal does not end the reading; a refusal of several lines does."""
    from magtwin.errors import InputError

    try:
        return call(name, *arguments, **options)
    except InputError as error:
        if "\n" in str(error):
            raise


def _read_package(file: Path) -> None:
    call("usd.info:info_of_stage", file)
    folder = file.parent / "unpacked"
    folder.mkdir()
    call("export.usdz:unpack", file, folder)


def _read_map(file: Path) -> None:
    field = call("usd.maps.layer:load_map", file)
    str(field.report())
    field.lookup(np.zeros((1, 2)), np.zeros(1))


def _read_robot(file: Path) -> None:
    call("usd.robot:load_robot", file)
    _refusable("urdf.write:write_urdf", file, file.with_name("out.urdf"))
    call("usd.robot:read_notes", file)


def _read_scene(file: Path) -> None:
    root = file.with_name("room.usda")
    call("usd.scene:open_scene", root)
    _refusable("usd.info:info_of_stage", root)
    call("usd.lab.obstacles:read_obstacles", root)
    _refusable("twin:open_twin", root)


def _read_xacro(file: Path) -> None:
    call("urdf.source.source:read_source", file.with_name("x.xacro"))


def _read_urdf(file: Path) -> None:
    call("urdf.convert:convert_with_report", file, file.with_name("out.usda"))


def _read_controllers(file: Path) -> None:
    options = call("urdf.options:Options", controllers=file, profile="diff-drive")
    call(
        "urdf.convert:convert_with_report",
        file.with_name("x.urdf"),
        file.with_name("out.usda"),
        options=options,
    )


def _read_scene_toml(file: Path) -> None:
    call("author.scene_file:scene_from_toml", file, workshop=file.parent)


def _read_shard(file: Path) -> None:
    """The shard, with its checksum in the manifest."""
    manifest = file.parent.parent / "dataset.json"
    about = json.loads(manifest.read_text())
    about["recordings"][0]["sha256"] = hashlib.sha256(file.read_bytes()).hexdigest()
    manifest.write_text(json.dumps(about))
    _read_dataset(manifest)


def _read_dataset(file: Path) -> None:
    made = call("learn.data.dataset:open_dataset", file.parent)
    str(made.report())
    made.check()
    for _ in made.runs():
        pass
    made.rows(("odom_v_x",)) if "odom_v" in made.columns else None


def _read_tolles_lawson(file: Path) -> None:
    from magtwin.learn.compensation.tolles_lawson import TollesLawson

    TollesLawson.load(file).report("x")


def _read_results(file: Path) -> None:
    root = next(folder for folder in file.parents if (folder / "suite.toml").exists())
    results = call("bench.results:read_results", root)
    str(results)
    str(results.report(call("bench.leaderboard:standings", results.rows, results.times)))


def _reads(*names: str, folder: bool = False, **options: Any) -> Callable[[Path], None]:
    def read(file: Path) -> None:
        for name in names:
            made = call(name, file.parent if folder else file, **options)
            for _ in made if isinstance(made, types.GeneratorType) else ():
                pass
            if hasattr(made, "report"):
                with contextlib.suppress(TypeError):  # some need a title
                    str(made.report())

    return read


@dataclass(frozen=True)
class Format:
    """A format that is fuzzed."""

    file: str
    """The file that is damaged, in the seed's folder."""

    write: Callable[[Path], object]
    """Writes it, and the files beside it."""

    read: Callable[[Path], object]
    """Reads it, as a command does."""

    slow: bool = field(default=False, kw_only=True)
    """Whether a read takes a process or more than 50 ms; such formats get fewer inputs."""


_MESH = _reads("urdf.meshes.mesh:read_mesh")
_OBJ: Callable[[Path], object] = lambda file: call("urdf.meshes.mesh:read_mesh", file.with_name("m.obj"))  # noqa: E731
_NETWORK = _reads("learn.models.predictor:load_predictor", "io.info:info_of")
_READINGS = _reads("io.surveys.readings:read_readings")

FORMATS: Mapping[str, Format] = {
    **{kind: Format(f"x.{kind}", _saved_run, _read_run) for kind in ("npz", "parquet", "csv", "mcap")},
    "db3": Format("x.db3", _db3, _read_run),
    "rrd": Format("x.rrd", _saved_run, _read_run, slow=True),
    "bag": Format("plain.mcap", _plain_bag, _read_run),
    "bag-folder": Format("metadata.yaml", _bag_folder, lambda file: _read_run(file.parent)),
    "bag-survey": Format("plain.mcap", _plain_bag, _read_survey_bag),
    "recorded": Format("plain.mcap", _plain_bag, _read_recorded),
    "animation": Format("x.usda", _saved_run, _read_run),
    "release": Format("x.json", _recording, _reads("io.release:read_release")),
    "usda": Format("x.usda", _stage, _read_stage),
    "usdc": Format("x.usdc", _stage, _read_stage),
    "usdz": Format("x.usdz", _package, _read_package),
    "map": Format("x.usdc", _map_layer, _read_map),
    "map-text": Format("x.usda", _map_layer, _read_map),
    "robot": Format("cart.usda", _robot, _read_robot, slow=True),
    "scene": Format("room.usda", _scene, _read_scene, slow=True),
    "scene-magnetics": Format("magnetics.usda", _scene, _read_scene, slow=True),
    "stl": Format("x.stl", _mesh, _MESH),
    "stl-text": Format("ascii.stl", _mesh, _MESH),
    "ply": Format("x.ply", _mesh, _MESH),
    "glb": Format("x.glb", _mesh, _MESH),
    "gltf": Format("triangle.gltf", _mesh, _MESH),
    "dae": Format("triangle.dae", _mesh, _MESH),
    "obj": Format("m.obj", _textured, _OBJ),
    "mtl": Format("m.mtl", _textured, _OBJ),
    **{
        kind: Format(f"t.{kind}", _textured, _OBJ)
        for kind in ("png", "jpg", "bmp", "tga", "tiff", "gif", "webp")
    },
    "urdf": Format("x.urdf", _urdf, _read_urdf, slow=True),
    "xacro": Format(
        "x.xacro",
        lambda file: (text(XACRO)(file), text("a: 1\nb: !degrees 3\n")(file.with_name("s.yaml"))),
        _read_xacro,
    ),
    "xacro-yaml": Format(
        "s.yaml",
        lambda file: (text("a: 1\nb: [!degrees 3]\n")(file), text(XACRO)(file.with_name("x.xacro"))),
        _read_xacro,
    ),
    "controllers": Format(
        "c.yaml", lambda file: _urdf(file.with_name("x.urdf")), _read_controllers, slow=True
    ),
    "robot-toml": Format("robot.toml", text(ROBOT), _reads("author.robot:read_settings")),
    "scene-toml": Format("room.toml", _scene_toml, _read_scene_toml, slow=True),
    "suite": Format("suite.toml", text(SUITE), _reads("bench.suite:load_suite")),
    "training": Format(
        "t.toml",
        text('model = "paper"\nlayers = [8, 4]\nepochs = 3\nlr = 0.001\n'),
        _reads("learn.training.config:read_config"),
    ),
    "survey": Format("0_map.csv", _survey, _reads("field.survey.nodes:read_survey", folder=True)),
    "table": Format("x.csv", _table, _READINGS),
    "readings": Format("x.parquet", _readings, _READINGS),
    "scans": Format("x.parquet", _scans, _reads("io.scans:read_scans")),
    "path": Format("x.csv", text("x,y\n0,0\n1,0\n1,1\n"), _reads("path.points:read_path_csv")),
    "commands": Format(
        "x.csv", text("t,v,w\n0,0.1,0\n1,0.2,0.1\n"), _reads("sim.motion.commands:read_commands")
    ),
    "safetensors": Format("net.safetensors", _network, _NETWORK),
    "hybrid": Format("hybrid.safetensors", _network, _NETWORK),
    "pth": Format("x.pth", _checkpoint, _NETWORK),
    "onnx": Format("x.onnx", _onnx, _reads("learn.inference.onnx:report_onnx")),
    "state": Format(
        "x.safetensors",
        _state,
        lambda file: call("learn.training.state:load_state", file, _tensors(), _SETTINGS),
    ),
    "tolles-lawson": Format("x.json", _tolles_lawson, _read_tolles_lawson),
    "dataset": Format("dataset.json", _dataset, _read_dataset),
    "shard": Format("runs/a.parquet", _dataset, _read_shard),
    "results": Format("suite.json", _results, _read_results),
    "results-rows": Format("rows/a/part-00000.parquet", _results, _read_results),
    "magnetic-data": Format(
        "1-loc.csv", _magnetic_data, _reads("bench.magnetic_data:read_recording", folder=True, number=1)
    ),
    "matlab": Format(
        "Aligned_SquareLoop_1.mat", _matlab, _reads("bench.magslam:ship_case", folder=True, loop=1, seed=1)
    ),
}
"""Formats by name: every kind of file that a command, a stage or a robot's description may name."""


@dataclass(frozen=True)
class Seed:
    """A whole file of a format, and the files beside it."""

    data: bytes
    beside: Mapping[str, bytes]


def seed(kind: str, folder: Path) -> Seed:
    """The seed of a format, written into an empty folder."""
    chosen = FORMATS[kind]
    file = folder / chosen.file
    file.parent.mkdir(parents=True, exist_ok=True)
    chosen.write(file)
    files = {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}
    return Seed(files.pop(chosen.file), files)


def read(kind: str, data: bytes, beside: Mapping[str, bytes], folder: Path) -> None:
    """Read a file of a format as a user would, in a folder that is made."""
    for name, content in {**beside, FORMATS[kind].file: data}.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    FORMATS[kind].read(folder / FORMATS[kind].file)


def members(data: bytes, sound: bool) -> tuple[list[bytes], Callable[[int, bytes], bytes]] | None:
    """Parts of a container that a change of its bytes would not reach, and how to replace one.

    Members of zips, the JSON of safetensors and GLB, columns and metadata of Parquet files, arrays of MATLAB
    files, and blobs of SQLite files; checksums and lengths are then right. The last three only if `sound`.
    """
    for begin, parts_of in ((b"PAR1", _columns), (b"MATLAB", _arrays), (b"SQLite", _blobs)):
        if data.startswith(begin):
            return parts_of(data) if sound else None
    if data[:4] == b"PK\x03\x04":
        try:
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                parts = [(info, archive.read(info)) for info in archive.infolist()]
        except Exception:
            return None

        def packed(at: int, part: bytes) -> bytes:
            out = io.BytesIO()
            with zipfile.ZipFile(out, "w") as archive:
                for i, (info, old) in enumerate(parts):
                    copy = zipfile.ZipInfo(info.filename, info.date_time)
                    copy.extra, copy.compress_type = info.extra, info.compress_type
                    archive.writestr(copy, part if i == at else old)
            return out.getvalue()

        return [part for _, part in parts], packed
    glb = data[:4] == b"glTF"
    start, width = (20, 4) if glb else (8, 8)
    size = int.from_bytes(data[start - width - 4 * glb : start - 4 * glb], "little")
    if data[start : start + 1] != b"{" or not 0 < size <= len(data) - start:
        return None

    def joined(at: int, part: bytes) -> bytes:
        part += b" " * (-len(part) % 4)
        rest = data[start + size :]
        if glb:
            total = start + len(part) + len(rest)
            return (
                data[:8]
                + total.to_bytes(4, "little")
                + len(part).to_bytes(4, "little")
                + data[16:20]
                + part
                + rest
            )
        return len(part).to_bytes(8, "little") + part + rest

    return [data[start : start + size]], joined


def _columns(data: bytes) -> tuple[list[bytes], Callable[[int, bytes], bytes]]:
    """The values of the columns of numbers of a Parquet file, its texts, and its metadata."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.read_table(io.BytesIO(data), use_threads=False)
    about = sorted((table.schema.metadata or {}).items())
    whole = [column.combine_chunks() for column in table.columns]
    rows = [isinstance(column, pa.FixedSizeListArray) for column in whole]
    flat = [column.flatten() if listed else column for column, listed in zip(whole, rows, strict=True)]
    numbers = [i for i, column in enumerate(flat) if pa.types.is_primitive(column.type)]
    places = [(i, k) for i in numbers for k, part in enumerate(flat[i].buffers()) if part and len(flat[i])]
    parts = [flat[i].buffers()[k].to_pybytes() for i, k in places]
    texts = [i for i, column in enumerate(whole) if pa.types.is_string(column.type)]
    words = [json.dumps(whole[i].to_pylist()).encode() for i in texts]

    def packed(at: int, part: bytes) -> bytes:
        columns, metadata = list(whole), dict(about)
        if at < len(parts):
            i, k = places[at]
            size, buffers = len(parts[at]), flat[i].buffers()
            buffers[k] = pa.py_buffer(part[:size].ljust(size, b"\0"))
            columns[i] = pa.Array.from_buffers(flat[i].type, len(flat[i]), buffers)
            if rows[i]:
                columns[i] = pa.FixedSizeListArray.from_arrays(columns[i], type=whole[i].type)
        elif at < len(parts) + len(texts):
            i = texts[at - len(parts)]
            columns[i] = pa.array(json.loads(part), whole[i].type)
        else:
            metadata[about[at - len(parts) - len(texts)][0]] = part
        out = io.BytesIO()
        pq.write_table(pa.Table.from_arrays(columns, schema=table.schema.with_metadata(metadata)), out)
        return out.getvalue()

    return [*parts, *words, *(value for _, value in about)], packed


def _arrays(data: bytes) -> tuple[list[bytes], Callable[[int, bytes], bytes]]:
    """The values of the arrays of a MATLAB file."""
    from scipy.io import loadmat, savemat

    arrays = {name: value for name, value in loadmat(io.BytesIO(data)).items() if not name.startswith("_")}
    names = [name for name, value in arrays.items() if value.dtype.kind in "biuf"]

    def packed(at: int, part: bytes) -> bytes:
        old = arrays[names[at]]
        new = np.frombuffer(part[: old.nbytes].ljust(old.nbytes, b"\0"), old.dtype).reshape(old.shape)
        out = io.BytesIO()
        savemat(out, {**arrays, names[at]: new})
        return out.getvalue()

    return [arrays[name].tobytes() for name in names], packed


def _blobs(data: bytes) -> tuple[list[bytes], Callable[[int, bytes], bytes]]:
    """The texts and blobs of a SQLite file."""
    base = sqlite3.connect(":memory:")
    base.deserialize(data)
    names = [name for (name,) in base.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
    places: list[tuple[str, str, int]] = []
    parts: list[bytes] = []
    for table in names:
        for _, column, *_ in base.execute(f'PRAGMA table_info("{table}")').fetchall():
            for row, value in base.execute(f'SELECT rowid, "{column}" FROM "{table}"').fetchall():
                if isinstance(value, str | bytes):
                    places.append((table, column, row))
                    parts.append(value.encode() if isinstance(value, str) else value)

    def packed(at: int, part: bytes) -> bytes:
        table, column, row = places[at]
        copy = sqlite3.connect(":memory:")
        copy.deserialize(data)
        (kind,) = copy.execute(f'SELECT typeof("{column}") FROM "{table}" WHERE rowid = ?', (row,)).fetchone()
        value = part.decode(errors="replace") if kind == "text" else part
        copy.execute(f'UPDATE "{table}" SET "{column}" = ? WHERE rowid = ?', (value, row))
        copy.commit()
        return copy.serialize()

    return parts, packed
