"""Build the default map: furnish a lab, lay steel about and below it, survey it with the robot, fit a map.

`python maps/lab/build.py` writes sources.toml, lab.usdc and map.toml beside this file. The same seed gives
the same lab: a test compares a fresh build with the committed files.

The robot surveys as it would in a real lab: it stands a little beside each node and looks a little past each
heading. So the map errs as a fitted map does. It is the map that the shipped hybrid network learned on.
"""

import math
import sys
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.field.fit.fit import fit, raster
from magtwin.field.maps.map import NOISE, TABLED, AnomalyMap
from magtwin.field.maps.scene_state import made_from
from magtwin.field.survey.readings import Readings
from magtwin.files.file import shipped
from magtwin.files.outputs import output
from magtwin.frames import quat_from_rpy
from magtwin.report.report import Report
from magtwin.sim.survey import survey_readings
from magtwin.spec.base import ZERO3
from magtwin.spec.furniture import FurnitureSpec, parts_of
from magtwin.spec.lab import LabSpec
from magtwin.spec.magnetics import EarthFieldSpec, SourceSpec
from magtwin.spec.robot import RobotSpec
from magtwin.spec.scene import Scene
from magtwin.usd.lab.earth import derived
from magtwin.usd.maps.layer import save_map
from magtwin.usd.robot import load_robot

HERE = Path(__file__).resolve().parent
SEED = 398
"""Chosen among 0 to 499: of the maps whose greatest gradient is above 20 uT/m and whose least value is
above 30 uT, it comes nearest to the published survey in mean, spread, gradients and heading amplitude."""

LATITUDE_DEG, LONGITUDE_DEG, HEIGHT_M = 29.65, -82.35, 50.0
"""Gainesville, Florida, where the survey was made that this lab is like."""

DATE = "2026-11-21"

APRON_M = 2.0
"""Slab outside of the walls, which the furniture stands on."""

SPACING_M, HEADING_STEP_DEG = 0.05, 15.0
"""Of the map's nodes: finer than the fit's own resolution, so that interpolation adds next to nothing."""

READINGS = 135
"""Readings averaged at a node: the robot stands for a second."""

HEADING_ERROR_DEG, POSITION_ERROR_M = 7.0, 0.015
"""How the robot stands about a node: the published survey's recorded headings are 5 to 11 deg off its
nominal ones, and what its four headings leave at a node, 79 nT, is 1.5 cm of the lab's gradient."""

SURVEY_SEED = 7
"""Of where the robot stands and of its sensor's noise."""

SUSCEPTIBILITY = 80.0
"""Of structural steel in weak fields; the shape of a piece leaves it a tenth to a half of that."""

# Magnetisations usual for steel in buildings and furniture, some kA/m, and of either sign where remanent.
# That of a column, of 12 mm walls, is of the whole section.
COLUMN, REBAR, PIPE, FURNITURE, IRON = (2.2e3, 3.2e3), (1e3, 10e3), (4e3, 10e3), (500.0, 5e3), (2e3, 7e3)

SETTLED = 4e3
"""Magnetisation of buried iron along the Earth's field, which it took on over the years [A/m]."""

NORTH, SOUTH, EAST, WEST = math.pi / 2, -math.pi / 2, 0.0, math.pi

PIECES = (
    ("desk_0", "desk", (-1.9, 2.3), SOUTH),
    ("desk_1", "desk", (-0.4, 2.3), SOUTH),
    ("desk_2", "desk", (1.9, 2.3), SOUTH),
    ("chair_0", "chair", (-1.8, 2.85), SOUTH - 0.2),
    ("chair_1", "chair", (-0.5, 2.9), SOUTH + 0.15),
    ("chair_2", "chair", (2.0, 2.85), SOUTH + 0.3),
    ("chair_3", "chair", (3.5, -0.6), WEST - 0.4),
    ("chair_4", "chair", (1.2, -2.3), NORTH + 0.3),
    ("cabinet_0", "cabinet", (-2.3, -2.15), NORTH),
)
"""Name, kind, place [m] and front of the furniture about the floor."""


def earth() -> EarthFieldSpec:
    """The Earth's field in the lab, by the IGRF-14."""
    return derived(
        EarthFieldSpec(
            b_world_nt=ZERO3,
            latitude_deg=LATITUDE_DEG,
            longitude_deg=LONGITUDE_DEG,
            height_m=HEIGHT_M,
            date=DATE,
        )
    )


