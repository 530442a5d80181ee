"""Convert: turn a URDF into a USD articulation that can be driven; the steps stand here in order."""

import os
import shutil
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any

from numpy.typing import NDArray
from pxr import Sdf, Usd, UsdGeom, UsdPhysics, UsdUtils, Vt

from magtwin.errors import InputError
from magtwin.files.file import sha256
from magtwin.files.outputs import check_free, output, transaction
from magtwin.spec.drive import DriveSpec
from magtwin.urdf.description.description import Description, origin_of, read_description
from magtwin.urdf.description.extensions import MODULES
from magtwin.urdf.description.tag import Tags
from magtwin.urdf.layout import (
    EDITS,
    GEOMETRIES,
    PAYLOADS,
    check_payloads,
    keep_edits,
    lost_edits,
    write_layers,
)
from magtwin.urdf.material import LOOKS
from magtwin.urdf.meshes.mesh_layer import MeshLayer, free_name, gather
from magtwin.urdf.meshes.texture import TEXTURES
from magtwin.urdf.options import DEFAULTS, Options
from magtwin.urdf.physics.articulation import define_articulation, filter_overlaps
from magtwin.urdf.physics.control import read_base, read_commands
from magtwin.urdf.physics.drive import NO_WHEELS, Wheels, check_rules
from magtwin.urdf.physics.gazebo import (
    Surface,
    read_surfaces,
    self_collides,
)
from magtwin.urdf.physics.joint import define_fixed_joint, define_joint, define_mimic
from magtwin.urdf.physics.link import SITE_API, Rider, define_body, is_marker
from magtwin.urdf.physics.mechanism import Mechanism, read_mechanism
from magtwin.urdf.physics.merge import WORLD, Place, carried, place_links, riders
from magtwin.urdf.physics.mobile_base import MobileBase, drive_spec, leave_out
from magtwin.urdf.physics.wheel import find_base, fit_wheels, grip, not_on, wheel_radius
from magtwin.urdf.placeholder import replace_failed
from magtwin.urdf.report import ConversionReport, Ledger, make_report
from magtwin.urdf.shape import COLLISIONS, VISUALS, define_collider, define_no_contact, define_visual, pose_of
from magtwin.urdf.simready import check_metadata, metadata
from magtwin.urdf.source.source import read_source
from magtwin.usd.attributes import write_pose
from magtwin.usd.layers import describe_stage

JOINTS = "joints"
"""Scope of the joints below the robot's prim."""

THUMBNAILS = Path(".thumbs", "256x256")
"""Folder of an asset's thumbnail, relative to the asset's folder."""

ROBOT_API = "IsaacRobotAPI"
"""Isaac Sim's applied schema; its plugin is not installed here."""

Finish = Callable[[Usd.Prim], Iterable[str]]


def convert_urdf(urdf: str | os.PathLike[str], out: str | os.PathLike[str], **choices: Any) -> Path:
    """Convert a URDF as `convert_with_report` does, with its options; returns `out`."""
    convert_with_report(urdf, out, **choices)
    return Path(out)


