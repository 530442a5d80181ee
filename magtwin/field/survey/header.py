"""Comment lines above the rows of a survey's CSV: a map's metadata.

A line is `# KEY: VALUE` with a JSON value. Other programs skip it as a comment. The first line stays `#
x,y,theta,scalar_mag`.
"""

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from magtwin.errors import InputError
from magtwin.field.days import check_day
from magtwin.field.maps.map import TEXTS, AnomalyMap
from magtwin.field.maps.statistics import statistics

# Fields of a map that an import restores. Its source becomes the imported files.
KEPT = (*(name for name in TEXTS if name != "source"), "height_m", "parameters")
# Keys: rows of a file that are not field, counted from 0; median standard deviation of its values [nT]
MASKED, ERROR = "masked_rows", "median_error_nt"

_LINE = re.compile(r"#\s*(\w+):\s*(.*?)\s*$")
_QUOTED = 60  # Characters of a line that an error quotes


def header_lines(field: AnomalyMap, heading: int) -> list[str]:
    """Comment lines for the file of one heading, by its index: metadata, statistics and masked rows.

    Raises:
        InputError: A parameter of the map cannot be written as JSON.
    """
    figures = {name: value for name, value in statistics(field, heading).items() if math.isfinite(value)}
    named = {name: getattr(field, name) for name in (*KEPT, "source")}
    metadata: dict[str, Any] = {name: value for name, value in named.items() if value not in ("", None)}
    metadata["parameters"] = dict(field.parameters)
    metadata |= {"units": ["m", "m", "rad", "nT"], "spacing_m": list(field.cell_m), **figures}
    metadata[MASKED] = np.flatnonzero(~field.valid[heading].ravel()).tolist()
    metadata = {name: value for name, value in metadata.items() if value not in ({}, [])}
    try:
        return [f"# {name}: {json.dumps(value, allow_nan=False)}" for name, value in metadata.items()]
    except (TypeError, ValueError) as error:
        raise InputError(
            f"parameters of map {field.name!r} must be finite numbers, texts and lists of them ({error})"
        ) from error


def read_header(path: Path, lines: list[tuple[int, str]]) -> dict[str, Any]:
    """Read the comment lines (number, text) that an import restores; others are ignored.

    Raises:
        InputError: A value is not JSON, has the wrong type, or its key occurs twice; with file and line.
    """
    metadata: dict[str, Any] = {}
    for number, line in lines:
        match = _LINE.match(line)
        if match is None or match[1] not in (*KEPT, MASKED, ERROR):
            continue
        key, text = match.groups()
        if key in metadata:
            raise InputError(f"{path}:{number}: {key} is given a second time; remove one of the two lines")
        try:
            metadata[key] = json.loads(text, parse_constant=_no_number)
        except (ValueError, RecursionError) as error:
            if key not in TEXTS:
                raise InputError(
                    f"{path}:{number}: {key} must be JSON, got {text[:_QUOTED]!r} ({error})"
                ) from error
            metadata[key] = text  # written by hand, without quotes
        if not _fits(key, metadata[key]):
            raise InputError(
                f"{path}:{number}: {key} cannot be {text[:_QUOTED]!r}; correct or remove the line"
            )
        if key == "created":
            check_day(metadata[key], f"{path}:{number}: created")
    return metadata


def _fits(key: str, value: Any) -> bool:
    if key in TEXTS:
        return isinstance(value, str)
    if key == "parameters":
        return isinstance(value, dict)
    if key == MASKED:
        whole = isinstance(value, list) and all(isinstance(v, int) and not isinstance(v, bool) for v in value)
        return whole and min(value, default=0) >= 0
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and 0 <= value < math.inf


def _no_number(word: str) -> float:
    raise ValueError(f"{word} is not a JSON number")
