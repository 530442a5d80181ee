"""Maps of surveys, from files to files: import, fit, validate."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.survey.changes import changes_line
from magtwin.field.survey.folder import heading_doubts
from magtwin.field.survey.nodes import node_map, on_lattice
from magtwin.field.survey.nodes import read_survey as read_folder
from magtwin.field.survey.readings import Readings, masked_words
from magtwin.field.survey.saved import save_readings
from magtwin.files.kinds import SURVEY, kind_of
from magtwin.files.outputs import check_free
from magtwin.io.surveys.axes import vector_doubts
from magtwin.io.surveys.columns import About, Columns
from magtwin.io.surveys.readings import Source
from magtwin.io.surveys.survey import survey_and_report
from magtwin.report.report import Report
from magtwin.usd.maps.layer import save_map

Method = Literal["auto", "trilinear", "cubic", "gp", "harmonic"]
Split = Literal["checkerboard", "heading", "run", "block"]
Progress = Callable[..., None]
Vector = tuple[float, float, float]

LEAST_READINGS = 8  # Smallest number of good readings that a map can be fitted to
USUAL_READINGS = 100  # Number of good readings below which the report doubts the map
MOST_MASKED = 0.9  # Share of masked nodes above which the report doubts the map


def import_survey(
    sources: Sequence[Source],
    out: Source,
    *,
    about: About | None = None,
    progress: Progress | None = None,
    force: bool = False,
    **reading: Any,
) -> Report:
    """Write a survey as a map layer, or as readings.

    Sources are those of `read_readings`; a folder with one CSV per heading too. The output is a map layer
    (.usdc) or readings (.parquet). A grid with a reading at each node keeps its values; to other readings a
    map is fitted. `about` are metadata that the files lack, `reading` options of `survey_and_report`.
    """
    out, columns, about = check_free(out, force=force), reading.get("columns") or Columns(), about or About()
    name = about.name or out.stem
    table = out.suffix.lower() == ".parquet"
    unnamed = replace(columns, unit=None, scale=None) == Columns()
    if not table and len(sources) == 1 and kind_of(Path(sources[0])) is SURVEY and unnamed:
        known = {**asdict(about), "name": name, "unit": columns.unit or "nT", "scale": columns.scale}
        field, report = read_folder(sources[0], **known, keep_stuck=reading.get("keep_stuck", False))
        save_map(field, out, force=force)
        return report
    readings, found = survey_and_report(sources, about=about, **reading)
    readings = readings.with_(name=name) if table else on_lattice(readings.with_(name=name))
    if not table and readings.grid is None:
        return _fitted(readings, out, found, progress=progress, force=force)
    found = _with_doubts(found, [*heading_doubts(readings), *vector_doubts(readings)])
    if table:
        save_readings(readings, out, force=force)
        return _joined(readings.report(), found)
    field = node_map(readings)
    save_map(field, out, force=force)
    return _joined(field.report(), found)


def fit_survey(
    sources: Sequence[Source],
    out: Source,
    *,
    method: Method = "auto",
    kernel: Literal["matern", "poisson"] | None = None,
    earth_nt: Vector | None = None,
    spacing_m: float | None = None,
    headings_rad: Sequence[float] | None = None,
    keep_stuck: bool = False,
    progress: Progress | None = None,
    force: bool = False,
) -> Report:
    """Fit a model to a survey and write its map with variance.

    `kernel` is the covariance of the Gaussian process (None: poisson; for "auto" the better one), `earth_nt`
    the Earth's field in world axes for the harmonic fit. Spacing and headings are chosen by accuracy if they
    are not given. The report is on the map, its grid, stuck readings and doubts.
    """
    out = check_free(out, force=force)
    options = _method_options([method], kernel, earth_nt).get(method, {})
    readings, report = survey_and_report(sources, keep_stuck=keep_stuck)
    readings = readings.with_(name=out.stem)
    grid: dict[str, Any] = {"spacing_m": spacing_m, "headings_rad": headings_rad}
    return _fitted(readings, out, report, method, options, progress=progress, force=force, **grid)


def _fitted(
    readings: Readings,
    out: Path,
    report: Report,
    method: str = "auto",
    options: Mapping[str, Any] = MappingProxyType({}),
    *,
    progress: Progress | None,
    force: bool,
    **grid: Any,
) -> Report:
    """Fit a map to readings, write it, and report on it and on the readings."""
    from magtwin.field.fit.choice import choice_report
    from magtwin.field.fit.fit import fit, grid_report, raster

    doubts = [*_doubts(readings), *_shared(readings, method)]
    model = fit(readings, method, progress=progress, **options)
    field = raster(model, readings, progress=progress, **grid)
    save_map(field, out, force=force)
    report = _with_doubts(report, [*doubts, *_masked(field)])
    return _joined(field.report(), choice_report(field.parameters), grid_report(field), report)


def validate_methods(
    sources: Sequence[Source],
    *,
    methods: Sequence[str] | None = None,
    split: Split | None = None,
    kernel: Literal["matern", "poisson"] | None = None,
    earth_nt: Vector | None = None,
    keep_stuck: bool = False,
    progress: Progress | None = None,
) -> Report:
    """Predict left-out readings of a survey with each method, and report the errors.

    All methods but "auto" by default. Left out are, by default, nodes of a gridded survey, runs if there are
    several, else blocks. Further arguments are those of `fit_survey`.
    """
    from magtwin.field.fit.check import FILLED, check
    from magtwin.field.fit.fit import METHODS

    chosen = list(methods or (name for name in METHODS if name != "auto"))
    options = {**FILLED, **_method_options(chosen, kernel, earth_nt)}
    readings, _ = survey_and_report(sources, keep_stuck=keep_stuck)
    if split is None:
        split = "checkerboard" if readings.grid is not None else "run" if len(readings.runs) > 1 else "block"
    return check(readings, chosen, split=split, options=options, progress=progress)


def _doubts(readings: Readings) -> list[str]:
    """What makes a map of these readings doubtful; too few readings are refused."""
    from magtwin.field.fit.harmonic.problem import ONE_HEADING

    count, yaw, doubts = int(readings.good.sum()), readings.yaw[readings.good], list[str]()
    if readings.grid is None and count < LEAST_READINGS:
        text = f"a map needs {LEAST_READINGS} at least, and some hundred to be of use"
        good = f"{count} of {len(readings)} readings are good{masked_words(readings)}"
        raise InputError(f"{readings.name}: {good}; {text}")
    if readings.grid is None and count < USUAL_READINGS:
        doubts.append(f"only {count} good readings: the map is valid only next to them")
    if line := changes_line(readings):
        doubts.append(line)
    doubts += [*heading_doubts(readings), *vector_doubts(readings)]
    mean = np.exp(1j * yaw).mean()
    if np.abs(mean) >= ONE_HEADING and not readings.by_hand:
        doubts.append(
            f"one heading only, {np.degrees(np.angle(mean)):.0f} deg: the robot's own field cannot "
            "be separated from the room's, and a simulated robot adds its own again; survey in several "
            "headings, or give --heading none if the sensor was carried by hand"
        )
    return doubts


def _masked(field: AnomalyMap) -> list[str]:
    """The doubt about a map that has hardly a node."""
    count, size = int(np.count_nonzero(~field.valid)), field.valid.size
    doubt = (
        f"{count:,} of {size:,} nodes are masked: they are far from the readings, or the fit's standard "
        "deviation there is over half that of the readings; check headings and vectors, or take another "
        "--method"
    )
    return [doubt] if count > MOST_MASKED * size else []


def _with_doubts(report: Report, doubts: list[str]) -> Report:
    doubts = [*report.metadata.get("doubts", []), *doubts]
    return replace(report, metadata={**report.metadata, "doubts": doubts}) if doubts else report


def _shared(readings: Readings, method: str) -> list[str]:
    """What a fit takes for granted about the runs of a survey, and what its intervals leave out."""
    from magtwin.field.fit.fit import offset_sd_nt
    from magtwin.field.fit.passes import by_pass
    from magtwin.field.survey.onboard import lacking

    doubts = list[str]()
    if readings.grid is not None:
        return doubts
    if len(readings.runs) > 1 and method != "gp":
        doubts.append(
            f"{len(readings.runs)} runs are fitted with one platform: if the robot's hard iron changed "
            "between them, as between sessions, the map takes the difference for field; fit each session "
            "alone, or use --method gp, in which runs may disagree"
        )
    if readings.t is not None and np.ptp(by_pass(readings).run) == 0:
        doubts.append(
            "the drive never comes back to a place, so the noise between passes is unknown and the standard "
            "deviations are too small; cross your own path often"
        )
    used = readings.signal_names if method in ("auto", "harmonic") else ()
    if offset := offset_sd_nt(readings, used):
        columns = ", ".join(lacking(readings.signal_names))
        way = f"record {columns} with it" if columns else "take --method auto, which fits them"
        doubts.append(
            "one drive: what its robot adds alike throughout (motors, battery, LiDAR) cannot be told from "
            f"the room's field; the standard deviations hold {offset:g} nT for it (offset sd), which "
            f"localization takes for an unknown bias; {way}, or survey at rest, node by node"
        )
    elif readings.t is not None and not readings.by_hand and np.ptp(readings.run[readings.good]):
        doubts.append(
            "readings of drives: the standard deviations do not hold what the robot adds alike in all runs "
            "(motors, battery, LiDAR); survey at rest, node by node, for intervals that hold"
        )
    return doubts


def _method_options(
    methods: Sequence[str], kernel: str | None, earth_nt: Vector | None
) -> dict[str, dict[str, Any]]:
    """Options by method; an option of a method that is not used is refused."""
    options: dict[str, dict[str, Any]] = {"auto": {}}
    given = {("kernel", "kernel", "gp"): kernel, ("earth", "earth_nt", "harmonic"): earth_nt}
    for (name, option, method), value in given.items():
        if value is None:
            continue
        if not {method, "auto"} & set(methods):
            raise InputError(f"`{name}` is for `method={method}`; drop it for {methods[0]}", parameter=name)
        options[method] = {option: value}
        options["auto"] |= options[method]
    return options


def _joined(report: Report, *below: Report) -> Report:
    """A report with the figures and metadata of others below its own."""
    for other in below:
        figures, metadata = report.figures + other.figures, {**report.metadata, **other.metadata}
        report = replace(report, figures=figures, metadata=metadata)
    return report
