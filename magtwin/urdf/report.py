"""Report: every link, joint and geometry of a conversion, in the description and on the stage."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pxr import Sdf, Usd, UsdGeom, UsdPhysics

from magtwin.errors import InputError
from magtwin.report.report import Figure, Report
from magtwin.urdf.description.description import Description, origin_of
from magtwin.urdf.description.model import Shape
from magtwin.urdf.meshes.mesh import bounds
from magtwin.urdf.meshes.mesh_layer import MeshLayer
from magtwin.urdf.physics.mass import engine_masses
from magtwin.urdf.repairs import FAULTS, UNKNOWN, Repair
from magtwin.usd.geometry import read_vertices

Box = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Lower and upper corner of an axis-aligned box in the robot's frame [m]."""

BOX_TOLERANCE = 1e-5
"""Allowed error of a box relative to its diagonal, for vertices in single precision."""

ROUND_TOLERANCE = 0.01
"""The same for a sphere, cylinder or capsule, which the stage shows as a polygon of 32 sides:
1 - cos(pi / 32) is 0.5 % of its radius."""


PLACES, LINES = 3, 8
"""Most places of one kind of fault, and most guesses and doubts, that the terminal shows."""

ADDED = 1e-3
"""Share of the URDF's mass above which a note gives the mass that links without mass add."""


@dataclass(frozen=True)
class LinkLine:
    """A link before and after."""

    name: str
    became: str
    """"body", "frame" (a site on another body), "merged" or "nothing"."""
    prim: str
    """Path of its prim, or ""."""
    mass_in_kg: float | None
    mass_out_kg: float | None
    """Mass of its body as physics engines compute it, with all merged links; None if it is not a body."""


@dataclass(frozen=True)
class JointLine:
    """A joint before and after."""

    name: str
    type_in: str
    type_out: str
    """Type of its prim; "" if it has none, as for frames and merged links."""
    prim: str


@dataclass(frozen=True)
class GeometryLine:
    """A visual or collider before and after."""

    link: str
    role: str
    """"visual" or "collision"."""
    index: int
    """Index within its link and role, from 0."""
    shape: str
    """"box", "sphere", "cylinder", "capsule", or the name of the mesh's file."""
    prims: tuple[str, ...]
    box_in: Box | None
    """None if the mesh could not be read."""
    box_out: Box | None
    """None if it is not on the stage."""

    @property
    def error_m(self) -> float:
        """Largest difference between coordinates of the two boxes [m]; infinite if one is missing."""
        if self.box_in is None or self.box_out is None:
            return np.inf
        return float(np.abs(np.subtract(self.box_in, self.box_out)).max())

    @property
    def kept(self) -> bool:
        """Whether the box is unchanged."""
        if self.box_in is None or self.box_out is None:
            return False
        diagonal = float(np.linalg.norm(np.subtract(*self.box_in)))
        rounded = self.shape in ("sphere", "cylinder", "capsule")
        return self.error_m <= (ROUND_TOLERANCE if rounded else BOX_TOLERANCE) * diagonal + 1e-9


@dataclass(frozen=True)
class RepairLine:
    """All faults of one kind."""

    kind: str
    """A key of `repairs.FAULTS`, or "loss"."""
    fault: str
    done: str
    """What was done about each."""
    count: int
    entries: tuple[Repair, ...]
    """Each fault, with file and line."""

    @property
    def places(self) -> str:
        """The first places, or the first text if no place is known."""
        places = list(dict.fromkeys(entry.place for entry in self.entries if entry.place))
        more = f" and {len(places) - PLACES} more" if len(places) > PLACES else ""
        return ", ".join(places[:PLACES]) + more if places else self.entries[0].text


