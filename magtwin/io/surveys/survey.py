"""Surveys for scripts: readings of any source, with stuck readings masked."""

import warnings
from typing import Any

from magtwin.field.survey.readings import Readings
from magtwin.field.units import Unit
from magtwin.io.surveys.columns import Columns
from magtwin.io.surveys.maps import Source
from magtwin.io.surveys.maps import read_survey as read_with_report


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
        **options: Further options of `magtwin.io.surveys.maps.read_survey`.

    Raises:
        InputError: A source is missing or cannot be read, or all of its readings are stuck.
    """
    chosen = columns or (Columns(unit=unit, scale=scale) if unit or scale else None)
    readings, _ = read_with_report(list(sources), columns=chosen, **options)
    masked = len(readings) - int(readings.good.sum())
    if masked:
        text = f"{masked} of {len(readings)} readings are masked as stuck (keep_stuck=True keeps them)"
        warnings.warn(f"{sources[0]}: {text}", stacklevel=2)
    return readings
