"""Convert: a URDF becomes a USD articulation that drives; the steps stand here in their order."""

import os
import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path

from pxr import Sdf, Usd, UsdGeom, UsdPhysics, UsdUtils, Vt

from magtwin.errors import InputError
from magtwin.files import check_free, output, sha256
from magtwin.spec.drive import DriveSpec
from magtwin.urdf.description.control import define_differential, define_safety, read_commands, read_drive
from magtwin.urdf.description.description import Description, origin_of, read_description
from magtwin.urdf.description.gazebo import (
    Surface,
    define_springs,
    define_weightless,
    read_surfaces,
    self_collides,
)
from magtwin.urdf.description.tag import Tags
from magtwin.urdf.drive import NO_WHEELS, WheelDrive, check_rules
from magtwin.urdf.joint import define_joint, define_mimic, define_root_joint
from magtwin.urdf.layout import GEOMETRIES, PAYLOADS, check_payloads, write_layers
from magtwin.urdf.link import Rider, define_body, define_frame, is_marker
from magtwin.urdf.lint import lint
from magtwin.urdf.material import LOOKS
from magtwin.urdf.mechanism import Mechanism, read_mechanism
from magtwin.urdf.merge import WORLD, Place, carried, place_links, riders
from magtwin.urdf.meshes.mesh_layer import MeshLayer, free_name, gather
from magtwin.urdf.meshes.texture import TEXTURES
from magtwin.urdf.options import DEFAULTS, Options
from magtwin.urdf.report import ConversionReport, Ledger, make_report
from magtwin.urdf.sensor import define_sensors
from magtwin.urdf.shape import COLLISIONS, VISUALS, define_collider, define_visual, pose_of
from magtwin.urdf.simready import check_metadata, metadata
from magtwin.urdf.source.source import read_source
from magtwin.urdf.wheel import find_wheels, fit_wheels, grip, not_on
from magtwin.usd.layers import describe_stage, open_stage
from magtwin.usd.sensors import write_pose

JOINTS = "joints"
"""Scope of the joints below the robot's prim."""

THUMBNAILS = Path(".thumbs", "256x256")
"""Folder of an asset's picture beside it."""

ROBOT_API, ARTICULATION_API = "IsaacRobotAPI", "NewtonArticulationRootAPI"
"""Applied schemas of Isaac Sim and Newton, by name: their plugins live elsewhere."""


def convert_urdf(
    urdf: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    options: Options = DEFAULTS,
    force: bool = False,
    finish: Callable[[Usd.Prim], Iterable[str]] | None = None,
) -> Path:
    """Convert a URDF to a USD articulation with a floating base: `convert_with_report` without its report.

    Args, refusals and what is authored as there.

    Returns:
        `out`.
    """
    convert_with_report(urdf, out, options=options, force=force, finish=finish)
    return Path(out)


def convert_with_report(
    urdf: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    options: Options = DEFAULTS,
    force: bool = False,
    finish: Callable[[Usd.Prim], Iterable[str]] | None = None,
    thumbnail: Callable[[Path, Path], object] | None = None,
) -> ConversionReport:
    """Convert a URDF to a USD articulation with a floating base, and say what became of it.

    The robot's prim is the URDF's root link's frame. Its links lie flat below it as rigid bodies, its
    joints in a scope of their own; links that only name a place become sites on the body they ride on.
    What was repaired, guessed or left out is kept in the file, see `read_notes`.

    Args:
        urdf: The description; its meshes lie below its folder or in packages around it.
        out: Root layer to write, `.usda`; the folder `payloads` beside it has the others, see `layout`.
            With `options.single_file` there is one other at most, `<stem>_meshes.usdc`.
        options: What is done where the URDF leaves a choice.
        force: Whether files that are there are replaced.
        finish: Called with the robot's prim before anything is written, to author more; gives notes.
        thumbnail: Called with `out` and the name of a PNG to draw of it, 256 pixels square; it lies
            where asset browsers look for it, `.thumbs/256x256/`.

    Returns:
        Every link, joint and geometry, in and out, with what was repaired, guessed or left out.

    Raises:
        InputError: The URDF or a mesh cannot be converted, something was lost and `options.strict`
            forbids that, or a file is there already; nothing is written.
    """
    out = Path(out)
    if out.suffix != ".usda":
        raise InputError(f"{out}: the robot's root layer is text; give it the suffix .usda")
    check_metadata(options.metadata)
    report = _convert(urdf, out, options, force, finish)
    if thumbnail is not None:
        with output(out.parent / THUMBNAILS / f"{out.name}.png", force=True) as aside:
            thumbnail(out, aside)
    return report


