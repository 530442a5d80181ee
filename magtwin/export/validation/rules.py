"""Rules of magtwin's own: what a lab, its map and its robots must hold to, so that others find them."""

import json
import math
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Usd, UsdGeom, UsdPhysics

from magtwin.errors import InputError
from magtwin.export.contents import named_files, weights_metadata
from magtwin.export.validation.findings import Severity
from magtwin.export.validation.rule import Subject, Wrong, rule, wrong_of
from magtwin.files.file import sha256
from magtwin.usd.lab.looks import VISUALS
from magtwin.usd.lab.obstacles import read_obstacles
from magtwin.usd.lab.room import read_lab
from magtwin.usd.maps.layer import read_map
from magtwin.usd.placement import labs_on
from magtwin.usd.robot import read_robot
from magtwin.usd.scene import OpenedScene, open_scene
from magtwin.usd.schema import NOUNS, attribute_name, declared, has_api, prims_with
from magtwin.usd.sensors import (
    IMU_TYPE,
    LIDAR_TYPE,
    read_footprint,
    read_imu,
    read_lidar,
    read_magnetometer,
)
from magtwin.usd.units import mixed_units

NETWORK = attribute_name("magnetometer", "network")

SAME_M = 1e-6
"""Single precision at 10 m [m]: what two places that ought to be one may be apart."""

OFF_M = 1e-3
"""Largest distance between a mesh and what it shows [m]."""


@rule("magtwin", "make the path relative to the layer")
def absolute_paths(subject: Subject) -> Iterator[Wrong]:
    """No layer names a file by an absolute path."""
    for layer in subject.layers:
        for named in named_files(layer):
            if is_absolute(named.path):
                yield Wrong(f"{subject.name_of(layer)} names {named.path}", named.where)


@rule("magtwin", "convert it to metres with Z up in the program that made it")
def units(subject: Subject) -> Iterator[Wrong]:
    """The stage is authored in metres and kilograms with Z up, and what it brings in is scaled to that."""
    root, advice = subject.stage.GetRootLayer(), "author it; stages of magtwin are in metres with Z up"
    for name, default in (("metersPerUnit", "centimetres"), ("upAxis", "Y up")):
        if not subject.stage.HasAuthoredMetadata(name):
            yield Wrong(f"does not say {name}, and counts as {default}", advice=advice)
    metres, up = UsdGeom.GetStageMetersPerUnit(subject.stage), UsdGeom.GetStageUpAxis(subject.stage)
    severity: Severity = "warning" if subject.labs else "error"  # a lab is scaled and turned to fit
    if not UsdGeom.LinearUnitsAre(metres, UsdGeom.LinearUnits.meters):
        yield Wrong(f"is in units of {metres:g} m; USD does not convert them", severity=severity)
    if up != UsdGeom.Tokens.z:
        yield Wrong(f"has {up} up; USD does not turn it", severity=severity)
    for text in mixed_units(subject.stage):
        yield wrong_of(InputError(text))
    for layer in subject.layers:
        name = "" if layer == root else f"{subject.name_of(layer)} "
        said = layer.pseudoRoot
        kilograms = said.GetInfo("kilogramsPerUnit") if said.HasInfo("kilogramsPerUnit") else 1.0
        if not math.isclose(kilograms, UsdPhysics.MassUnits.kilograms, rel_tol=1e-6):
            yield Wrong(f"{name}is in units of {kilograms:g} kg; USD does not convert them")


@rule("magtwin", "use a name that is in docs/schema.md")
def schema_names(subject: Subject) -> Iterator[Wrong]:
    """Every schema and attribute with magtwin's prefix is defined, and its prim has the schema."""
    for prim in subject.prims:
        for api in applied(prim):
            if api.startswith("Magtwin") and api not in NOUNS.values():
                yield Wrong(f"has the schema {api}, which there is not", str(prim.GetPath()))
        for prop in prim.GetAuthoredPropertiesInNamespace("magtwin"):
            name = prop.GetName()
            if prop.IsCustom() or declared(prop):
                continue  # what is custom is nobody's schema, such as the readings of a run
            noun = name.split(":")[1]
            has = noun in NOUNS and has_api(prim, noun)
            why = f"which {NOUNS[noun]} has not" if has else "and has no schema of it"
            yield Wrong(f"has {name}, {why}", str(prim.GetPath()))


@rule("magtwin", "point it to the right prim")
def targets(subject: Subject) -> Iterator[Wrong]:
    """Every relationship and every connection points to something that exists."""
    for prim in subject.prims:
        for prop in prim.GetAuthoredProperties():
            ends = prop.GetTargets() if isinstance(prop, Usd.Relationship) else prop.GetConnections()
            for end in ends:
                if not subject.stage.GetObjectAtPath(end):
                    text = f"{prop.GetName()} points to <{end}>, which is not there"
                    yield Wrong(text, str(prim.GetPath()))


