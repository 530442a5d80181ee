"""`magtwin robot`: a description in, a USD articulation out, and back."""

from contextlib import ExitStack
from pathlib import Path
from typing import Literal

from magtwin.cli.app import app
from magtwin.cli.options import Flag, Force, pairs
from magtwin.cli.terminal import Done, named, note, step
from magtwin.errors import InputError


@app.command
def robot(
    urdf: Path,
    *,
    out: Path,
    settings: Path | None = None,
    package: list[str] | None = None,
    arg: list[str] | None = None,
    skip_missing_includes: bool | None = None,
    profile: Literal["general", "diff-drive"] | None = None,
    drive: list[str] | None = None,
    controllers: Path | None = None,
    fix_base: bool | None = None,
    merge_fixed: bool | None = None,
    density: float | None = None,
    single_file: bool | None = None,
    strict: bool | None = None,
    thumbnail: Flag = False,
    report: Path | None = None,
    proof: Path | None = None,
    force: Force = False,
) -> Done:
    """Convert a URDF or xacro to a USD articulation that drives, or such a stage to a URDF.

    Parameters
    ----------
    urdf
        Robot description (.urdf, .xacro); or a stage with one robot, to write as a URDF.
    out
        Folder to make, with NAME.usda and its layers; or one .usda with its meshes beside it; or a .urdf to
        write from a stage, with the same kinematics and inertia.
    settings
        TOML with drive, battery, platform field, sensor mounts and conversion, such as
        robots/turtlebot4/robot.toml. Options given here override its [conversion].
    package
        NAME=DIR: folder of a package that package:// or $(find) names. May be repeated.
    arg
        NAME=VALUE: argument of the xacro. May be repeated.
    skip_missing_includes
        Skip files and packages that a xacro includes but that are missing, if none of their macros is called.
    profile
        general; or diff-drive: velocity drives on wheels, casters without friction, dead suspensions welded.
    drive
        PATTERN:TYPE[:stiffness=X][:damping=X][:max_force=X], TYPE velocity, position or none: drive of the
        joints whose name fits. May be repeated; the first that fits wins.
    controllers
        YAML with the settings of the robot's controllers (ros_control, ros2_control), for its drive.
    fix_base
        Fix the base to the world.
    merge_fixed
        Merge links on fixed joints into the body that carries them; their frames stay.
    density
        Density of links whose mass the description does not give [kg/m3]. Default: 1000.
    single_file
        Write one root layer and its meshes, in place of Isaac Sim's layers.
    strict
        Refuse a description with faults, naming all of them, in place of repairing it.
    thumbnail
        Draw a picture of the robot beside it, which NVIDIA's SimReady profiles require.
    report
        Full report to write (.json).
    proof
        Table to write (.csv): each element and attribute with the prim and value that carries it, or "lost".
    """
    given = dict(locals())
    from magtwin.files.outputs import output, transaction

    if out.suffix.lower() in (".usd", ".usdc", ".usdz"):
        give = f"give {out.stem}, or {out.stem}.usda"
        raise InputError(f"{out}: a robot is a folder, or one file .usda; {give}")
    beside = {".usda": ("_meshes.usdc", "_textures"), ".urdf": ("_meshes",)}.get(out.suffix.lower(), ())
    out = named(out, beside=beside, force=force)
    if out.suffix.lower() == ".urdf":
        from magtwin.author.from_urdf import write_urdf

        own = ("urdf", "out", "thumbnail", "force")
        if any(value is not None for name, value in given.items() if name not in own):
            raise InputError("a stage is written as a URDF without other options than --force; drop them")
        if urdf.suffix.lower() in (".urdf", ".xacro"):
            raise InputError(f"{urdf}: is no stage; a URDF is written from .usd, .usda, .usdc or .usdz")
        told = write_urdf(urdf, out, force=force)
        return Done(told, out, next=(("magtwin", "robot", out, "--out", out.stem),))
    from magtwin.author.from_urdf import DriveRule, from_urdf

    if report is not None:
        report = named(report, (".json",), "a report", force=force)
    if proof is not None:
        proof = named(proof, (".csv",), "a proof", force=force)
    if out.suffix.lower() == ".usda" and single_file is None:
        note(f"{out} is one file, with its meshes beside it; --out {out.stem} makes a folder of layers")
    same = ("skip_missing_includes", "profile", "fix_base", "merge_fixed", "density", "single_file", "strict")
    choices = {name: given[name] for name in same} | {
        "packages": {name: Path(folder) for name, folder in pairs("package", package).items()} or None,
        "arguments": pairs("arg", arg, empty=True) or None,
        "drives": tuple(DriveRule.parse(text) for text in drive or ()) or None,
        "controllers": controllers,
        "proof": True if proof is not None else None,
    }
    step("Converting the robot")
    with transaction(), ExitStack() as files:
        asides = {f: files.enter_context(output(f, force=force)) for f in (report, proof) if f is not None}
        chosen = {name: choice for name, choice in choices.items() if choice is not None}
        picture = _thumbnail if thumbnail else None
        made = from_urdf(urdf, out, settings=settings, force=force, thumbnail=picture, **chosen)
        for file, aside in asides.items():
            text = made.report.to_json() if file == report else made.report.proof_table()
            aside.write_text(text, encoding="utf-8")
    summary = made.report.summary()
    following = (("magtwin", "plot", made.asset), ("magtwin", "validate", made.asset))
    return Done(summary, made.asset, rest=f"magtwin info {made.asset}", next=following)


def _thumbnail(asset: Path, out: Path) -> None:
    from magtwin.figures.pictures import picture_of_stage

    picture_of_stage(asset, out, size=(256, 256))
