"""The command line: one typed function a subcommand, nothing else."""

import signal
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

from cyclopts import App, Parameter
from cyclopts.config import Env, Toml
from cyclopts.exceptions import CycloptsError

import magtwin
from magtwin.names import RefusedError

app = App(
    name="magtwin",
    help="Magnetic digital twins of robots: author labs and robots as USD, drive them, log what a "
    "neural-network magnetometer reads.",
    version=magtwin.__version__,
    config=[Env("MAGTWIN_", show=False), Toml("magtwin.toml", search_parents=False)],
    help_epilogue="Options also come from the environment (MAGTWIN_RUN_SEED=1) and from magtwin.toml. "
    "Exit status: 0 done, 1 an input was refused, 2 wrong usage. --debug shows the traceback of a refusal.",
)
map_app = App(name="map", help="Make and look at anomaly maps.")
net_app = App(name="net", help="Work with networks.")
app.command(map_app)
app.command(net_app)


def _whole(kind: type, tokens: Any) -> int:
    """A whole number; cyclopts itself would round 1.5 to 2."""
    return int(tokens[0].value)


Seed = Annotated[int, Parameter(converter=_whole)]
Force = Annotated[bool, Parameter(name="--force", negative="")]
Json = Annotated[bool, Parameter(name="--json", negative="")]


@app.command
def demo(*, out: Path = Path("demo"), seed: Seed = 0, force: Force = False, json: Json = False) -> None:
    """Author a lab and a TurtleBot 4, drive a figure of eight, log what the magnetometer reads.

    Writes the stages, run.rrd (opens in Rerun), run.parquet and pictures. Takes under a minute.

    Parameters
    ----------
    out
        Folder to make.
    seed
        Seed of all noise.
    force
        Replace the folder if it exists.
    json
        Print the summary as JSON.
    """
    from magtwin.files import output, shipped
    from magtwin.twin import scene_from_toml
    from magtwin.usd.robot import build_robot
    from magtwin.usd.scene import author_scene

    steps = _steps(quiet=json)
    with output(out, force=force) as folder:
        steps("Authoring the TurtleBot 4 from its URDF")
        source = shipped("robots", "turtlebot4")
        asset = folder / "robot" / "turtlebot4.usda"
        build_robot(source / "turtlebot4.urdf", source / "robot.toml", asset)
        steps("Authoring the lab around it, with its magnetic map")
        scene = scene_from_toml(shipped("scenes", "lab.toml"))
        scene = replace(scene, robot=replace(scene.robot, asset=asset))
        scene_file = author_scene(scene, folder / "scene")
        report = _run(
            scene_file, "figure8", folder, steps=steps, seed=seed, speed=0.2, title=f"Demo in {out}"
        )
        steps("Taking pictures")
        _picture(scene_file, folder / "lab.png")
    _print_report(report, json)
    if not json:
        pictures = ", ".join(str(file) for file in sorted(out.glob("*.png")))
        _say(f"\nLook at it:  magtwin view {out / 'run.rrd'}\nPictures:    {pictures}")


