"""Write: the URDF of an articulation, with the same kinematics, inertia and shapes.

Poses of bodies are in double precision on the stage and are reproduced to 1e-12. UsdPhysics stores other
numbers in single precision; each is written as the shortest number that rounds to it, so 0.0228 becomes
0.0228 again. A URDF has no place for sensors, drive gains, contact and textures; they are left out.
"""

import math
import os
import re
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics

from magtwin.errors import InputError
from magtwin.files.outputs import check_free, output, transaction
from magtwin.frames import matrix_from_quat
from magtwin.report.report import Figure, Report
from magtwin.urdf.description.model import rpy_of
from magtwin.urdf.meshes.mesh_layer import MESH, free_name, primitive_of
from magtwin.urdf.meshes.scan import STL
from magtwin.urdf.physics.contact import CONTACT, DESCRIBED
from magtwin.urdf.physics.joint import AXIS
from magtwin.urdf.physics.link import SITE_API
from magtwin.urdf.physics.mechanism import displacement
from magtwin.usd.attributes import read_axis, read_number, target
from magtwin.usd.geometry import SHOWN, Shape, read_shapes, srgb_from_linear
from magtwin.usd.layers import open_stage, translates
from magtwin.usd.schema import place

Array = NDArray[np.float64]
Element = ElementTree.Element
Sub = ElementTree.SubElement

WORLD = "world"
"""Name of a URDF's root link to which a base is fixed."""

AT_REST = 1e-5
"""Joint value below which a joint counts as at 0 [rad or m]; its frames are in single precision."""

SAME = 1e-6
"""Tolerance of positions in single precision [m]."""

KINDS = {
    "PhysicsFixedJoint": "fixed",
    "PhysicsRevoluteJoint": "revolute",
    "PhysicsPrismaticJoint": "prismatic",
    "PhysicsJoint": "planar",
}

WORDS = ("name", "type", "link", "joint", "filename")
"""Attributes of a URDF's tags that are no numbers."""


@dataclass
class _Joint:
    """A `<joint>`."""

    name: str
    kind: str
    parent: str
    child: str
    T: Array
    """Pose of the child in the parent at 0, shape (4, 4)."""
    prim: Usd.Prim
    axis: Array | None = None
    limit: dict[str, float] = field(default_factory=dict)
    dynamics: dict[str, float] = field(default_factory=dict)
    mimic: tuple[str, float, float] | None = None
    """Name of the leader, multiplier, offset."""


@dataclass
class _Link:
    """A `<link>`."""

    name: str
    T: Array
    """Pose in the robot's prim, shape (4, 4)."""
    prim: Usd.Prim
    body: bool


