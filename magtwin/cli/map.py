"""`magtwin map`: make and look at anomaly maps."""

from pathlib import Path
from typing import Any

from cyclopts import App

from magtwin.cli.app import app
from magtwin.cli.terminal import Force, Json, check_suffix, print_report, say

map_app = App(name="map", help="Make and look at anomaly maps.")
app.command(map_app)


@map_app.command(name="import")
def map_import(
    folder: Path,
    *,
    out: Path,
    name: str | None = None,
    licence: str = "",
    force: Force = False,
    json: Json = False,
) -> None:
    """Read a survey, one CSV file a heading, into a map layer.

    Parameters
    ----------
    folder
        Folder of 0_map.csv, 90_map.csv, ...: rows of x [m], y [m], heading [rad], field [nT].
    out
        Map layer to write, a .usdc file.
    name
        Name of the map; the file's unless given.
    licence
        Licence of the survey, an SPDX identifier such as MIT.
    force
        Replace the file if it exists.
    json
        Print the summary as JSON.
    """
    from magtwin.field.survey import read_survey
    from magtwin.files import check_free
    from magtwin.usd.maps import save_map

    check_suffix(out, (".usdc", ".usd"), "a map layer")
    check_free(out, force=force)
    field, report = read_survey(folder, name=name or out.stem, licence=licence)
    save_map(field, out, force=force)
    print_report(report, json)
    if not json:
        say(f"Wrote {out}")


@map_app.command(name="plot")
def map_plot(file: Path, *, out: Path, force: Force = False) -> None:
    """Draw a map, a panel a heading.

    Parameters
    ----------
    file
        Map layer (.usdc), or a folder of survey CSVs.
    out
        Picture to write, a .png file.
    force
        Replace the picture if it exists.
    """
    from magtwin.files import output
    from magtwin.io.plots import plot_map

    check_suffix(out, (".png",), "a picture")
    field = _open_map(file)
    with output(out, force=force) as aside:
        plot_map(field, aside)
    say(f"Wrote {out}")


@map_app.command(name="info")
def map_info(file: Path, *, json: Json = False) -> None:
    """Say what a map holds and where it comes from.

    Parameters
    ----------
    file
        Map layer (.usdc), or a folder of survey CSVs.
    json
        Print it as JSON.
    """
    print_report(_open_map(file).report(), json)


def _open_map(file: Path) -> Any:
    """The map of a layer, or of a folder of survey CSVs."""
    if file.is_dir():
        from magtwin.field.survey import import_survey

        return import_survey(file)
    from magtwin.usd.maps import load_map

    return load_map(file)
