"""Authoring: a scene from its TOML, surveyed and checked against its own sources."""

import base64
import hashlib
import importlib
import logging
import tempfile
from collections.abc import Callable
from html import escape
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any

from magtwin.errors import InputError, find
from magtwin.files.file import sha256, shipped
from magtwin.files.kinds import expected
from magtwin.files.outputs import WORKSHOP, check_free, output, transaction
from magtwin.files.settings import copy_schemas
from magtwin.spec.lab import SurveySpec
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.scene import Scene

if TYPE_CHECKING:
    from tempfile import TemporaryDirectory

    from matplotlib.figure import Figure

    from magtwin.author import rooms
    from magtwin.twin.twin import Place

NOTED_NT = 50.0
"""RMS difference of a map from its sources that is reported [nT]; above the error of a careful survey."""

SCHEMA_FOLDER = ".magtwin"
"""Folder beside a new TOML with its JSON schema."""

_WORKSHOPS: "list[TemporaryDirectory[str]]" = []
"""Temporary folders of scenes, deleted when Python ends."""

Report = Callable[[str], Any]
TOLD: Report = logging.getLogger("magtwin").info
"""Who is told by default: who listens to the logger."""

Progress = Callable[[int, int, str], Any]


def new_workshop() -> str:
    """A temporary folder, deleted when Python ends."""
    _WORKSHOPS.append(tempfile.TemporaryDirectory(prefix=WORKSHOP))
    return _WORKSHOPS[-1].name


def scene_from_toml(
    path: "str | FilePath | rooms.Room",
    *,
    map_layer: str | FilePath | None = None,
    network: str | FilePath | None = None,
    workshop: str | FilePath | None = None,
    robot: FilePath | None = None,
    name: str = "",
    scale: float = 1.0,
    report: Report = TOLD,
    progress: Progress = lambda done, total, what: None,
) -> Scene:
    """Read the TOML of a scene.

    A scene without a map is surveyed by its own robot; this needs its Earth field. If the TOML names a map
    and also an Earth field, sources or furniture, the map is compared with their field.

    Args:
        path: The TOML, or the name of a scene that ships with magtwin ("lab", "aprilab"), or a `Room`. File
            names in a TOML are relative to its folder.
        map_layer: Map that replaces the one of the TOML.
        network: Weights (.safetensors or .pth) that replace those of the TOML.
        workshop: Folder for a robot converted from a URDF and for the map of a survey. Default: a temporary
            folder, deleted when Python ends; `author_scene` copies from it.
        robot: USD asset of a robot that replaces those of the TOML, see `scene_with_robot`.
        name: Name of the scene, in place of the TOML's.
        scale: Factor on the floor and on the places of furniture and sources; their sizes stay.
        report: Called with a line about the survey, and about a map that differs from the sources. Default:
            the logger "magtwin".
        progress: Called during a survey with headings done, headings in all, and the current step.

    Raises:
        InputError: A key is misspelt or missing, a file is missing or invalid, there is neither a map nor an
            Earth field, or the map contradicts the sources; the text gives the difference.
    """
    from magtwin.author.scene_file import scene_from_toml as read_toml_scene
    from magtwin.sim.contradiction import check_agrees
    from magtwin.usd.maps.layer import check_map_layer, load_map

    if map_layer is not None:
        check_map_layer(map_layer)
    workshop = workshop or new_workshop()

    def inputs_of(weights: FilePath) -> tuple[str, ...]:
        from magtwin.learn.models.predictor import load_predictor

        return load_predictor(weights).features

    def survey_of(scene: Scene, spec: SurveySpec, seed: int, obstacles: Obstacles) -> FilePath:
        from magtwin.sim.survey import survey_room
        from magtwin.usd.maps.layer import save_map

        source = f"{where.name} sha256:{checksum}"
        surveyed = survey_room(scene, spec, seed=seed, obstacles=obstacles, source=source, progress=progress)
        layer = FilePath(workshop) / f"{scene.name}.map.usdc"
        save_map(surveyed.field, layer)
        report(f"{scene.name} names no map: {surveyed}")
        return layer

    tables: Any = None
    if isinstance(path, str | FilePath):
        where = expected(_file_of(path), "TOML of a scene")
        checksum = sha256(where)
    else:
        tables = path.tables
        where = FilePath(f"room {tables['name']!r}")
        checksum = hashlib.sha256(path.to_toml().encode()).hexdigest()
    scene = read_toml_scene(
        where,
        table=tables,
        map_layer=map_layer,
        network=network,
        workshop=workshop,
        robot=robot,
        name=name,
        scale=scale,
        inputs_of=inputs_of,
        survey_of=survey_of,
    )
    if scene.map_layer.parent != FilePath(workshop):
        what = f"{where} with {map_layer or scene.map_layer.name}"
        difference = check_agrees(scene, load_map(scene.map_layer), what)
        if difference and difference.rms_nt >= NOTED_NT:
            report(f"Note: the map differs from the field of the scene's sources by {difference}")
    return scene


