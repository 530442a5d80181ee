"""`magtwin map`: make and look at anomaly maps."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import App, Parameter

from magtwin.cli.app import app
from magtwin.cli.map_input import (
    headings_rad,
    is_survey_folder,
    method_options,
    read_sources,
    worth_a_map,
)
from magtwin.cli.terminal import Force, Json, Seed, check_suffix, print_report, progress, say, step
from magtwin.errors import InputError
from magtwin.io.surveys.columns import Columns

map_app = App(name="map", help="Make and look at anomaly maps.")
app.command(map_app)

KeepLatched = Annotated[bool, Parameter(name="--keep-latched", negative="")]
Kernel = Literal["matern", "poisson"]
TableColumns = Annotated[Columns, Parameter(name="*")]
NO_COLUMNS = Columns()


@dataclass(frozen=True, kw_only=True)
class About:
    """What a survey cannot say of itself."""

    name: str | None = None
    """Name of the map; the file's unless given."""

    licence: str = ""
    """Licence of the survey, an SPDX identifier such as MIT."""

    created: str = ""
    """Day of the survey, YYYY-MM-DD."""

    height: float | None = None
    """Height of the sensor above the floor [m]."""

    frame: str = ""
    """Axes that x, y and heading are in, such as "world: x east, y north, z up"."""

    datum: str = ""
    """Where that frame lies, such as "origin amid the floor, heights above it"."""

    def given(self, out: Path) -> dict[str, Any]:
        """What it says, by the names that readings have; refused where the day is none."""
        from magtwin.field.days import check_day

        check_day(self.created, "--created")
        return {
            "name": self.name or out.stem,
            "licence": self.licence,
            "created": self.created,
            "height_m": self.height,
            "frame": self.frame,
            "datum": self.datum,
        }


AboutSurvey = Annotated[About, Parameter(name="*")]
NOTHING_SAID = About()


@map_app.command(name="import")
def map_import(
    *sources: Path,
    out: Path,
    about: AboutSurvey = NOTHING_SAID,
    keep_latched: KeepLatched = False,
    pose_topic: str | None = None,
    field_topic: str | None = None,
    columns: TableColumns = NO_COLUMNS,
    force: Force = False,
    json: Json = False,
) -> None:
    """Read a survey: a gridded one into a map layer or readings, any other into readings.

    Readings that latched, or are stuck, are found and masked; outliers are named and left in.

    Parameters
    ----------
    sources
        Folder of 0_map.csv, 90_map.csv, ...: rows of x [m], y [m], heading [rad], field. Or tables (CSV,
        Parquet), Runs or rosbag2 folders, each a run of its own; a pattern in quotes ('drives/*.parquet')
        or a folder of Parquet files stands for all files in it. Files whose rows belong together are
        joined by a plus, time.csv+place.csv+field.csv.
    out
        Map layer to write, a .usdc file; or readings, a .parquet file, to fit a model to.
    keep_latched
        Leave latched and stuck readings in.
    pose_topic
        Topic of a bag's poses, where it has several.
    field_topic
        Topic of a bag's field, where it has several.
    force
        Replace the file if it exists.
    json
        Print the summary as JSON.
    """
    from magtwin.field.survey.gridded import node_map, read_survey
    from magtwin.files import check_free

    check_suffix(out, (".usdc", ".usd", ".parquet"), "a map layer, or a file of readings,")
    check_free(out, force=force)
    given = about.given(out)
    if out.suffix != ".parquet" and len(sources) == 1 and is_survey_folder(sources[0], columns):
        field: Any
        field, report = read_survey(
            sources[0],
            **given,
            unit=columns.unit or "nT",
            scale=columns.scale,
            keep_latched=keep_latched,
        )
    else:
        readings, found = read_sources(sources, columns, given, keep_latched, pose_topic, field_topic)
        readings = readings.with_(name=given["name"])
        field = None if out.suffix == ".parquet" else node_map(readings)
        report = _joined((field or readings).report(), found)
    if field is None:
        from magtwin.io.surveys.readings import save_readings

        save_readings(readings, out, force=force)
    else:
        from magtwin.usd.maps import save_map

        save_map(field, out, force=force)
    print_report(report, json)
    if not json:
        say(f"Wrote {out}")