def convert_with_report(
    urdf: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    options: Options = DEFAULTS,
    force: bool = False,
    finish: Finish | None = None,
    thumbnail: Callable[[Path, Path], object] | None = None,
) -> ConversionReport:
    """Convert a URDF to a USD articulation with a floating base, and report the result.

    The robot's prim has the frame of the URDF's root link. Its links are rigid bodies directly below it, and
    its joints are in a scope. Links without mass and shape become sites on the body that they ride on. Notes
    of repairs, guesses and omissions are stored in the file, see `read_notes`.

    Args:
        urdf: The description; its meshes are below its folder or in packages around it.
        out: Root layer to write, `.usda`; the other layers go to the folder `payloads` beside it, see
            `layout`. With `options.single_file` there is at most one other layer, `<stem>_meshes.usdc`.
        options: Choices that the URDF leaves open.
        force: Whether to replace existing files.
        finish: Called with the robot's prim before writing, to author more; returns notes.
        thumbnail: Called with `out` and the name of a PNG of 256 x 256 pixels to draw; it goes to
            `.thumbs/256x256/`, where asset browsers look for it.

    Returns:
        Every link and joint before and after, and all notes.

    Raises:
        InputError: The URDF cannot be converted, `options.strict` is set and something was repaired or
            lost, or a file exists; nothing is written.
    """
    out = Path(out)
    if out.suffix != ".usda":
        raise InputError(f"{out}: the robot's root layer is text; give it the suffix .usda")
    check_metadata(options.metadata)
    source = read_source(
        urdf,
        packages=options.packages,
        arguments=options.arguments,
        skip_missing_includes=options.skip_missing_includes,
    )
    description = read_description(source)
    textures = f"{out.stem}_textures" if options.single_file else f"{PAYLOADS}/{TEXTURES}"
    meshes = gather(description, f"./{textures}")
    description = replace_failed(description, meshes)
    check_free(out, force=force)
    write = _write_single if options.single_file else _write_payloads
    report = write(_Author(description, options, meshes, out, finish), out, force)
    if thumbnail is not None:
        with output(out.parent / THUMBNAILS / f"{out.name}.png", force=True) as aside:
            thumbnail(out, aside)
    return report


def _write_payloads(author: "_Author", out: Path, force: bool) -> ConversionReport:
    """Write the asset as an interface layer and a folder of payloads."""
    folder = check_payloads(out, force=force)
    with transaction(), output(folder, force=force) as aside_folder, output(out, force=force) as aside:
        work = aside.with_name(PAYLOADS)  # beside the root layer, so that references resolve
        work.mkdir()
        if author.meshes:
            author.meshes.export(work / GEOMETRIES)
        stage, report = author.stage(aside, f"./{PAYLOADS}/{GEOMETRIES}")
        if author.meshes.textures:
            author.meshes.textures.export(work / TEXTURES)
        write_layers(stage.GetRootLayer(), aside, work, out, edits=True)
        keep_edits(out.parent, stage.GetDefaultPrim().GetName())
        shutil.move(work, aside_folder)
    return report


def _write_single(author: "_Author", out: Path, force: bool) -> ConversionReport:
    """Write the asset as one root layer, with a layer of meshes and a folder of textures if needed."""
    beside = out.with_name(f"{out.stem}_meshes.usdc")
    with transaction(), output(out, force=force) as aside, ExitStack() as others:
        copy = aside.with_name(beside.name)
        if author.meshes:
            aside_meshes = others.enter_context(output(beside, force=force))
            author.meshes.export(copy)
        stage, report = author.stage(aside, f"./{beside.name}")

        def as_seen_from_out(path: str) -> str:
            if not path.startswith("../"):
                return path
            return Path(os.path.relpath(aside.parent / path, out.resolve().parent)).as_posix()

        UsdUtils.ModifyAssetPaths(stage.GetRootLayer(), as_seen_from_out)
        stage.GetRootLayer().Save()
        if author.meshes:
            shutil.move(copy, aside_meshes)
        if author.meshes.textures:
            pictures = output(out.with_name(f"{out.stem}_textures"), force=force)
            author.meshes.textures.export(others.enter_context(pictures))
    return report