def furniture(rng: np.random.Generator) -> tuple[FurnitureSpec, ...]:
    """Desks and chairs, cabinets, and ten columns of the building.

    The columns are magnetised downwards, as steel that stands here comes to be. Beside one its field
    opposes its magnetisation, so they weaken the field in the lab.
    """
    pieces = [(*piece, FURNITURE) for piece in PIECES]
    columns = [(x, y) for y in (-3.2, 3.2) for x in (-4.6, -1.55, 1.55, 4.6)] + [(-4.6, 0.0), (4.75, 0.0)]
    pieces += [(f"column_{k}", "column", p, NORTH, COLUMN) for k, p in enumerate(columns)]
    made = []
    for name, kind, (x, y), front, (least, most) in pieces:
        steel = sum(part.steel for part in parts_of(kind))
        size = rng.uniform(least, most, steel) * rng.choice((-1, 1), steel)
        if kind == "column":
            size = np.full(steel, -np.abs(size).mean())
        made.append(
            FurnitureSpec(
                name=name,
                kind=kind,
                p_world=(x, y, 0.0),
                q_world_xyzw=_turn(0.0, 0.0, front),
                magnetization=tuple(float(m) for m in np.round(size)),
            )
        )
    return tuple(made)


def sources(rng: np.random.Generator, earth: EarthFieldSpec) -> tuple[SourceSpec, ...]:
    """What lies in the slab and below it, placed to 1 mm and magnetised to 1 A/m."""
    down = np.array(earth.b_world_nt) / np.linalg.norm(earth.b_world_nt)
    return (*_rebar(rng), *_pipe(rng, down), *_iron(rng, down))


def _rebar(rng: np.random.Generator) -> Iterator[SourceSpec]:
    """Bars of the slab (20 mm, 0.8 m) that were bent, welded or lifted by magnet, along x or y."""
    for k in range(20):
        front = 0.0 if rng.integers(2) else NORTH
        p = rng.uniform((-3.2, -2.0, -0.3), (3.2, 2.0, -0.2))
        size = rng.uniform(*REBAR) * rng.choice((-1, 1))
        yield SourceSpec(
            name=f"rebar_{k}",
            p_world=_rounded(p),
            shape="cylinder",
            q_world_xyzw=_turn(0.0, math.pi / 2, front),  # its own z lies along the floor
            size_m=(0.02, 0.02, 0.8),
            magnetization=(0.0, 0.0, round(size)),
            susceptibility=SUSCEPTIBILITY,
        )


def _pipe(rng: np.random.Generator, down: NDArray[np.float64]) -> Iterator[SourceSpec]:
    """A water main (DN 100, wall 4 mm) that crosses under the floor, 0.7 m deep, in lengths of 0.8 m.

    Solid cylinders stand for it, magnetised as much less as they are thicker.
    """
    share = 1 - (0.0532 / 0.0572) ** 2
    front = math.atan2(0.147, 0.989)
    axis = np.array([math.cos(front), math.sin(front), 0.0])
    side = np.array([-math.sin(front), math.cos(front), 0.0])
    for k in range(8):
        size = rng.choice((-1, 1)) * rng.uniform(*PIPE)
        # own z lies along the pipe, own x down, own y to its left
        settled = 0.6 * SETTLED * np.array([-down[2], down @ side, down @ axis])
        yield SourceSpec(
            name=f"pipe_{k}",
            p_world=_rounded(np.array([-2.8, 0.6, -0.7]) + 0.8 * k * axis),
            shape="cylinder",
            q_world_xyzw=_turn(0.0, math.pi / 2, front),
            size_m=(0.1144, 0.1144, 0.8),
            magnetization=_rounded(share * (settled + np.array([0, 0, size])), 0),
        )


def _iron(rng: np.random.Generator, down: NDArray[np.float64]) -> Iterator[SourceSpec]:
    """Blocks that former machines stood on, the deeper the larger, 0.3 to 0.9 m below the floor."""
    for k in range(22):
        p = rng.uniform((-3.0, -1.8, -0.9), (3.0, 1.8, -0.3))
        axis = rng.standard_normal(3)
        side = round(0.126 * float((0.4 - p[2]) / 0.8) ** (2 / 3), 3)
        size = rng.uniform(*IRON)
        yield SourceSpec(
            name=f"iron_{k}",
            p_world=_rounded(p),
            shape="cuboid",
            size_m=(side, side, side),
            magnetization=_rounded(size * axis / np.linalg.norm(axis) + SETTLED * down, 0),
        )


