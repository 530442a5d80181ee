"""Report of a conversion: every link, joint and geometry, in the description and on the stage."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pxr import Sdf, Usd, UsdGeom, UsdPhysics

from magtwin.errors import InputError
from magtwin.report import Figure, Report
from magtwin.urdf.description.description import Description, origin_of
from magtwin.urdf.description.model import Geometry, Joint, Link, Shape
from magtwin.urdf.meshes.mesh import bounds
from magtwin.urdf.meshes.mesh_layer import MeshLayer
from magtwin.usd.geometry import read_vertices

Box = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Least and greatest corner of what bounds a shape, axis-aligned in the robot's frame [m]."""

BOX_TOLERANCE = 1e-5
"""How far a box may be off, as part of its diagonal, before it counts as changed: 32-bit vertices."""

ROUND_TOLERANCE = 0.01
"""The same for a sphere, cylinder or capsule, which comes from the stage as a polygon of 32 sides:
1 - cos(pi / 32) is 0.5 % of its radius."""


@dataclass(frozen=True)
class LinkLine:
    """A link, in and out."""

    name: str
    became: str
    """"body", "frame" (a site on another body), "merged" or "nothing"."""
    prim: str
    """Path of its prim; "" for none."""
    mass_in_kg: float | None
    mass_out_kg: float | None


@dataclass(frozen=True)
class JointLine:
    """A joint, in and out."""

    name: str
    type_in: str
    type_out: str
    """Type of its prim; "" where none holds its link, as with frames and merged links."""
    prim: str


@dataclass(frozen=True)
class GeometryLine:
    """A visual or collider, in and out."""

    link: str
    role: str
    """"visual" or "collision"."""
    index: int
    """Which of its link's it is, from 0."""
    shape: str
    """"box", "sphere", "cylinder", "capsule", or the name of the mesh's file."""
    prims: tuple[str, ...]
    box_in: Box | None
    """None where the mesh could not be read."""
    box_out: Box | None
    """None where nothing of it is on the stage."""

    @property
    def error_m(self) -> float:
        """Greatest distance between the coordinates of both boxes [m]; infinite where one is missing."""
        if self.box_in is None or self.box_out is None:
            return np.inf
        return float(np.abs(np.subtract(self.box_in, self.box_out)).max())

    @property
    def kept(self) -> bool:
        """Whether what arrived fills the box that was sent."""
        if self.box_in is None or self.box_out is None:
            return False
        diagonal = float(np.linalg.norm(np.subtract(*self.box_in)))
        rounded = self.shape in ("sphere", "cylinder", "capsule")
        return self.error_m <= (ROUND_TOLERANCE if rounded else BOX_TOLERANCE) * diagonal + 1e-9


@dataclass(frozen=True)
class ConversionReport:
    """What a conversion read, what it wrote, and what it changed on the way."""

    robot: str
    source: str
    """Name of the description's file."""
    source_sha256: str
    stage: str
    """Name of the root layer."""
    links: tuple[LinkLine, ...]
    joints: tuple[JointLine, ...]
    geometries: tuple[GeometryLine, ...]
    mass_in_kg: float
    mass_out_kg: float
    box_in: Box | None
    """What bounds every visual, in the description."""
    box_out: Box | None
    """What bounds every visual, on the stage."""
    notes: tuple[str, ...]
    """What was repaired, guessed or left out, one line each."""
    losses: tuple[str, ...]
    """What the stage has less of than the description, one line each."""
    lint: tuple[str, ...]
    """What is doubtful in the description itself, one line each."""
    unknown_tags: Mapping[str, int] = field(default_factory=dict)
    """How often each tag was met that has no meaning here and is kept as text."""

    def to_json(self) -> str:
        """The report as one JSON object."""
        return json.dumps(dataclasses.asdict(self), indent=2) + "\n"

    def summary(self) -> Report:
        """The report in figures, for a terminal."""
        bodies = sum(line.became == "body" for line in self.links)
        kept = sum(line.kept for line in self.geometries)
        moving = [line for line in self.joints if line.type_out not in ("", "PhysicsFixedJoint")]
        figures = [
            Figure("links", len(self.links), note=f"{bodies} bodies, the rest frames on them"),
            Figure("joints", len(self.joints), note=f"{len(moving)} move"),
            Figure("shapes", len(self.geometries), note=f"{kept} with their true bounding box"),
            Figure("mass", round(self.mass_out_kg, 6), "kg", note=f"{self.mass_in_kg:.6g} kg in the URDF"),
        ]
        if self.box_out is not None:
            size = np.subtract(self.box_out[1], self.box_out[0])
            figures.append(Figure("size", " x ".join(f"{v:.3f}" for v in size), "m"))
        figures += [
            Figure("unknown tags", sum(self.unknown_tags.values()), note="kept as text"),
            Figure("notes", len(self.notes)),
            Figure("losses", len(self.losses)),
            Figure("doubts about the description", len(self.lint)),
        ]
        metadata = {
            "source": self.source,
            "sha256": self.source_sha256,
            "losses": list(self.losses),
            "notes": list(self.notes),
            "lint": list(self.lint),
        }
        return Report(f"{self.robot}: {self.source} -> {self.stage}", tuple(figures), metadata)

    def refuse_losses(self) -> None:
        """Go on only if nothing was lost.

        Raises:
            InputError: Something was; the text has the first loss and says how many there are.
        """
        if self.losses:
            more = len(self.losses) - 1
            others = f" (and {more} more)" if more else ""
            raise InputError(
                f"{self.source}: {self.losses[0]}{others}; convert without --strict to accept that"
            )


