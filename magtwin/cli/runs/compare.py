"""`magtwin compare`: two runs laid over each other."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from magtwin.cli.app import app
from magtwin.cli.options import Force, Json
from magtwin.cli.terminal import check_suffix, say, stdout_console, step

if TYPE_CHECKING:
    from magtwin.run.compare import Comparison


@app.command
def compare(
    a: Path,
    b: Path,
    *,
    align: Literal["time", "path", "none"] = "time",
    out: Path | None = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Lay run B over run A, and say how far apart they are in pose and in field.

    Parameters
    ----------
    a
        A run, in any format that magtwin reads.
    b
        The other.
    align
        time finds the offset of the clocks at which the positions lie closest; path aligns them by
        distance driven, for runs of different speeds; none takes the clocks as they stand.
    out
        Page (.html, .md, .json) or picture (.png, .svg) to write: readings as recorded and aligned, the
        distance between the two, and both paths.
    force
        Replace what exists.
    json
        Print the figures as JSON.
    """
    from magtwin.files import check_free
    from magtwin.io.formats import read_run
    from magtwin.run.compare import compare as compare_runs

    if out is not None:
        check_suffix(out, (".html", ".md", ".json", ".png", ".svg"), "a comparison")
        check_free(out, force=force)
    step("Reading the runs")
    runs = read_run(a), read_run(b)
    step("Comparing the runs")
    found = compare_runs(*runs, align=align)
    step("Writing the comparison")
    names = (a.name, b.name) if a.name != b.name else (str(a), str(b))
    if out is not None and out.suffix in (".png", ".svg"):
        from magtwin.figures.charts import plot_comparison

        plot_comparison(*runs, found, out, names=names, force=force)
    elif out is not None:
        from magtwin.figures.pages import Told, page_of_comparison, write_page

        told = Told(names[0], runs[0]), Told(names[1], runs[1])
        write_page(page_of_comparison(*told, found), out, force=force)
    if json:
        say(found.to_json())
        return
    _print(found, names)
    if out is not None:
        say(f"Wrote {out}")


def _print(found: "Comparison", names: tuple[str, str]) -> None:
    """The figures as a table for people."""
    from rich.table import Table
    from rich.text import Text

    how = "clocks as they stand" if found.align == "none" else f"moved by {found.shift:+.4f} {found.unit}"
    console = stdout_console()
    console.print(Text(f"{names[1]} less {names[0]}, {how}; {len(found.at):,} readings", style="bold"))
    table = Table(box=None, pad_edge=False)
    for column in ("", "unit", "mean", "RMS", "mean abs.", "greatest", "correlation"):
        table.add_column(column, justify="left" if column in ("", "unit") else "right", no_wrap=True)
    for one in found.agreements():
        correlation = "" if one.correlation is None else f"{one.correlation:.4f}"
        numbers = (f"{value:,.4g}" for value in (one.mean, one.rms, one.mae, one.greatest))
        table.add_row(one.name, one.unit, *numbers, correlation)
    console.print(table)