@map_app.command(name="fit")
def map_fit(
    *sources: Path,
    out: Path,
    method: Literal["trilinear", "cubic", "gp", "harmonic"] = "harmonic",
    kernel: Kernel | None = None,
    earth: str | None = None,
    spacing: float | None = None,
    headings: str | None = None,
    about: AboutSurvey = NOTHING_SAID,
    keep_latched: KeepLatched = False,
    pose_topic: str | None = None,
    field_topic: str | None = None,
    columns: TableColumns = NO_COLUMNS,
    force: Force = False,
    json: Json = False,
) -> None:
    """Fit a model to a survey, and write its map with variance.

    Parameters
    ----------
    sources
        Readings of any form that `magtwin map import` takes, its .parquet files too; several runs as
        several files, as a pattern in quotes ('drives/*.parquet'), or as a folder of Parquet files.
    out
        Map layer to write, a .usdc file.
    method
        trilinear between nodes, cubic, a Gaussian process, or the harmonic field of equivalent dipoles
        with the platform that the survey was made with.
    kernel
        Covariance of the Gaussian process: Matern's of order 5/2, or Poisson's, that of a field above
        uncorrelated sources; poisson unless given.
    earth
        The Earth's field for the harmonic fit: a scene or stage that knows it; latitude,longitude,height,date
        [deg, deg, m, YYYY-MM-DD], where the world's y is true north; or its x,y,z in the world [nT]. That
        of a survey of a twin is known unless given.
    spacing
        Distance between the map's nodes [m]. Default: the survey's own for trilinear, else the widest that
        costs next to no accuracy; the summary shows the error of interpolation.
    headings
        Headings of the map [deg], as 0,90,180,270. Default: the survey's own for trilinear, else the
        fewest of 4, 6, 8, 12 or 24 that cost next to no accuracy.
    keep_latched
        Leave latched and stuck readings in.
    pose_topic
        Topic of a bag's poses, where it has several.
    field_topic
        Topic of a bag's field, where it has several.
    force
        Replace the file if it exists.
    json
        Print the summary as JSON.
    """
    from magtwin.files import check_free
    from magtwin.usd.maps import save_map

    check_suffix(out, (".usdc", ".usd"), "a map layer")
    check_free(out, force=force)
    angles = None if headings is None else headings_rad(headings)
    given = about.given(out)
    options = method_options([method], kernel, earth).get(method, {})
    readings, found = read_sources(sources, columns, given, keep_latched, pose_topic, field_topic)
    from magtwin.field.fit.fit import fit, grid_report, raster

    found = worth_a_map(readings, found, sources[0])

    with progress(f"Fitting {method}") as advance:
        model = fit(readings, method, progress=advance, **options)
        named = readings.with_(name=given["name"])
        field = raster(model, named, spacing_m=spacing, headings_rad=angles, progress=advance)
    step("Writing the map")
    save_map(field, out, force=force)
    print_report(_joined(_joined(field.report(), grid_report(field)), found), json)
    if not json:
        say(f"Wrote {out}")