def _turn(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    x, y, z, w = (round(float(c), 9) + 0.0 for c in quat_from_rpy((roll, pitch, yaw)))
    return x, y, z, w


def _rounded(v: NDArray[np.float64], digits: int = 3) -> tuple[float, float, float]:
    x, y, z = (round(float(c), digits) + 0.0 for c in v)  # + 0.0 turns -0.0 into 0.0
    return x, y, z


def robot() -> RobotSpec:
    """The robot that surveys the lab."""
    return load_robot(shipped("robots", "turtlebot4", "turtlebot4.usda"))


def scene(robot: RobotSpec) -> Scene:
    """The lab with the robot that surveys it; its map is what `build` makes."""
    rng, field = np.random.default_rng(SEED), earth()
    return Scene(
        name="lab",
        map_layer=HERE / "lab.usdc",
        robot=robot,
        lab=LabSpec(apron_m=APRON_M),
        earth=field,
        sources=sources(rng, field),
        furniture=furniture(rng),
    )


def survey(scene: Scene) -> Readings:
    """What the robot reads on its survey of the scene."""
    return survey_readings(
        scene,
        rng=np.random.default_rng(SURVEY_SEED),
        readings=READINGS,
        heading_error_rad=math.radians(HEADING_ERROR_DEG),
        position_error_m=POSITION_ERROR_M,
        source=f"maps/lab/build.py, seed {SEED}, robot {scene.robot.name}, {len(scene.magnets)} bodies",
        licence="Apache-2.0",
        created=DATE,
    )


def lab_map(scene: Scene) -> AnomalyMap:
    """The map fitted to the survey, in numbers that single precision holds, as its layer does."""
    readings = survey(scene)
    field = raster(
        fit(readings, "harmonic"),
        readings,
        spacing_m=SPACING_M,
        headings_rad=np.radians(np.arange(0.0, 360.0, HEADING_STEP_DEG)),
    )
    assert field.variance_nt2 is not None
    assert field.between_nt2 is not None
    return replace(
        field,
        values_nt=field.values_nt.astype(np.float32),
        variance_nt2=stepped(field.variance_nt2),
        between_nt2=stepped(field.between_nt2),
        parameters={k: v for k, v in field.parameters.items() if k not in (NOISE, TABLED)},  # as released
        made_from=made_from(scene),
    )


def stepped(variance_nt2: NDArray[np.float64]) -> NDArray[np.float32]:
    """Variances in steps of 4 %, of at least 1e-3 nT^2 or 0; USD packs arrays of few distinct numbers."""
    known = np.isfinite(variance_nt2) & (variance_nt2 >= 1e-3)
    steps = np.round(np.log(np.where(known, variance_nt2, 1.0)) / 0.04)
    rounded = np.where(known, np.exp(0.04 * steps), np.where(np.isfinite(variance_nt2), 0.0, variance_nt2))
    return np.asarray(rounded, np.float32)


def build(folder: Path, *, force: bool = False) -> Report:
    """Write sources.toml, lab.usdc and map.toml to `folder`; returns the map's figures."""
    lab = scene(robot())
    field = lab_map(lab)
    report = field.report()
    with output(folder / "sources.toml", force=force) as path:
        path.write_text(sources_toml(lab.sources, lab.furniture), encoding="utf-8")
    with output(folder / "map.toml", force=force) as path:
        path.write_text(map_toml(field, earth(), report), encoding="utf-8")
    save_map(field, folder / "lab.usdc", force=force)
    return report


def sources_toml(sources: tuple[SourceSpec, ...], furniture: tuple[FurnitureSpec, ...]) -> str:
    """The furniture and the sources as TOML, one table each."""
    lines = ["# Magnetised steel of the lab, by maps/lab/build.py: metres, A/m; see docs/sources.md."]
    for table, things in (("furniture", furniture), ("source", sources)):
        for thing in things:
            lines += ["", f"[[{table}]]"]
            for field in fields(thing):
                value = getattr(thing, field.name)
                if value != field.default:
                    lines.append(f"{field.name} = {_toml(value)}")
    return "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    return f'"{value}"' if isinstance(value, str) else str(list(value) if isinstance(value, tuple) else value)


def map_toml(field: AnomalyMap, earth: EarthFieldSpec, report: Report) -> str:
    """What the map is, for people and for tools that do not read USD."""
    figures = {f.name.replace(" ", "_"): f for f in report.figures}
    x0, x1, y0, y1 = field.extent
    b = field.values_nt
    lines = [
        "# The default map, by maps/lab/build.py; the numbers are in lab.usdc.",
        f'name = "{field.name}"',
        'layer = "lab.usdc"',
        'unit = "nT"',
        f'frame = "{field.frame}"',
        f'datum = "{field.datum}"',
        f"origin_m = {list(field.origin_m)}",
        f"cell_m = {list(field.cell_m)}",
        f"shape = {list(b.shape)}  # headings, rows along y, columns along x",
        f"extent_m = {[x0, x1, y0, y1]}  # least and greatest x, least and greatest y",
        f"headings_deg = {[round(float(h), 6) for h in np.degrees(field.headings_rad)]}",
        f"magnetometer_height_m = {field.height_m:.4f}",
        f'licence = "{field.licence}"',
        f'created = "{field.created}"',
        f'method = "{field.method}"',
        f'source = "{field.source}"',
        "",
        "[earth]  # by the IGRF-14, in world axes",
        f"b_world_nt = {list(earth.b_world_nt)}",
        f"latitude_deg = {earth.latitude_deg}",
        f"longitude_deg = {earth.longitude_deg}",
        f"height_m = {earth.height_m}",
        f'date = "{earth.date}"',
    ]
    lines += ["", "[statistics]"]
    for name, figure in figures.items():
        note = " ".join(word for word in (figure.unit, figure.note) if word)
        lines.append(f"{name} = {figure.value}" + (f"  # {note}" if note else ""))
        if figure.spread is not None:
            lines.append(f"{name}_sd = {figure.spread}  # {figure.unit}")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.stdout.write(build(HERE, force=True).to_json() + "\n")
