"""Reports of runs as one page, and of two runs compared."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

from magtwin.errors import InputError
from magtwin.figures.pages import Told, page_of_comparison, page_of_runs, write_page
from magtwin.files import check_free
from magtwin.io.formats import read_run
from magtwin.io.provenance import map_of, planned_of
from magtwin.run.compare import Comparison, compare

MOST_PICTURED = 60
"""Largest number of runs with pictures on a page; each takes 0.4 MB and a second."""

Source = str | Path


def report_runs(
    runs: Sequence[Source],
    out: Source,
    *,
    scene: Source | None = None,
    force: bool = False,
    progress: Callable[[int, int, str], None] = lambda done, total, what: None,
) -> None:
    """Write a page about runs: what was run, map and path, time series, errors, events, provenance.

    Args:
        runs: Runs in any format; a folder that `magtwin sweep` made stands for its runs.
        out: Page to write (.html, .md or .json).
        scene: Scene of the map below the paths. None: the one of each run's metadata.
        force: Whether an existing page is replaced.
        progress: Called with the number of runs done, the number in all and the current step.

    Raises:
        InputError: A run cannot be read, or the page cannot be written.
    """
    out = check_free(out, force=force)
    files = [file for source in runs for file in runs_in(Path(source))]
    names = [file.name for file in files]
    told = []
    for k, file in enumerate(files):
        progress(k, len(files), f"reading {file.name}")
        run, note, field = read_run(file), "", None
        try:
            field = map_of(run, scene, near=file)
        except InputError as error:
            note = f"Its map is not shown: {error}."
        name = file.name if names.count(file.name) == 1 else str(file)
        told.append(Told(name, run, field, planned_of(run, near=file), note))
    pictured = out.suffix == ".html" and len(told) <= MOST_PICTURED
    page = page_of_runs(told, pictures=pictured, advance=lambda done: progress(done, len(told), "drawing"))
    if out.suffix == ".html" and not pictured:
        page = replace(page, lead=f"{page.lead} Pages of more than {MOST_PICTURED} runs have no pictures.")
    write_page(page, out, force=force)


def compare_files(
    a: Source,
    b: Source,
    *,
    align: Literal["time", "path", "none"] = "time",
    out: Source | None = None,
    force: bool = False,
) -> Comparison:
    """Compare two runs, and write a page or a picture of the comparison.

    Args:
        a: First run, in any format.
        b: Second run.
        align: As for `magtwin.run.compare.compare`.
        out: Page (.html, .md, .json) or picture (.png, .svg) to write.
        force: Whether an existing output is replaced.

    Raises:
        InputError: A run cannot be read, they do not overlap, or the output cannot be written.
    """
    a, b = Path(a), Path(b)
    runs = read_run(a), read_run(b)
    comparison = compare(*runs, align=align)
    names = names_of(a, b)
    if out is not None and Path(out).suffix in (".png", ".svg"):
        from magtwin.figures.charts import plot_comparison

        plot_comparison(*runs, comparison, out, names=names, force=force)
    elif out is not None:
        page = page_of_comparison(Told(names[0], runs[0]), Told(names[1], runs[1]), comparison)
        write_page(page, out, force=force)
    return comparison


def names_of(a: Path, b: Path) -> tuple[str, str]:
    """Names of two files that tell them apart."""
    return (a.name, b.name) if a.name != b.name else (str(a), str(b))


def runs_in(path: Path) -> list[Path]:
    """The runs in a folder that `magtwin sweep` made, or the one run that a path names."""
    if not (path / "runs.csv").is_file():
        return [path]
    return sorted(path.glob("run_*.parquet"))