@translates
@np.errstate(all="ignore")  # what is not finite is refused
def write_urdf(asset: str | os.PathLike[str], out: str | os.PathLike[str], *, force: bool = False) -> Report:
    """Write the URDF of a stage's robot.

    Args:
        asset: A stage with one articulation.
        out: The .urdf to write; meshes go beside it to `<stem>_meshes`, as STL.
        force: Whether to replace existing files.

    Returns:
        Counts of what was written, and notes on what was left out.

    Raises:
        InputError: The stage has no robot or several, URDF has no such joint, the joints form a circle, a
            value is of another type or not finite, or a file exists; nothing is written.
    """
    out = Path(out)
    if out.suffix != ".urdf":
        raise InputError(f"{out}: a URDF ends in .urdf")
    folder = out.with_name(f"{out.stem}_meshes")
    stage = open_stage(asset)
    roots = [prim for prim in stage.Traverse() if prim.HasAPI(UsdPhysics.ArticulationRootAPI)]
    if len(roots) != 1:
        seen = ", ".join(str(prim.GetPath()) for prim in roots) or "none"
        raise InputError(f"{asset}: a URDF has one articulation, found {seen}; give the robot's own asset")
    robot = roots[0].GetParent() if roots[0].HasAPI(UsdPhysics.RigidBodyAPI) else roots[0]
    if robot.GetVariantSets().HasVariantSet(CONTACT):
        path = robot.GetPath()
        with Usd.EditContext(stage, stage.GetSessionLayer()):
            robot.GetVariantSet(CONTACT).SetVariantSelection(DESCRIBED)
        robot = stage.GetPrimAtPath(path)
    writer = _Writer(stage, robot, folder.name)
    xml = writer.write()
    ElementTree.indent(xml)
    text = f'<?xml version="1.0"?>\n{ElementTree.tostring(xml, encoding="unicode")}\n'
    check_free(out, force=force)
    with transaction(), ExitStack() as files:
        if writer.meshes:
            aside_meshes = files.enter_context(output(folder, force=force))
            aside_meshes.mkdir()
            for name, triangles in writer.meshes.items():
                (aside_meshes / name).write_bytes(_stl(triangles))
        files.enter_context(output(out, force=force)).write_text(text, encoding="utf-8")
    mass = sum(float(e.attrib["value"]) for e in xml.iter("mass"))
    figures = (
        Figure("links", len(xml.findall("link"))),
        Figure("joints", len(xml.findall("joint"))),
        Figure("mass", round(mass, 9), "kg"),
        Figure("meshes", len(writer.meshes)),
    )
    return Report(f"{asset} -> {out}", figures, {"notes": writer.notes} if writer.notes else {})


