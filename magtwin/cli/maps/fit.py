"""`magtwin map import`, `fit`, `validate` and `survey`: surveys to maps."""

import re
import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from magtwin.cli.maps.map import LAYERS, Earth, Kernel, Sources, earth_nt, map_app
from magtwin.cli.options import Flag, Force, Jobs, Lab, Licence, Scene, Seed, Whole, headings_rad
from magtwin.cli.terminal import Done, named, progress
from magtwin.errors import InputError
from magtwin.io.surveys.columns import About, Columns
from magtwin.report.report import Report

COLUMNS = Columns()
READINGS = "a map layer, or a file of readings,"
KeepStuck = Annotated[Flag, Parameter(help="Keep readings of a sensor that was stuck.")]


@dataclass(frozen=True, kw_only=True)
class Reading:
    """How the files of a survey are read."""

    waypoints: Path | None = None
    """Table of t,x,y, or of t and notes such as "1.5,2": when the sensor was carried past which places [m].
    For the log of a phone, which has no positions. Or of x,y alone, in the order of the walk."""

    step_m: float | None = None
    """Length of a step [m], for waypoints without times in a log with accelerations. Default: a steady pace
    from the first to the last."""

    pose_topic: str | None = None
    """Topic of the poses in a bag, if it has several."""

    field_topic: str | None = None
    """Topic of the field in a bag, if it has several."""

    columns: Annotated[Columns, Parameter(name="*")] = COLUMNS


AboutSurvey = Annotated[About, Parameter(name="*")]
ReadingOptions = Annotated[Reading, Parameter(name="*")]
ABOUT, READING = About(), Reading()

_TOLD = {f.name: f"--{f.name.replace('_', '-')}" for f in (*fields(Reading), *fields(Columns))}
"""Flags of `map import` that tell how to read a survey."""

_FLAGS = "|".join(sorted(set(_TOLD.values()), key=len, reverse=True))
_ADVICE = re.compile(rf"(?:(?:{_FLAGS}) [^\s,;()]+ ?)+")


@contextmanager
def _as_imported(sources: Sequence[Path]) -> Iterator[None]:
    """Ends a refusal that names a flag of `map import` with the command to type."""
    try:
        yield
    except InputError as error:
        text = error.in_flags(_TOLD)
        advice = _ADVICE.search(text)
        if advice is None:
            raise
        told = advice.group().split()
        out = Path(sources[0]).with_suffix(".parquet").name
        words = ["magtwin", "map", "import", *map(str, sources), *told, "--out", out]
        raise InputError(f"{text}; import it first: {shlex.join(words)}") from error


@map_app.command(name="import")
def map_import(
    *sources: Sources,
    out: Path | None = None,
    about: AboutSurvey = ABOUT,
    reading: ReadingOptions = READING,
    keep_stuck: KeepStuck = False,
    force: Force = False,
) -> Done:
    """Import a survey as a map layer, or as a file of readings.

    A grid with a reading at each node keeps its values. To other readings a map is fitted, as by map fit.
    Stuck readings are found and masked. Outliers are reported and kept.

    Parameters
    ----------
    sources
        Tables of x, y and the field, and perhaps the heading (CSV, Excel, Parquet); logs of phones (phyphox,
        Sensor Logger, Android traces: file, folder or zip) and of vehicles (.ulg, .bin, .h5); runs or rosbag2
        folders; each is one run. Or a folder of 0_map.csv, 90_map.csv, ..., one per heading. A pattern in
        quotes ('drives/*.parquet') or a folder of Parquet files stands for all its files. A plus joins files
        whose rows belong together: time.csv+place.csv+field.csv.
    out
        Map layer (.usdc) or readings (.parquet) to write. Default: the name of the first source, with .usdc.
    """
    from magtwin.io.surveys.maps import import_survey

    out = out or Path(f"{Path(sources[0]).stem}.usdc")
    out = named(out, (*LAYERS, ".parquet"), READINGS, force=force)
    with progress("Reading the survey") as advance:
        how: Any = {"keep_stuck": keep_stuck, "force": force, **vars(reading)}
        report = import_survey(sources, out, about=about, progress=advance, **how)
    return _done(report, out)


@map_app.command(name="fit")
def map_fit(
    *sources: Sources,
    out: Path,
    method: Literal["auto", "trilinear", "cubic", "gp", "harmonic"] = "auto",
    kernel: Kernel = None,
    earth: Earth = None,
    spacing_m: float | None = None,
    headings_deg: str | None = None,
    keep_stuck: KeepStuck = False,
    force: Force = False,
) -> Done:
    """Fit a model to a survey and write its map with variance.

    Parameters
    ----------
    sources
        The .parquet files that `magtwin map import` writes, or any readings that it reads without options.
    out
        Map layer to write (.usdc).
    method
        trilinear interpolation between nodes, cubic, a Gaussian process (gp), the field of equivalent dipoles
        with the robot's own field (harmonic), or the one of these, or mixture of two, that best predicts
        readings left out (auto).
    spacing_m
        Spacing of the map's nodes [m]. Default for trilinear: that of the survey. Default for other methods:
        the widest with almost no loss of accuracy. The report gives the interpolation error.
    headings_deg
        Headings of the map [deg], such as 0,90,180,270. Default for trilinear: the headings of the
        survey. Default for other methods: the smallest of 4, 6, 8, 12 or 24 headings with almost no loss of
        accuracy.
    """
    from magtwin.io.surveys.maps import fit_survey

    out = named(out, LAYERS, "a map layer", force=force)
    how: Any = {"method": method, "kernel": kernel, "spacing_m": spacing_m, "keep_stuck": keep_stuck}
    how["headings_rad"] = None if headings_deg is None else headings_rad(headings_deg)
    work = "Choosing the method of the map" if method == "auto" else f"Fitting the {method} map"
    with _as_imported(sources), progress(work) as advance:
        how["earth_nt"] = None if earth is None else earth_nt(earth)
        report = fit_survey(sources, out, progress=advance, force=force, **how)
    return _done(report, out)


