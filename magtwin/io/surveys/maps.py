"""Surveys to maps: import a survey of any form, fit a model to it, validate methods on it, survey a scene."""

import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from math import radians
from pathlib import Path
from typing import Any, Literal

import numpy as np

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.survey.changes import changes_line
from magtwin.field.survey.folder import heading_doubts, node_map
from magtwin.field.survey.folder import read_survey as read_folder
from magtwin.field.survey.hold import without_repeats
from magtwin.field.survey.readings import Readings, masked_words, taken_of
from magtwin.field.survey.stuck import mask_stuck
from magtwin.files.file import sha256
from magtwin.files.outputs import check_free, output, transaction
from magtwin.io.surveys.about import About
from magtwin.io.surveys.columns import Columns
from magtwin.io.surveys.readings import (
    ALIGNED,
    TURNED,
    is_pattern,
    kept_direction,
    read_readings,
    save_readings,
)
from magtwin.report.report import Report

Method = Literal["auto", "trilinear", "cubic", "gp", "harmonic"]
Split = Literal["checkerboard", "heading", "run", "block"]
Source = str | os.PathLike[str]
Progress = Callable[..., None]

LAYERS = (".usdc", ".usd")
"""Suffixes of map layers."""

LEAST_READINGS = 8
"""Smallest number of good readings that a map can be fitted to."""

USUAL_READINGS = 100
"""Number of good readings below which the report doubts the map."""

MOST_MASKED = 0.9
"""Share of masked nodes above which the report doubts the map."""


def read_survey(
    sources: Sequence[Source], *, about: About | None = None, keep_stuck: bool = False, **reading: Any
) -> tuple[Readings, Report]:
    """Readings of a survey of any form, with stuck readings masked, and the report on them.

    Of values that a logger faster than the sensor repeated, one reading each is kept.

    Args:
        sources: As for `magtwin.io.surveys.readings.read_readings`.
        about: Metadata that the files lack.
        keep_stuck: Whether stuck and repeated readings stay in.
        reading: `columns`, `pose_topic` and `field_topic` of `read_readings`.

    Raises:
        InputError: A source cannot be read, or all of its readings are stuck.
    """
    known = {} if about is None else {**asdict(about), "name": None}  # errors name the file
    readings = read_readings(*sources, **reading, **known)
    if not keep_stuck:
        readings = without_repeats(readings)
    masked, report = mask_stuck(readings)
    if keep_stuck:
        report.metadata.pop("doubts", None)
    if taken := taken_of(readings):
        report = replace(report, metadata={**report.metadata, "taken": taken})
    if not (keep_stuck or masked.good.any()):
        raise InputError(
            f"{sources[0]}: all {len(readings)} readings come from a sensor that was stuck; survey again, or "
            "keep them with `keep_stuck=True`",
            parameter="keep_stuck",
        )
    return (readings if keep_stuck else masked), report


