"""Write: the URDF of an articulation, with equal kinematics, inertia and shapes.

What is told in double precision on the stage, where bodies stand, comes back to 1e-12; what UsdPhysics has in
single precision comes back as the shortest number that it can have come from, so 0.0228 is 0.0228 again.
Sensors, drives' gains, contact and textures have no place in a URDF, and stay behind.
"""

import math
import os
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics

from magtwin.errors import InputError
from magtwin.files import check_free, output
from magtwin.frames import matrix_from_quat
from magtwin.report import Figure, Report
from magtwin.urdf.physics.joint import AXIS
from magtwin.urdf.physics.link import SITE_API
from magtwin.usd.geometry import SHOWN, Shape, read_shapes, srgb_from_linear
from magtwin.usd.layers import open_stage
from magtwin.usd.schema import place

Array = NDArray[np.float64]
Element = ElementTree.Element

WORLD = "world"
"""Name of the link that a URDF bolts a base to."""

MESHES = "meshes"
"""Folder of the triangles beside the URDF, under the URDF's name."""

AT_REST = 1e-5
"""Value of a joint below which it counts as 0 [rad or m]: its frames are in single precision."""

SAME = 1e-6
"""What two places in single precision may be apart [m]."""

KINDS = {
    "PhysicsFixedJoint": "fixed",
    "PhysicsRevoluteJoint": "revolute",
    "PhysicsPrismaticJoint": "prismatic",
    "PhysicsJoint": "planar",
}


@dataclass
class _Joint:
    """A joint as a URDF has it."""

    name: str
    kind: str
    parent: str
    child: str
    T: Array
    """Pose of the child in the parent at 0, shape (4, 4)."""
    axis: Array | None = None
    limit: dict[str, float] = field(default_factory=dict)
    dynamics: dict[str, float] = field(default_factory=dict)
    mimic: tuple[str, float, float] | None = None
    """Name of the leader, multiplier, offset."""


@dataclass
class _Link:
    """A link as a URDF has it."""

    name: str
    T: Array
    """Pose in the robot's prim, shape (4, 4)."""
    prim: Usd.Prim
    body: bool


def write_urdf(asset: str | os.PathLike[str], out: str | os.PathLike[str], *, force: bool = False) -> Report:
    """Write the URDF of a stage's robot.

    Args:
        asset: A stage with one articulation.
        out: The .urdf to make; triangles lie beside it in `<stem>_meshes`, as STL.
        force: Whether files that are there are replaced.

    Returns:
        What was written, and what a URDF has no place for.

    Raises:
        InputError: The stage has no robot or several, one of its joints is none that URDF has, its joints
            close a circle, or a file is there already; nothing is written.
    """
    out = Path(out)
    if out.suffix != ".urdf":
        raise InputError(f"{out}: a URDF ends in .urdf")
    folder = out.with_name(f"{out.stem}_{MESHES}")
    stage = open_stage(asset)
    writer = _Writer(stage, _robot(stage, asset), folder.name)
    xml, meshes = writer.write()
    ElementTree.indent(xml)
    text = f'<?xml version="1.0"?>\n{ElementTree.tostring(xml, encoding="unicode")}\n'
    check_free(out, force=force)
    if meshes:
        with output(folder, force=force) as aside_meshes, output(out, force=force) as aside:
            aside_meshes.mkdir()
            for name, triangles in meshes.items():
                (aside_meshes / name).write_bytes(_stl(triangles))
            aside.write_text(text, encoding="utf-8")
    else:
        with output(out, force=force) as aside:
            aside.write_text(text, encoding="utf-8")
    mass = sum(float(e.attrib["value"]) for e in xml.iter("mass"))
    figures = (
        Figure("links", len(xml.findall("link"))),
        Figure("joints", len(xml.findall("joint"))),
        Figure("mass", round(mass, 9), "kg"),
        Figure("meshes", len(meshes)),
    )
    return Report(f"{asset} -> {out}", figures, {"notes": writer.notes} if writer.notes else {})


def _robot(stage: Usd.Stage, asset: str | os.PathLike[str]) -> Usd.Prim:
    """The prim of the one articulation of a stage."""
    roots = [prim for prim in stage.Traverse() if prim.HasAPI(UsdPhysics.ArticulationRootAPI)]
    if len(roots) != 1:
        seen = ", ".join(str(prim.GetPath()) for prim in roots) or "none"
        raise InputError(f"{asset}: a URDF is of one articulation, found {seen}; name the robot's own asset")
    root = roots[0]
    return root.GetParent() if root.HasAPI(UsdPhysics.RigidBodyAPI) else root


