"""Drawing: what `magtwin plot` makes of files, by what they are and by the suffix of the output."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

from magtwin.errors import InputError
from magtwin.files.file import existing
from magtwin.files.kinds import SURVEY, USD_SUFFIXES, kind_of, shipped_or
from magtwin.files.outputs import check_free, output

Show = Literal["charts", "picture", "field", "gradient", "variance", "mask", "headings"]

FILMS = (".mp4", ".gif")
PHOTOS = (".jpg", ".jpeg")
SUFFIXES = {
    "chart": (".png", ".svg", *PHOTOS),
    "map": (".png", ".svg", *PHOTOS, ".html"),
    "picture": (".png", *PHOTOS),
    "film": FILMS,
}

WAYS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "charts": ("chart", "charts of a run", ("scene",)),
    "comparison": ("chart", "charts of two runs", ()),
    "map": ("map", "a map", ("headings",)),
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
        out: Picture or film, by its suffix. None: a PNG in the working folder, named after the first file.
        show: What to draw of a run, or of a map, a stage's too. None: charts of a run unless `at_s` or
            `camera` asks for a picture; a recording as its viewer shows it; a map's overview; a stage.
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
    paths = [_layer_in(existing(shipped_or(file), "run, stage, map or recording")) for file in files]
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

    with TemporaryDirectory() as folder, output(out, force=force) as aside:
        picture = Path(folder) / "picture.png"
        messages = _draw(way, paths, picture, show, advance=advance, **given)
        with Image.open(picture) as image:
            image.convert("RGB").save(aside, "JPEG", quality=92)
    return out, messages


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
    if show not in (None, "charts", "picture") or _is_survey(path) or (suffix == ".html" and not runs[0]):
        return "map"
    if not runs[0]:
        return "map" if not looks and ending != ".usdz" and is_map_layer(path) else "stage"
    if ending == ".rrd" and show != "charts" and not given.keys() & {"camera", "scene"}:
        return "recording"
    return "moment" if looks else "charts"


def _layer_in(path: Path) -> Path:
    """The map layer of a folder that holds one and is of no other kind; any other path as it is."""
    from magtwin.usd.maps.layer import is_map_layer

    unknown = path.is_dir() and kind_of(path) is None
    layers = [file for file in sorted(path.glob("*.usd[ac]")) if is_map_layer(file)] if unknown else []
    return layers[0] if len(layers) == 1 else path


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

    path = paths[0]
    check_free(out, force=force)
    if way == "comparison":
        views.compare_files(*paths, out=out, force=force)
    elif way in ("map", "difference"):
        from magtwin.figures.maps import draw_difference, draw_map
        from magtwin.io.map_files import open_map

        fields = [open_map(file) for file in paths]
        if way == "difference":
            from magtwin.field.maps.difference import difference

            save(draw_difference(difference(*fields)), out, force=force)
        elif out.suffix.lower() == ".html":
            from magtwin.figures.page import write_page
            from magtwin.figures.reports import page_of_maps

            write_page(page_of_maps(fields, views.floor_plan(path)), out, force=force)
        else:
            plan = views.floor_plan(path)
            save(draw_map(fields, what=show or "overview", plan=plan, **given), out, force=force)
    elif way == "charts":
        from magtwin.figures.reporting import named_run
        from magtwin.figures.runs import draw_run
        from magtwin.io.formats import read_run

        named = named_run("", read_run(path), given.get("scene"), path)
        plan = None if named.stage is None else views.plan_in(named.stage)
        save(draw_run(named.run, named.field, named.planned, plan), out, force=force)
    elif way == "recording":
        from magtwin.io.rerun.viewer import screenshot

        return screenshot(path, out, time_s=given.pop("at_s", None), force=force, **given)
    elif way == "stage":
        from magtwin.figures.pictures import picture_of_stage
        from magtwin.figures.scenery import View

        given |= {"camera": View.of(given["camera"]).camera()} if "camera" in given else {}
        picture_of_stage(path, out, force=force, **given)
    else:
        from magtwin.figures.films import film_of_run
        from magtwin.figures.scenery import picture_of_run

        run, stage = views.run_and_scene(path, given.pop("scene", None))
        if way == "film":
            film_of_run(run, stage, out, speed=given.pop("pace", None), force=force, advance=advance, **given)
        else:
            picture_of_run(run, stage, out, time_s=given.pop("at_s", None), force=force, **given)
    return ()