@rule("magtwin", "docs/schema.md lists every attribute with its range")
def scene(subject: Subject) -> Iterator[Wrong]:
    """Lab, Earth's field, sources, robots and map are complete, in range, and belong together."""
    survey = "survey it again: magtwin map survey STAGE --out MAP.usdc --adopt"
    labs = dict.fromkeys(lab.path for lab in labs_on(subject.stage))
    looks: list[Callable[[], object]] = [
        partial(open_scene, subject.file, lab=lab, check_network=False) for lab in labs
    ]
    if not labs:
        looks += [partial(read_map, prim) for prim in subject.having("anomalyMap")]
        looks += [partial(read_robot, prim) for prim in subject.having("robot")]
    for look in looks:
        try:
            opened = look()
        except InputError as error:
            yield wrong_of(error)
            continue
        if isinstance(opened, OpenedScene):
            for text in opened.changes:
                where = opened.lab or next(iter(labs))
                yield Wrong(f"since the map was made: {text}", where, survey, "warning")
            for note in opened.notes:
                yield replace(wrong_of(InputError(note)), severity="warning")


@rule("magtwin", "restore the weights, or make the scene again with these")
def network_file(subject: Subject) -> Iterator[Wrong]:
    """The weights that a magnetometer names exist and match its checksum."""
    for prim in subject.having("magnetometer"):
        spec, where = read_magnetometer(prim), str(prim.GetPath())
        if spec.kind != "neural":
            continue
        file, said = spec.network, f"{spec.network_sha256[:12]}..."
        if file is None and spec.network_sha256:  # as in a package
            text = f"keeps the checksum {said} of a network that it does not name"
            yield Wrong(text, where, "give it to magtwin run --network", "note")
        elif file is None:
            yield Wrong("is neural and names no network", where)
        elif not file.is_file():
            yield Wrong(f"names the network {file.name}, which is not there", where)
        elif spec.network_sha256 and (seen := sha256(file)) != spec.network_sha256.lower():
            yield Wrong(f"{file.name} has SHA-256 {seen[:12]}..., it names {said}", where)


@rule("magtwin", "train it on inputs of magtwin.learn.data.features.FEATURES")
def network_inputs(subject: Subject) -> Iterator[Wrong]:
    """The inputs of every network are known and unique, and equal those of its weights file."""
    for prim in subject.having("magnetometer"):
        spec, where = read_magnetometer(prim), str(prim.GetPath())
        if spec.kind != "neural":
            continue
        unknown = [] if subject.inputs is None else sorted(set(spec.inputs) - subject.inputs)
        if unknown:
            yield Wrong(f"has the inputs {', '.join(unknown)}, which are not known", where)
        if len(set(spec.inputs)) < len(spec.inputs):
            yield Wrong("has an input twice", where)
        if spec.network is None or spec.network.suffix.lower() != ".safetensors" or not spec.inputs:
            continue
        try:
            own = json.loads(weights_metadata(spec.network)["features"])
        except (ValueError, KeyError, TypeError):
            continue  # it has no names, or is not there
        if isinstance(own, list) and tuple(map(str, own)) != spec.inputs:
            yield Wrong("names other inputs than its file of weights, or in another order", where)


@rule("magtwin", "give the lab's size and the map's origin in one frame")
def map_inside(subject: Subject) -> Iterator[Wrong]:
    """Every map lies within the floor of its lab."""
    for stage in subject.labs:
        lab = read_lab(prims_with(stage.GetPseudoRoot(), "lab")[0])
        for prim in prims_with(stage.GetPseudoRoot(), "anomalyMap"):
            over = np.subtract((field := read_map(prim)).extent, lab.extent_m) * (-1, 1, -1, 1)
            if over.max() > max(field.cell_m) / 2 + SAME_M:
                text = f"reaches {over.max():.3g} m beyond the floor of {lab.size_text}"
                yield Wrong(text, str(prim.GetPath()))


@rule("magtwin", "start it on the floor, clear of the walls")
def robot_inside(subject: Subject) -> Iterator[Wrong]:
    """Every robot stands on the floor, with its footprint inside it."""
    for stage in subject.labs:
        world, cache = stage.GetPseudoRoot(), UsdGeom.XformCache()
        lab = read_lab(prims_with(world, "lab")[0])
        for prim in prims_with(world, "robot"):
            x, y, _ = cache.GetLocalToWorldTransform(prim).ExtractTranslation()
            radius = read_footprint(prim)
            if lab.inside_m([[x, y]])[0] < radius - SAME_M:
                text = f"stands at ({x:g}, {y:g}) m and needs {radius:g} m about it: it is off the floor"
                yield Wrong(text, str(prim.GetPath()))