def _convert(
    urdf: str | os.PathLike[str],
    out: Path,
    options: Options,
    force: bool,
    finish: Callable[[Usd.Prim], Iterable[str]] | None,
) -> ConversionReport:
    """Read, author and write, see `convert_with_report`."""
    source = read_source(urdf, packages=options.packages, arguments=options.arguments)
    description = read_description(source)
    beside, pictures = (out.with_name(f"{out.stem}_{what}") for what in ("meshes.usdc", "textures"))
    textures = pictures.name if options.single_file else f"{PAYLOADS}/{TEXTURES}"
    meshes = gather(description, options, f"./{textures}")
    check_free(out, force=force)
    if not options.single_file:
        folder = check_payloads(out, force=force)
        with output(folder, force=force) as aside_folder, output(out, force=force) as aside:
            work = aside.with_name(PAYLOADS)  # beside the root layer, so that references resolve
            work.mkdir()
            if meshes:
                meshes.export(work / GEOMETRIES)
            stage, report = _author_all(
                description, options, meshes, aside, f"./{PAYLOADS}/{GEOMETRIES}", out, finish
            )
            if meshes.textures:
                meshes.textures.export(work / TEXTURES)
            write_layers(stage.GetRootLayer(), aside, work, out)
            shutil.move(work, aside_folder)
        return report
    with output(out, force=force) as aside:
        if not meshes:
            return _write(description, options, meshes, aside, beside.name, out, finish)
        with output(beside, force=force) as aside_meshes:
            copy = aside.with_name(beside.name)
            meshes.export(copy)
            report = _write(description, options, meshes, aside, beside.name, out, finish)
            shutil.move(copy, aside_meshes)
            if meshes.textures:
                with output(pictures, force=force) as aside_pictures:
                    meshes.textures.export(aside_pictures)
    return report


def read_notes(asset: str | os.PathLike[str]) -> tuple[str, ...]:
    """What a conversion repaired, guessed or left out, one line each.

    Raises:
        InputError: The file is missing or is not USD.
    """
    stage = open_stage(asset)  # held in a name: a layer does not outlive its stage
    metadata = stage.GetRootLayer().customLayerData.get("magtwin", {})
    return tuple(metadata.get("notes", ()))


def _write(
    description: Description,
    options: Options,
    meshes: MeshLayer,
    aside: Path,
    mesh_layer: str,
    out: Path,
    finish: Callable[[Usd.Prim], Iterable[str]] | None,
) -> ConversionReport:
    """Write the root layer at `aside`, with asset paths that hold once it stands at `out`."""
    stage, report = _author_all(description, options, meshes, aside, f"./{mesh_layer}", out, finish)

    def as_seen_from_out(path: str) -> str:
        if not path.startswith("../"):
            return path
        return Path(os.path.relpath(aside.parent / path, out.resolve().parent)).as_posix()

    UsdUtils.ModifyAssetPaths(stage.GetRootLayer(), as_seen_from_out)
    stage.GetRootLayer().Save()
    return report


def _author_all(
    description: Description,
    options: Options,
    meshes: MeshLayer,
    aside: Path,
    mesh_layer: str,
    out: Path,
    finish: Callable[[Usd.Prim], Iterable[str]] | None,
) -> tuple[Usd.Stage, ConversionReport]:
    """Author the whole robot in one layer at `aside`, and compare it with its description."""
    stage, ledger, checksum = Usd.Stage.CreateNew(str(aside)), Ledger(), sha256(description.path)
    robot = _author(stage, description, options, meshes, mesh_layer, ledger)
    if finish is not None:
        for note in finish(robot):
            description.note(note)
    report = make_report(
        description,
        meshes,
        stage,
        ledger,
        name=out.name,
        sha256=checksum,
        poses=read_mechanism(description, options).poses(),
        lint=lint(description, mass=options.mass, vertices=meshes.vertices),
    )
    if options.strict:
        report.refuse_losses()
    stage.GetRootLayer().customLayerData = {
        **stage.GetRootLayer().customLayerData,
        **metadata(stage, description, report, options.metadata),
        "magtwin": {
            "source": description.path.name,
            "sourceSha256": checksum,
            "notes": Vt.StringArray(description.notes),
        },
    }
    return stage, report