@dataclass
class Ledger:
    """What is authored for what, put down while a robot is authored."""

    bodies: dict[str, tuple[str, Sdf.Path]] = field(default_factory=dict)
    """What each link became, see LinkLine, and its prim, by name of the link."""

    joints: dict[str, Sdf.Path] = field(default_factory=dict)
    """Prim of each joint that has one, by its name."""

    shapes: dict[tuple[str, str, int], list[Sdf.Path]] = field(default_factory=dict)
    """Prims of each geometry, by link, role and index."""

    unknown_tags: dict[str, int] = field(default_factory=dict)
    """How often each tag was met that has no meaning here."""

    def link(self, name: str, became: str, prim: Usd.Prim) -> None:
        """Put down a link's prim."""
        self.bodies[name] = (became, prim.GetPath())

    def joint(self, name: str, prim: Usd.Prim) -> None:
        """Put down a joint's prim."""
        self.joints[name] = prim.GetPath()

    def shape(self, link: str, role: str, index: int, prims: Sequence[Usd.Prim]) -> None:
        """Put down the prims of a visual or collider."""
        self.shapes[link, role, index] = [prim.GetPath() for prim in prims]


def make_report(
    description: Description,
    meshes: MeshLayer,
    stage: Usd.Stage,
    ledger: Ledger,
    *,
    name: str,
    sha256: str,
    poses: Mapping[str, NDArray[np.float64]] | None = None,
    lint: tuple[str, ...] = (),
) -> ConversionReport:
    """Compare a description with the stage that was made of it.

    Boxes on the stage are those of its vertices, read back as a viewer reads them; boxes of the
    description are those of its mesh files' vertices and of its primitives, placed by its own joints.

    Args:
        description: What was read; its notes are taken over.
        meshes: Its mesh files.
        stage: What was authored.
        ledger: Which prim stands for what.
        name: Name of the root layer.
        sha256: Checksum of the description's file.
        poses: T_root_link of each link as the robot is authored, (4, 4); each joint at 0 unless given.
        lint: Lines of `lint.lint`.
    """
    lines = _geometries(description, meshes, stage, ledger, poses or description.poses())
    links = tuple(_link(name_, link, stage, ledger) for name_, link in description.links.items())
    joints = tuple(_joint(joint, stage, ledger) for joint in description.joints.values())
    visuals = [line for line in lines if line.role == "visual"]
    mass_in = sum(line.mass_in_kg or 0.0 for line in links)
    mass_out = sum(
        float(UsdPhysics.MassAPI(prim).GetMassAttr().Get() or 0.0)
        for prim in stage.Traverse()
        if prim.HasAPI(UsdPhysics.MassAPI)
    )
    losses = list(description.dropped)
    losses += [f"link {line.name!r} has no prim" for line in links if line.became == "nothing"]
    for line in lines:
        if line.box_in is not None and not line.kept:
            what = "did not arrive" if line.box_out is None else f"changed its box by {line.error_m:.3g} m"
            losses.append(f"{line.role} {line.index} of link {line.link!r} ({line.shape}) {what}")
    if abs(mass_out - mass_in) > 1e-6 * max(mass_in, 1e-9) and mass_out < mass_in:
        losses.append(f"mass {mass_in:.6g} kg became {mass_out:.6g} kg")
    return ConversionReport(
        robot=description.name,
        source=description.path.name,
        source_sha256=sha256,
        stage=name,
        links=links,
        joints=joints,
        geometries=lines,
        mass_in_kg=round(mass_in, 9),
        mass_out_kg=round(mass_out, 9),
        box_in=_union([line.box_in for line in visuals]),
        box_out=_union([line.box_out for line in visuals]),
        notes=tuple(description.notes),
        losses=tuple(dict.fromkeys(losses)),
        lint=tuple(lint),
        unknown_tags=dict(sorted(ledger.unknown_tags.items())),
    )