class _Writer:
    """Takes one robot from its stage."""

    def __init__(self, stage: Usd.Stage, robot: Usd.Prim, folder: str) -> None:
        self.stage, self.robot, self.folder = stage, robot, folder
        self.notes: list[str] = []
        self.cache = UsdGeom.XformCache()
        self.links: dict[Sdf.Path, _Link] = {}
        names: set[str] = set()
        for prim in Usd.PrimRange(robot):
            body = prim.HasAPI(UsdPhysics.RigidBodyAPI)
            if prim != robot and (body or SITE_API in prim.GetPrimTypeInfo().GetAppliedAPISchemas()):
                name = self._free(_name(prim), names)
                self.links[prim.GetPath()] = _Link(name, self._pose(prim), prim, body)

    def write(self) -> tuple[Element, dict[str, Array]]:
        """The `<robot>`, and its triangles by file name."""
        joints = self._joints()
        root = _root([link.name for link in self.links.values()], joints, self.robot)
        xml = Element("robot", name=_name(self.robot))
        if any(joint.parent == WORLD for joint in joints) and root == WORLD:
            ElementTree.SubElement(xml, "link", name=WORLD)
        meshes: dict[str, Array] = {}
        shapes = self._shapes()
        for path, link in self.links.items():
            element = ElementTree.SubElement(xml, "link", name=link.name)
            if link.body:
                _write_inertial(element, link.prim)
                self._write_shapes(element, path, link, shapes, meshes)
        for joint in joints:
            _write_joint(xml, joint)
        self._note_left()
        return xml, meshes

    def _free(self, name: str, taken: set[str]) -> str:
        unique = next(n for n in (name, *(f"{name}_{i}" for i in range(2, 100_000))) if n not in taken)
        taken.add(unique)
        return unique

    def _pose(self, prim: Usd.Prim) -> Array:
        """Pose of a prim in the robot's, shape (4, 4)."""
        matrix, _ = self.cache.ComputeRelativeTransform(prim, self.robot)
        T = np.array(matrix, float).T
        scale = np.linalg.norm(T[:3, :3], axis=0)
        if not np.allclose(scale, 1, rtol=0, atol=SAME):
            raise InputError(
                f"{place(prim)}: is scaled, which no link of a URDF is; scale its shapes instead"
            )
        T[:3, :3] /= scale
        return T

    def _joints(self) -> list[_Joint]:
        """The stage's joints, those that hold sites, and floating ones for bodies that none holds."""
        taken = set[str]()
        found = [
            self._joint(prim, self._free(_name(prim), taken))
            for prim in Usd.PrimRange(self.robot)
            if prim.IsA(UsdPhysics.Joint) and UsdPhysics.Joint(prim).GetJointEnabledAttr().Get() is not False
        ]
        held = {joint.child for joint in found}
        bodies = [link for link in self.links.values() if link.body]
        free = [link for link in bodies if link.name not in held]
        base = free[0] if free else None
        for link in free[1:]:
            assert base is not None
            name = self._free(f"{link.name}_joint", taken)
            found.append(_Joint(name, "floating", base.name, link.name, _between(base.T, link.T)))
        for path, link in self.links.items():
            if link.body:
                continue
            above = next(
                (self.links[p] for p in path.GetAncestorsRange() if p != path and p in self.links), None
            )
            if above is None:
                raise InputError(
                    f"{place(link.prim)}: is a site on no body; put it below the one it rides on"
                )
            name = self._free(f"{link.name}_joint", taken)
            if (
                base is not None
                and above is base
                and _is_root(link.T)
                and not _is_root(base.T)
                and "" not in held
            ):
                held.add("")  # a frame on the floor, such as base_footprint, that the robot's prim is
                found.append(_Joint(name, "fixed", link.name, base.name, _between(link.T, base.T)))
            else:
                found.append(_Joint(name, "fixed", above.name, link.name, _between(above.T, link.T)))
        return found

    def _joint(self, prim: Usd.Prim, name: str) -> _Joint:
        joint, kind = UsdPhysics.Joint(prim), KINDS.get(prim.GetTypeName())
        if kind is None:
            raise InputError(f"{place(prim)}: URDF has no {prim.GetTypeName()}; known: {', '.join(KINDS)}")
        ends = [self._end(prim, rel) for rel in (joint.GetBody0Rel(), joint.GetBody1Rel())]
        parent, child = ends
        if child is None:
            raise InputError(f"{place(prim)}: its body1 is no link of the robot; swap the bodies")
        frames = [
            _frame(joint.GetLocalPos0Attr().Get(), joint.GetLocalRot0Attr().Get()),
            _frame(joint.GetLocalPos1Attr().Get(), joint.GetLocalRot1Attr().Get()),
        ]
        if kind != "fixed" and np.abs(frames[1][:3, 3]).max() > SAME:
            raise InputError(
                f"{place(prim)}: turns about a point of {child.name!r} that is not its origin, as every "
                "joint of a URDF does; move the body's frame there"
            )
        T = _between(np.eye(4) if parent is None else parent.T, child.T)
        made = _Joint(name, kind, WORLD if parent is None else parent.name, child.name, T)
        if kind == "fixed":
            return made
        token = self._token(prim, kind)
        made.axis = _tidy(frames[1][:3, "XYZ".index(token)], prim.GetCustomDataByKey(AXIS))
        if kind != "planar":
            self._figures(prim, made)
        value = _value(np.linalg.inv(frames[0]) @ T @ frames[1], token, kind)
        if made.mimic is not None and abs(value - made.mimic[2]) < AT_REST:
            value = made.mimic[2]  # it follows a leader that stands at 0
        if abs(value) > AT_REST:
            made.T = T @ _moved(made.axis, -value, kind)
        return made

    def _end(self, prim: Usd.Prim, relationship: Usd.Relationship) -> _Link | None:
        """The link that a joint holds; None for the world, and for the robot's prim, which stands for it."""
        targets = relationship.GetTargets()
        if not targets or targets[0] == self.robot.GetPath():
            return None
        if targets[0] not in self.links:
            raise InputError(
                f"{place(prim)}: holds <{targets[0]}>, which is no link of {self.robot.GetPath()}"
            )
        return self.links[targets[0]]

    def _token(self, prim: Usd.Prim, kind: str) -> str:
        """The axis X, Y or Z of a joint's frame that it moves along or about."""
        if kind != "planar":
            return str(prim.GetAttribute("physics:axis").Get())
        free = {
            axis
            for axis in (f"{motion}{letter}" for motion in ("trans", "rot") for letter in "XYZ")
            if not (limit := UsdPhysics.LimitAPI(prim, axis)) or not _locked(limit)
        }
        for token in "XYZ":
            if free == {f"rot{token}", *(f"trans{other}" for other in "XYZ" if other != token)}:
                return token
        raise InputError(f"{place(prim)}: is free along {', '.join(sorted(free))}, as no joint of a URDF is")

    def _figures(self, prim: Usd.Prim, joint: _Joint) -> None:
        """Limits, dynamics and mimic of a joint of one degree of freedom."""
        slides = joint.kind == "prismatic"
        unit, axis = (1.0, "linear") if slides else (math.pi / 180, "angular")
        ends = [prim.GetAttribute(f"physics:{end}Limit").Get() for end in ("lower", "upper")]
        if not slides and (None in ends or not np.isfinite(ends).all()):
            joint.kind = "continuous"
        else:
            joint.limit = {
                end: _shortest(value, unit) for end, value in zip(("lower", "upper"), ends, strict=True)
            }
        force = prim.GetAttribute(f"drive:{axis}:physics:maxForce").Get()
        speed = _first(prim, "newton:velocityLimit", "physxJoint:maxJointVelocity")
        for name, value in (("effort", force), ("velocity", speed)):
            if value is not None and math.isfinite(value):
                joint.limit[name] = _shortest(value, unit if name == "velocity" else 1.0)
        lost = [name for name in ("effort", "velocity") if name not in joint.limit]
        if joint.limit and lost and joint.kind != "continuous":
            self._note(
                f"the stage gives joint {joint.name!r} no {' nor '.join(lost)}, which urdfdom asks for"
            )
        for name, per in (("damping", 1 / unit), ("friction", 1.0)):
            value = prim.GetAttribute(f"newton:{name}").Get()
            if value is not None:
                joint.dynamics[name] = _shortest(value, per)
        leads = prim.GetRelationship("newton:mimicJoint")
        if leads and leads.GetTargets():
            leader = self.stage.GetPrimAtPath(leads.GetTargets()[0])
            offset, ratio = (float(prim.GetAttribute(f"newton:mimicCoef{i}").Get() or 0.0) for i in (0, 1))
            joint.mimic = (_name(leader), _shortest(ratio), _shortest(offset, unit))

    def _shapes(self) -> dict[str, list[Shape]]:
        """What is shown, and what collides, by the path of its gprim."""
        shapes: dict[str, list[Shape]] = {}
        for shape in read_shapes(self.stage, purposes=(*SHOWN, UsdGeom.Tokens.guide)):
            path = Sdf.Path(shape.prim)
            prim = self.stage.GetPrimAtPath(path)
            if prim and not prim.IsA(UsdGeom.Gprim):
                path = path.GetParentPath()  # a subset of it
            shapes.setdefault(str(path), []).append(shape)
        return shapes

    def _write_shapes(
        self,
        element: Element,
        path: Sdf.Path,
        link: _Link,
        shapes: dict[str, list[Shape]],
        meshes: dict[str, Array],
    ) -> None:
        for prim in Usd.PrimRange(link.prim, Usd.TraverseInstanceProxies()):
            if not prim.IsA(UsdGeom.Gprim) or str(prim.GetPath()) not in shapes:
                continue
            collides = prim.HasAPI(UsdPhysics.CollisionAPI)
            shown = UsdGeom.Imageable(prim).ComputePurpose() in SHOWN
            for role in (*(("visual",) if shown else ()), *(("collision",) if collides else ())):
                parts = shapes[str(prim.GetPath())]
                solid = self._primitive(prim, link)
                for shape in parts[:1] if solid is not None else parts:
                    own = ElementTree.SubElement(element, role, name=_shape_name(prim))
                    if solid is not None:
                        T, tag, sizes = solid
                        write_origin(own, T)
                        ElementTree.SubElement(ElementTree.SubElement(own, "geometry"), tag, sizes)
                    else:
                        name = f"{link.name}_{role}_{len(meshes)}.stl"
                        name = re.sub(r"[^\w.-]", "_", name)
                        meshes[name] = shape.vertices[shape.faces].astype(float)
                        geometry = ElementTree.SubElement(own, "geometry")
                        ElementTree.SubElement(geometry, "mesh", filename=f"{self.folder}/{name}")
                    if role == "visual":
                        self._write_colour(own, shape)

    def _write_colour(self, element: Element, shape: Shape) -> None:
        colour = np.array(shape.colour, float)
        if shape.vertex_colours is not None:
            colour[:3] = shape.vertex_colours.mean(axis=0)
            self._note("colours by vertex are their mean")
        rgba = " ".join(f"{v:.4g}" for v in [*srgb_from_linear(colour[:3]), colour[3]])
        material = ElementTree.SubElement(element, "material", name=f"rgba_{rgba.replace(' ', '_')}")
        ElementTree.SubElement(material, "color", rgba=rgba)

    def _primitive(self, prim: Usd.Prim, link: _Link) -> tuple[Array, str, dict[str, str]] | None:
        """Pose, tag and sizes of a gprim that URDF has a tag for; None where its triangles must do."""
        matrix, _ = self.cache.ComputeRelativeTransform(prim, link.prim)
        M = np.array(matrix, float).T
        scale = np.linalg.norm(M[:3, :3], axis=0)
        if scale.min() == 0 or np.linalg.det(M[:3, :3]) < 0:
            return None
        T = M.copy()
        T[:3, :3] /= scale
        if not np.allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), rtol=0, atol=1e-9):
            return None
        even = np.allclose(scale, scale[0], rtol=1e-9)
        if prim.IsA(UsdGeom.Cube):
            size = scale * float(UsdGeom.Cube(prim).GetSizeAttr().Get())
            return T, "box", {"size": _text(_shortest(v) for v in size)}
        if prim.IsA(UsdGeom.Sphere) and even:
            return T, "sphere", {"radius": _text([UsdGeom.Sphere(prim).GetRadiusAttr().Get() * scale[0]])}
        for schema, tag in ((UsdGeom.Cylinder, "cylinder"), (UsdGeom.Capsule, "capsule")):
            if not (prim.IsA(schema) and even):
                continue
            token = "XYZ".index(schema(prim).GetAxisAttr().Get())
            turn = np.eye(4)
            if token != 2:  # URDF's stand along z
                turn[:3, :3] = np.roll(np.eye(3), token + 1, axis=0)
            radius, height = (
                schema(prim).GetRadiusAttr().Get() * scale[0],
                schema(prim).GetHeightAttr().Get() * scale[0],
            )
            return T @ turn, tag, {"radius": _text([radius]), "length": _text([height])}
        return None

    def _note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)

    def _note_left(self) -> None:
        """Say what a URDF has no place for."""
        kinds = {
            prim.GetTypeName()
            for prim in Usd.PrimRange(self.robot)
            if prim.GetTypeName() in ("IsaacImuSensor", "OmniLidar", "Camera", "IsaacContactSensor")
        }
        applied = {
            api
            for prim in Usd.PrimRange(self.robot)
            for api in prim.GetPrimTypeInfo().GetAppliedAPISchemas()
            if api.startswith("Magtwin")
        }
        left = sorted(kinds | applied)
        if left:
            self._note(f"a URDF has no place for {', '.join(left)}")


