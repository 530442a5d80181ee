"""`magtwin scene`: a scene's TOML in, stages out."""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from magtwin.cli.app import app
from magtwin.cli.options import Force, Json
from magtwin.cli.terminal import announce, print_report, progress, say


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
    """Author a scene from its TOML: the room, its magnetic map, a robot with sensors.

    A scene that names no map is surveyed by its own robot, from the Earth's field, furniture and sources.
    `magtwin new room.toml` writes a TOML to start from; docs/scenes.md has every key.

    Parameters
    ----------
    spec
        TOML file, or the name of one that ships with magtwin: lab, aprilab.
    out
        Folder to make; it holds all that the stage needs and can be moved.
    map
        Map layer to use in place of the one that the TOML names. Earth, sources and furniture stay; a map
        that contradicts them is refused, and the difference is told in nT.
    net
        Weights to use in place of those that the TOML names (.safetensors or .pth).
    force
        Replace the folder if it exists.
    json
        Print the summary as JSON.
    """
    from magtwin.author.robot import notes_of
    from magtwin.author.scene import author_scene
    from magtwin.files import check_free, shipped
    from magtwin.twin import scene_from_toml
    from magtwin.usd.info import info_of_stage

    file = Path(spec)
    if not file.suffix and not file.is_file():
        from magtwin.errors import find

        file = find("scene", spec, {f.stem: f for f in sorted(shipped("scenes").glob("*.toml"))})
    check_free(out, force=force)
    told: list[str] = []
    steps = announce
    with TemporaryDirectory() as workshop:
        steps(f"Reading {file}")
        with progress("Reading the scene", "headings") as advance:
            scene = scene_from_toml(
                file, map_layer=map, network=net, workshop=workshop, report=told.append, progress=advance
            )
        steps("Authoring the stage")
        root = author_scene(scene, out, force=force)
        built = [
            one.robot for one in scene.robots if one.robot.asset.is_relative_to(Path(workshop).resolve())
        ]
        notes = {f"notes on {robot.name}": notes_of(robot.asset) for robot in built}
    report = info_of_stage(root)
    print_report(replace(report, metadata={**report.metadata, **notes}), json)
    if not json:
        say("\n".join([*told, f"Wrote {root}"]))
