"""Drawing: what `magtwin plot` makes of files, by what they are and by the suffix of the output."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

from magtwin.errors import InputError
from magtwin.files.file import existing
from magtwin.files.kinds import SCENE_FOLDER, SURVEY, USD_SUFFIXES, kind_of, scene_file, shipped_or

Show = Literal["charts", "picture", "field", "gradient", "variance", "mask", "headings"]

FILMS = (".mp4", ".gif")
PHOTOS = (".jpg", ".jpeg")
SUFFIXES = {"chart": (".png", ".svg", *PHOTOS), "picture": (".png", *PHOTOS), "film": FILMS}

WAYS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "charts": ("chart", "charts of a run", ("scene",)),
    "comparison": ("chart", "charts of two runs", ()),
    "map": ("chart", "a map", ("headings",)),
    "difference": ("chart", "the difference of two maps", ()),
    "moment": ("picture", "a moment of a run in its lab", ("at_s", "camera", "size", "scene")),
    "recording": ("picture", "a recording in the viewer", ("at_s", "size")),
    "stage": ("picture", "a stage", ("camera", "size")),
    "film": ("film", "a film of a run", ("camera", "size", "scene", "pace", "fps")),
}
"""Ways of drawing: the suffixes that they write, what they draw, and the options that they take."""


def draw(
    files: Sequence[str | Path],
    out: str | Path | None = None,
    *,
    show: Show | None = None,
    force: bool = False,
    advance: Callable[[int, int], None] = lambda done, total: None,
    **options: Any,
) -> tuple[Path, Sequence[str]]:
    """Draw a run, a stage, a map or a recording; or compare two runs or two maps in a picture.

    Args:
        files: One file, or two of one kind. Names of shipped scenes are stages.
        out: File to write; its suffix says whether it is a picture or a film. None: a PNG in the working
            folder, named after the first file.
        show: What to draw of a run (charts, picture) or of a map and the map of a stage. None: charts of a
            run unless `at_s` or `camera` asks for a picture; a recording as the Rerun viewer shows it; the
            field of a map; a stage as it looks.
        force: Whether an existing output is replaced.
        advance: Called with the frames of a film that are drawn, and their number.
        options: at_s [s], camera, size [pixels], scene, headings [rad], pace and fps, as far as what is drawn
            has them (`WAYS`).

    Returns:
        The file, and messages of the Rerun viewer.

    Raises:
        InputError: A file is none that can be drawn, an option is for another way of drawing, or the output
            cannot be written.
    """
    given = {name: value for name, value in options.items() if value is not None}
    out = Path(f"{Path(files[0]).stem}.png") if out is None else Path(out)
    suffix = out.suffix.lower()
    if not any(suffix in known for known in SUFFIXES.values()):
        raise InputError(f"{out}: a picture ends in .png, .svg or .jpg, and a film in .mp4 or .gif")
    paths = [existing(_inside(shipped_or(file)), "run, stage, map or recording") for file in files]
    way = _way(paths, suffix, show, given)
    kind, what, takes = WAYS[way]
    if suffix not in SUFFIXES[kind]:
        raise InputError(f"{out}: {what} ends in {' or '.join(SUFFIXES[kind])}")
    for name in given.keys() - set(takes):
        raise InputError(f"`{name}` does not go with {what}; drop it")
    if suffix not in PHOTOS:
        return out, _draw(way, paths, out, show, force=force, advance=advance, **given)
    from tempfile import TemporaryDirectory

    from PIL import Image

    from magtwin.files.outputs import output

    with TemporaryDirectory() as folder, output(out, force=force) as aside:
        picture = Path(folder) / "picture.png"
        messages = _draw(way, paths, picture, show, advance=advance, **given)
        with Image.open(picture) as image:
            image.convert("RGB").save(aside, "JPEG", quality=92)
    return out, messages


def _inside(file: Path) -> Path:
    """The stage in the folder of a scene; another path as it is."""
    return scene_file(file) if file.is_dir() and kind_of(file) is SCENE_FOLDER else file


def _way(paths: Sequence[Path], suffix: str, show: Show | None, given: dict[str, Any]) -> str:
    """The way of drawing files."""
    from magtwin.usd.maps.layer import is_map_layer

    if len(paths) > 2:
        raise InputError("give one file, or two to compare; magtwin report makes a page of many runs")
    runs = [not _is_stage(path) and not _is_survey(path) for path in paths]
    if len(paths) == 2:
        if runs[0] != runs[1]:
            raise InputError(f"{paths[0]} and {paths[1]}: one is a run and one is none; give two of a kind")
        return "comparison" if runs[0] else "difference"
    path, ending = paths[0], paths[0].suffix.lower()
    if suffix in FILMS:
        return "film"
    looks = show == "picture" or (show is None and given.keys() & {"camera", "at_s"})
    if show not in (None, "charts", "picture") or _is_survey(path):
        return "map"
    if not runs[0]:
        return "map" if not looks and ending != ".usdz" and is_map_layer(path) else "stage"
    if ending == ".rrd" and show != "charts" and not given.keys() & {"camera", "scene"}:
        return "recording"
    return "moment" if looks else "charts"


def _is_survey(path: Path) -> bool:
    return path.is_dir() and kind_of(path) is SURVEY


def _is_stage(path: Path) -> bool:
    """Whether a file is USD and plays no run."""
    from magtwin.usd.animation import is_animation

    suffix = path.suffix.lower()
    return suffix in USD_SUFFIXES and path.is_file() and (suffix == ".usdz" or not is_animation(path))


def _draw(
    way: str,
    paths: Sequence[Path],
    out: Path,
    show: Show | None,
    *,
    force: bool = False,
    advance: Callable[[int, int], None],
    **given: Any,
) -> Sequence[str]:
    """Draw files in a way; messages of the Rerun viewer."""
    from magtwin.figures import views
    from magtwin.figures.canvas import save

    if way == "comparison":
        views.compare_files(*paths, out=out, force=force)
    elif way in ("map", "difference"):
        from magtwin.field.maps.difference import difference
        from magtwin.figures.maps import draw_difference, draw_map
        from magtwin.io.map_files import open_map

        fields = [open_map(path) for path in paths]
        figure = (
            draw_difference(difference(*fields))
            if way == "difference"
            else draw_map(fields[0], what=show or "field", headings=given.get("headings"))
        )
        save(figure, out, force=force)
    elif way == "charts":
        save(_charts(paths[0], given.get("scene")), out, force=force)
    elif way == "film":
        views.film(paths[0], out, force=force, advance=advance, **given)
    else:
        camera = given.pop("camera", "orbit" if way == "moment" else None)
        time_s = given.pop("at_s", None)
        return views.picture(paths[0], out, force=force, camera=camera, time_s=time_s, **given)
    return ()


def _charts(file: Path, scene: str | Path | None) -> Any:
    """Charts of a run over its map, if that is at hand."""
    import warnings

    from magtwin.errors import MismatchWarning
    from magtwin.figures.runs import draw_run
    from magtwin.io.formats import read_run
    from magtwin.io.provenance import map_of, planned_of

    run, field = read_run(file), None
    try:
        field = map_of(run, scene, near=file)
    except InputError as error:
        if scene is not None:
            warnings.warn(f"{file}: its map is not shown: {error}", MismatchWarning, stacklevel=2)
    return draw_run(run, field, planned_of(run, near=file))