@map_app.command(name="check")
def map_check(
    *sources: Path,
    method: list[Literal["trilinear", "cubic", "gp", "harmonic"]] | None = None,
    split: Literal["checkerboard", "heading", "run", "block"] | None = None,
    kernel: Kernel | None = None,
    earth: str | None = None,
    within: float | None = None,
    keep_latched: KeepLatched = False,
    pose_topic: str | None = None,
    field_topic: str | None = None,
    columns: TableColumns = NO_COLUMNS,
    json: Json = False,
) -> None:
    """Say how well each method predicts readings that it was not shown.

    Parameters
    ----------
    sources
        Readings of any form that `magtwin map import` takes, its .parquet files too.
    method
        Method to check; may be given several times; all of them unless given.
    split
        What is left out: every other node at all its headings, one heading at a time, one run at a time, or
        blocks of the floor; nodes of a gridded survey, runs where there are several, else blocks, unless
        given.
    kernel
        Covariance of the Gaussian process: Matern's of order 5/2, or Poisson's, that of a field above
        uncorrelated sources; poisson unless given.
    earth
        The Earth's field for the harmonic fit: a scene or stage that knows it; latitude,longitude,height,date
        [deg, deg, m, YYYY-MM-DD], where the world's y is true north; or its x,y,z in the world [nT]. That
        of a survey of a twin is known unless given.
    within
        Only readings this near to one that was shown count [m].
    keep_latched
        Leave latched and stuck readings in.
    pose_topic
        Topic of a bag's poses, where it has several.
    field_topic
        Topic of a bag's field, where it has several.
    json
        Print the summary as JSON.
    """
    from magtwin.field.fit.check import FILLED, check
    from magtwin.field.fit.fit import METHODS

    methods = list(method or METHODS)
    options = {**FILLED, **method_options(methods, kernel, earth)}
    readings, _ = read_sources(sources, columns, {}, keep_latched, pose_topic, field_topic)
    if split is None:
        split = "checkerboard" if readings.grid is not None else "run" if len(readings.runs) > 1 else "block"
    with progress("Checking") as advance:
        report = check(readings, methods, split=split, within_m=within, options=options, progress=advance)
    print_report(report, json)


