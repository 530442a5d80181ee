"""Receipt: what results were made of and by, in short, so that others can check them."""

import hashlib
import importlib.util
import json
import os
import platform
import random
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from magtwin.bench import sealed
from magtwin.bench.store import KEY, ROWS, Columns, write_file
from magtwin.bench.suite import Suite
from magtwin.errors import InputError
from magtwin.files.file import read_text
from magtwin.version import __version__

RECEIPT = "receipt.json"
FORMAT = 1
"""Version of a receipt."""

_NAMES = ("numpy", "scipy", "numba", "pyarrow")
"""Packages on which rows may depend."""


def write_receipt(folder: Path, about: Mapping[str, Any], suite: Suite, rows: Columns) -> None:
    """Write the receipt of results: checksums of code, suite and rows, the environment, and who was sealed.

    Args:
        folder: Folder of results.
        about: Content of its suite.json.
        suite: The suite.
        rows: All rows.
    """
    names = sorted(set(rows["localizer"].tolist()))
    methods = {name: suite.localizers[name].method if name in suite.localizers else name for name in names}
    made = {
        "format": FORMAT,
        "suite": {name: about[name] for name in ("name", "version", "sha256", "seeds", "data")},
        "code": {"magtwin": folder_sha256(Path(__file__).parents[1], "*.py")}
        | {method: _code_of(method) for method in methods.values() if sealed.foreign(method)},
        "environment": {"magtwin": __version__, "python": platform.python_version()}
        | {name: metadata.version(name) for name in _NAMES}
        | {"system": platform.system(), "machine": platform.machine()},
        "localizers": {name: _sealed(method) for name, method in methods.items()},
        "rows": {"count": len(rows["run"]), "sha256": rows_sha256(rows)},
    }
    write_file(folder / RECEIPT, (json.dumps(made, indent=2) + "\n").encode())


def read_receipt(file: str | os.PathLike[str]) -> dict[str, Any]:
    """The content of a receipt.

    Raises:
        InputError: It is no receipt, or one of another version.
    """
    path = Path(file) / RECEIPT if Path(file).is_dir() else Path(file)
    try:
        made = json.loads(read_text(path, "receipt", "JSON"))
        form = made["format"] if isinstance(made, dict) else None
        known = isinstance(made["rows"]["sha256"], str) and isinstance(made["suite"]["sha256"], str)
    except (ValueError, KeyError, TypeError, RecursionError):
        raise InputError(f"{path}: no receipt of magtwin bench; give RESULTS/{RECEIPT}") from None
    if form != FORMAT or not known:
        text = f"a receipt of version {form!r}, and this magtwin reads {FORMAT}; verify it with the magtwin"
        said = str(made.get("environment", {}).get("magtwin", ""))[:20]
        raise InputError(f"{path}: {text} that made it ({said or 'unknown'})")
    return dict(made)


def rows_sha256(rows: Columns) -> str:
    """SHA-256 of all values of rows, in their order."""
    sum_ = hashlib.sha256()
    for name in sorted(rows):
        values = rows[name]
        plain = values.tolist() if values.dtype == object else None
        sum_.update(name.encode() + b"\0" + (json.dumps(plain).encode() if plain else values.tobytes()))
    return sum_.hexdigest()


def sample(rows: Columns, count: int, seed: str) -> list[tuple[str, int, tuple[str, ...]]]:
    """Scenarios and runs that are drawn from rows, with their localizers.

    Args:
        rows: Rows of results.
        count: Number of runs.
        seed: What the draw depends on.
    """
    found: dict[tuple[str, int], list[str]] = {}
    for scenario, name, run in zip(*(rows[column].tolist() for column in KEY), strict=True):
        found.setdefault((scenario, run), []).append(name)
    drawn = random.Random(seed).sample(sorted(found), min(count, len(found)))
    return [(*key, tuple(found[key])) for key in sorted(drawn)]


def differences(rows: Columns, made: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[str]:
    """Runs whose rows are not those that were made again: which, and the first column that differs."""
    keys = zip(*(rows[column].tolist() for column in KEY), strict=True)
    at = {key: k for k, key in enumerate(keys)}
    said = []
    for row in made[ROWS]:
        k = at[tuple(row[column] for column in KEY)]  # type: ignore[index]
        for name, value in row.items():
            there = rows[name][k] if name in rows else value
            if not (value == there or (value != value and there != there)):
                where = f"{row['scenario']}, {row['localizer']}, run {row['run']}"
                said.append(f"{where}: {name} is {there}, and again {value}")
                break
    return said


def _sealed(method: str) -> str:
    if not sealed.foreign(method):
        return "of magtwin"
    return "sealed" if sealed.seals(method) else "not sealed"


def _code_of(method: str) -> str:
    """SHA-256 of the module or package of a localizer, which is not imported; "" where it is not found."""
    try:
        spec = importlib.util.find_spec(method.partition(":")[0].partition(".")[0])
    except (ImportError, ValueError):
        return ""
    if spec is None or not spec.origin or not Path(spec.origin).is_file():
        return ""
    if spec.submodule_search_locations:
        return folder_sha256(Path(spec.origin).parent, "*.py")
    return hashlib.sha256(Path(spec.origin).read_bytes()).hexdigest()


def folder_sha256(folder: Path, pattern: str = "*") -> str:
    """SHA-256 of the files of a folder that match `pattern`, and their names; hidden files do not count."""
    sum_ = hashlib.sha256()
    for file in sorted(folder.rglob(pattern)):
        inside = file.relative_to(folder)
        if file.is_file() and not any(part.startswith(".") for part in inside.parts):
            with open(file, "rb") as content:
                sum_.update(
                    f"{inside.as_posix()} {hashlib.file_digest(content, 'sha256').hexdigest()}\n".encode()
                )
    return sum_.hexdigest()