def _author(
    stage: Usd.Stage,
    description: Description,
    options: Options,
    meshes: MeshLayer,
    layer: str,
    ledger: Ledger,
) -> Usd.Prim:
    """The robot's prim with all that hangs from it."""
    describe_stage(stage, f"{description.name}: converted from {description.path.name}.")
    names = _prim_names(description)
    mechanism, tags = read_mechanism(description, options), Tags(description)
    check_rules(mechanism, options)
    (drive, named), commands = read_drive(tags, mechanism), read_commands(tags, mechanism)
    surfaces = read_surfaces(tags)
    driven: tuple[str, ...] = ()
    if options.profile == "diff-drive":
        driven = find_wheels(mechanism, named)
        surfaces = grip(mechanism, driven, surfaces)
        commands = not_on(driven, commands)
    options = replace(options, drives=(*options.drives, *commands))
    places, poses = place_links(mechanism, merge=options.merge_fixed), mechanism.poses()
    robot = UsdGeom.Xform.Define(stage, Sdf.Path.absoluteRootPath.AppendChild(names[""])).GetPrim()
    _show_name(robot, description.name)
    stage.SetDefaultPrim(robot)
    Usd.ModelAPI(robot).SetKind("component")
    paths = {WORLD: robot.GetPath()}
    for name in description.links:
        if places[name][0] != name:
            continue
        body = UsdGeom.Xform.Define(stage, robot.GetPath().AppendChild(names[name])).GetPrim()
        write_pose(body, *pose_of(poses[name]))
        _show_name(body, name)
        paths[name] = body.GetPath()
        ledger.link(name, "body", body)
        parts = []
        for part, pose in riders(places, name):
            link, surface = description.links[part], surfaces.get(part, Surface())
            parts.append(Rider(link, pose))
            for i, visual in enumerate(carried(link.visuals, pose, part, name)):
                made = define_visual(body, visual, description, meshes, layer)
                ledger.shape(part, "visual", i, made)
                parts[-1].visuals.extend(made)
            for i, collision in enumerate(carried(link.collisions, pose, part, name)):
                made = define_collider(body, collision, surface, meshes, layer)
                ledger.shape(part, "collision", i, made)
                parts[-1].colliders.extend(made)
        define_body(body, parts, description, options.density)
    for name, (above, pose) in places.items():
        if above != name:
            frame = UsdGeom.Xform.Define(stage, paths[above].AppendChild(names[name])).GetPrim()
            write_pose(frame, *pose_of(pose))
            _show_name(frame, name)
            define_frame(frame)
            ledger.link(name, "frame" if is_marker(description.links[name]) else "merged", frame)
    scope = UsdGeom.Scope.Define(stage, robot.GetPath().AppendChild(JOINTS)).GetPath()
    bodies = {name: stage.GetPrimAtPath(path) for name, path in paths.items() if name != WORLD}
    wheels = fit_wheels(mechanism, driven, bodies) if driven else NO_WHEELS
    joints = _define_joints(stage, scope, mechanism, options, wheels, places, paths, ledger)
    links = [path for name, path in paths.items() if name != WORLD]
    _articulate(robot, links, joints, self_collision=self_collides(tags))
    _equip(robot, tags, options, drive, ledger)
    return robot


def _equip(robot: Usd.Prim, tags: Tags, options: Options, drive: DriveSpec | None, ledger: Ledger) -> None:
    """Author what the tags beyond URDF tell of; what is left of them is kept as text."""
    stage = robot.GetStage()

    def link_of(name: str) -> Usd.Prim:
        return stage.GetPrimAtPath(ledger.bodies[name][1])

    def joint_of(name: str) -> Usd.Prim | None:
        return stage.GetPrimAtPath(ledger.joints[name]) if name in ledger.joints else None

    define_springs(tags, joint_of, options)
    define_weightless(tags, link_of)
    define_safety(tags, joint_of)
    if not options.fix_base and (drive is not None or options.profile == "diff-drive"):
        robot.CreateAttribute("isaac:robotType", Sdf.ValueTypeNames.Token, custom=False).Set("Wheeled")
    if drive is not None:
        define_differential(robot, drive, {name: path.name for name, path in ledger.joints.items()})
    define_sensors(tags, robot, link_of)
    ledger.unknown_tags = tags.keep(
        lambda name: link_of(name) if name in ledger.bodies else joint_of(name) or robot
    )
    count = sum(ledger.unknown_tags.values())
    if count:
        most = sorted(ledger.unknown_tags, key=lambda tag: -ledger.unknown_tags[tag])[:4]
        tags.description.note(
            f"{count} tags without a meaning here are kept as text, such as {', '.join(most)}"
        )


