"""`magtwin map import`, `fit`, `validate` and `survey`: surveys to maps."""

import json
import re
import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from magtwin.cli.maps.map import LAYERS, Earth, Kernel, Sources, earth_nt, map_app
from magtwin.cli.options import Flag, Force, Jobs, Lab, Licence, Seed, Whole, headings_rad
from magtwin.cli.terminal import Done, check_output, progress, step
from magtwin.errors import InputError
from magtwin.io.surveys.columns import About, Columns
from magtwin.report.report import Report

COLUMNS = Columns()
KeepStuck = Annotated[Flag, Parameter(help="Keep readings of a sensor that was stuck.")]


@dataclass(frozen=True, kw_only=True)
class Reading:
    """How the files of a survey are read."""

    keep_stuck: KeepStuck = False

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
        text = error.in_flags({k: flag for k, flag in _TOLD.items() if k != "keep_stuck"})
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
    out: Path,
    about: AboutSurvey = ABOUT,
    reading: ReadingOptions = READING,
    force: Force = False,
) -> Done:
    """Import a survey as a map layer, if it is gridded, or as a file of readings.

    Stuck readings are found and masked. Outliers are reported and kept.

    Parameters
    ----------
    sources
        Folder of 0_map.csv, 90_map.csv, ...: rows of x [m], y [m], heading [rad], field. Or tables (CSV,
        Parquet), runs or rosbag2 folders; each is one run. A pattern in quotes ('drives/*.parquet') or a
        folder of Parquet files stands for all its files. A plus joins files whose rows belong together:
        time.csv+place.csv+field.csv.
    out
        Map layer (.usdc) or readings (.parquet) to write.
    """
    from magtwin.io.surveys.maps import import_survey

    check_output(out, (*LAYERS, ".parquet"), "a map layer, or a file of readings,", force=force)
    step("Reading the survey")
    report = import_survey(sources, out, about=about, force=force, **vars(reading))
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

    check_output(out, LAYERS, "a map layer", force=force)
    angles = None if headings_deg is None else headings_rad(headings_deg)
    work = "Fitting" if method == "auto" else f"Fitting {method}"
    with _as_imported(sources), progress(work) as advance:
        report = fit_survey(
            sources,
            out,
            method=method,
            kernel=kernel,
            earth_nt=None if earth is None else earth_nt(earth),
            spacing_m=spacing_m,
            headings_rad=angles,
            keep_stuck=keep_stuck,
            progress=advance,
            force=force,
        )
    return _done(report, out)


def _done(report: Report, out: Path) -> Done:
    """A report on a survey, with its outliers in one line; JSON lists them."""
    outliers = report.metadata.get("outliers", ())
    if not outliers:
        return Done(report, out)
    note = f"left in; the largest: {outliers[0]}; --json lists {len(outliers)}"
    figures = tuple(replace(f, note=note) if f.name == "outliers" else f for f in report.figures)
    shown = {name: value for name, value in report.metadata.items() if name != "outliers"}
    brief = replace(report, figures=figures, metadata=shown)
    return Done(brief, out, data=json.loads(report.to_json()))


@map_app.command(name="validate")
def map_validate(
    *sources: Sources,
    method: list[Literal["auto", "trilinear", "cubic", "gp", "harmonic"]] | None = None,
    split: Literal["checkerboard", "heading", "run", "block"] | None = None,
    kernel: Kernel = None,
    earth: Earth = None,
    keep_stuck: KeepStuck = False,
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
    """
    from magtwin.io.surveys.maps import validate_methods

    with _as_imported(sources), progress("Validating") as advance:
        report = validate_methods(
            sources,
            methods=method,
            split=split,
            kernel=kernel,
            earth_nt=None if earth is None else earth_nt(earth),
            keep_stuck=keep_stuck,
            progress=advance,
        )
    return Done(report)


@map_app.command(name="survey")
def map_survey(
    scene: Path,
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

    The field is that of the stage as it is now: move a desk in it, survey again, and `magtwin map diff` finds
    the change. With --adopt, the stage reads the new map from then on. The map's variance includes noise and
    pose errors. Nodes where the sensor loses lock or the robot cannot stand are masked.

    Parameters
    ----------
    scene
        USD stage with a known Earth field, or the name of a scene that ships with magtwin: lab.
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
    from magtwin.files.kinds import scene_file
    from magtwin.twin.maps import survey_scene

    scene = scene_file(scene)
    check_output(out, (*LAYERS, ".parquet"), "a map layer, or a file of readings,", force=force)
    angles = headings_rad(headings_deg)
    with progress(f"Surveying {scene.name}", "headings") as advance:
        report = survey_scene(
            scene,
            out,
            adopt=adopt,
            lab=lab,
            spacing_m=spacing_m,
            headings_rad=angles,
            readings=readings,
            height_m=height_m,
            heading_error_deg=heading_error_deg,
            position_error_m=position_error_m,
            seed=seed,
            name=name,
            licence=licence,
            created=created,
            jobs=jobs,
            progress=advance,
            force=force,
        )
    return Done(report, out)