class _Writer:
    """Reads one robot from its stage and builds its URDF."""

    def __init__(self, stage: Usd.Stage, robot: Usd.Prim, folder: str) -> None:
        self.stage, self.robot, self.folder = stage, robot, folder
        self.notes: list[str] = []
        self.meshes: dict[str, Array] = {}
        """Triangles by file name, shape (T, 3, 3)."""
        self.cache = UsdGeom.XformCache()
        self.links: dict[Sdf.Path, _Link] = {}
        self.joint_names: dict[Sdf.Path, str] = {}
        names: set[str] = set()
        for prim in Usd.PrimRange(robot):
            body = prim.HasAPI(UsdPhysics.RigidBodyAPI)
            if prim != robot and (body or SITE_API in prim.GetPrimTypeInfo().GetAppliedAPISchemas()):
                name = free_name(_name(prim), names)
                self.links[prim.GetPath()] = _Link(name, self._pose(prim), prim, body)
        self.world = free_name(WORLD, names)

    def write(self) -> Element:
        """The `<robot>`."""
        joints = self._joints()
        root = _root([link.name for link in self.links.values()], joints, self.robot)
        xml = Element("robot", name=_name(self.robot))
        if root == self.world:
            Sub(xml, "link", name=root)
        shapes = self._shapes()
        for link in self.links.values():
            element = Sub(xml, "link", name=link.name)
            if link.body:
                _write_inertial(element, link.prim)
                _check_finite(element, link.prim)
                self._write_shapes(element, link, shapes)
        for joint in joints:
            element = Sub(xml, "joint", name=joint.name, type=joint.kind)
            Sub(element, "parent", link=joint.parent)
            Sub(element, "child", link=joint.child)
            write_origin(element, joint.T)
            if joint.axis is not None:
                Sub(element, "axis", xyz=_text(joint.axis))
            for tag, figures in (("limit", joint.limit), ("dynamics", joint.dynamics)):
                if figures:
                    Sub(element, tag, {name: _text([value]) for name, value in figures.items()})
            if joint.mimic is not None:
                leader, ratio, offset = joint.mimic
                Sub(element, "mimic", joint=leader, multiplier=_text([ratio]), offset=_text([offset]))
            _check_finite(element, joint.prim)
        left = {
            name
            for prim in Usd.PrimRange(self.robot)
            for name in (prim.GetTypeName(), *prim.GetPrimTypeInfo().GetAppliedAPISchemas())
            if name in ("IsaacImuSensor", "OmniLidar", "Camera", "IsaacContactSensor")
            or name.startswith("Magtwin")
        }
        if left:
            self._note(f"a URDF has no place for {', '.join(sorted(left))}")
        return xml

    def _pose(self, prim: Usd.Prim) -> Array:
        """Pose of a prim in the robot's prim, shape (4, 4)."""
        matrix, _ = self.cache.ComputeRelativeTransform(prim, self.robot)
        T = np.array(matrix, float).T
        scale = np.linalg.norm(T[:3, :3], axis=0)
        T[:3, :3] /= scale
        if not np.allclose([*scale, np.linalg.det(T[:3, :3])], 1, rtol=0, atol=SAME):
            raise InputError(
                f"{place(prim)}: is scaled, which a URDF cannot do to links, or mirrored, skewed or not "
                "finite; change its shapes instead"
            )
        return T

    def _joints(self) -> list[_Joint]:
        """The stage's joints, fixed joints for sites, and floating joints for bodies without a joint."""
        taken = set[str]()
        prims = [
            prim
            for prim in Usd.PrimRange(self.robot)
            if prim.IsA(UsdPhysics.Joint) and UsdPhysics.Joint(prim).GetJointEnabledAttr().Get() is not False
        ]
        if any(self._end(prim, UsdPhysics.Joint(prim).GetBody0Rel()) is None for prim in prims):
            self._take_world()
        self.joint_names = {prim.GetPath(): free_name(_name(prim), taken) for prim in prims}
        joints = [self._joint(prim, self.joint_names[prim.GetPath()]) for prim in prims]
        if circle := _circle({joint.name: joint.mimic[0] for joint in joints if joint.mimic is not None}):
            raise InputError(f"{place(self.robot)}: joints mimic in a circle: {circle}; remove one mimic")
        held = {joint.child for joint in joints}
        free = [link for link in self.links.values() if link.body and link.name not in held]
        base = free[0] if free else None

        def hold(kind: str, parent: _Link, child: _Link, named: _Link) -> None:
            name = free_name(f"{named.name}_joint", taken)
            joints.append(
                _Joint(name, kind, parent.name, child.name, _between(parent.T, child.T), child.prim)
            )

        for link in free[1:]:
            hold("floating", free[0], link, link)
        for path, link in self.links.items():
            if link.body:
                continue
            ancestors = (self.links.get(p) for p in path.GetAncestorsRange() if p != path)
            above = next((each for each in ancestors if each), None)
            if above is None:
                raise InputError(f"{place(link.prim)}: is a site without a body; put it below its body")
            if base is not None and above is base and _is_identity(link.T) and not _is_identity(base.T):
                hold("fixed", link, base, link)  # a frame at the robot's prim, such as base_footprint
                base = None  # is held now
            else:
                hold("fixed", above, link, link)
        return joints

    def _take_world(self) -> None:
        """Let a site called `world` at the robot's prim be the link that holds the base, and no frame."""
        for path, link in self.links.items():
            if link.name == WORLD and not link.body and _is_identity(link.T):
                self.world = self.links.pop(path).name
                return

    def _joint(self, prim: Usd.Prim, name: str) -> _Joint:
        joint, kind = UsdPhysics.Joint(prim), KINDS.get(prim.GetTypeName())
        if kind is None:
            raise InputError(f"{place(prim)}: URDF has no {prim.GetTypeName()}; known: {', '.join(KINDS)}")
        parent, child = (self._end(prim, rel) for rel in (joint.GetBody0Rel(), joint.GetBody1Rel()))
        if child is None:
            raise InputError(f"{place(prim)}: its body1 is not a link of the robot; swap the bodies")
        frames = [_frame(prim, body) for body in (0, 1)]
        if kind != "fixed" and np.abs(frames[1][:3, 3]).max() > SAME:
            raise InputError(
                f"{place(prim)}: turns about a point of {child.name!r} that is not its origin; in a URDF it "
                "must be, so move the body's frame there"
            )
        T = _between(np.eye(4) if parent is None else parent.T, child.T)
        made = _Joint(name, kind, self.world if parent is None else parent.name, child.name, T, prim)
        if kind == "fixed":
            return made
        token = _token(prim, kind)
        made.axis = _tidy(frames[1][:3, "XYZ".index(token)], prim.GetCustomDataByKey(AXIS))
        if kind != "planar":
            self._figures(prim, made)
        value = _value(np.linalg.inv(frames[0]) @ T @ frames[1], token, kind)
        if made.mimic is not None and abs(value - made.mimic[2]) < AT_REST:
            value = made.mimic[2]  # its leader is at 0
        if abs(value) > AT_REST:
            made.T = T @ displacement(made.axis, -value, slides=kind == "prismatic")
        return made

    def _end(self, prim: Usd.Prim, relationship: Usd.Relationship) -> _Link | None:
        """The link at one end of a joint; None for the world or the robot's prim."""
        targets = relationship.GetTargets()
        if not targets or targets[0] == self.robot.GetPath():
            return None
        if targets[0] not in self.links:
            raise InputError(f"{place(prim)}: holds <{targets[0]}>, not a link of {self.robot.GetPath()}")
        return self.links[targets[0]]

    def _figures(self, prim: Usd.Prim, joint: _Joint) -> None:
        """Read limits, dynamics and mimic of a joint of one degree of freedom."""
        slides = joint.kind == "prismatic"
        unit, axis = (1.0, "linear") if slides else (math.pi / 180, "angular")
        ends = {end: _read(prim, f"physics:{end}Limit") for end in ("lower", "upper")}
        if not {None, math.inf, -math.inf}.isdisjoint(ends.values()):
            if slides:
                raise InputError(
                    f"{place(prim)}: slides without an end, unlike a URDF's joints; give it limits"
                )
            joint.kind = "continuous"
        else:
            joint.limit = {end: _shortest(value, unit) for end, value in ends.items()}
        force = _read(prim, f"drive:{axis}:physics:maxForce")
        names = ("newton:velocityLimit", "physxJoint:maxJointVelocity")
        speed = next((value for name in names if (value := _read(prim, name)) is not None), None)
        for name, value, per in (("effort", force, 1.0), ("velocity", speed, unit)):
            if value is not None and math.isfinite(value):
                joint.limit[name] = _shortest(value, per)
        lost = [name for name in ("effort", "velocity") if name not in joint.limit]
        if joint.limit and lost and joint.kind != "continuous":
            self._note(
                f"the stage gives joint {joint.name!r} no {' nor '.join(lost)}, which urdfdom requires"
            )
        for name, per in (("damping", 1 / unit), ("friction", 1.0)):
            value = _read(prim, f"newton:{name}")
            if value is not None:
                joint.dynamics[name] = _shortest(value, per)
        leads = prim.GetRelationship("newton:mimicJoint")
        if leads and leads.GetTargets():
            leader = target(prim, "newton:mimicJoint")
            name = self.joint_names.get(leader.GetPath(), "")
            if not name or KINDS.get(leader.GetTypeName()) not in ("revolute", "prismatic"):
                raise InputError(
                    f"{place(prim)}: mimics <{leader.GetPath()}>, not a joint of the robot that turns or "
                    "slides; correct newton:mimicJoint"
                )
            offset, ratio = (_read(prim, f"newton:mimicCoef{i}") or 0.0 for i in (0, 1))
            joint.mimic = (name, _shortest(ratio), _shortest(offset, unit))

    def _shapes(self) -> dict[Sdf.Path, list[Shape]]:
        """Visuals and colliders by the path of their gprim; a mesh may have several subsets."""
        shapes: dict[Sdf.Path, list[Shape]] = {}
        for shape in read_shapes(self.stage, purposes=(*SHOWN, UsdGeom.Tokens.guide)):
            path = Sdf.Path(shape.prim)
            prim = self.stage.GetPrimAtPath(path)
            is_subset = prim and not prim.IsA(UsdGeom.Gprim)
            shapes.setdefault(path.GetParentPath() if is_subset else path, []).append(shape)
        return shapes

    def _write_shapes(self, element: Element, link: _Link, shapes: dict[Sdf.Path, list[Shape]]) -> None:
        for prim in Usd.PrimRange(link.prim, Usd.TraverseInstanceProxies()):
            parts = shapes.get(prim.GetPath(), [])
            if not prim.IsA(UsdGeom.Gprim) or not parts:
                continue
            shown = UsdGeom.Imageable(prim).ComputePurpose() in SHOWN
            roles = {"visual": shown, "collision": False}
            if prim.HasAPI(UsdPhysics.CollisionAPI):
                roles["collision"] = bool(UsdPhysics.CollisionAPI(prim).GetCollisionEnabledAttr().Get())
            primitive = self._primitive(prim, link)
            parent = prim.GetParent()  # has the name of the shape if it refers to a mesh
            named = parent if prim.GetName() == MESH and parent != link.prim else prim
            for role in (role for role, wanted in roles.items() if wanted):
                for shape in parts[:1] if primitive is not None else parts:
                    own = Sub(element, role, name=named.GetName())
                    if primitive is not None:
                        T, tag, sizes = primitive
                        write_origin(own, T)
                        Sub(Sub(own, "geometry"), tag, sizes)
                    else:
                        name = re.sub(r"[^\w.-]", "_", f"{link.name[:50]}_{role}_{len(self.meshes)}.stl")
                        self.meshes[name] = shape.vertices[shape.faces].astype(float)
                        Sub(Sub(own, "geometry"), "mesh", filename=f"{self.folder}/{name}")
                    if role == "visual":
                        colour = np.array(shape.colour, float)
                        if shape.vertex_colours is not None:
                            colour[:3] = shape.vertex_colours.mean(axis=0)
                            self._note("colours by vertex are replaced by their mean")
                        channels = [*srgb_from_linear(colour[:3]), np.clip(colour[3], 0, 1)]
                        rgba = " ".join(f"{v:.4g}" for v in channels)
                        material = Sub(own, "material", name=f"rgba_{rgba.replace(' ', '_')}")
                        Sub(material, "color", rgba=rgba)
                    _check_finite(own, prim)

    def _primitive(self, prim: Usd.Prim, link: _Link) -> tuple[Array, str, dict[str, str]] | None:
        """Pose, tag and sizes of a gprim that URDF supports; None if it must become triangles."""
        matrix, _ = self.cache.ComputeRelativeTransform(prim, link.prim)
        T = np.array(matrix, float).T
        scale = np.linalg.norm(T[:3, :3], axis=0)
        if scale.min() == 0 or np.linalg.det(T[:3, :3]) < 0:
            return None
        T[:3, :3] /= scale
        if not np.allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), rtol=0, atol=1e-9):
            return None
        form = primitive_of(prim)
        if form is not None and form.kind == "box":
            return T, "box", {"size": _text(_shortest(v) for v in scale * form.size)}
        if form is None or not np.allclose(scale, scale[0], rtol=1e-9):
            return None
        if prim.IsA(UsdGeom.Cylinder) or prim.IsA(UsdGeom.Capsule):
            axis = "XYZ".index(read_axis(prim))
            if axis != 2:  # URDF's primitives are along z
                T[:3, :3] = T[:3, :3] @ np.roll(np.eye(3), axis + 1, axis=0)
        names = ("radius",) if form.kind == "sphere" else ("radius", "length")
        return T, form.kind, {name: _text([getattr(form, name) * scale[0]]) for name in names}

    def _note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)