def _name(prim: Usd.Prim) -> str:
    """What the description called a prim."""
    return str(prim.GetDisplayName() or prim.GetName())


def _shape_name(prim: Usd.Prim) -> str:
    """Name of a shape: its prim's, or that of the Xform that refers to a mesh."""
    parent = prim.GetParent()
    return str((parent if prim.IsInstanceProxy() and parent.IsInstance() else prim).GetName())


def _root(names: list[str], joints: list[_Joint], robot: Usd.Prim) -> str:
    """The link that no joint holds.

    Raises:
        InputError: A link is held by two joints, or the links are not one tree.
    """
    above: dict[str, str] = {}
    for joint in joints:
        if joint.child in above:
            raise InputError(
                f"{place(robot)}: {joint.child!r} is held by two joints, in a circle; a URDF is a tree"
            )
        above[joint.child] = joint.parent
    every = [*names, *(WORLD for joint in joints if joint.parent == WORLD and WORLD not in names)]
    roots = [name for name in dict.fromkeys(every) if name not in above]
    if len(roots) != 1:
        seen = ", ".join(roots) or "none"
        raise InputError(f"{place(robot)}: a URDF has one root link, found {seen}; join them")
    return roots[0]


def _is_root(T: Array) -> bool:
    return bool(np.allclose(T, np.eye(4), rtol=0, atol=1e-9))


