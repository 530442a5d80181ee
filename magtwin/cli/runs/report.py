"""`magtwin report`, `compare` and `reproduce`."""

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from magtwin.cli.app import app
from magtwin.cli.options import AnyRun, Force, RunScene, reads_recordings
from magtwin.cli.terminal import Done, named, progress, step
from magtwin.report.summary import aligned

if TYPE_CHECKING:
    from magtwin.run.compare import Comparison


@app.command
@reads_recordings
def report(
    *runs: Annotated[Path, Parameter(required=True)],
    out: Path | None = None,
    scene: RunScene = None,
    force: Force = False,
) -> Done:
    """Write a page that plays a run in its lab, with charts, errors by source, events and provenance.

    Runs of robots that drove together in one scene are played together. Other sets of runs get an overview
    with a small picture of each.

    Parameters
    ----------
    runs
        Runs in any format that magtwin reads; a folder that `magtwin sweep` made stands for all of its runs.
    out
        Page to write (.html), which needs no other file; or a folder, with index.html and a page of each run.
        Default: report.html; for the folder of a sweep, the folder report.
    """
    from magtwin.figures.reporting import report_runs, usual_name

    out = named(out or usual_name(runs), (".html", ""), "a report", force=force)
    with progress("Reporting", "runs") as advance:
        report_runs(runs, out, scene=scene, force=force, progress=advance)
    return Done(wrote=out, text="open it in a browser")


@app.command
@reads_recordings
def compare(
    a: AnyRun,
    b: Path,
    *,
    align: Literal["time", "path", "none"] = "time",
    out: Path | None = None,
    force: Force = False,
) -> Done:
    """Compare two runs: how far apart they are in pose and in field.

    Parameters
    ----------
    b
        The run to compare with it.
    align
        time: shift the clocks so that the positions agree best. path: align by distance driven, for runs of
        different speeds. none: keep the clocks.
    out
        Picture (.png, .svg) or page (.html) to write: readings as recorded and aligned, the distance between
        the runs, and both paths.
    """
    from magtwin.figures.views import compare_files, names_of

    out = out and named(out, (".png", ".svg", ".html"), "a comparison", force=force)
    step("Comparing the runs")
    comparison = compare_files(a, b, align=align, out=out, force=force)
    lines, draw = _lines(comparison, names_of(a, b)), ("magtwin", "plot", a, b, "--out", "difference.png")
    return Done(wrote=out or (), lines=lines, data=comparison.summary(), next=() if out else (draw,))


@app.command
def reproduce(file: Path, *, scene: RunScene = None) -> Done:
    """Reproduce a run from its metadata and report whether the bytes match.

    It names what has changed since (scene, map, network, versions), and each column that differs and by how
    much. Exit status: 0 if all columns are equal, else 1.

    Parameters
    ----------
    file
        A run in any format that magtwin writes.
    """
    from magtwin.io.provenance import repeat_of

    step("Reproducing the run")
    found = repeat_of(file, scene)
    report = found.report(f"{file}, reproduced")
    told, data = replace(report, metadata={}), json.loads(report.to_json())
    return Done(told, lines=found.causes, data=data, status=0 if found.equal else 1)


def _lines(comparison: "Comparison", names: tuple[str, str]) -> list[str]:
    """The agreements as lines of a table."""
    shift = f"moved by {comparison.shift:+.4f} {comparison.unit}"
    how = "clocks as recorded" if comparison.align == "none" else shift
    rows: list[tuple[str, ...]] = [("", "unit", "mean", "RMS", "mean abs.", "greatest", "correlation")]
    for row in comparison.agreements():
        correlation = "" if row.correlation is None else f"{row.correlation:.4f}"
        numbers = (f"{value:,.4g}" for value in (row.mean, row.rms, row.mae, row.greatest))
        rows.append((row.name, row.unit, *numbers, correlation))
    head = f"{names[1]} less {names[0]}, {how}; {len(comparison.at):,} readings"
    return [head, *aligned(rows, right=range(2, 7))]