@dataclass(frozen=True)
class ConversionReport:
    """What a conversion read, wrote and changed."""

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
    """Mass as physics engines compute it, see `engine_masses`."""
    box_in: Box | None
    """Box of all visuals in the description."""
    box_out: Box | None
    """Box of all visuals on the stage."""
    repairs: tuple[RepairLine, ...]
    """Faults of the description by kind; `Options.strict` refuses each."""
    supply: str
    """Options of the command line that would supply what is missing."""
    notes: tuple[str, ...]
    """Repairs, guesses and omissions, one line each."""
    losses: tuple[str, ...]
    """Contents of the description that the stage lacks, one line each."""
    lint: tuple[str, ...]
    """Doubtful values in the description, one line each."""
    unknown_tags: Mapping[str, int] = field(default_factory=dict)
    """Number of occurrences of each tag, and attribute as `@name`, that is known and kept as text."""

    @property
    def _faults(self) -> frozenset[str]:
        """Texts of all repairs and losses."""
        return frozenset(entry.text for line in self.repairs for entry in line.entries)

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
            Figure(
                "mass",
                round(self.mass_out_kg, 6),
                "kg",
                note=f"in engines; {self.mass_in_kg:.6g} kg in the URDF",
            ),
        ]
        if self.box_out is not None:
            size = np.subtract(self.box_out[1], self.box_out[0])
            figures.append(Figure("size", " x ".join(f"{v:.3f}" for v in size), "m"))
        figures += [
            Figure(line.fault, line.count, note=f"{line.done}: {line.places}".lstrip(": "))
            for line in self.repairs
        ]
        faults = self._faults
        guesses = [note for note in self.notes if note not in faults]
        figures += [
            Figure("tags and attributes without a use", sum(self.unknown_tags.values()), note="kept as text"),
            Figure("guesses", len(guesses)),
            Figure("doubts about the description", len(self.lint)),
        ]
        metadata: dict[str, str | list[str]] = {
            "source": self.source,
            "sha256": self.source_sha256,
            "to supply what is missing": self.supply,
        }
        unknown = [
            f"{entry.place}: {entry.text}"
            for line in self.repairs
            for entry in line.entries
            if line.kind in UNKNOWN
        ]
        lists = {
            "unknown": _first(unknown),
            "losses": _first(self.losses),
            "guesses": _first(guesses),
            "doubts": _first(self.lint),
        }
        metadata |= {name: lines for name, lines in lists.items() if lines}
        return Report(f"{self.robot}: {self.source} -> {self.stage}", tuple(figures), metadata)


@dataclass
class Ledger:
    """The prims authored for each part of a description."""

    bodies: dict[str, tuple[str, Sdf.Path]] = field(default_factory=dict)
    """Kind (see LinkLine) and prim by link name."""

    joints: dict[str, Sdf.Path] = field(default_factory=dict)
    """Prim by joint name; floating joints have none."""

    shapes: dict[tuple[str, str, int], list[Sdf.Path]] = field(default_factory=dict)
    """Prims of each geometry, by link, role and index."""

    unknown_tags: dict[str, int] = field(default_factory=dict)
    """Number of occurrences of each known tag or attribute without a meaning here."""


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
    """Compare a description with its stage.

    Boxes on the stage bound its vertices, as a viewer reads them. Boxes of the description bound the vertices
    of its mesh files and its primitives, placed by its joints.

    Args:
        description: The description, with its notes.
        meshes: Its mesh files.
        stage: The authored stage.
        ledger: Prims of each part.
        name: Name of the root layer.
        sha256: Checksum of the description's file.
        poses: T_root_link of each link as authored, (4, 4). Default: all joints at 0.
        lint: Lines of `lint.lint`.
    """
    lines = _geometries(description, meshes, stage, ledger, poses or description.poses())
    links, joints, masses = [], [], engine_masses(stage)
    for link in description.links.values():
        became, path = ledger.bodies.get(link.name, ("nothing", Sdf.Path.emptyPath))
        mass_out = round(masses[path], 9) if path in masses and became == "body" else None
        mass_in = None if link.inertial is None else link.inertial.mass
        links.append(LinkLine(link.name, became, str(path), mass_in, mass_out))
    for joint in description.joints.values():
        path = ledger.joints.get(joint.name, Sdf.Path.emptyPath)
        kind = str(stage.GetPrimAtPath(path).GetTypeName()) if path else ""
        joints.append(JointLine(joint.name, joint.type, kind, str(path)))
    visuals = [line for line in lines if line.role == "visual"]
    given = sum(line.mass_in_kg or 0.0 for line in links)
    total = sum(masses.values())
    losses = [f"link {line.name!r} has no prim" for line in links if line.became == "nothing"]
    for line in lines:
        plate = meshes.flat.get(line.shape, 0.0) if line.role == "collision" else 0.0
        if line.box_in is not None and not line.kept and not (plate and line.error_m <= plate):
            what = "did not arrive" if line.box_out is None else f"changed its box by {line.error_m:.3g} m"
            losses.append(f"{line.role} {line.index} of link {line.link!r} ({line.shape}) {what}")
    if given - total > 1e-6 * max(given, 1e-9):
        losses.append(f"mass {given:.6g} kg became {total:.6g} kg")
    for loss in losses:
        description.note(loss, lost=True)
    if total > (1 + ADDED) * given > 0:
        description.note(
            f"physics engines compute {total:.6g} kg, {total / given - 1:.2%} above the URDF's mass"
        )
    repairs = description.repairs
    return ConversionReport(
        robot=description.name,
        source=description.path.name,
        source_sha256=sha256,
        stage=name,
        links=tuple(links),
        joints=tuple(joints),
        geometries=lines,
        mass_in_kg=round(given, 9),
        mass_out_kg=round(total, 9),
        box_in=_union([line.box_in for line in visuals]),
        box_out=_union([line.box_out for line in visuals]),
        repairs=tuple(
            RepairLine(kind, *FAULTS.get(kind, ("left out", "")), len(entries), tuple(entries))
            for kind, entries in repairs.by_kind().items()
        ),
        supply=" ".join(repairs.supplies),
        notes=repairs.notes,
        losses=repairs.losses,
        lint=tuple(lint),
        unknown_tags=dict(sorted(ledger.unknown_tags.items())),
    )