def _done(report: Report, out: Path) -> Done:
    """A report on a survey or its map, and what to do with it."""
    rest = f"magtwin info {out}"
    look: list[tuple[object, ...]] = [("magtwin", "plot", out)]
    if out.suffix.lower() == ".parquet":
        rest, look = "", [("magtwin", "map", "fit", out, "--out", out.with_suffix(".usdc"))]
    return Done(report, out, rest=rest, next=look)


@map_app.command(name="validate")
def map_validate(
    *sources: Sources,
    method: list[Literal["auto", "trilinear", "cubic", "gp", "harmonic"]] | None = None,
    split: Literal["checkerboard", "heading", "run", "block"] | None = None,
    kernel: Kernel = None,
    earth: Earth = None,
    keep_stuck: KeepStuck = False,
    out: Path | None = None,
    force: Force = False,
) -> Done:
    """Measure how well each method predicts readings that were left out of its fit.

    Parameters
    ----------
    sources
        The .parquet files that `magtwin map import` writes, or any readings that it reads without options.
    method
        Method to validate. May be repeated. Default: all but auto.
    split
        What is left out at a time: every other node, one heading, one run, or blocks of the floor. Default:
        nodes of a gridded survey, runs if there are several, else blocks.
    out
        Page to write (.html): the best method first, and the errors of all of them.
    """
    from magtwin.io.surveys.maps import validate_methods

    page = None if out is None else named(out, (".html",), "a page", force=force)
    with _as_imported(sources), progress("Predicting the readings left out") as advance:
        how: Any = {"methods": method, "split": split, "kernel": kernel, "keep_stuck": keep_stuck}
        how["earth_nt"] = None if earth is None else earth_nt(earth)
        report = validate_methods(sources, progress=advance, **how)
    if page is not None:
        from magtwin.figures.page import write_page
        from magtwin.figures.reports import page_of_check

        write_page(page_of_check(report), page, force=force)
    best = ("magtwin", "map", "fit", *sources, "--out", "map.usdc")
    return Done(report, page or (), next=(best,))


@map_app.command(name="survey")
def map_survey(
    scene: Scene,
    *,
    out: Path,
    adopt: Flag = False,
    lab: Lab = "",
    spacing_m: float = 0.25,
    headings_deg: str = "0,90,180,270",
    readings: Whole = 135,
    height_m: float | None = None,
    heading_error_deg: float = 2.0,
    position_error_m: float = 0.01,
    seed: Seed = 0,
    name: str | None = None,
    licence: Licence = "",
    created: str | None = None,
    jobs: Jobs = None,
    force: Force = False,
) -> Done:
    """Survey a scene as its robot would, node by node, with sensor noise and pose errors.

    The field, whose Earth's part must be known, is that of the stage as it is now: move a desk in it, survey
    again, and `magtwin map diff` finds the change. With --adopt, the stage reads the new map from then on.
    The map's variance includes noise and pose errors. Nodes where the sensor loses lock or the
    robot cannot stand are masked.

    Parameters
    ----------
    out
        Map layer (.usdc) or readings (.parquet) to write.
    adopt
        Put the new map in place of the stage's old one: in the sublayers, and in the checksum of each
        magnetometer. The old map's file stays.
    spacing_m
        Spacing of the nodes [m].
    headings_deg
        Headings of the robot at each node [deg], ascending.
    readings
        Readings averaged at each node; the shipped map has 135, one second of them.
    height_m
        Height of the sensor above the floor [m]. Default: the robot's.
    heading_error_deg
        Standard deviation of the robot's heading about the node's [deg]. Readings record the heading; a map
        takes the node's. 0 surveys the scene without this error.
    position_error_m
        Standard deviation of the robot's position about the node, along x and y [m]. The node is recorded.
    name
        Name of the map. Default: the name of the output.
    created
        Date of the survey, YYYY-MM-DD. Default: that of the Earth's field.
    jobs
        Number of processes that share the headings. Default: one, with several threads.
    """
    given: dict[str, Any] = dict(locals())
    from magtwin.files.kinds import scene_file
    from magtwin.twin.maps import survey_scene

    stage = scene_file(given.pop("scene"))
    out = named(given.pop("out"), (*LAYERS, ".parquet"), READINGS, force=force)
    angles = headings_rad(given.pop("headings_deg"))
    with progress(f"Surveying {stage.name}", "headings") as advance:
        report = survey_scene(stage, out, headings_rad=angles, progress=advance, **given)
    return _done(report, out)