@map_app.command(name="survey")
def map_survey(
    scene: Path,
    *,
    out: Path,
    spacing: float = 0.25,
    headings: str = "0,90,180,270",
    readings: int = 135,
    height: float | None = None,
    heading_error: float = 2.0,
    position_error: float = 0.01,
    seed: Seed = 0,
    name: str | None = None,
    licence: str = "",
    created: str | None = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Survey a scene as its robot would, from node to node, with its sensor's noise and its own errors.

    What the stage holds now makes the field: move a desk in it, survey again, and `magtwin map diff` finds
    it. The map's variance is that of noise and errors; nodes where the sensor lost lock or where the robot
    cannot stand are masked.

    Parameters
    ----------
    scene
        USD stage whose Earth's field is known.
    out
        Map layer to write, a .usdc file; or readings, a .parquet file, to fit a model to.
    spacing
        Distance between nodes [m].
    headings
        Headings in which the robot stands at each node [deg], ascending.
    readings
        Readings whose mean a node gives; the lab's own map has 135, a second's.
    height
        Height of the sensor above the floor [m]; the robot's own unless given.
    heading_error
        Standard deviation of the robot's heading about the node's [deg]; readings record it, a map takes
        the node's. 0 for a map of the scene itself.
    position_error
        Standard deviation of where the robot stands about the node, along x and y [m]; the node is
        recorded. 0 for a map of the scene itself.
    seed
        Seed of the noise and of the errors.
    name
        Name of the map; the file's unless given.
    licence
        Licence of the map, an SPDX identifier.
    created
        Day of the survey, YYYY-MM-DD; that of the Earth's field unless given.
    force
        Replace the file if it exists.
    json
        Print the summary as JSON.
    """
    from math import radians

    import numpy as np

    from magtwin.author.scene import read_scene
    from magtwin.files import check_free, sha256
    from magtwin.sim.survey import blocked_by, survey, survey_readings
    from magtwin.usd.layers import layer_files
    from magtwin.usd.obstacles import read_obstacles

    check_suffix(out, (".usdc", ".usd", ".parquet"), "a map layer, or a file of readings,")
    check_free(out, force=force)
    if seed < 0:
        raise InputError(f"seed must be a whole number from 0 up, got {seed}")
    step("Reading the scene")
    twin = read_scene(scene, check_network=False)
    day = twin.earth.date if twin.earth is not None else ""
    files = [file for file in layer_files(scene) if file.resolve() != twin.map_layer.resolve()]
    about: dict[str, Any] = {
        "rng": np.random.default_rng(seed),
        "spacing_m": spacing,
        "headings_rad": headings_rad(headings),
        "readings": readings,
        "height_m": height,
        "heading_error_rad": radians(heading_error),
        "position_error_m": position_error,
        "source": "; ".join(f"{file.name} sha256:{sha256(file)}" for file in files),
        "licence": licence,
        "created": day if created is None else created,
    }
    with progress(f"Surveying {twin.name}", "headings") as advance:
        blocked = blocked_by(twin, read_obstacles(scene))
        if out.suffix == ".parquet":
            read = survey_readings(twin, **about, progress=advance, blocked=blocked)
        else:
            field = survey(twin, **about, name=name or out.stem, progress=advance, blocked=blocked)
    if out.suffix == ".parquet":
        from magtwin.io.surveys.readings import save_readings

        save_readings(replace(read, name=name or out.stem), out, force=force)
        print_report(read.report(), json)
    else:
        from magtwin.usd.maps import save_map

        field = replace(field, parameters={**field.parameters, "seed": seed})
        save_map(field, out, force=force)
        print_report(field.report(), json)
    if not json:
        say(f"Wrote {out}")


@map_app.command(name="plot")
def map_plot(
    file: Path,
    *,
    out: Path,
    what: Literal["field", "gradient", "variance", "mask", "headings"] = "field",
    headings: str | None = None,
    date: str | None = None,
    force: Force = False,
) -> None:
    """Draw a map as filled contours, a panel a heading.

    Parameters
    ----------
    file
        Map layer or stage (.usd, .usda, .usdc), or a folder of survey CSVs.
    out
        Picture to write, a .png or .svg file.
    what
        The field; its gradient along the floor; its standard deviation; which nodes are masked; or each
        heading minus the mean over all of them.
    headings
        Headings to show [deg], as 0,90,180,270; the map's own unless given, of more than eight four.
    date
        Day to show, YYYY-MM-DD, between the map's epochs; the latest unless given.
    force
        Replace the picture if it exists.
    """
    from magtwin.figures.plots import plot_map
    from magtwin.files import check_free

    check_suffix(out, (".png", ".svg"), "a picture")
    check_free(out, force=force)
    angles = None if headings is None else headings_rad(headings)
    step("Drawing the map")
    plot_map(_open_map(file, date), out, what=what, headings=angles, force=force)
    say(f"Wrote {out}")


@map_app.command(name="info")
def map_info(file: Path, *, date: str | None = None, json: Json = False) -> None:
    """Say everything that a map knows: its field, how sure it is, how it came about and from what.

    Parameters
    ----------
    file
        Map layer or stage (.usd, .usda, .usdc), or a folder of survey CSVs.
    date
        Day to tell of, YYYY-MM-DD, between the map's epochs; the latest unless given.
    json
        Print it as JSON.
    """
    from magtwin.field.maps.card import map_card

    if file.is_dir():
        card = map_card(_open_map(file, date))
    else:
        from magtwin.field.maps.epochs import at_date

        epochs = _open_epochs(file)
        card = map_card(epochs[-1] if date is None else at_date(epochs, date), epochs)
    print_report(card, json)


@map_app.command(name="diff")
def map_diff(
    before: Path, after: Path, *, out: Path | None = None, force: Force = False, json: Json = False
) -> None:
    """Say what changed from one survey to another, where, and how much against the variance.

    Parameters
    ----------
    before
        The earlier map: a layer or stage, or a folder of survey CSVs.
    after
        The later map.
    out
        Picture to write, a .png or .svg file; none unless given.
    force
        Replace the picture if it exists.
    json
        Print the summary as JSON.
    """
    from magtwin.field.maps.difference import difference
    from magtwin.files import check_free

    if out is not None:
        check_suffix(out, (".png", ".svg"), "a picture")
        check_free(out, force=force)
    step("Comparing the maps")
    found = difference(_open_map(before), _open_map(after))
    if out is not None:
        from magtwin.figures.plots import plot_difference

        plot_difference(found, out, force=force)
    report = found.report()
    if json:  # every region, in numbers
        report = replace(report, metadata={**report.metadata, "regions": [asdict(r) for r in found.regions]})
    print_report(report, json)
    if out is not None and not json:
        say(f"Wrote {out}")


@map_app.command(name="continue")
def map_continue(
    file: Path, *, height: float, out: Path, date: str | None = None, force: Force = False, json: Json = False
) -> None:
    """Take a map to another height: exactly by its harmonic field, else upwards by the waves of its grid.

    Parameters
    ----------
    file
        Map layer or stage (.usd, .usda, .usdc), or a folder of survey CSVs.
    height
        Height of the sensor above the floor there [m].
    out
        Map layer to write, a .usdc file.
    date
        Day to take, YYYY-MM-DD, between the map's epochs; the latest unless given.
    force
        Replace the file if it exists.
    json
        Print the summary as JSON.
    """
    from magtwin.field.maps.card import map_card
    from magtwin.field.maps.continuation import at_height
    from magtwin.files import check_free
    from magtwin.usd.maps import save_map

    check_suffix(out, (".usdc", ".usd"), "a map layer")
    check_free(out, force=force)
    step(f"Continuing the field to {height:g} m")
    field = at_height(_open_map(file, date), height)
    save_map(field, out, force=force)
    print_report(map_card(field), json)
    if not json:
        say(f"Wrote {out}")


@map_app.command(name="export")
def map_export(file: Path, *, out: Path, date: str | None = None, force: Force = False) -> None:
    """Write a map as CSVs, one per heading, as map import reads them; a survey's rows come back unchanged.

    Comment lines above the rows keep the map's method, frame, height, day, licence and statistics.

    Parameters
    ----------
    file
        Map layer or stage (.usd, .usda, .usdc).
    out
        Folder to make: 0_map.csv, 90_map.csv, ..., rows of x [m], y [m], heading [rad], field [nT].
    date
        Day to take, YYYY-MM-DD, between the map's epochs; the latest unless given.
    force
        Replace the folder if it exists.
    """
    from magtwin.field.survey.gridded import write_survey

    for written in write_survey(_open_map(file, date), out, force=force):
        say(f"Wrote {written}")


@map_app.command(name="epochs")
def map_epochs(*files: Path, out: Path, force: Force = False, json: Json = False) -> None:
    """Join maps of several days into one layer that knows how the field drifts.

    Parameters
    ----------
    files
        Map layers of one grid, each with the day of its survey, in any order.
    out
        Map layer to write, a .usdc file: a time sample a day, the time code days since 2000-01-01.
    force
        Replace the file if it exists.
    json
        Print the summary as JSON.
    """
    from magtwin.field.maps.epochs import drift, in_order
    from magtwin.files import check_free
    from magtwin.usd.maps import save_map_series

    check_suffix(out, (".usdc", ".usd"), "a map layer")
    check_free(out, force=force)
    maps = in_order([epoch for file in files for epoch in _open_epochs(file)])
    save_map_series(maps, out, force=force)
    print_report(drift(maps), json)
    if not json:
        say(f"Wrote {out}")


def _joined(report: Any, found: Any) -> Any:
    """A report with the figures and metadata of another below its own."""
    return replace(
        report, figures=report.figures + found.figures, metadata={**report.metadata, **found.metadata}
    )


def _open_map(file: Path, date: str | None = None) -> Any:
    """The map of a layer or stage, of a day where one is given, or of a folder of survey CSVs."""
    if file.is_dir():
        from magtwin.field.survey.gridded import import_survey

        if date is not None:
            raise InputError(f"{file}: a folder of CSVs is one survey without a day; leave out --date")
        return import_survey(file)
    from magtwin.usd.maps import load_map

    return load_map(file, date)


def _open_epochs(file: Path) -> Any:
    """Every epoch of a layer's or stage's map."""
    from magtwin.usd.maps import load_epochs

    return load_epochs(file)
