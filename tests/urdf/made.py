"""Descriptions that the tests of this folder make, and what they become."""

import textwrap

import numpy as np
import yourdfpy
from pxr import Usd, UsdPhysics

from magtwin.urdf.convert import convert_with_report
from magtwin.urdf.options import Options

INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
BALL = '<geometry><sphere radius="0.1"/></geometry>'
BODY = f"{INERTIAL}<visual>{BALL}</visual><collision>{BALL}</collision>"


def urdf(tmp_path, body, name="arm"):
    """A URDF file around `body`; {INERTIAL} and {BODY} stand for usual contents of a link."""
    text = textwrap.dedent(body).replace("{INERTIAL}", INERTIAL).replace("{BODY}", BODY)
    path = tmp_path / f"{name}.urdf"
    path.write_text(f'<?xml version="1.0"?>\n<robot name="{name}">\n{text}\n</robot>\n')
    return path


def link(name, content="{BODY}"):
    return f'<link name="{name}">{content}</link>'


def joint(name, parent, child, kind="fixed", content=""):
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{content}</joint>'


def arm(tmp_path, held, child="{BODY}"):
    """Two links held by a joint called j, whose type and inner XML are given."""
    kind, _, inner = held.partition("|")
    parts = link("base_link"), link("hand", child), joint("j", "base_link", "hand", kind, inner)
    return urdf(tmp_path, "\n".join(parts))


def converted(path, **options):
    """The stage of a description, its robot's prim, and the report; a single file unless it is told."""
    out = path.with_suffix(".usda")
    report = convert_with_report(path, out, options=Options(**{"single_file": True} | options), force=True)
    stage = Usd.Stage.Open(str(out))
    stage.Reload()
    return stage, stage.GetDefaultPrim(), report


def link_poses(path, values):
    """T_root_link of each link by yourdfpy, shape (4, 4), with joints at values by name; mimics follow."""
    peer = yourdfpy.URDF.load(str(path), load_meshes=False)
    peer.update_cfg(dict(values))
    return {link.name: peer.get_transform(link.name, peer.base_link) for link in peer.robot.links}


def masses(stage):
    """Mass of each body by name [kg]."""
    bodies = [prim for prim in stage.Traverse() if prim.HasAPI(UsdPhysics.RigidBodyAPI)]
    return {body.GetName(): UsdPhysics.MassAPI(body).GetMassAttr().Get() for body in bodies}


def prim(robot, name):
    return next(p for p in Usd.PrimRange(robot) if p.GetName() == name)


def drive_of(robot, name, axis="angular"):
    """Drive of a joint, its stiffness and its damping, per radian or metre."""
    drive = UsdPhysics.DriveAPI(prim(robot, name), axis)
    unit = 180 / np.pi if axis == "angular" else 1.0
    return drive, drive.GetStiffnessAttr().Get() * unit, drive.GetDampingAttr().Get() * unit