@rule("magtwin", "start it elsewhere; a run that begins in a collision is refused")
def robot_clear(subject: Subject) -> Iterator[Wrong]:
    """Every robot is clear of obstacles and of the other robots."""
    for stage in subject.labs:
        yield from _collisions(stage, prims_with(stage.GetPseudoRoot(), "robot"))


def _collisions(stage: Usd.Stage, robots: list[Usd.Prim]) -> Iterator[Wrong]:
    """Robots that start in an obstacle or in another robot, in the axes of a lab."""
    obstacles, cache = read_obstacles(stage), UsdGeom.XformCache()
    places = [np.array(cache.GetLocalToWorldTransform(prim).ExtractTranslation())[:2] for prim in robots]
    radii = [read_footprint(prim) for prim in robots]
    for i, prim in enumerate(robots):
        distance, which = obstacles.clearance(places[i][None], reach_m=radii[i] + 1.0)
        if distance[0] < radii[i] - SAME_M:
            text = f"is {distance[0]:.3g} m from {obstacles.names[int(which[0])]}"
            yield Wrong(f"{text}, and needs {radii[i]:g} m about it", str(prim.GetPath()))
        for j in range(i):
            apart = float(np.linalg.norm(places[i] - places[j]))
            if apart < radii[i] + radii[j] - SAME_M:
                yield Wrong(f"stands {apart:.3g} m from <{robots[j].GetPath()}>", str(prim.GetPath()))


@rule("magtwin", "author the sensor again with magtwin robot or magtwin scene")
def sensor_types(subject: Subject) -> Iterator[Wrong]:
    """Isaac Sim's sensor prims have the rates and ranges of the magtwin sensors above them."""

    def differs(prim: Usd.Prim, kind: str, name: str, wanted: float) -> tuple[bool, Any]:
        sensor = next((p for p in prim.GetChildren() if p.GetTypeName() == kind), None)
        seen = sensor.GetAttribute(name).Get() if sensor else None
        return seen is None or not math.isclose(seen, wanted, rel_tol=1e-6, abs_tol=1e-9), seen

    for prim in subject.having("imu"):
        rate = read_imu(prim).rate_hz
        wrong, seen = differs(prim, IMU_TYPE, "sensorPeriod", 1 / rate)
        if wrong:
            yield Wrong(f"reads {rate:g} Hz, its {IMU_TYPE} has a period of {seen} s", str(prim.GetPath()))
    for prim in subject.having("lidar"):
        spec = read_lidar(prim)
        for name, wanted in (("nearRangeM", spec.range_min_m), ("farRangeM", spec.range_max_m)):
            wrong, seen = differs(prim, LIDAR_TYPE, f"omni:sensor:Core:{name}", wanted)
            if wrong:
                text = f"ranges to {wanted:g} m, its {LIDAR_TYPE} has {name} {seen}"
                yield Wrong(text, str(prim.GetPath()))


@rule("magtwin", "move the piece of furniture or the room as a whole, or both prims alike")
def shown_meshes(subject: Subject) -> Iterator[Wrong]:
    """A mesh below `Visuals` stands where the collider or source that it shows is."""
    boxes = UsdGeom.BBoxCache(Usd.TimeCode.Default(), [UsdGeom.Tokens.default_, UsdGeom.Tokens.guide])
    for prim in subject.prims:
        if prim.GetParent().GetName() != VISUALS:
            continue
        body = prim.GetParent().GetParent().GetChild(prim.GetName())
        if not body:
            continue
        here, there = (boxes.ComputeWorldBound(p).ComputeAlignedRange() for p in (prim, body))
        off = max(
            (a - b).GetLength() for a, b in ((here.GetMin(), there.GetMin()), (here.GetMax(), there.GetMax()))
        )
        if off > OFF_M:
            text = f"is shown {off:.3g} m from {body.GetPath()}, which readings and collisions follow"
            yield Wrong(text, str(prim.GetPath()))


def robot_assets(subject: Subject) -> dict[str, Path | None]:
    """File of the asset of each robot by its prim's path; None where it is part of the stage's own layer."""
    found: dict[str, Path | None] = {}
    default = subject.stage.GetDefaultPrim()
    strangers = [default] if default and "IsaacRobotAPI" in applied(default) else []
    for prim in subject.having("robot") or strangers:
        arcs = Usd.PrimCompositionQuery.GetDirectReferences(prim).GetCompositionArcs()
        file = Path(arcs[0].GetTargetLayer().realPath) if arcs else None
        found[str(prim.GetPath())] = subject.file if prim == default else file
    return found


def is_absolute(path: str) -> bool:
    """Whether an asset path holds on one machine, or on a network, alone."""
    return bool(re.match(r"^(/|\\|[A-Za-z]:[\\/]|[A-Za-z][A-Za-z0-9+.-]+:)", path))


def applied(prim: Usd.Prim) -> list[str]:
    """Names of the schemas applied to a prim, including those that are not known here."""
    return list(prim.GetPrimTypeInfo().GetAppliedAPISchemas())
