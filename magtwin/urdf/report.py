"""Report: every link and joint of a conversion, in the description and on the stage."""

import csv
import dataclasses
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdPhysics

from magtwin.report.report import Figure, Report
from magtwin.urdf.description.description import Description, Element
from magtwin.urdf.description.model import Shape
from magtwin.urdf.repairs import FAULTS, UNKNOWN, Repair
from magtwin.usd.geometry import read_vertices

Box = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Lower and upper corner of an axis-aligned box in the robot's frame [m]."""

HUGE_M = 30.0
"""Size of a robot above which its meshes are probably in millimetres [m]."""

FATES = ("used", "text", "repaired", "lost")
"""Every element and attribute has one: a prim carries it; it is kept as text; a repair changed it or left it
out; nothing carries it."""

PLACES, LINES = 3, 8
"""Most places of one kind of fault, and most guesses, that the terminal shows."""


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
    """Mass of its body, with all merged links; None if it is not a body."""


@dataclass(frozen=True)
class JointLine:
    """A joint before and after."""

    name: str
    type_in: str
    type_out: str
    """Type of its prim; "" if it has none, as for frames and merged links."""
    prim: str


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
class ProofLine:
    """An element, or an attribute of one."""

    place: str
    """`file:line`."""
    item: str
    """Path of elements, with `@attribute` at its end if it is one."""
    value: str
    """Value of the attribute."""
    fate: str
    """See `FATES`."""
    prim: str
    """Prim that carries it."""
    carried: str
    """Property and value of the prim, the repair, or the reason why nothing carries it."""


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
    mass_in_kg: float
    mass_out_kg: float
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
    unknown_tags: Mapping[str, int] = field(default_factory=dict)
    """Number of occurrences of each tag, and attribute as `@name`, that is known and kept as text."""
    proof: tuple[ProofLine, ...] = ()
    """What became of each element and attribute, with `Options.proof`."""

    def to_json(self) -> str:
        """The report as one JSON object."""
        return json.dumps(dataclasses.asdict(self), indent=2) + "\n"

    def proof_table(self) -> str:
        """The proof as CSV."""
        text = io.StringIO()
        rows = csv.writer(text, lineterminator="\n")
        rows.writerow([field.name for field in dataclasses.fields(ProofLine)])
        rows.writerows(map(dataclasses.astuple, self.proof))
        return text.getvalue()

    def summary(self) -> Report:
        """The report in figures, for a terminal."""
        bodies = sum(line.became == "body" for line in self.links)
        moving = [line for line in self.joints if line.type_out not in ("", "PhysicsFixedJoint")]
        figures = [
            Figure("links", len(self.links), note=f"{bodies} bodies, the rest frames on them"),
            Figure("joints", len(self.joints), note=f"{len(moving)} move"),
            Figure("mass", round(self.mass_out_kg, 6), "kg", note=f"{self.mass_in_kg:.6g} kg in the URDF"),
        ]
        if self.box_out is not None:
            size = np.subtract(self.box_out[1], self.box_out[0])
            figures.append(Figure("size", " x ".join(f"{v:.3f}" for v in size), "m"))
        figures += [
            Figure(line.fault, line.count, note=f"{line.done}: {line.places}".lstrip(": "))
            for line in self.repairs
        ]
        faults = {entry.text for line in self.repairs for entry in line.entries}
        guesses = [note for note in self.notes if note not in faults]
        figures += [
            Figure("tags and attributes without a use", sum(self.unknown_tags.values()), note="kept as text"),
            Figure("guesses", len(guesses)),
        ]
        if self.proof:
            counted = ", ".join(f"{sum(line.fate == fate for line in self.proof)} {fate}" for fate in FATES)
            figures.append(Figure("elements and attributes", len(self.proof), note=counted))
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

    visuals: set[Sdf.Path] = field(default_factory=set)

    shapes: dict[Element, Sdf.Path] = field(default_factory=dict)
    """Prim by the checked element of a visual or collision."""

    unknown_tags: dict[str, int] = field(default_factory=dict)
    """Number of occurrences of each known tag or attribute without a meaning here."""

    def show(self, shape: Shape, prim: Usd.Prim) -> None:
        """Keep the prim of a visual or collision."""
        if shape.element is not None:
            self.shapes[shape.element] = prim.GetPath()