def _between(T_above: Array, T_below: Array) -> Array:
    """Pose of one frame in another, both given in a third, shape (4, 4)."""
    R, p = T_above[:3, :3], T_above[:3, 3]
    T = np.eye(4)
    T[:3, :3] = R.T @ T_below[:3, :3]
    T[:3, 3] = R.T @ (T_below[:3, 3] - p)
    return T


def _frame(p: Any, q: Any) -> Array:
    """A joint's frame in a body, shape (4, 4), its turn brought to unit length in double precision."""
    T = np.eye(4)
    T[:3, 3] = [_shortest(v) for v in (p or (0, 0, 0))]
    if q is not None:
        xyzw = np.array([*q.GetImaginary(), q.GetReal()], float)
        T[:3, :3] = matrix_from_quat(xyzw / np.linalg.norm(xyzw))
    return T


def _tidy(axis: Array, told: Any) -> Array:
    """An axis from single precision: as it was told, or along the frame's own, where it is so to that."""
    for better in (np.round(axis), np.array(told if isinstance(told, Gf.Vec3d) else (0, 0, 0), float)):
        if np.abs(axis - better).max() < SAME and np.linalg.norm(better) > 0.5:
            return better
    return axis


def _value(M: Array, token: str, kind: str) -> float:
    """Value of a joint whose child's frame stands at M in its parent's [rad or m]."""
    i = "XYZ".index(token)
    if kind == "prismatic":
        return float(M[i, 3])
    if kind == "planar":
        return 0.0  # where it stands is its 0
    j, k = (i + 1) % 3, (i + 2) % 3
    return math.atan2(M[k, j] - M[j, k], M[j, j] + M[k, k])


