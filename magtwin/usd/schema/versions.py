"""Version of the schema that a layer was written with, and names that the schema does not have.

A layer that magtwin writes has its version in customLayerData, as `magtwinSchemaVersion`.
"""

import difflib
import re
import warnings
from pathlib import Path
from typing import Any

from pxr import Sdf, Usd

from magtwin.errors import InputError, MismatchWarning
from magtwin.usd.schema import declarations
from magtwin.usd.schema.names import BESIDE, VERSION

KEY = "magtwinSchemaVersion"
TEXT = ".".join(map(str, VERSION))

_checked: set[tuple[str, int]] = set()
"""Files whose names were checked, with the time of their last change [ns]: a stage is opened often."""


def creator() -> dict[str, Any]:
    """What a layer that magtwin writes has as customLayerData."""
    return {"creator": "magtwin", KEY: TEXT}


def version_of(layer: Sdf.Layer) -> tuple[int, int] | None:
    """Version that a layer was written with; None if it does not tell.

    Raises:
        InputError: It is not a version, or its first number is above that of this magtwin.
    """
    text, where = layer.customLayerData.get(KEY), layer.realPath or layer.identifier
    if text is None:
        return None
    version = re.fullmatch(r"([0-9]{1,9})\.([0-9]{1,9})", str(text))
    if version is None:
        wanted = f"must be a version such as {TEXT!r}, got {text!r}"
        raise InputError(f"{where}: customLayerData {KEY} {wanted}")
    first, second = map(int, version.groups())
    if first > VERSION[0]:
        said = f"is of schema {text}, this magtwin knows {TEXT}; read it with a later magtwin"
        raise InputError(f"{where}: {said}")
    return first, second


def unknown_properties(layer: Sdf.Layer) -> list[Sdf.Path]:
    """Properties of magtwin with a value that the schema does not define, so that nothing reads them."""
    found: list[Sdf.Path] = []

    def look(path: Sdf.Path) -> None:
        ours, *words = path.name.split(":") if path.IsPropertyPath() else ("",)
        if ours == "magtwin" and words and words[0] not in BESIDE and path.name not in declarations():
            spec = layer.GetPropertyAtPath(path)
            if not isinstance(spec, Sdf.AttributeSpec) or spec.default is not None:  # a reading has samples
                found.append(path)

    layer.Traverse(Sdf.Path.absoluteRootPath, look)
    return found


def check_schema(stage: Usd.Stage, name: str) -> None:
    """Check the layers of a stage, which warnings call `name`; each file is warned of once.

    Raises:
        InputError: As for `version_of`.
    """
    for layer in stage.GetUsedLayers(includeClipLayers=False):
        file = Path(layer.realPath)
        if not layer.realPath:
            continue
        version, said = version_of(layer), ""
        key = layer.realPath, file.stat().st_mtime_ns if file.is_file() else 0  # 0: in a package
        if key in _checked:
            continue
        _checked.add(key)
        if version is not None and version > VERSION:
            said = f"is of a schema later than {TEXT}; what this magtwin does not know is ignored"
        elif unknown := unknown_properties(layer):
            said = _ignored(unknown)
        if said:
            where = name if file.name == Path(name).name else f"{name}: {file.name}"
            warnings.warn(f"{where}: {said}", MismatchWarning, stacklevel=3)


def _ignored(unknown: list[Sdf.Path]) -> str:
    """What is wrong with names that the schema does not define: the first one, and their number."""
    first = unknown[0]
    longer = [name for name in declarations() if name.startswith(first.name)]  # with the unit
    near = longer or difflib.get_close_matches(first.name, declarations(), n=1, cutoff=0.8)
    hint = f"did you mean {near[0]}?" if near else "docs/schema.md has the names"
    more = f" and {len(unknown) - 1} more such names" if len(unknown) > 1 else ""
    return f"<{first.GetPrimPath()}> has {first.name}{more}, not in the schema and ignored; {hint}"
