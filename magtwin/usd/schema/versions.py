"""Version of the schema that a layer was written with; names of an older version are replaced in memory.

A layer that magtwin writes has its version in customLayerData, as `magtwinSchemaVersion`. Any layer, also an
edit made by hand, is older if it has a name that only an older version had.
"""

import re
import warnings
from pathlib import Path
from typing import Any

from pxr import Sdf, Usd

from magtwin.errors import InputError, MismatchWarning
from magtwin.usd.schema import declarations
from magtwin.usd.schema.names import OLDER, REMOVED, RENAMED, VERSION

KEY = "magtwinSchemaVersion"
TEXT = ".".join(map(str, VERSION))

_upgraded: dict[str, int] = {}
"""Layers whose names were replaced in memory, by identifier: when their file was last changed [ns]."""

_warned: set[tuple[str, int]] = set()
"""Files that a warning has named, with the time of their last change [ns]: a stage is opened often."""


def creator() -> dict[str, Any]:
    """What a layer that magtwin writes has as customLayerData."""
    return {"creator": "magtwin", KEY: TEXT}


def stamp(layer: Sdf.Layer) -> None:
    """Author this version in a layer, beside its other data."""
    layer.customLayerData = {**layer.customLayerData, KEY: TEXT}


def version_of(layer: Sdf.Layer) -> tuple[int, int] | None:
    """Version that a layer was written with; None if it does not tell.

    Raises:
        InputError: It is not a version, or its first number is above that of this magtwin.
    """
    text = layer.customLayerData.get(KEY)
    if text is None:
        return None
    version = re.fullmatch(r"([0-9]{1,9})\.([0-9]{1,9})", str(text))
    if version is None:
        raise InputError(
            f"{layer.realPath or layer.identifier}: customLayerData {KEY} must be a version such as "
            f"{TEXT!r}, got {text!r}"
        )
    first, second = map(int, version.groups())
    if first > VERSION[0]:
        raise InputError(
            f"{layer.realPath or layer.identifier}: is of schema {text}, this magtwin knows {TEXT}; read it "
            "with a later magtwin"
        )
    return first, second


def older_properties(layer: Sdf.Layer) -> list[Sdf.Path]:
    """Properties with a name that only an older version has."""
    found: list[Sdf.Path] = []

    def look(path: Sdf.Path) -> None:
        if path.IsPropertyPath() and (path.name in RENAMED or path.name in REMOVED):
            found.append(path)

    layer.Traverse(Sdf.Path.absoluteRootPath, look)
    return found


def upgrade_layer(layer: Sdf.Layer) -> int:
    """Replace a layer's older names, make its attributes uniform and author the version; not saved.

    Returns:
        Number of properties that were renamed or removed. 0 leaves the layer as it is.

    Raises:
        InputError: A prim has an attribute under both names, or a value that this version cannot express; or
            as for `version_of`. The layer is not changed.
    """
    version_of(layer)
    older = older_properties(layer)
    for path in older:
        spec, name = layer.GetPropertyAtPath(path), RENAMED.get(path.name)
        where = f"{layer.realPath or layer.identifier} <{path.GetPrimPath()}>"
        if name is None and spec.default not in (None, REMOVED[path.name]):
            raise InputError(
                f"{where}: {path.name} is {spec.default!r}, magtwin reads {REMOVED[path.name]}; make it anew"
            )
        if name and layer.GetPropertyAtPath(path.ReplaceName(name)):
            raise InputError(f"{where}: has {path.name} and its later name {name}; remove one of them")
    if older:
        with Sdf.ChangeBlock():
            _rename(layer, older)
        stamp(layer)
    return len(older)


def _rename(layer: Sdf.Layer, older: list[Sdf.Path]) -> None:
    for path in older:
        spec = layer.GetPropertyAtPath(path)
        if path.name in RENAMED:
            spec.name = RENAMED[path.name]
        else:
            spec.owner.RemoveProperty(spec)

    def settle(path: Sdf.Path) -> None:
        if path.IsPropertyPath() and path.name in declarations():
            layer.GetPropertyAtPath(path).SetInfo("variability", Sdf.VariabilityUniform)

    layer.Traverse(Sdf.Path.absoluteRootPath, settle)


def is_upgraded(layer: Sdf.Layer) -> bool:
    """Whether a layer's unsaved changes are, first of all, newer names, and its file is as it was."""
    return layer.dirty and _upgraded.get(layer.identifier) == _changed(layer)


def upgrade_stage(stage: Usd.Stage, name: str) -> None:
    """Replace older names in the layers of a stage, in memory, with one warning.

    Args:
        stage: The stage.
        name: What the warning calls it, and the command that it names.

    Raises:
        InputError: As for `upgrade_layer`.
    """
    changed, later = [], []
    for layer in stage.GetUsedLayers(includeClipLayers=False):
        if not layer.realPath:
            continue
        version = version_of(layer)
        if upgrade_layer(layer):
            changed.append(layer)
            _upgraded[layer.identifier] = _changed(layer)
        elif version is not None and version > VERSION:
            later.append(layer)
    if fresh := _not_named(changed):
        warnings.warn(
            f"{name}: {_counted(fresh, 'has', 'have')} attributes of schema {OLDER}, read as those of {TEXT};"
            f" `magtwin upgrade {name}` rewrites the files",
            MismatchWarning,
            stacklevel=3,
        )
    if fresh := _not_named(later):
        warnings.warn(
            f"{name}: {_counted(fresh, 'is', 'are')} of a schema later than {TEXT}; attributes that "
            "this magtwin does not know are ignored",
            MismatchWarning,
            stacklevel=3,
        )


def _not_named(layers: list[Sdf.Layer]) -> list[Sdf.Layer]:
    """The layers that no warning has named yet, and from now on has."""
    keys = {(layer.realPath, _changed(layer)): layer for layer in layers}
    fresh = [layer for key, layer in keys.items() if key not in _warned]
    _warned.update(keys)
    return fresh


def _counted(layers: list[Sdf.Layer], one: str, several: str) -> str:
    first = Path(layers[0].realPath).name
    return f"{first} {one}" if len(layers) == 1 else f"{first} and {len(layers) - 1} more layers {several}"


def _changed(layer: Sdf.Layer) -> int:
    """When a layer's file was last changed [ns]; 0 for one in a package."""
    file = Path(layer.realPath)
    return file.stat().st_mtime_ns if file.is_file() else 0