def make_report(
    description: Description, stage: Usd.Stage, ledger: Ledger, *, name: str, sha256: str
) -> ConversionReport:
    """Compare a description with its stage.

    Args:
        description: The description, with its notes.
        stage: The authored stage.
        ledger: Prims of each part.
        name: Name of the root layer.
        sha256: Checksum of the description's file.
    """
    links, joints = [], []
    for link in description.links.values():
        became, path = ledger.bodies.get(link.name, ("nothing", Sdf.Path.emptyPath))
        mass_in = None if link.inertial is None else link.inertial.mass
        mass_out = None
        if became == "body":
            mass_out = round(float(UsdPhysics.MassAPI(stage.GetPrimAtPath(path)).GetMassAttr().Get()), 9)
        links.append(LinkLine(link.name, became, str(path), mass_in, mass_out))
    for joint in description.joints.values():
        path = ledger.joints.get(joint.name, Sdf.Path.emptyPath)
        kind = str(stage.GetPrimAtPath(path).GetTypeName()) if path else ""
        joints.append(JointLine(joint.name, joint.type, kind, str(path)))
    box = _box(stage, ledger.visuals)
    size = np.zeros(3) if box is None else np.subtract(box[1], box[0])
    if size.max() > HUGE_M:
        description.note(
            f"the robot is {' x '.join(f'{side:.4g}' for side in size)} m large; are its meshes in mm? then "
            '<mesh scale="0.001 0.001 0.001" .../>'
        )
    repairs = description.repairs
    return ConversionReport(
        robot=description.name,
        source=description.path.name,
        source_sha256=sha256,
        stage=name,
        links=tuple(links),
        joints=tuple(joints),
        mass_in_kg=round(sum(line.mass_in_kg or 0.0 for line in links), 9),
        mass_out_kg=round(sum(line.mass_out_kg or 0.0 for line in links), 9),
        box_out=box,
        repairs=tuple(
            RepairLine(kind, *FAULTS.get(kind, ("left out", "")), len(entries), tuple(entries))
            for kind, entries in repairs.by_kind().items()
        ),
        supply=" ".join(repairs.supplies),
        notes=repairs.notes,
        losses=repairs.losses,
        unknown_tags=dict(sorted(ledger.unknown_tags.items())),
    )


def _box(stage: Usd.Stage, visuals: set[Sdf.Path]) -> Box | None:
    """The box around all visuals in the frame of the default prim, rounded to a nanometre; None for none."""
    cache = UsdGeom.XformCache()
    to_robot = cache.GetLocalToWorldTransform(stage.GetDefaultPrim()).GetInverse()
    bodies = {str(p.GetPath()): p for p in stage.Traverse() if p.HasAPI(UsdPhysics.RigidBodyAPI)}
    by_name = {p.GetName(): p for p in bodies.values()} | bodies
    shown = read_vertices(stage, wanted=lambda prim, _: not visuals.isdisjoint(prim.GetPath().GetPrefixes()))
    ends = []
    for link, vertices in shown.values():
        points = vertices.astype(float)
        if link:
            T = np.array(cache.GetLocalToWorldTransform(by_name[link]) * to_robot)
            points = points @ T[:3, :3] + T[3, :3]
        ends += [points.min(axis=0), points.max(axis=0)]
    if not ends:
        return None
    low, high = (
        tuple(round(float(v), 9) + 0.0 for v in corner) for corner in (np.min(ends, 0), np.max(ends, 0))
    )
    return low, high  # type: ignore[return-value]


def _first(lines: Sequence[str]) -> list[str]:
    """The first lines, and how many are left."""
    left = len(lines) - LINES
    return (
        list(lines) if left <= 1 else [*lines[:LINES], f"and {left} more; the report of --report lists all"]
    )