def _name(prim: Usd.Prim) -> str:
    """Name of a prim in the description: its display name if all of that can be printed, and so be in XML."""
    shown = str(prim.GetDisplayName())
    return shown if shown and shown.isprintable() else str(prim.GetName())


def _read(prim: Usd.Prim, name: str, kind: Any = None) -> Any:
    """A number, or a value as the type `kind`, that may be infinite; None if the prim has none."""
    value = prim.GetAttribute(name).Get()
    if value is None:
        return None
    value = read_number(prim, name) if kind is None else kind(value)
    if "nan" in str(value):
        raise InputError(f"{place(prim)}: {name} is {value}; correct it")
    return value


def _check_finite(element: Element, prim: Usd.Prim) -> None:
    """Refuse numbers of an element, made of a prim, that are not finite."""
    for part in element.iter():
        for name, text in part.items():
            if name not in WORDS and not {"nan", "inf", "-inf"}.isdisjoint(text.split()):
                raise InputError(
                    f'{place(prim)}: becomes <{part.tag} {name}="{text}">, but a URDF holds finite numbers '
                    "only; correct it on the stage"
                )


def _circle(above: dict[str, str]) -> str:
    """A circle of names of which each is above the next; "" if there is none."""
    try:
        TopologicalSorter({name: [up] for name, up in above.items()}).prepare()
    except CycleError as error:
        return " -> ".join(error.args[1])
    return ""


