"""Surveys: readings of any source, with stuck readings masked."""

import warnings
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

from magtwin.errors import InputError
from magtwin.field.survey.hold import without_repeats
from magtwin.field.survey.readings import Readings, taken_of
from magtwin.field.survey.stuck import mask_stuck
from magtwin.field.units import Unit
from magtwin.io.surveys.columns import About, Columns
from magtwin.io.surveys.readings import Source, read_readings
from magtwin.report.report import Report


def read_survey(
    *sources: Source,
    unit: Unit | None = None,
    scale: float | None = None,
    columns: Columns | None = None,
    **options: Any,
) -> Readings:
    """Read a survey: readings of the field at known poses.

    Readings of a stuck sensor are masked, with a warning that gives their number.

    Args:
        *sources: A CSV or Parquet table, a folder with one CSV per heading, a bag, or any file of a run.
            Several sources are several runs of one survey.
        unit: Unit of the field, such as "uT". Default: found from the size of the values.
        scale: Factor from values to nT, instead of a unit.
        columns: Names of the columns. Default: found from their names.
        **options: Further options of `survey_and_report`.

    Raises:
        InputError: A source is missing or cannot be read, or all of its readings are stuck.
    """
    chosen = columns or (Columns(unit=unit, scale=scale) if unit or scale else None)
    readings, _ = survey_and_report(list(sources), columns=chosen, **options)
    masked = len(readings) - int(readings.good.sum())
    if masked:
        text = f"{masked} of {len(readings)} readings are masked as stuck (keep_stuck=True keeps them)"
        warnings.warn(f"{sources[0]}: {text}", stacklevel=2)
    return readings


def survey_and_report(
    sources: Sequence[Source], *, about: About | None = None, keep_stuck: bool = False, **reading: Any
) -> tuple[Readings, Report]:
    """Readings of a survey of any form, with stuck readings masked, and the report on them.

    Of values that a logger faster than the sensor repeated, one reading each is kept. `reading` are
    `columns`, `pose_topic` and `field_topic` of `read_readings`, `about` metadata that the files lack.
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
        text = f"all {len(readings)} readings come from a sensor that was stuck"
        advice = "survey again, or keep them with `keep_stuck=True`"
        raise InputError(f"{sources[0]}: {text}; {advice}", parameter="keep_stuck")
    return (readings if keep_stuck else masked), report