def _define_joints(
    stage: Usd.Stage,
    scope: Sdf.Path,
    mechanism: Mechanism,
    options: Options,
    wheels: Mapping[str, WheelDrive],
    places: dict[str, Place],
    paths: dict[str, Sdf.Path],
    ledger: Ledger,
) -> list[Sdf.Path]:
    """The joints between bodies, those to the world first; a floating one is none."""
    description, made = mechanism.description, {}
    names = _joint_names(description)
    base = next((name for name, (above, _) in places.items() if above == name), WORLD)
    if options.fix_base and places[description.root][0] != WORLD and base != WORLD:
        pose = mechanism.poses()[base]
        root = define_root_joint(stage, scope.AppendChild(names[""]), (paths[WORLD], paths[base]), pose)
        made[""] = root
    elif description.root == "world" and base != WORLD:
        description.note(
            f"link 'world' is no world: the base {base!r} floats, unless it is asked to be fixed"
        )
    for child, joint in description.joints.items():
        above, pose = places[joint.parent]
        if child not in paths or above == child or (child == base and joint.type == "floating"):
            continue
        if joint.type == "floating":
            description.note(
                f"joint {joint.name!r} is floating: link {child!r} is a body of its own, held by nothing"
            )
            continue
        path, ends = scope.AppendChild(names[joint.name]), (paths[above], paths[child])
        at = mechanism.pose(joint) if joint.name in mechanism.welded else origin_of(joint)
        prim = define_joint(stage, path, joint, ends, pose @ at, mechanism, options, wheels)
        _show_name(prim, joint.name)
        made[joint.name] = prim
        ledger.joint(joint.name, prim)
    joints = {joint.name: joint for joint in description.joints.values()}
    for name, mimic in mechanism.mimics.items():
        define_mimic(made[name], made[mimic.leader], joints[name], joints[mimic.leader], mechanism)
    return [prim.GetPath() for prim in made.values()]


def _articulate(
    robot: Usd.Prim, links: list[Sdf.Path], joints: list[Sdf.Path], *, self_collision: bool
) -> None:
    """Make the robot's prim one articulation, that says whether it collides with itself."""
    UsdPhysics.ArticulationRootAPI.Apply(robot)
    robot.AddAppliedSchema(ROBOT_API)
    robot.AddAppliedSchema(ARTICULATION_API)
    kinds = Sdf.ValueTypeNames
    robot.CreateAttribute("newton:selfCollisionEnabled", kinds.Bool, custom=False).Set(self_collision)
    physx = robot.CreateAttribute("physxArticulation:enabledSelfCollisions", kinds.Bool, custom=False)
    physx.Set(self_collision)
    robot.CreateRelationship("isaac:physics:robotLinks", custom=False).SetTargets(links)
    robot.CreateRelationship("isaac:physics:robotJoints", custom=False).SetTargets(joints)


def identifier(name: str) -> str:
    """A name as USD allows it: letters and digits of any script stay, whatever else is an underscore."""
    if Sdf.Path.IsValidIdentifier(name):
        return name
    kept = "".join(c if Sdf.Path.IsValidIdentifier(f"_{c}") else "_" for c in name)
    return kept if Sdf.Path.IsValidIdentifier(kept) else f"_{kept}"


def _show_name(prim: Usd.Prim, name: str) -> None:
    """Let viewers, and whoever looks for it, find a prim under the name that the description has for it."""
    if prim.GetName() != name:
        prim.SetDisplayName(name)


def _joint_names(description: Description) -> dict[str, str]:
    """Names of the prims of the root joint ("") and of the joints, as USD allows them."""
    joints = [joint.name for joint in description.joints.values()]
    names, taken = _free_names(joints, set(), "joint ", description), set(joints)
    free = ("root_joint", *(f"root_joint_{i}" for i in range(2, len(names) + 3)))
    names[""] = next(name for name in free if name not in taken.union(names.values()))
    return names


def _prim_names(description: Description) -> dict[str, str]:
    """Names of the prims of the robot ("") and of its links, as USD allows them.

    No link has a name that a scope of the robot or of a body has.
    """
    robot = identifier(description.name)
    if robot != description.name:
        description.note(f"{description.name!r} is called {robot!r} in USD")
    scopes = {JOINTS, LOOKS, VISUALS, COLLISIONS}
    return {"": robot, **_free_names(description.links, scopes, "", description)}


def _free_names(
    wanted: Iterable[str], taken: set[str], what: str, description: Description
) -> dict[str, str]:
    """Names as USD allows them, no two alike; those that need no change come first, the others are noted.

    Args:
        wanted: Names in the description.
        taken: Names that none may have.
        what: What is named, for notes.
        description: Takes the notes.
    """
    wanted = list(wanted)
    used = taken | {name for name in wanted if identifier(name) == name}
    names = {}
    for name in wanted:
        names[name] = name
        if identifier(name) != name or name in taken:
            names[name] = free_name(identifier(name), used)
            description.note(f"{what}{name!r} is called {names[name]!r} in USD")
    return names
