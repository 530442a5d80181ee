"""`magtwin report`: a run, or a set of runs, as one page."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from magtwin.cli.app import app
from magtwin.cli.options import Force
from magtwin.cli.terminal import check_suffix, progress, say

MOST_PICTURED = 60
"""Runs of a page with pictures: 0.4 MB and a second each."""


@app.command
def report(
    *runs: Annotated[Path, Parameter(required=True)],
    out: Path = Path("report.html"),
    scene: Path | None = None,
    force: Force = False,
) -> None:
    """Write what happened in a run, or in a set of runs, as one page with its pictures inside.

    What was run, the map with the path, time series, errors by source, events, and provenance.
    Several runs get an overview first.

    Parameters
    ----------
    runs
        Runs, in any format that magtwin reads; or the folder of a data set, for all of its runs.
    out
        Page to write: .html, which needs nothing else to be shown; .md; or .json.
    scene
        Where the scene lies whose map is drawn below the paths; looked for where each run says unless given.
    force
        Replace what exists.
    """
    from magtwin.errors import InputError
    from magtwin.figures.pages import WRITERS, Told, page_of_runs, write_page
    from magtwin.files import check_free
    from magtwin.io.formats import read_run
    from magtwin.io.provenance import map_of, planned_of

    check_suffix(out, tuple(WRITERS), "a report")
    check_free(out, force=force)
    told = []
    files = [file for given in runs for file in _files(given)]
    names = [file.name for file in files]
    with progress("Reading", "runs") as advance:
        for k, file in enumerate(files):
            advance(k, len(files), file.name)
            run = read_run(file)
            note, field = "", None
            try:
                field = map_of(run, scene, near=file)
            except InputError as error:
                note = f"Its map is not shown: {error}."
            name = file.name if names.count(file.name) == 1 else str(file)
            told.append(Told(name, run, field, planned_of(run, near=file), note))
    with progress("Drawing", "runs") as advance:
        advance(0, len(told))
        page = page_of_runs(
            told,
            pictures=out.suffix == ".html" and len(told) <= MOST_PICTURED,
            advance=lambda done: advance(done, len(told)),
        )
    if out.suffix == ".html" and len(told) > MOST_PICTURED:
        page = replace(page, lead=f"{page.lead} Pictures are left out of more than {MOST_PICTURED} runs.")
    write_page(page, out, force=force)
    say(f"Wrote {out}")


def _files(given: Path) -> list[Path]:
    """The runs of a data set that `magtwin runs` made, or the one run that a name is of."""
    if not (given / "runs.csv").is_file():
        return [given]
    return sorted(given.glob("run_*.parquet"))