def _root(names: list[str], joints: list[_Joint], robot: Usd.Prim) -> str:
    """The link that no joint holds; refuses links that are not one tree."""
    above: dict[str, str] = {}
    for joint in joints:
        if joint.child in above:
            text = f"{joint.child!r} is held by two joints, in a circle; a URDF is a tree"
            raise InputError(f"{place(robot)}: {text}")
        above[joint.child] = joint.parent
    names = [*names, *(joint.parent for joint in joints)]
    roots = [name for name in dict.fromkeys(names) if name not in above]
    if len(roots) != 1:
        seen = ", ".join(roots) or "none"
        raise InputError(f"{place(robot)}: a URDF has one root link, found {seen}; join them")
    if circle := _circle(above):
        raise InputError(f"{place(robot)}: joints hold links in a circle: {circle}; a URDF is a tree")
    return roots[0]


def _is_identity(T: Array) -> bool:
    return bool(np.allclose(T, np.eye(4), rtol=0, atol=1e-9))


def _between(T_above: Array, T_below: Array) -> Array:
    """Pose of one frame in another, both given in a third, shape (4, 4)."""
    R, p = T_above[:3, :3], T_above[:3, 3]
    T = np.eye(4)
    T[:3, :3] = R.T @ T_below[:3, :3]
    T[:3, 3] = R.T @ (T_below[:3, 3] - p)
    return T