@dataclass
class _Author:
    """Authors one robot."""

    description: Description
    options: Options
    meshes: MeshLayer
    out: Path
    finish: Finish | None
    ledger: Ledger = field(default_factory=Ledger)

    def __post_init__(self) -> None:
        self.tags = Tags(self.description)

    def stage(self, aside: Path, layer: str) -> tuple[Usd.Stage, ConversionReport]:
        """Author the robot in one layer at `aside`, and compare it with its description."""
        stage, description, options = Usd.Stage.CreateNew(str(aside)), self.description, self.options
        robot = self._robot(stage, layer)
        for note in self.finish(robot) if self.finish else ():
            description.note(note)
        for path in () if options.single_file else lost_edits(self.out.parent, stage):
            description.note(f"{EDITS} edits <{path}>, which this conversion does not have", lost=True)
        checksum = sha256(description.path)
        report = make_report(description, stage, self.ledger, name=self.out.name, sha256=checksum)
        if options.proof:
            report = replace(
                report, proof=import_module(MODULES["proof"]).make_proof(self.tags, stage, self.ledger)
            )
        description.repairs.check(report.source, strict=options.strict)
        notes = Vt.StringArray(description.repairs.notes)
        stage.GetRootLayer().customLayerData = {
            **stage.GetRootLayer().customLayerData,
            **metadata(stage, description, report, options.metadata),
            "magtwin": {
                "source": description.path.name,
                "sourceSha256": checksum,
                "notes": notes,
            },
        }
        return stage, report

    def _robot(self, stage: Usd.Stage, layer: str) -> Usd.Prim:
        """The robot's prim with everything below it."""
        description, ledger = self.description, self.ledger
        describe_stage(stage, f"{description.name}: converted from {description.path.name}.")
        names = {"": identifier(description.name)}
        if names[""] != description.name:
            description.note(f"{description.name!r} is called {names['']!r} in USD")
        names |= _free_names(description.links, {JOINTS, LOOKS, VISUALS, COLLISIONS}, "", description)
        mechanism, tags = read_mechanism(description, self.options), self.tags
        check_rules(mechanism, self.options)
        base = read_base(tags, self.options.controllers)
        surfaces = read_surfaces(tags)
        driven: tuple[str, ...] = ()
        if self.options.profile == "diff-drive":
            base = find_base(mechanism, base)
            driven = base.wheels
            surfaces = grip(mechanism, driven, surfaces)
        places = place_links(mechanism, merge=self.options.merge_fixed)
        fixed = self.options.fix_base or (
            base is None and self.options.profile == "general" and mechanism.in_world(_base(places))
        )
        options = replace(self.options, fix_base=fixed)
        poses = mechanism.poses()
        robot = _define(stage, Sdf.Path.absoluteRootPath.AppendChild(names[""]), description.name)
        stage.SetDefaultPrim(robot)
        Usd.ModelAPI(robot).SetKind("component")
        bodies, colliders = dict[str, Usd.Prim](), dict[str, list[Usd.Prim]]()
        for name, carried_links in riders(places).items():
            body = _define(stage, robot.GetPath().AppendChild(names[name]), name, poses[name])
            bodies[name] = body
            ledger.bodies[name] = "body", body.GetPath()
            parts = []
            for part, pose in carried_links:
                link, surface = description.links[part], surfaces.get(part, Surface())
                rider = Rider(link, pose)
                for visual in carried(link.visuals, pose, part, name):
                    rider.visuals.append(define_visual(body, visual, description, self.meshes, layer))
                    ledger.visuals.add(rider.visuals[-1].GetPath())
                    ledger.show(visual, rider.visuals[-1])
                for collision in carried(link.collisions, pose, part, name):
                    rider.colliders.append(define_collider(body, collision, surface, self.meshes, layer))
                    ledger.show(collision, rider.colliders[-1])
                parts.append(rider)
            filled = define_body(body, parts, description, options.density)
            mechanism.filled.update({part: solid.moved(poses[name]) for part, solid in filled.items()})
            colliders[name] = [collider for part in parts for collider in part.colliders]
            if not colliders[name]:
                define_no_contact(body, surfaces.get(name, Surface()), self.meshes)
        paths = {WORLD: robot.GetPath(), **{name: body.GetPath() for name, body in bodies.items()}}
        for name, (above, pose) in places.items():
            if above != name:
                frame = _define(stage, paths[above].AppendChild(names[name]), name, pose)
                frame.AddAppliedSchema(SITE_API)
                became = "frame" if is_marker(description.links[name]) else "merged"
                ledger.bodies[name] = became, frame.GetPath()
        drive = self._drive(base, mechanism, bodies, tags)
        wheels = fit_wheels(mechanism, driven, bodies) if driven else NO_WHEELS
        commands = not_on(driven, read_commands(tags, mechanism))
        options = replace(options, drives=(*options.drives, *commands))
        joints = self._joints(stage, mechanism, options, wheels, places, paths)
        planes = _planes(drive, base, mechanism)
        if planes:
            wheeled = {stage.GetPrimAtPath(ledger.joints[n]): y for n, y in planes.items()}
            import_module(MODULES["drive"]).define_contacts(robot, wheeled)
        robot.AddAppliedSchema(ROBOT_API)
        jointed = [stage.GetPrimAtPath(joint) for joint in joints]
        held = any(robot.GetPath() in UsdPhysics.Joint(joint).GetBody0Rel().GetTargets() for joint in jointed)
        first = bodies.get(_base(places), robot)
        define_articulation(robot if held else first, self_collision=self_collides(tags))
        filter_overlaps(bodies, colliders, jointed)
        links = [body.GetPath() for body in bodies.values()]
        for name, paths_listed in (("robotLinks", links), ("robotJoints", joints)):
            relationship = robot.CreateRelationship(f"isaac:physics:{name}", custom=False)
            for path in paths_listed:  # each is prepended, so that a stronger layer can add to the list
                relationship.AddTarget(path)
        self._equip(robot, tags, options, drive, held)
        return robot

    def _drive(
        self, base: MobileBase | None, mechanism: Mechanism, bodies: dict[str, Usd.Prim], tags: Tags
    ) -> DriveSpec | None:
        """The drive of the robot's base; None if it has none, or one whose wheels are not known."""
        if base is None:
            return None
        joints = {joint.name: joint for joint in self.description.joints.values()}
        if len(base.wheels) < 2:
            try:
                base = find_base(mechanism, base)
            except InputError:
                text = f"{base.source} moves the base, but no wheels are known: kept as text"
                self.description.note(text, lost=True)
                if base.element is not None:
                    tags.forget(base.element)
                return None

        def radius_of(name: str) -> float:
            link = self.description.links[joints[name].child]
            forms = [part.geometry for part in (*link.collisions, *link.visuals)]
            round_ones = [form.radius for form in forms if form.kind in ("cylinder", "sphere")]
            body = bodies.get(link.name)
            return round_ones[0] if round_ones else wheel_radius(body, joints[name].axis) if body else 0.0

        try:
            return drive_spec(base, mechanism, radius_of)
        except InputError as error:
            if self.options.profile == "diff-drive" or self.options.controllers is not None:
                raise
            leave_out(tags, base.element, error)
            return None

    def _joints(
        self,
        stage: Usd.Stage,
        mechanism: Mechanism,
        options: Options,
        wheels: Wheels,
        places: dict[str, Place],
        paths: dict[str, Sdf.Path],
    ) -> list[Sdf.Path]:
        """Author the joints between bodies, the root joint first; a floating joint has no prim."""
        description, made = self.description, dict[str, Usd.Prim]()
        scope = UsdGeom.Scope.Define(stage, paths[WORLD].AppendChild(JOINTS)).GetPath()
        joints = {joint.name: joint for joint in description.joints.values()}
        names = _free_names(joints, set(), "joint ", description)
        names[""] = free_name("root_joint", {*joints, *names.values()})
        base = _base(places)
        if options.fix_base and places[description.root][0] != WORLD and base != WORLD:
            pose, ends = mechanism.poses()[base], (paths[WORLD], paths[base])
            made[""] = define_fixed_joint(stage, scope.AppendChild(names[""]), ends, pose)
            if not self.options.fix_base:
                description.note(f"link 'world' is the world: the base {base!r} is fixed to it")
        elif description.root == "world" and base != WORLD:
            description.note(f"link 'world' is not the world: the base {base!r} floats; --fix-base holds it")
        for child, joint in description.joints.items():
            above, pose = places[joint.parent]
            if child not in paths or above == child or (child == base and joint.type == "floating"):
                continue
            if joint.type == "floating":
                description.note(f"joint {joint.name!r} is floating: link {child!r} is a free body")
                continue
            at = mechanism.pose(joint) if joint.name in mechanism.welded else origin_of(joint)
            path, ends = scope.AppendChild(names[joint.name]), (paths[above], paths[child])
            prim = define_joint(stage, path, joint, ends, pose @ at, mechanism, options, wheels)
            _show_name(prim, joint.name)
            made[joint.name] = prim
            self.ledger.joints[joint.name] = prim.GetPath()
        for name, mimic in mechanism.mimics.items():
            define_mimic(made[name], made[mimic.joint], joints[name], joints[mimic.joint], mechanism)
        return [prim.GetPath() for prim in made.values()]

    def _equip(
        self, robot: Usd.Prim, tags: Tags, options: Options, drive: DriveSpec | None, held: bool
    ) -> None:
        """Author the contents of tags outside URDF's grammar; the rest is kept as text."""
        stage, ledger = robot.GetStage(), self.ledger

        def link_of(name: str) -> Usd.Prim:
            return stage.GetPrimAtPath(ledger.bodies[name][1])

        def joint_of(name: str) -> Usd.Prim | None:
            return stage.GetPrimAtPath(ledger.joints[name]) if name in ledger.joints else None

        wheeled = not options.fix_base and (drive is not None or options.profile == "diff-drive")
        kind = "Wheeled" if wheeled else "Manipulator" if held else "Default"  # of Isaac Sim's list
        robot.CreateAttribute("isaac:robotType", Sdf.ValueTypeNames.Token, custom=False).Set(kind)
        if drive is not None:
            names = {name: path.name for name, path in ledger.joints.items()}
            import_module(MODULES["sensor"]).define_differential(robot, drive, names)
        if tags.have("sensor"):
            import_module(MODULES["sensor"]).define_sensors(tags, robot, link_of)
        ledger.unknown_tags = tags.keep(
            lambda name: link_of(name) if name in ledger.bodies else joint_of(name) or robot
        )
        count = sum(ledger.unknown_tags.values())
        if count:
            most = ", ".join(sorted(ledger.unknown_tags, key=lambda tag: -ledger.unknown_tags[tag])[:4])
            tags.description.note(f"{count} tags without a meaning here are kept as text, such as {most}")