def _geometries(
    description: Description,
    meshes: MeshLayer,
    stage: Usd.Stage,
    ledger: Ledger,
    poses: Mapping[str, NDArray],
) -> tuple[GeometryLine, ...]:
    below: dict[Sdf.Path, list[Box]] = {prim: [] for prims in ledger.shapes.values() for prim in prims}
    for path, box in _boxes(stage, set(below)).items():
        for prim in path.GetPrefixes():
            if prim in below:
                below[prim].append(box)
    lines = []
    for name, link in description.links.items():
        for role, shapes in (("visual", link.visuals), ("collision", link.collisions)):
            for index, shape in enumerate(shapes):
                prims, form = ledger.shapes.get((name, role, index), []), shape.geometry
                box_in = _box_of(shape, poses[name] @ origin_of(shape), meshes)
                box_out = [box for prim in prims for box in below[prim]]
                kind = form.filename.rpartition("/")[2] if form.kind == "mesh" else form.kind
                paths = tuple(map(str, prims))
                lines.append(GeometryLine(name, role, index, kind, paths, box_in, _union(box_out)))
    return tuple(lines)


def _box_of(shape: Shape, T: NDArray[np.float64], meshes: MeshLayer) -> Box | None:
    """The box around a URDF visual or collision at a pose (4, 4) in the robot's frame."""
    if shape.geometry.kind != "mesh":
        half = shape.geometry.half_extents(T[:3, :3])
        return _corners(T[:3, 3] - half, T[:3, 3] + half)
    try:
        points = meshes.vertices(shape.geometry)
    except (InputError, KeyError):
        return None  # missing, with a note
    return _corners(*bounds(points @ T[:3, :3].T + T[:3, 3]))


def _boxes(stage: Usd.Stage, prims: set[Sdf.Path]) -> dict[Sdf.Path, Box]:
    """The box around each gprim at or below `prims`, in the frame of the default prim."""
    to_robot = UsdGeom.XformCache().GetLocalToWorldTransform(stage.GetDefaultPrim()).GetInverse()
    bodies = {str(p.GetPath()): p for p in stage.Traverse() if p.HasAPI(UsdPhysics.RigidBodyAPI)}
    by_name = {p.GetName(): p for p in bodies.values()} | bodies
    cache, boxes = UsdGeom.XformCache(), {}
    tokens = UsdGeom.Tokens
    shown = read_vertices(
        stage,
        purposes=(tokens.default_, tokens.render, tokens.guide),
        wanted=lambda prim, _: not prims.isdisjoint(prim.GetPath().GetPrefixes()),
    )
    for path, (link, vertices) in shown.items():
        points = vertices.astype(float)
        if link:
            T = np.array(cache.GetLocalToWorldTransform(by_name[link]) * to_robot)
            points = points @ T[:3, :3] + T[3, :3]
        boxes[path] = _corners(*bounds(points))
    return boxes


def _first(lines: Sequence[str]) -> list[str]:
    """The first lines, and how many are left."""
    left = len(lines) - LINES
    return (
        list(lines) if left <= 1 else [*lines[:LINES], f"and {left} more; the report of --report lists all"]
    )


def _union(boxes: Sequence[Box | None]) -> Box | None:
    """The box around all boxes; None if there is none."""
    there = np.array([box for box in boxes if box is not None])
    return _corners(there[:, 0].min(0), there[:, 1].max(0)) if len(there) else None


def _corners(least: NDArray, greatest: NDArray) -> Box:
    """A box, rounded to a nanometre."""
    low, high = (tuple(round(float(v), 9) + 0.0 for v in corner) for corner in (least, greatest))
    return low, high  # type: ignore[return-value]