def _rotation(q: Gf.Quatd) -> Array:
    """Rotation by a quaternion, normalised in double precision, shape (3, 3)."""
    xyzw = np.array([*q.GetImaginary(), q.GetReal()])
    return matrix_from_quat(xyzw / np.linalg.norm(xyzw))


def _frame(prim: Usd.Prim, body: int) -> Array:
    """A joint's frame in its body 0 or 1, shape (4, 4)."""
    p, q = _read(prim, f"physics:localPos{body}", Gf.Vec3d), _read(prim, f"physics:localRot{body}", Gf.Quatd)
    T = np.eye(4)
    T[:3, 3] = [_shortest(v) for v in p or (0, 0, 0)]
    T[:3, :3] = _rotation(q or Gf.Quatd(1))
    if not np.isfinite(T).all():
        raise InputError(
            f"{place(prim)}: physics:localPos{body} is {p} and physics:localRot{body} {q}, not a frame; "
            "correct them"
        )
    return T


def _token(prim: Usd.Prim, kind: str) -> str:
    """The axis X, Y or Z of a joint's frame along or about which it moves."""
    if kind != "planar":
        return read_axis(prim, "physics:axis")
    free = {
        axis
        for axis in (f"{motion}{letter}" for motion in ("trans", "rot") for letter in "XYZ")
        if not UsdPhysics.LimitAPI(prim, axis)
        or read_number(prim, f"limit:{axis}:physics:low") <= read_number(prim, f"limit:{axis}:physics:high")
    }
    for token in "XYZ":
        if free == {f"rot{token}", *(f"trans{other}" for other in "XYZ" if other != token)}:
            return token
    raise InputError(f"{place(prim)}: is free along {', '.join(sorted(free))}; URDF has no such joint")