def _moved(axis: Array, value: float, kind: str) -> Array:
    """Motion of a joint's child from its place at 0, shape (4, 4)."""
    T = np.eye(4)
    if kind == "prismatic":
        T[:3, 3] = value * axis
        return T
    K = np.cross(np.eye(3), axis)
    T[:3, :3] += math.sin(value) * K + (1 - math.cos(value)) * K @ K
    return T


def _locked(limit: UsdPhysics.LimitAPI) -> bool:
    low, high = limit.GetLowAttr().Get(), limit.GetHighAttr().Get()
    return low is not None and high is not None and low > high


def _first(prim: Usd.Prim, *names: str) -> float | None:
    values = (prim.GetAttribute(name).Get() for name in names)
    return next((float(value) for value in values if value is not None), None)


def _shortest(value: float, unit: float = 1.0) -> float:
    """The number of fewest digits that single precision holds as this one, in another unit."""
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
    """Numbers as text that reads back to 1e-15, without the last digits of arithmetic."""
    return " ".join(repr(round(float(v), 15) + 0.0).removesuffix(".0") for v in values)


def _rpy(R: Array) -> tuple[float, float, float]:
    """Roll, pitch and yaw of a rotation, R = Rz Ry Rx, each taken out before the next is read.

    So what one of them is ill told of at a pitch of 90 deg, the next makes good.
    """
    yaw = math.atan2(R[1, 0], R[0, 0]) if math.hypot(R[0, 0], R[1, 0]) > 1e-12 else 0.0
    c, s = math.cos(yaw), math.sin(yaw)
    R = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ R
    pitch = math.atan2(-R[2, 0], R[0, 0])
    c, s = math.cos(pitch), math.sin(pitch)
    R = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]) @ R
    return math.atan2(R[2, 1], R[1, 1]), pitch, yaw