def import_survey(
    sources: Sequence[Source], out: Source, *, about: About | None = None, force: bool = False, **reading: Any
) -> Report:
    """Write a survey as a map layer, which it must be gridded for, or as readings.

    Args:
        sources: As for `read_survey`; a folder with one CSV per heading too.
        out: Map layer (.usdc) or readings (.parquet) to write.
        about: Metadata that the files lack.
        force: Whether an existing output is replaced.
        reading: Options of `read_survey`.

    Returns:
        A report on the field and on stuck readings.

    Raises:
        InputError: A source cannot be read, or the output cannot be written.
    """
    from magtwin.usd.maps.layer import save_map

    out, columns, about = check_free(out, force=force), reading.get("columns") or Columns(), about or About()
    name = about.name or out.stem
    table = out.suffix.lower() == ".parquet"
    if not table and len(sources) == 1 and _is_survey_folder(Path(sources[0]), columns):
        known = {**asdict(about), "name": name, "unit": columns.unit or "nT", "scale": columns.scale}
        field, report = read_folder(sources[0], **known, keep_stuck=reading.get("keep_stuck", False))
        save_map(field, out, force=force)
        return report
    readings, found = read_survey(sources, about=about, **reading)
    readings, found = readings.with_(name=name), _with_doubts(found, _contradictions(readings))
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
    earth: str | None = None,
    spacing_m: float | None = None,
    headings_rad: Sequence[float] | None = None,
    about: About | None = None,
    progress: Progress | None = None,
    force: bool = False,
    **reading: Any,
) -> Report:
    """Fit a model to a survey and write its map with variance.

    Args:
        sources: As for `import_survey`.
        out: Map layer to write (.usdc).
        method: One of `magtwin.field.fit.fit.METHODS`; "auto" is the best at readings left out.
        kernel: Covariance of the Gaussian process. None: poisson; for "auto", the better one.
        earth: The Earth's field for the harmonic fit, as for `magtwin.author.earth.earth_of`.
        spacing_m: Spacing of the map's nodes [m]. None: chosen by accuracy.
        headings_rad: Headings of the map [rad]. None: chosen by accuracy.
        about: Metadata that the files lack.
        progress: Called with the number done, the total, and a word.
        force: Whether an existing output is replaced.
        reading: Options of `read_survey`.

    Returns:
        A report on the map, its grid, stuck readings and doubts.

    Raises:
        InputError: A source cannot be read, has too few good readings, or the output cannot be written.
    """
    from magtwin.field.fit.choice import choice_report
    from magtwin.field.fit.fit import fit, grid_report, raster
    from magtwin.usd.maps.layer import save_map

    out, about = check_free(out, force=force), about or About()
    options = _method_options([method], kernel, earth).get(method, {})
    readings, report = read_survey(sources, about=about, **reading)
    doubts = [*_doubts(readings, sources[0]), *_shared(readings, method)]
    model = fit(readings, method, progress=progress, **options)
    named = readings.with_(name=about.name or out.stem)
    field = raster(model, named, spacing_m=spacing_m, headings_rad=headings_rad, progress=progress)
    save_map(field, out, force=force)
    report = _with_doubts(report, [*doubts, *_masked(field)])
    return _joined(field.report(), choice_report(field.parameters), grid_report(field), report)


def validate_methods(
    sources: Sequence[Source],
    *,
    methods: Sequence[str] | None = None,
    split: Split | None = None,
    kernel: Literal["matern", "poisson"] | None = None,
    earth: str | None = None,
    within_m: float | None = None,
    progress: Progress | None = None,
    **reading: Any,
) -> Report:
    """Predict left-out readings of a survey with each method, and report the errors.

    Args:
        sources: As for `import_survey`.
        methods: Methods to validate. None: all but "auto".
        split: What is left out. None: nodes of a gridded survey, runs if there are several, else blocks.
        kernel: Covariance of the Gaussian process. None: poisson.
        earth: The Earth's field for the harmonic fit, as for `magtwin.author.earth.earth_of`.
        within_m: Count only readings this near to one that was fitted [m].
        progress: Called with the number done, the total, and a word.
        reading: Options of `read_survey`.

    Raises:
        InputError: A source cannot be read, or an option belongs to a method that is not validated.
    """
    from magtwin.field.fit.check import FILLED, check
    from magtwin.field.fit.fit import METHODS

    chosen = list(methods or (name for name in METHODS if name != "auto"))
    options = {**FILLED, **_method_options(chosen, kernel, earth)}
    readings, _ = read_survey(sources, **reading)
    if split is None:
        split = "checkerboard" if readings.grid is not None else "run" if len(readings.runs) > 1 else "block"
    return check(readings, chosen, split=split, within_m=within_m, options=options, progress=progress)