def _tidy(axis: Array, authored: Any) -> Array:
    """An axis in single precision, replaced by the authored one or a frame's axis if they agree."""
    given = authored if isinstance(authored, Gf.Vec3d) else (0, 0, 0)
    for better in (np.round(axis), np.array(given, float)):
        if np.abs(axis - better).max() < SAME and np.linalg.norm(better) > 0.5:
            return better
    return axis


def _value(M: Array, token: str, kind: str) -> float:
    """Value of a joint whose child's frame has pose M in its parent's [rad or m]; 0 if planar."""
    i = "XYZ".index(token)
    if kind == "prismatic":
        return float(M[i, 3])
    if kind == "planar":
        return 0.0
    j, k = (i + 1) % 3, (i + 2) % 3
    return math.atan2(M[k, j] - M[j, k], M[j, j] + M[k, k])


def _shortest(value: float, unit: float = 1.0) -> float:
    """The shortest number, in another unit, that rounds to this one in single precision."""
    if not math.isfinite(value):
        return float(value)
    wanted = np.float32(value)
    if unit == 1.0:
        return float(str(wanted))
    for digits in range(1, 10):
        short = float(f"{float(wanted) * unit:.{digits}g}")
        if np.float32(short / unit) == wanted:
            return short
    return float(wanted) * unit


def _text(values: Iterable[float]) -> str:
    """Numbers as text, rounded to 1e-15 to drop rounding errors of arithmetic."""
    return " ".join(repr(round(float(v), 15) + 0.0).removesuffix(".0") for v in values)


def write_origin(element: Element, T: Array) -> None:
    """Add an `<origin>` with pose T, shape (4, 4), unless it is the identity."""
    if not _is_identity(T):
        Sub(element, "origin", xyz=_text(T[:3, 3]), rpy=_text(rpy_of(T[:3, :3])))


def _write_inertial(element: Element, prim: Usd.Prim) -> None:
    """Mass, centre and inertia of a body, as far as authored."""
    mass = _read(prim, "physics:mass") if prim.HasAPI(UsdPhysics.MassAPI) else None
    if mass is None or mass <= 0:
        return
    inertial, centre = Sub(element, "inertial"), _read(prim, "physics:centerOfMass", Gf.Vec3d)
    if centre is not None and np.isfinite(centre).all() and any(centre):
        Sub(inertial, "origin", xyz=_text(_shortest(v) for v in centre), rpy="0 0 0")
    Sub(inertial, "mass", value=_text([_shortest(mass)]))
    moments = np.array([_shortest(v) for v in _read(prim, "physics:diagonalInertia", Gf.Vec3d) or (0, 0, 0)])
    if not moments.any():
        return  # engines compute it from the colliders
    R, q = np.eye(3), _read(prim, "physics:principalAxes", Gf.Quatd)
    if q is not None and q.GetLength() > 0.5 and q.GetImaginary().GetLength() > 0:
        R = _rotation(q)
    tensor = R @ np.diag(moments) @ R.T
    names = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
    Sub(inertial, "inertia", {name: repr(float(tensor[at]) + 0.0) for name, at in names.items()})


def _stl(triangles: Array) -> bytes:
    """Triangles (T, 3, 3) as binary STL."""
    rows = np.zeros(len(triangles), STL)
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    rows["normal"] = np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)
    rows["corners"] = triangles
    return bytes(80) + np.uint32(len(rows)).astype("<u4").tobytes() + rows.tobytes()