def _link(name: str, link: Link, stage: Usd.Stage, ledger: Ledger) -> LinkLine:
    became, path = ledger.bodies.get(name, ("nothing", Sdf.Path.emptyPath))
    mass_in = None if link.inertial is None else link.inertial.mass
    mass_out = None
    if became == "body":
        api = UsdPhysics.MassAPI(stage.GetPrimAtPath(path))
        mass_out = float(api.GetMassAttr().Get()) if api and api.GetMassAttr().HasAuthoredValue() else None
    return LinkLine(
        name=name,
        became=became,
        prim=str(path),
        mass_in_kg=None if mass_in is None else float(mass_in),
        mass_out_kg=None if mass_out is None else round(mass_out, 9),
    )


def _joint(joint: Joint, stage: Usd.Stage, ledger: Ledger) -> JointLine:
    path = ledger.joints.get(joint.name)
    if path is None:
        return JointLine(name=joint.name, type_in=joint.type, type_out="", prim="")
    kind = str(stage.GetPrimAtPath(path).GetTypeName())
    return JointLine(name=joint.name, type_in=joint.type, type_out=kind, prim=str(path))


def _geometries(
    description: Description,
    meshes: MeshLayer,
    stage: Usd.Stage,
    ledger: Ledger,
    poses: Mapping[str, NDArray],
) -> tuple[GeometryLine, ...]:
    """A line for each visual and collider."""
    boxes, lines = _boxes(stage), []
    for name, link in description.links.items():
        for role, shapes in (("visual", link.visuals), ("collision", link.collisions)):
            for index, shape in enumerate(shapes):
                prims = ledger.shapes.get((name, role, index), [])
                lines.append(
                    GeometryLine(
                        link=name,
                        role=role,
                        index=index,
                        shape=_kind(shape.geometry),
                        prims=tuple(map(str, prims)),
                        box_in=_box_of(shape, poses[name] @ origin_of(shape), meshes),
                        box_out=_union(
                            [box for prim in prims for path, box in boxes.items() if path.HasPrefix(prim)]
                        ),
                    )
                )
    return tuple(lines)


def _kind(geometry: Geometry) -> str:
    """What a URDF `<geometry>` is, in a word."""
    if geometry.mesh is not None:
        return str(geometry.mesh.filename).rpartition("/")[2]
    return geometry.kind


def _box_of(shape: Shape, T: NDArray[np.float64], meshes: MeshLayer) -> Box | None:
    """What bounds a URDF visual or collision at a pose (4, 4) in the robot's frame."""
    geometry = shape.geometry
    if geometry.mesh is not None:
        try:
            points = meshes.vertices(geometry.mesh)
        except (InputError, KeyError):
            return None  # missing, and noted as that
        placed = points @ T[:3, :3].T + T[:3, 3]
        return _corners(*bounds(placed))
    R, p = T[:3, :3], T[:3, 3]
    if geometry.box is not None:
        half = np.abs(R) @ (np.asarray(geometry.box.size, float) / 2)
    elif geometry.sphere is not None:
        half = np.full(3, float(geometry.sphere.radius))
    elif geometry.cylinder is not None:
        # a disc of radius r with normal n reaches r sqrt(1 - n_i^2) along axis i
        n, r = R[:, 2], float(geometry.cylinder.radius)
        half = r * np.sqrt(np.clip(1 - n**2, 0, 1)) + np.abs(n) * float(geometry.cylinder.length) / 2
    else:
        capsule = getattr(geometry, "capsule", None)
        if capsule is None:
            return None
        half = float(capsule.radius) + np.abs(R[:, 2]) * float(capsule.length) / 2
    return _corners(p - half, p + half)


def _boxes(stage: Usd.Stage) -> dict[Sdf.Path, Box]:
    """What bounds each gprim of a stage, colliders included, in the frame of its default prim."""
    to_robot = UsdGeom.XformCache().GetLocalToWorldTransform(stage.GetDefaultPrim()).GetInverse()
    bodies = {str(p.GetPath()): p for p in stage.Traverse() if p.HasAPI(UsdPhysics.RigidBodyAPI)}
    by_name = {p.GetName(): p for p in bodies.values()} | bodies
    cache, boxes = UsdGeom.XformCache(), {}
    tokens = UsdGeom.Tokens
    shown = read_vertices(stage, purposes=(tokens.default_, tokens.render, tokens.guide))
    for path, (link, vertices) in shown.items():
        points = vertices.astype(float)
        if link:
            T = np.array(cache.GetLocalToWorldTransform(by_name[link]) * to_robot)
            points = points @ T[:3, :3] + T[3, :3]
        boxes[path] = _corners(*bounds(points))
    return boxes


def _union(boxes: Sequence[Box | None]) -> Box | None:
    """What bounds all boxes; None where there is none."""
    there = np.array([box for box in boxes if box is not None])
    return _corners(there[:, 0].min(0), there[:, 1].max(0)) if len(there) else None


def _corners(least: NDArray, greatest: NDArray) -> Box:
    """A box, rounded to a nanometre."""
    low, high = (tuple(round(float(v), 9) + 0.0 for v in corner) for corner in (least, greatest))
    return low, high  # type: ignore[return-value]