def _file_of(path: str | FilePath) -> FilePath:
    """The TOML that a path or the name of a shipped scene leads to."""
    file = FilePath(path)
    if file.suffix or file.is_file():
        return file
    known = {toml.stem: toml for toml in sorted(shipped("scenes").glob("*.toml"))}
    return file if file.exists() and str(path) not in known else find("scene", str(path), known)


if TYPE_CHECKING:
    _Path = FilePath
else:
    _Path = type(FilePath())  # before Python 3.12, only this has subclasses


class Authored(_Path):
    """The root layer of a scene that was written: a path, which also shows the scene."""

    @property
    def scene(self) -> Scene:
        """The scene of the stage, as it is now."""
        return importlib.import_module("magtwin").read_scene(FilePath(self))  # type: ignore[no-any-return]

    def plot(self) -> "Figure":
        """Draw the room from above, over its map; see `magtwin.plot`."""
        return self.scene.plot()

    def _repr_html_(self) -> str | None:
        if not self.is_file():  # such as a folder of it
            return None
        figure = self.plot()
        picture = base64.b64encode(figure._repr_png_()).decode()  # type: ignore[attr-defined]
        style = 'alt="the room from above" style="max-width:100%"'
        shown = f'<img {style} src="data:image/png;base64,{picture}"/>'
        return f"{self.scene._repr_html_()}{shown}<p>{escape(str(self))}</p>"


def author_scene(
    scene: "Place",
    out: str | FilePath,
    *,
    map_layer: str | FilePath | None = None,
    network: str | FilePath | None = None,
    force: bool = False,
    report: Report = TOLD,
    progress: Progress = lambda done, total, what: None,
) -> Authored:
    """Write a scene as a folder of USD layers that needs no file outside it.

    Args:
        scene: A `Scene` or a `Room`, or a TOML as for `scene_from_toml`.
        out: Folder to make.
        map_layer: As for `scene_from_toml`, if `scene` is a TOML.
        network: As for `scene_from_toml`, if `scene` is a TOML.
        force: Whether to replace a folder that exists.
        report: As for `scene_from_toml`.
        progress: As for `scene_from_toml`.

    Returns:
        The root layer, `out/<name>.usda`: a path that also has `scene` and `plot`, and shows itself in a
        notebook.

    Raises:
        InputError: The folder exists, or as for `scene_from_toml`.
    """
    from magtwin.author.scene import author_scene as write_scene

    check_free(out, force=force)
    if isinstance(scene, str | FilePath):
        options: Any = {"map_layer": map_layer, "network": network, "report": report, "progress": progress}
        with tempfile.TemporaryDirectory() as workshop:
            read = scene_from_toml(scene, workshop=workshop, **options)
            return Authored(write_scene(read, out, force=force))
    if map_layer is not None or network is not None:
        text = "map_layer and network are for a TOML; use with_() on a Scene"
        raise InputError(text, parameter="map_layer")
    made = importlib.import_module("magtwin.twin.twin").scene_in(scene)
    if hasattr(made, "GetRootLayer"):
        made = importlib.import_module("magtwin").read_scene(made)
    return Authored(write_scene(made, out, force=force))


def new_scene(
    out: str | FilePath,
    *,
    plan: str | FilePath | None = None,
    scale: float | None = None,
    report: Report = lambda text: None,
    force: bool = False,
) -> FilePath:
    """Write a TOML with comments that describes a small furnished room, or the room of a floor plan.

    Its first line names the schema by which editors complete its keys; that is written beside it, into
    the hidden folder `.magtwin`.

    Args:
        out: TOML to write. The scene is named after it.
        plan: Floor plan (.svg, .dxf, .geojson), or occupancy map of ROS (.pgm, .png or its .yaml).
        scale: Metres per unit of the plan, or per cell of the map. Default: what the file states.
        report: Called with a line about each thing that was deduced or left out.
        force: Whether to replace a file that exists.

    Returns:
        The file.

    Raises:
        InputError: The file exists, or its name cannot name a scene; or the plan has no scale or no walls.
    """
    from magtwin.author.room import check_name

    name = FilePath(out).stem
    check_name(name)
    if plan is not None:
        from magtwin.author.plan.plan import plan_toml

        text, notes = plan_toml(FilePath(plan), name, scale)
        for note in notes:
            report(note)
    elif scale is not None:
        raise InputError("scale is that of a plan; give `plan=FILE` too", parameter="scale")
    else:
        text = shipped("scenes", "starter.toml").read_text(encoding="utf-8")
        text = text.replace('name = "room"', f'name = "{name}"', 1)
    schemas = FilePath(out).parent / SCHEMA_FOLDER
    with transaction(), output(out, force=force) as aside, output(schemas, force=True) as folder:
        aside.write_text(f"#:schema ./{SCHEMA_FOLDER}/scene.schema.json\n\n{text}", encoding="utf-8")
        copy_schemas(folder)
    return FilePath(out)
