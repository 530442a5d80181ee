"""JSON lines: an object a line, whose keys are the columns of a table."""

import json
import re
from pathlib import Path
from typing import Any

from magtwin.errors import InputError
from magtwin.tables.delimited import QUOTED

MOST_KEYS = 1_000  # Most columns


def is_json_lines(content: bytes) -> bool:
    """Whether the first line of a text is an object of JSON."""
    line = content.lstrip(b"\xef\xbb\xbf \t\r\n").partition(b"\n")[0].strip()
    return re.match(rb'\{\s*"', line) is not None and line.endswith(b"}")


def rows_of_json(path: Path, content: bytes) -> tuple[dict[str, list[str]], list[int]]:
    """The columns of the objects, with empty cells where one has no such key, and the line of each.

    Keys of an object within an object follow its own, with a point between; parts of a list have numbers.
    """
    rows, lines = list[dict[str, str]](), list[int]()
    text = content.decode("utf-8-sig", "replace").rstrip("\n").split("\n")
    for number, line in enumerate(text, 1):
        try:
            value = json.loads(line) if line.strip() else None
        except (ValueError, RecursionError):
            if number == len(text) and rows:
                break  # the last line was cut short
            raise InputError(f"{path}:{number}: no object of JSON: {line[:QUOTED]!r}") from None
        if isinstance(value, dict):
            rows.append(dict(_flat("", value)))
            lines.append(number)
    names = list(dict.fromkeys(name for row in rows for name in row))
    if len(names) > MOST_KEYS:
        raise InputError(f"{path}: {len(names)} different keys; a table has {MOST_KEYS} columns at most")
    return {name: [row.get(name, "") for row in rows] for name in names}, lines


def _flat(name: str, value: Any) -> list[tuple[str, str]]:
    """Names and texts of the values in a value of JSON."""
    if isinstance(value, dict | list):
        parts = value.items() if isinstance(value, dict) else enumerate(value, 1)
        return [pair for key, part in parts for pair in _flat(f"{name}.{key}" if name else str(key), part)]
    return [(name, "" if value is None else str(value))]