def survey_scene(
    scene_file: Source,
    out: Source,
    *,
    lab: str = "",
    adopt: bool = False,
    spacing_m: float = 0.25,
    headings_rad: Sequence[float],
    readings: int = 135,
    height_m: float | None = None,
    heading_error_deg: float = 2.0,
    position_error_m: float = 0.01,
    seed: int = 0,
    name: str | None = None,
    licence: str = "",
    created: str | None = None,
    jobs: int | None = None,
    progress: Progress | None = None,
    force: bool = False,
) -> Report:
    """Survey a scene as its robot would: node by node, with sensor noise and pose errors.

    Args:
        scene_file: USD stage with a known Earth field.
        lab: As for `magtwin.open_twin`.
        adopt: Whether the stage reads this map from now on, in place of its old one.
        out: Map layer (.usdc) or readings (.parquet) to write.
        spacing_m: Spacing of the nodes [m].
        headings_rad: Headings at each node [rad], ascending.
        readings: Readings averaged at a node.
        height_m: Height of the sensor above the floor [m]. None: the robot's.
        heading_error_deg: Standard deviation of the robot's heading about the node's [deg].
        position_error_m: Standard deviation of the robot's x and y about the node [m].
        seed: Seed of noise and errors.
        name: Name of the map. None: that of `out`.
        licence: Licence of the map, an SPDX identifier.
        created: Date of the survey, YYYY-MM-DD. None: that of the Earth's field.
        jobs: Processes that share the headings; they do not change the output. None: this process, with
            several threads.
        progress: Called with the number of headings done and their total.
        force: Whether an existing output is replaced.

    Raises:
        InputError: The scene has no Earth field, a number is out of range, or the output cannot be written.
    """
    from magtwin.sim.survey import blocked_by, survey, survey_readings
    from magtwin.usd.layers import check_not_part, layer_files
    from magtwin.usd.maps.layer import save_map
    from magtwin.usd.scene import open_scene, use_map

    out = check_free(out, force=force)
    if seed < 0:
        raise InputError(f"`seed` must be a whole number from 0 up, got {seed}", parameter="seed")
    if not 0 <= heading_error_deg <= 90:
        raise InputError(f"heading_error_deg must be from 0 to 90 deg, got {heading_error_deg!r}")
    if adopt and out.suffix.lower() == ".parquet":
        raise InputError(f"{out}: a scene reads a map layer (.usdc), not readings", parameter="adopt")
    opened = open_scene(scene_file, lab=lab, check_network=False)
    if adopt:
        use_map(opened, out, dry=True)  # refuses before the survey
    else:
        check_not_part(opened.stage, out)
    twin = opened.scene
    day = twin.earth.date if twin.earth is not None else ""
    files = [file for file in layer_files(scene_file) if file.resolve() != twin.map_layer.resolve()]
    options: dict[str, Any] = {
        "rng": np.random.default_rng(seed),
        "spacing_m": spacing_m,
        "headings_rad": headings_rad,
        "readings": readings,
        "height_m": height_m,
        "heading_error_rad": radians(heading_error_deg),
        "position_error_m": position_error_m,
        "source": "; ".join(f"{file.name} sha256:{sha256(file)}" for file in files),
        "licence": licence,
        "created": day if created is None else created,
        "progress": progress or (lambda done, total, what: None),
        "blocked": blocked_by(twin, opened.obstacles),
        "jobs": jobs,
    }
    if out.suffix.lower() == ".parquet":
        surveyed = replace(survey_readings(twin, **options), name=name or out.stem)
        save_readings(surveyed, out, force=force)
        return surveyed.report()
    field = survey(twin, **options, name=name or out.stem)
    field = replace(field, parameters={**field.parameters, "seed": seed})
    with transaction(), output(out, force=force) as aside:
        save_map(field, aside)
        if adopt:
            use_map(opened, out, written=aside)
    return field.report()


def _is_survey_folder(source: Path, columns: Columns) -> bool:
    """Whether a source is a folder with one CSV per heading, whose columns need no names."""
    if (source / "metadata.yaml").is_file() or is_pattern(source) or any(source.glob("*.parquet")):
        return False
    named = replace(columns, unit=None, scale=None) != Columns()
    return (source.is_dir() or not source.exists()) and not named


