"""`magtwin robot`: convert a URDF to a USD articulation, and back."""

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from magtwin.cli.app import app
from magtwin.cli.terminal import Force, Json, check_suffix, print_report, say, step
from magtwin.errors import InputError


@app.command
def robot(
    urdf: Path,
    *,
    out: Path | None = None,
    to_urdf: Path | None = None,
    settings: Path | None = None,
    package: Annotated[list[str] | None, Parameter(negative="")] = None,
    arg: Annotated[list[str] | None, Parameter(negative="")] = None,
    missing_meshes: Literal["refuse", "note"] | None = None,
    collision: Literal["hull", "decomposition", "mesh"] | None = None,
    profile: Literal["general", "diff-drive"] | None = None,
    drive: Annotated[list[str] | None, Parameter(negative="")] = None,
    fix_base: bool | None = None,
    merge_fixed: bool | None = None,
    density: float | None = None,
    mass: float | None = None,
    single_file: bool | None = None,
    strict: bool | None = None,
    thumbnail: Annotated[bool, Parameter(negative="")] = False,
    report: Path | None = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Convert a URDF or a xacro to a USD articulation that can be driven, or back.

    Parameters
    ----------
    urdf
        The robot's description, .urdf or .xacro; with --to-urdf, a stage with one robot.
    out
        Folder to create, with NAME.usda and the layers it references.
    to_urdf
        URDF to write from a stage, instead of --out, with the same kinematics and inertia.
        Only --force and --json may be given with it.
    settings
        TOML with drive, battery, platform field, sensor mounts and conversion, such as
        robots/turtlebot4/robot.toml; options on the command line override its [conversion].
    package
        NAME=DIR: folder of a package for package:// or $(find); may be repeated.
    arg
        NAME=VALUE: an argument of the xacro; may be repeated.
    missing_meshes
        Treatment of missing meshes: refuse, or leave them out with a note.
    collision
        Mesh colliders: convex hull, convex decomposition (extra "decomposition"), or the mesh itself.
    profile
        diff-drive: velocity drives on wheels, low friction on casters, suspensions without springs welded.
    drive
        PATTERN:TYPE[:stiffness=X][:damping=X][:max_force=X], TYPE velocity, position or none: drive of joints
        whose name matches; may be repeated, the first match wins.
    fix_base
        Fix the base to the world.
    merge_fixed
        Merge links on fixed joints into the body above; their frames stay.
    density
        Density of links without inertia [kg/m3].
    mass
        Mass on the data sheet, to check the robot's [kg].
    single_file
        Write one root layer and the meshes, instead of Isaac Sim's layers.
    strict
        Refuse a conversion that loses anything.
    thumbnail
        Draw a picture beside the asset, which NVIDIA's SimReady profiles require.
    report
        File for the whole report, .json.
    force
        Replace existing files.
    json
        Print the summary as JSON.
    """
    from magtwin.author.from_urdf import DriveRule, from_urdf
    from magtwin.files import check_free, output

    if (out is None) == (to_urdf is None):
        raise InputError(
            "robot writes a stage with --out DIR, or a URDF with --to-urdf FILE; give one of them"
        )
    given = (settings, package, arg, missing_meshes, collision, profile, drive, fix_base, merge_fixed)
    if to_urdf is not None:
        if any(option is not None for option in (*given, density, mass, single_file, strict, report)):
            raise InputError("--to-urdf takes only --force and --json; leave the other options out")
        _to_urdf(urdf, to_urdf, force=force, json=json)
        return
    assert out is not None
    if report is not None:
        check_suffix(report, (".json",), "a report")
        check_free(report, force=force)
    choices = {
        "packages": {k: Path(v) for k, v in _pairs("package", package).items()} if package else None,
        "arguments": _pairs("arg", arg) if arg else None,
        "missing_meshes": missing_meshes,
        "collision": collision,
        "profile": profile,
        "drives": tuple(DriveRule.parse(text) for text in drive) if drive else None,
        "fix_base": fix_base,
        "merge_fixed": merge_fixed,
        "density": density,
        "mass": mass,
        "single_file": single_file,
        "strict": strict,
    }
    step("Converting the robot")
    made = from_urdf(
        urdf,
        out,
        settings=settings,
        force=force,
        thumbnail=_thumbnail if thumbnail else None,
        **{name: choice for name, choice in choices.items() if choice is not None},
    )
    if report is not None:
        with output(report, force=force) as aside:
            aside.write_text(made.report.to_json(), encoding="utf-8")
    print_report(made.report.summary(), json)
    if not json:
        say(f"Wrote {made.asset}")


def _to_urdf(stage: Path, out: Path, *, force: bool, json: bool) -> None:
    from magtwin.author.from_urdf import write_urdf

    if stage.suffix in (".urdf", ".xacro"):
        raise InputError(f"{stage}: --to-urdf takes a stage, .usd, .usda, .usdc or .usdz")
    print_report(write_urdf(stage, out, force=force), json)
    if not json:
        say(f"Wrote {out}")


def _thumbnail(asset: Path, out: Path) -> None:
    from magtwin.figures.pictures import picture_of_stage

    picture_of_stage(asset, out, size=(256, 256))


def _pairs(option: str, texts: list[str]) -> dict[str, str]:
    """NAME=VALUE texts as a table."""
    pairs = [text.partition("=") for text in texts]
    for text, (name, equals, _) in zip(texts, pairs, strict=True):
        if not (name and equals):
            raise InputError(f"--{option} {text!r}: expected NAME=VALUE")
    return {name: value for name, _, value in pairs}
