"""Settings: YAML files beside a description, read as plain data of limited size."""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import yaml

from magtwin.errors import InputError
from magtwin.files.budget import BUDGETS
from magtwin.files.file import read_text
from magtwin.files.settings import yaml_loader

ENTRIES = BUDGETS["YAML"].count
"""Most tables of a file."""

VALUES = 100 * ENTRIES
"""Most values of all tables, each with those of the tables below it."""


def read_settings(path: Path) -> Iterator[dict[str, Any]]:
    """Every table of a YAML file, at any depth, with the tables below it flattened to dotted keys.

    Raises:
        InputError: The file is too big or is not YAML.
    """
    text = read_text(path, "settings file", "YAML")
    try:
        pending = [yaml.load(text, yaml_loader())]
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # an impossible date is a ValueError
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark is not None else ""
        said = str(error).partition(";")[0].partition("\n")[0]
        reason = getattr(error, "problem", None) or said or "cannot be read"
        raise InputError(f"{path}{line}: not YAML: {reason}") from error
    left = VALUES
    for _ in range(ENTRIES):  # aliases of aliases could go on without end
        if not pending:
            return
        node = pending.pop()
        if isinstance(node, dict):
            table = dict(islice(_dotted(node, "", 0), left + 1))
            left -= len(table)
            if left < 0:
                raise InputError(f"{path}: has over {VALUES:,} values, with those of its aliases")
            pending += node.values()
            yield table


def _dotted(table: dict[Any, Any], prefix: str, depth: int) -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, dict) and depth < 3:
            yield from _dotted(value, f"{prefix}{key}.", depth + 1)
        else:
            yield f"{prefix}{key}", value