def _doubts(readings: Readings, source: Source) -> list[str]:
    """What makes a map of these readings doubtful; too few readings are refused."""
    from magtwin.field.fit.harmonic.problem import ONE_HEADING

    count, yaw, doubts = int(readings.good.sum()), readings.yaw[readings.good], list[str]()
    if readings.grid is None and count < LEAST_READINGS:
        raise InputError(
            f"{source}: {count} of {len(readings)} readings are good{masked_words(readings)}; a map needs "
            f"{LEAST_READINGS} at least, and some hundred to be of use"
        )
    if readings.grid is None and count < USUAL_READINGS:
        doubts.append(f"only {count} good readings: the map is valid only next to them")
    if line := changes_line(readings):
        doubts.append(line)
    doubts += _contradictions(readings)
    mean = np.exp(1j * yaw).mean()
    if np.abs(mean) >= ONE_HEADING:
        doubts.append(
            f"one heading only, {np.degrees(np.angle(mean)):.0f} deg: unless the sensor was carried by hand, "
            "the robot's own field cannot be separated from the room's, and a simulated robot adds its own "
            "again; survey in several headings"
        )
    return doubts


def _contradictions(readings: Readings) -> list[str]:
    """What a survey's headings contradict: its vectors, and the names of its files."""
    doubts, good = heading_doubts(readings), readings.good
    if readings.b_body_nt is not None and np.count_nonzero(good) >= LEAST_READINGS:
        spin = np.exp(1j * readings.yaw[good])
        kept = kept_direction(readings.b_body_nt[good, :2] @ np.array([1, 1j]) * spin)
        if kept < ALIGNED and np.abs(spin.mean()) <= TURNED:
            doubts.append(
                f"vectors keep no direction in world axes ({100 * kept:.0f} %): headings and vectors "
                "contradict each other, or the robot's own field is as strong as the Earth's"
            )
    return doubts


def _masked(field: AnomalyMap) -> list[str]:
    """The doubt about a map that has hardly a node."""
    count, size = int(np.count_nonzero(~field.valid)), field.valid.size
    if count <= MOST_MASKED * size:
        return []
    return [
        f"{count:,} of {size:,} nodes are masked: they are far from the readings, or the fit's standard "
        "deviation there is over half that of the readings; check headings and vectors, or take another "
        "--method"
    ]


def _with_doubts(report: Report, doubts: list[str]) -> Report:
    doubts = [*report.metadata.get("doubts", []), *doubts]
    return replace(report, metadata={**report.metadata, "doubts": doubts}) if doubts else report


def _shared(readings: Readings, method: str) -> list[str]:
    """What a fit takes for granted about the runs of a survey, and what its intervals leave out."""
    from magtwin.field.fit.fit import offset_sd_nt
    from magtwin.field.fit.passes import by_pass

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
    if offset := offset_sd_nt(readings):
        doubts.append(
            "one drive: what its robot adds alike throughout (motors, battery, LiDAR) cannot be told from "
            f"the room's field; the standard deviations hold {offset:g} nT for it (offset sd), which "
            "localization takes for an unknown bias; survey at rest, node by node, for a smaller one"
        )
    elif readings.t is not None:
        doubts.append(
            "readings of drives: the standard deviations do not hold what the robot adds alike in all runs "
            "(motors, battery, LiDAR); survey at rest, node by node, for intervals that hold"
        )
    return doubts


def _method_options(
    methods: Sequence[str], kernel: str | None, earth: str | None
) -> dict[str, dict[str, Any]]:
    """Options by method; an option of a method that is not used is refused."""
    from magtwin.author.earth import earth_of

    for name, value, method in (("kernel", kernel, "gp"), ("earth", earth, "harmonic")):
        if value is not None and not {method, "auto"} & set(methods):
            raise InputError(f"`{name}` is for `method={method}`; drop it for {methods[0]}", parameter=name)
    options: dict[str, dict[str, Any]] = {"auto": {}}
    if kernel is not None:
        options["gp"] = options["auto"] = {"kernel": kernel}
    if earth is not None:
        try:
            options["harmonic"] = {"earth_nt": earth_of(earth)}
        except InputError as error:
            raise InputError(str(error), parameter="earth") from error
        options["auto"] = {**options["auto"], **options["harmonic"]}
    return options


def _joined(report: Report, *below: Report) -> Report:
    """A report with the figures and metadata of others below its own."""
    for other in below:
        figures, metadata = report.figures + other.figures, {**report.metadata, **other.metadata}
        report = replace(report, figures=figures, metadata=metadata)
    return report