@app.command
def robot(
    urdf: Path,
    *,
    out: Path,
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
    """Convert a URDF or a xacro to a USD articulation that drives.

    Parameters
    ----------
    urdf
        The robot's description, .urdf or .xacro.
    out
        Folder to make; it will hold NAME.usda and the layers it refers to.
    settings
        TOML with drive, battery, platform field, sensor mounts and conversion, such as
        robots/turtlebot4/robot.toml; options given here come before its [conversion].
    package
        NAME=DIR: where a package lies that package:// or $(find) names; may be given again.
    arg
        NAME=VALUE: an argument of the xacro; may be given again.
    missing_meshes
        What to do about a mesh that is not there: refuse, or leave it out and note it.
    collision
        What a mesh collides as: its convex hull, a convex decomposition (extra "decomposition"), or itself.
    profile
        diff-drive: velocity drives on wheels, slippery casters, dead suspensions welded.
    drive
        PATTERN:TYPE[:stiffness=X][:damping=X][:max_force=X], TYPE velocity, position or none: how joints
        whose name fits are driven; may be given again, the first that fits wins.
    fix_base
        Bolt the base to the world.
    merge_fixed
        Merge links on fixed joints into the body that they ride on; their frames stay.
    density
        Density of links without inertia [kg/m3].
    mass
        Mass of a data sheet to hold the robot's against [kg].
    single_file
        One root layer and its meshes, in place of Isaac Sim's layers.
    strict
        Refuse a conversion that loses anything.
    thumbnail
        Draw a picture of the robot beside it, which NVIDIA's SimReady profiles ask for.
    report
        Where to write the whole report, a .json file.
    force
        Replace what exists.
    json
        Print the summary as JSON.
    """
    from magtwin.files import check_free, output
    from magtwin.robot import DriveRule, from_urdf

    if report is not None:
        _check_suffix(report, (".json",), "a report")
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
    _print_report(made.report.summary(), json)
    if not json:
        _say(f"Wrote {made.asset}")


@map_app.command(name="import")
def map_import(
    folder: Path,
    *,
    out: Path,
    name: str | None = None,
    licence: str = "",
    force: Force = False,
    json: Json = False,
) -> None:
    """Read a survey, one CSV file a heading, into a map layer.

    Parameters
    ----------
    folder
        Folder of 0_map.csv, 90_map.csv, ...: rows of x [m], y [m], heading [rad], field [nT].
    out
        Map layer to write, a .usdc file.
    name
        Name of the map; the file's unless given.
    licence
        Licence of the survey, an SPDX identifier such as MIT.
    force
        Replace the file if it exists.
    json
        Print the summary as JSON.
    """
    from magtwin.field.survey import read_survey
    from magtwin.files import check_free
    from magtwin.usd.maps import save_map

    _check_suffix(out, (".usdc", ".usd"), "a map layer")
    check_free(out, force=force)
    field, report = read_survey(folder, name=name or out.stem, licence=licence)
    save_map(field, out, force=force)
    _print_report(report, json)
    if not json:
        _say(f"Wrote {out}")


@map_app.command(name="plot")
def map_plot(file: Path, *, out: Path, force: Force = False) -> None:
    """Draw a map, a panel a heading.

    Parameters
    ----------
    file
        Map layer (.usdc), or a folder of survey CSVs.
    out
        Picture to write, a .png file.
    force
        Replace the picture if it exists.
    """
    from magtwin.files import output
    from magtwin.io.plots import plot_map

    _check_suffix(out, (".png",), "a picture")
    field = _open_map(file)
    with output(out, force=force) as aside:
        plot_map(field, aside)
    _say(f"Wrote {out}")


@map_app.command(name="info")
def map_info(file: Path, *, json: Json = False) -> None:
    """Say what a map holds and where it comes from.

    Parameters
    ----------
    file
        Map layer (.usdc), or a folder of survey CSVs.
    json
        Print it as JSON.
    """
    _print_report(_open_map(file).report(), json)


@app.command
def scene(
    spec: str,
    *,
    out: Path,
    map: Path | None = None,  # noqa: A002 - the option is called --map
    net: Path | None = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Author a scene from its TOML: the lab, its map, a robot with sensors.

    Parameters
    ----------
    spec
        TOML file, or the name of one that ships with magtwin: lab, aprilab.
    out
        Folder to make; it holds all that the stage needs and can be moved.
    map
        Map layer to use in place of the one that the TOML names.
    net
        Weights to use in place of those that the TOML names (.safetensors or .pth).
    force
        Replace the folder if it exists.
    json
        Print the summary as JSON.
    """
    from magtwin.files import shipped
    from magtwin.twin import scene_from_toml
    from magtwin.usd.info import info_of_stage
    from magtwin.usd.scene import author_scene

    file = Path(spec)
    if not file.suffix and not file.is_file():
        from magtwin.names import find

        file = find("scene", spec, {f.stem: f for f in sorted(shipped("scenes").glob("*.toml"))})
    with TemporaryDirectory() as workshop:
        scene = scene_from_toml(file, map_layer=map, network=net, workshop=workshop)
        root = author_scene(scene, out, force=force)
    _print_report(info_of_stage(root), json)
    if not json:
        _say(f"Wrote {root}")


@app.command
def run(
    scene: Path,
    *,
    path: str = "figure8",
    net: Path | None = None,
    seed: Seed = 0,
    speed: float = 0.2,
    duration: float | None = None,
    rate_hz: float | None = None,
    lidar: Literal["schedule", "on", "off"] = "schedule",
    outside: Literal["nan", "clamp", "raise"] = "nan",
    out: Path | None = None,
    rrd: Path | None = None,
    parquet: Path | None = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Drive a scene's robot along a path and write what happened.

    With none of --out, --rrd and --parquet, writes the folder "run".

    Parameters
    ----------
    scene
        USD stage to drive in.
    path
        sine, lawnmower, figure8, narrow_figure8, curvilinear, or a CSV file of x,y [m].
    net
        Weights to use in place of the scene's (.safetensors or .pth); "none" for the disturbance by physics.
    seed
        Seed of all noise; one seed, one Run.
    speed
        Forward speed where the path is straight [m/s].
    duration
        How long to drive [s]; once along the path unless given, longer gives further laps.
    rate_hz
        Magnetometer readings a second [Hz]; the scene's unless given.
    lidar
        Whether the LiDAR follows its schedule, or stays on or off.
    outside
        What the map reads outside its extent: nan, the nearest value inside, or a refusal.
    out
        Folder to make, for run.rrd, run.parquet and run.png.
    rrd
        Rerun recording to write.
    parquet
        Parquet table to write.
    force
        Replace what exists.
    json
        Print the summary as JSON.
    """
    from magtwin.files import existing, output

    existing(scene, "scene")
    if out is rrd is parquet is None:
        out = Path("run")
    targets = (out, rrd, parquet)
    places = [target.resolve() for target in targets if target is not None]
    if len(set(places)) < len(places):
        raise RefusedError("two outputs have one name; give each its own")
    options: dict[str, Any] = {
        "steps": _steps(quiet=json),
        "net": net,
        "seed": seed,
        "speed": speed,
        "duration_s": duration,
        "rate_hz": rate_hz,
        "lidar": lidar,
        "outside": outside,
        "title": f"{path} in {scene}",
    }
    with ExitStack() as stack:  # all are written, or none
        asides = [t if t is None else stack.enter_context(output(t, force=force)) for t in targets]
        if asides[0] is not None:
            asides[0].mkdir()
        report = _run(scene, path, asides[0], rrd=asides[1], parquet=asides[2], **options)
    _print_report(report, json)
    if not json:
        _say("Wrote " + ", ".join(str(target) for target in targets if target is not None))


@net_app.command(name="convert")
def net_convert(pth: Path, *, out: Path, force: Force = False) -> None:
    """Convert a released checkpoint (.pth) to safetensors, executing nothing of what it holds.

    Parameters
    ----------
    pth
        Checkpoint with the weights and the two scalers.
    out
        File to write, .safetensors.
    force
        Replace the file if it exists.
    """
    from magtwin.learn.model import convert

    _check_suffix(out, (".safetensors",), "a network")
    net = convert(pth, out, force=force)
    _print_report(net.report(str(out)), as_json=False)
    _say(f"Wrote {out}")


@app.command
def info(file: Path, *, json: Json = False) -> None:
    """Say what a stage, a map, a run or a network holds.

    Parameters
    ----------
    file
        A .usd, .usda, .usdc, .usdz, .parquet, .safetensors or .pth file.
    json
        Print it as JSON.
    """
    from magtwin.files import existing
    from magtwin.names import find

    existing(file, "file")
    suffixes: dict[str, Any] = {
        ".usd": _info_of_usd,
        ".usda": _info_of_usd,
        ".usdc": _info_of_usd,
        ".usdz": _info_of_usd,
        ".parquet": _info_of_run,
        ".safetensors": _info_of_net,
        ".pth": _info_of_net,
    }
    if file.is_dir():
        raise RefusedError(f"{file}: a folder; name a file in it, or use `magtwin map info` for a survey")
    _print_report(find("kind of file", file.suffix, suffixes)(file), json)


@app.command
def view(file: Path) -> None:
    """Open a recording, or the series of a run, in the Rerun viewer.

    Parameters
    ----------
    file
        A .rrd file, or a .parquet file of a run.
    """
    from magtwin.io.rerun import view as view_rrd

    view_rrd(file)


@app.command
def fetch(
    what: Literal["aprilab", "turtlebot4"],
    *,
    dest: Path | None = None,
    base_url: str | None = None,
    force: Force = False,
) -> None:
    """Fetch the originals, at a pinned commit, each file checked against its SHA-256.

    Parameters
    ----------
    what
        aprilab: the survey, the released network and paths (MIT). turtlebot4: the description packages
        (Apache-2.0, BSD-3-Clause).
    dest
        Folder to make; named after the source unless given.
    base_url
        Address of a mirror with the same paths.
    force
        Replace the folder if it exists.
    """
    from magtwin.fetch import fetch as fetch_files

    dest = dest or Path(what)
    with _progress(f"Fetching {what}") as advance:
        files = fetch_files(what, dest, base_url=base_url, force=force, progress=advance)
    _say(f"Wrote {len(files)} files to {dest}")


def main(arguments: list[str] | None = None) -> None:
    """Entry point of the `magtwin` command; `arguments` are those of the command line unless given."""
    arguments = sys.argv[1:] if arguments is None else arguments
    debug = "--debug" in arguments
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that what is half-written goes
    try:
        app([a for a in arguments if a != "--debug"], exit_on_error=False, result_action="return_value")
    except CycloptsError:
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # `magtwin info ... | head`
        sys.stderr.close()
        sys.exit(141)
    except Exception as error:
        if debug:
            raise
        if isinstance(error, RefusedError):
            _fail(str(error))
        if isinstance(error, OSError | MemoryError):
            _fail(f"{error} ({type(error).__name__})")
        _fail(f"a fault of magtwin's own, {type(error).__name__}: {error}; --debug shows where, do report it")


def _fail(text: str) -> None:
    print("magtwin: " + " ".join(text.split()), file=sys.stderr)  # noqa: T201
    sys.exit(1)


def _say(text: str) -> None:
    print(text)  # noqa: T201


def _steps(*, quiet: bool) -> Any:
    """A function that says what is being done, on stderr."""
    return (lambda text: None) if quiet else (lambda text: print(f"  {text} ...", file=sys.stderr))  # noqa: T201


@contextmanager
def _progress(title: str) -> Iterator[Any]:
    """A progress bar with rate and time left; gives `advance(done, total, what)`."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn(title),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[what]}"),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task(title, total=None, what="")
        yield lambda done, total, what: progress.update(task, completed=done, total=total, what=what)


def _thumbnail(asset: Path, out: Path) -> None:
    from magtwin.io.pictures import picture_of_stage

    picture_of_stage(asset, out, size=(256, 256))


def _pairs(option: str, texts: list[str]) -> dict[str, str]:
    """NAME=VALUE texts as a table."""
    pairs = [text.partition("=") for text in texts]
    for text, (name, equals, _) in zip(texts, pairs, strict=True):
        if not (name and equals):
            raise RefusedError(f"--{option} {text!r}: NAME=VALUE is wanted")
    return {name: value for name, _, value in pairs}


def _check_suffix(path: Path, suffixes: tuple[str, ...], what: str) -> None:
    if path.suffix not in suffixes:
        raise RefusedError(f"{path}: {what} ends in {' or '.join(suffixes)}")


def _print_report(report: Any, as_json: bool) -> None:
    """A report as a table for people, or as JSON for scripts."""
    if as_json:
        _say(report.to_json())
        return
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(highlight=False)
    numbers, words = ((Table(show_header=False, box=None, pad_edge=False)) for _ in range(2))
    for column in ("name", "value", "spread", "unit", "note"):
        numbers.add_column(column, justify="right" if column == "value" else "left", overflow="fold")
    for column in ("name", "text"):
        words.add_column(column, overflow="fold")
    for figure in report.figures:
        if isinstance(figure.value, str):
            note = f"  ({figure.note})" if figure.note else ""
            words.add_row(Text(figure.name), Text(f"{figure.value} {figure.unit}{note}".strip()))
        else:
            value = f"{figure.value:,.6g}" if isinstance(figure.value, float) else f"{figure.value:,}"
            spread = f"± {figure.spread:,.3g}" if figure.spread is not None else ""
            cells = (figure.name, value, spread, figure.unit)
            numbers.add_row(*map(Text, cells), Text(figure.note, style="dim"))
    for name, fact in report.facts.items():
        if isinstance(fact, dict):
            entries = list(fact.items())
        else:
            entries = [("", entry) for entry in (fact if isinstance(fact, list) else [fact])]
        for key, entry in entries:
            words.add_row(Text(f"{name} {key}".strip()), Text(str(entry)))
    console.print(Text(report.title, style="bold"))
    for table in (numbers, words):
        if table.row_count:
            console.print(table)


def _open_map(file: Path) -> Any:
    """The map of a layer, or of a folder of survey CSVs."""
    if file.is_dir():
        from magtwin.field.survey import import_survey

        return import_survey(file)
    from magtwin.usd.maps import load_map

    return load_map(file)


def _run(
    scene_file: Path,
    path: str,
    folder: Path | None,
    *,
    steps: Any,
    title: str,
    rrd: Path | None = None,
    parquet: Path | None = None,
    net: Path | None = None,
    **options: Any,
) -> Any:
    """Run a scene and write the outputs asked for; returns the run's report."""
    from magtwin.io.rerun import write_rrd
    from magtwin.io.tables import write_parquet
    from magtwin.path import resolve_path
    from magtwin.twin import open_twin, simulate

    planned = resolve_path(path)
    twin = open_twin(scene_file, net=net)
    steps(f"Driving {planned.name}")
    result = simulate(twin, planned, **options)
    steps("Writing the run")
    for target in (folder / "run.parquet" if folder else None, parquet):
        if target is not None:
            write_parquet(result, target)
    for target in (folder / "run.rrd" if folder else None, rrd):
        if target is not None:
            write_rrd(
                result,
                target,
                scene=twin.scene,
                scene_file=twin.scene_file,
                field=twin.field,
                planned=planned,
            )
    if folder:
        from magtwin.io.plots import plot_run

        plot_run(result, twin.field, folder / "run.png", planned=planned.p_xy)
    return result.report(title)


def _picture(scene_file: Path, out: Path) -> None:
    """A picture of a stage; where no OpenGL is to be had, says so and goes on."""
    from magtwin.io.pictures import picture_of_stage

    try:
        picture_of_stage(scene_file, out)
    except RefusedError as error:
        print(f"  no picture of the stage: {error}", file=sys.stderr)  # noqa: T201


def _info_of_usd(file: Path) -> Any:
    from magtwin.usd.info import info_of_stage

    return info_of_stage(file)


def _info_of_run(file: Path) -> Any:
    from magtwin.io.tables import read_parquet

    return read_parquet(file).report(str(file))


def _info_of_net(file: Path) -> Any:
    from magtwin.learn.model import load_net

    return load_net(file).report(str(file))
