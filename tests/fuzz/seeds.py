"""Seeds: small files of each format, made anew, and how each is read."""

import importlib
import json
from pathlib import Path

import numpy as np

RUNS = ("npz", "parquet", "csv", "mcap", "db3")
STAGES = ("usda", "usdc")
MESHES = ("stl", "ply", "obj", "glb", "dae")
FORMATS = (*RUNS, *STAGES, *MESHES, "toml", "xacro", "survey", "safetensors")
"""Formats that are fuzzed; .rrd is not, as each read starts Rerun's verifier."""

_XACRO = """<?xml version="1.0"?>
<robot name="b" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:property name="w" value="0.3"/>
  <xacro:macro name="leg" params="n x:=1"><link name="leg_${n}"><inertial><mass value="${w * x}"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link></xacro:macro>
  <xacro:if value="${w > 0}"><xacro:leg n="1"/></xacro:if>
</robot>
"""
_STAGE = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    upAxis = "Z"
)
def Xform "World" {
    def Cube "box" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"]) {
        float physics:mass = 2
        double size = 0.5
        double3 xformOp:translate = (0, 1, 2)
        quatf xformOp:orient = (1, 0, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:orient"]
    }
    def Mesh "m" (prepend references = </World/box>) {
        int[] faceVertexCounts = [3]
        int[] faceVertexIndices = [0, 1, 2]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
        color3f[] primvars:displayColor = [(1, 0, 0)]
    }
}
"""


def seeds(kind: str, folder: Path) -> list[bytes]:
    """The files to damage."""
    folder = folder / kind
    folder.mkdir()
    file = folder / f"seed.{kind}"
    if kind in RUNS:
        from magtwin.run.run import Column, Run

        t = np.arange(8) * 0.1
        columns = {
            "t": t,
            "b_total_nt": 5e4 + t,
            "p_world_base": np.zeros((8, 3)),
            "volts": t.astype(np.float32),
        }
        Run(columns, {"scene": "lab", "seed": 1}, {"volts": Column("V", "", "a voltage")}).save(file)
    elif kind in STAGES:
        from pxr import Sdf

        layer = Sdf.Layer.CreateAnonymous(".usda")
        layer.ImportFromString(_STAGE)
        layer.Export(str(file))
    elif kind in MESHES:
        import trimesh

        box = trimesh.creation.box()
        box.visual.vertex_colors = [200, 10, 10, 255]
        box.export(file)
    elif kind == "toml":
        from magtwin.files import shipped

        file.write_bytes(shipped("robots", "turtlebot4", "robot.toml").read_bytes())
    elif kind == "xacro":
        file.write_text(_XACRO)
    elif kind == "survey":
        rows = "".join(f"{x},{y},{h},{50000 + x}\n" for x in range(3) for y in range(3) for h in (0, 90))
        file.write_text(f"x,y,theta,b\n{rows}")
    else:
        from magtwin.files import shipped

        return [min(shipped("weights").rglob("*.safetensors"), key=lambda p: p.stat().st_size).read_bytes()]
    return [file.read_bytes()]


def read(kind: str, data: bytes, folder: Path) -> None:
    """Read a file of a format as a user would."""
    folder.mkdir()
    file = folder / f"x.{ {'survey': 'csv'}.get(kind, kind) }"
    file.write_bytes(data)
    name, arguments = {
        **dict.fromkeys(RUNS, ("magtwin.io.formats:read_run", ())),
        **dict.fromkeys(MESHES, ("magtwin.urdf.meshes.mesh:read_mesh", ())),
        "toml": ("magtwin.author.robot:read_settings", ()),
        "xacro": ("magtwin.urdf.source.source:read_source", ()),
        "survey": ("magtwin.io.surveys.table:read_csv", ()),
        "safetensors": ("magtwin.learn.models.predictor:load_predictor", ()),
        **dict.fromkeys(STAGES, ("magtwin.usd.info:info_of_stage", ())),
    }[kind]
    module, _, function = name.partition(":")
    made = getattr(importlib.import_module(module), function)(file, *arguments)
    if kind in STAGES:
        importlib.import_module("magtwin.usd.geometry").read_shapes(file)
    if kind in RUNS:
        json.dumps(str(made.report("x")))
