"""Reporting: pages about files: runs, the robots of one scene, the runs of a sweep, and a scene by itself."""

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

from magtwin.errors import InputError, MismatchWarning
from magtwin.figures.page import Embedded, Page, Still, to_html, write_page
from magtwin.figures.player import player_of
from magtwin.figures.reports import OVERVIEW, NamedRun, overview_of, page_of_runs, together
from magtwin.figures.runs import still_of
from magtwin.files.kinds import scene_file
from magtwin.files.outputs import check_free, output
from magtwin.io.formats import read_run, runs_in
from magtwin.io.provenance import map_of, planned_of
from magtwin.report.summary import span
from magtwin.run.run import Run
from magtwin.twin import scene_of
from magtwin.usd.maps.layer import load_map
from magtwin.usd.scene import read_scene

MOST_STILLS = 300
"""Most small pictures of a page of several runs, and most pages of a folder."""

Source = str | Path
Progress = Callable[[int, int, str], None]


def report_runs(
    runs: Sequence[Source],
    out: Source,
    *,
    scene: Source | None = None,
    force: bool = False,
    progress: Progress = lambda done, total, what: None,
) -> None:
    """Write a page about runs: the run in its lab, charts, errors, events, provenance.

    Args:
        runs: Runs in any format; a folder that `magtwin sweep` made stands for its runs. The robots of one
            scene that drove together are played together.
        out: Page to write (.html); or, without a suffix, a folder with index.html and a page of each run.
        scene: Scene of the map below the paths. None: the one of each run's metadata.
        force: Whether an existing page is replaced.
        progress: Called with the number of runs done, the number in all and the current step.

    Raises:
        InputError: A run or `scene` cannot be read, or the page cannot be written.
    """
    out = check_free(out, force=force)
    scene = None if scene is None else scene_file(scene)
    files = _files(runs)
    if not out.suffix:
        _write_folder(files, out, scene, force, progress)
        return
    named = list(_each(files, scene, progress))
    page = page_of_runs(named, advance=lambda done: progress(done, len(named), "drawing"))
    if page.overview is not None:
        stills = (_still(run, f"#run-{k}") for k, run in enumerate(named[:MOST_STILLS]))
        page = replace(page, stills=tuple(still for still in stills if still is not None))
    write_page(page, out, force=force)


def usual_name(runs: Sequence[Source]) -> Path:
    """Usual name of a report: a page, or a folder for the runs in a folder, such as those of a sweep."""
    files = _files(runs)
    page = len(runs) > 1 or len(files) == 1 or together([read_run(file) for file in files[:2]])
    return Path("report.html" if page else "report")


def report_scene(scene: Path, out: Source, *, force: bool = False) -> Path:
    """Write a page (.html) that shows a scene, or any other stage, and its map in 3D, without a run.

    Raises:
        InputError: The stage cannot be read, or shows nothing; or the page cannot be written.
    """
    out, figures, field, lead = check_free(out, force=force), [], None, "A stage without a magnetic map."
    try:
        told = read_scene(scene, check_network=False)
        field = load_map(told.map_layer)
        names = ", ".join(placed.robot.name for placed in told.robots)
        cell, least, most = field.cell_m, *(float(f(field.values_nt[field.valid])) for f in (min, max))
        figures = [
            ("floor", told.lab.size_text.replace(" x ", " × ")),
            ("robot", names),
            ("map", span(least, most, "nT")),
        ]
        figures += [("cells", f"{cell[0]:g} × {cell[1]:g} m"), ("headings", f"{len(field.headings_rad)}")]
        lead = f"The scene {told.name} and its map {field.name}, at the heading of the slider."
    except InputError as error:
        warnings.warn(f"{scene}: shown without its map: {error}", MismatchWarning, stacklevel=2)
    still = still_of(None, field)
    player = player_of([], field, scene, still=b"" if still is None else still.data)
    if not player.lab:
        raise InputError(f"{scene}: shows nothing")
    page = Page(f"Scene: {scene.stem}", lead, (), player=replace(player, figures=figures))
    write_page(page, out, force=force)
    return out


def embedded(run: Run, scene: Source | None, height: int) -> Embedded:
    """The page of a run for a notebook; arguments as of `Run.view`."""
    named = named_run("run", run, None if scene is None else scene_file(scene), None)
    return Embedded(to_html(page_of_runs([named])), height)


def _files(runs: Sequence[Source]) -> list[Path]:
    """The files of runs; of a run that a folder has in several formats, the first."""
    folders = [{file.with_suffix(""): file for file in runs_in(Path(source))[::-1]} for source in runs]
    return [file for inside in folders for file in reversed(inside.values())]


def _each(files: Sequence[Path], scene: Path | None, progress: Progress) -> Iterator[NamedRun]:
    """The runs of files, read one after another, under names that tell them apart."""
    names = [file.name for file in files]
    for k, file in enumerate(files):
        progress(k, len(files), f"reading {file.name}")
        yield named_run(file.name if names.count(file.name) == 1 else str(file), read_run(file), scene, file)


def named_run(name: str, run: Run, scene: Source | None, file: Path | None) -> NamedRun:
    """A run with its map, planned path and scene, as far as they are at hand."""
    note, field, stage = "", None, None
    try:
        field, stage = map_of(run, scene, near=file), scene_of(run, scene, near=file)
    except InputError as error:
        note = f"Its map is not shown: {error}."
        if scene is not None:
            text = f"{file or 'the run'}: its map is not shown: {error}"
            warnings.warn(text, MismatchWarning, stacklevel=3)
    return NamedRun(name, run, field, planned_of(run, near=file), note, stage)


def _still(named: NamedRun, link: str) -> Still | None:
    picture = still_of(named.run, named.field)
    return None if picture is None else Still(picture, link, named.name)


def _write_folder(
    files: Sequence[Path], out: Path, scene: Path | None, force: bool, progress: Progress
) -> None:
    """Write index.html with a still of each run, and a page of each."""
    rows, stills, links = [], [], []
    with output(out, force=force) as aside:
        aside.mkdir()
        for k, named in enumerate(_each(files, scene, progress)):
            rows.append(overview_of(named))
            links.append("")
            if k < MOST_STILLS:
                file = f"{files[k].stem}.html"
                file = f"{k:05}_{file}" if (aside / file).exists() or file == "index.html" else file
                (aside / file).write_text(to_html(page_of_runs([named])), encoding="utf-8")
                links[k] = quote(file)
                still = _still(named, links[k])
                stills += [] if still is None else [still]
        lead = f"{sum(row[3] for row in rows):,} readings in all."
        if len(rows) > MOST_STILLS:
            lead += f" The first {MOST_STILLS:,} runs have pages."
        overview = replace(OVERVIEW, rows=tuple(rows))
        index = Page(f"{len(rows):,} runs", lead, (), overview, stills=tuple(stills))
        (aside / "index.html").write_text(to_html(index, links), encoding="utf-8")