def write_origin(element: Element, T: Array) -> None:
    """Tell an element's place by a child `origin`, none where it is that of its parent."""
    if not _is_root(T):
        ElementTree.SubElement(element, "origin", xyz=_text(T[:3, 3]), rpy=_text(_rpy(T[:3, :3])))


def _write_inertial(element: Element, prim: Usd.Prim) -> None:
    """Mass, centre and tensor of a body, where it says them."""
    if not prim.HasAPI(UsdPhysics.MassAPI):
        return
    api = UsdPhysics.MassAPI(prim)
    mass, centre = api.GetMassAttr().Get(), api.GetCenterOfMassAttr().Get()
    if not mass or not mass > 0:
        return
    inertial = ElementTree.SubElement(element, "inertial")
    if centre is not None and np.isfinite(centre).all() and any(centre):
        ElementTree.SubElement(inertial, "origin", xyz=_text(_shortest(v) for v in centre), rpy="0 0 0")
    ElementTree.SubElement(inertial, "mass", value=_text([_shortest(mass)]))
    moments = np.array([_shortest(v) for v in api.GetDiagonalInertiaAttr().Get() or (0, 0, 0)])
    if not moments.any():
        return  # engines find it from the colliders
    R, q = np.eye(3), api.GetPrincipalAxesAttr().Get()
    if q is not None and Gf.Quatd(q).GetLength() > 0.5 and q.GetImaginary().GetLength() > 0:
        R = _frame(None, q)[:3, :3]
    tensor = R @ np.diag(moments) @ R.T
    names = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
    ElementTree.SubElement(
        inertial, "inertia", {name: repr(float(tensor[at]) + 0.0) for name, at in names.items()}
    )


def _write_joint(xml: Element, joint: _Joint) -> None:
    element = ElementTree.SubElement(xml, "joint", name=joint.name, type=joint.kind)
    ElementTree.SubElement(element, "parent", link=joint.parent)
    ElementTree.SubElement(element, "child", link=joint.child)
    write_origin(element, joint.T)
    if joint.axis is not None:
        ElementTree.SubElement(element, "axis", xyz=_text(joint.axis))
    for tag, figures in (("limit", joint.limit), ("dynamics", joint.dynamics)):
        if figures:
            ElementTree.SubElement(element, tag, {name: _text([value]) for name, value in figures.items()})
    if joint.mimic is not None:
        leader, ratio, offset = joint.mimic
        ElementTree.SubElement(
            element, "mimic", joint=leader, multiplier=_text([ratio]), offset=_text([offset])
        )


def _stl(triangles: Array) -> bytes:
    """Triangles (T, 3, 3) as binary STL."""
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    rows = np.zeros(len(triangles), record)
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    rows["normal"] = np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)
    rows["corners"] = triangles
    return bytes(80) + np.uint32(len(rows)).astype("<u4").tobytes() + rows.tobytes()