def _planes(
    drive: DriveSpec | None, base: MobileBase | None, mechanism: Mechanism
) -> dict[str, float | None]:
    """Y of the plane in which each wheel of a drive touches the floor [m]; None for that of its joint."""
    if drive is None or base is None:
        return {}
    joints = mechanism.description.joints.values()
    held = {joint.child for joint in joints if joint.name in base.steered}
    planes = {joint.name: None for joint in joints if joint.parent in held and joint.type == "continuous"}
    exact, half = base.kind in ("differential", "car"), drive.wheel_separation_m / 2  # else an effective one
    return planes | {name: half * (1 - 2 * side) if exact else None for name, side in drive.sides.items()}


def _base(places: dict[str, Place]) -> str:
    """Name of the first body, the base of its robot."""
    return next((name for name, (above, _) in places.items() if above == name), WORLD)


def _define(stage: Usd.Stage, path: Sdf.Path, name: str, pose: NDArray | None = None) -> Usd.Prim:
    """An Xform called `name` at a pose, shape (4, 4)."""
    prim = UsdGeom.Xform.Define(stage, path).GetPrim()
    if pose is not None:
        write_pose(prim, *pose_of(pose))
    _show_name(prim, name)
    return prim


def _show_name(prim: Usd.Prim, name: str) -> None:
    """Keep the name in the description as the prim's display name if USD does not allow it."""
    if prim.GetName() != name:
        prim.SetDisplayName(name)


def identifier(name: str) -> str:
    """A valid USD name: letters and digits of any script are kept, other characters become underscores."""
    if Sdf.Path.IsValidIdentifier(name):
        return name
    kept = "".join(c if Sdf.Path.IsValidIdentifier(f"_{c}") else "_" for c in name)
    return kept if Sdf.Path.IsValidIdentifier(kept) else f"_{kept}"


def _free_names(
    wanted: Iterable[str], taken: set[str], what: str, description: Description
) -> dict[str, str]:
    """Unique valid names, none in `taken`; names that need no change get precedence, changes are noted."""
    wanted = list(wanted)
    used = taken | {name for name in wanted if identifier(name) == name}
    names = {}
    for name in wanted:
        names[name] = name
        if identifier(name) != name or name in taken:
            names[name] = free_name(identifier(name), used)
            description.note(f"{what}{name!r} is called {names[name]!r} in USD")
    return names
