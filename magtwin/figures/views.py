"""Views of files: show a run or a stage; two runs compared."""

import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from magtwin.errors import InputError, MismatchWarning
from magtwin.figures.canvas import save
from magtwin.figures.maps import FloorPlan
from magtwin.figures.page import write_page
from magtwin.figures.reports import NamedRun, draw_comparison, page_of_comparison
from magtwin.files.file import existing, shipped
from magtwin.files.kinds import USD_SUFFIXES, shipped_or
from magtwin.io.convert import twin_to_show
from magtwin.io.formats import read_run
from magtwin.run.compare import Comparison, compare
from magtwin.run.run import Run
from magtwin.twin import scene_of
from magtwin.usd.layers import stage_sha256
from magtwin.usd.scene import open_scene

Source = str | Path


def view(files: Sequence[Source], *, scene: Source | None = None) -> None:
    """Show runs on one timeline in the Rerun viewer, or a stage in a window, until it is closed.

    `scene` is the stage to show runs in, by default the one of their metadata.

    Raises:
        InputError: A file cannot be read, or there is no viewer.
    """
    from magtwin.io.rerun.file import show_run, write_comparison
    from magtwin.io.rerun.viewer import show
    from magtwin.usd.animation import is_animation

    paths = [shipped_or(file) for file in files]
    if not paths:
        raise InputError("name a run or a stage to view")
    if len(paths) > 1:
        alike = len({path.stem for path in paths}) < len(paths)
        runs = {str(path) if alike else path.stem: read_run(path) for path in paths}
        if len(runs) < len(paths):
            raise InputError("one run is named twice; name each once")
        twin = twin_to_show(next(iter(runs.values())), paths[0], scene)
        with tempfile.TemporaryDirectory() as folder:
            rrd = Path(folder) / "runs.rrd"
            write_comparison(runs, rrd, twin)
            show(rrd, source=paths[0])
        return
    file, suffix = paths[0], paths[0].suffix.lower()
    is_usd = suffix in USD_SUFFIXES and not file.is_dir()
    existing(file, "stage" if is_usd else "run")
    if is_usd and (suffix == ".usdz" or not is_animation(file)):
        from magtwin.figures.pictures import show_stage

        show_stage(file)
    elif suffix == ".rrd" and scene is None:
        show(file)
    else:
        run = read_run(file)
        show_run(run, twin_to_show(run, file, file if is_usd else scene), file=file)


def compare_files(
    a: Source,
    b: Source,
    *,
    align: Literal["time", "path", "none"] = "time",
    out: Source | None = None,
    force: bool = False,
) -> Comparison:
    """Compare two runs in any format, and draw the comparison as a picture (.png, .svg) or a page (.html).

    Raises:
        InputError: A run cannot be read, they do not overlap, or the output cannot be written.
    """
    a, b = Path(a), Path(b)
    name_a, name_b = names_of(a, b)
    named = NamedRun(name_a, read_run(a)), NamedRun(name_b, read_run(b))
    comparison = compare(named[0].run, named[1].run, align=align)
    if out is not None:
        if Path(out).suffix.lower() == ".html":
            write_page(page_of_comparison(*named, comparison), out, force=force)
        else:
            save(draw_comparison(*named, comparison), out, force=force)
    return comparison


def floor_plan(source: Source) -> FloorPlan | None:
    """What stands on the floor of a map: by its stage, or by the stage beside it, if that reads this map."""
    from magtwin.io.map_files import map_file

    path = map_file(source)
    folders = [path.parent, path.parent.parent, shipped("scenes") / path.resolve().parent.name]
    stages = [path, *(folder / f"{folder.resolve().name}.usda" for folder in folders)]
    for stage in stages:
        if not stage.is_file():
            continue
        plan = plan_in(stage, None if stage == path else path)
        if plan is not None:
            return plan
    return None


def plan_in(stage: Path, only: Path | None = None) -> FloorPlan | None:
    """What stands on the floor of a stage, if it has a lab, and reads the map `only` where one is given."""
    try:
        opened = open_scene(stage, check_network=False)
    except InputError:  # a layer without a lab
        return None
    if only is not None and opened.scene.map_layer.resolve() != only.resolve():
        return None
    return FloorPlan.of(opened.scene, opened.obstacles)


def names_of(a: Path, b: Path) -> tuple[str, str]:
    """Names of two files that tell them apart."""
    return (a.name, b.name) if a.name != b.name else (str(a), str(b))


def run_and_scene(file: Path, scene: Source | None) -> tuple[Run, Path]:
    """A run and its scene; warns if the scene has changed since."""
    run = read_run(file)
    stage = scene_of(run, scene, near=file)
    if "scene_sha256" in run.metadata and run.metadata["scene_sha256"] != stage_sha256(stage):
        text = f"{stage} has changed since the run; it is drawn as it is now"
        warnings.warn(text, MismatchWarning, stacklevel=3)
    return run, stage
