"""Rewrite the files of a stage that an older magtwin wrote."""

import os
from contextlib import ExitStack
from pathlib import Path
from shlex import quote

from pxr import Sdf, Tf, UsdUtils

from magtwin.errors import InputError
from magtwin.kinds import expected
from magtwin.outputs import output, transaction
from magtwin.usd.layers import check_stage, export_like, layer_sha256
from magtwin.usd.schema.versions import stamp, upgrade_layer
from magtwin.usd.sensors import MAP_CHECKSUM
from magtwin.usd.trial import check_named


def upgrade(path: str | os.PathLike[str]) -> list[Path]:
    """Give a stage's files the names of this version of the schema.

    Every layer that the stage names, in any variant or payload, is rewritten in its place if it has older
    names. Magnetometers that name a rewritten map by its checksum get the new one. Values stay as they are.

    Args:
        path: Root layer of a stage, a robot or a map.

    Returns:
        The files that were rewritten.

    Raises:
        InputError: The file is missing, a package or not USD, a layer cannot be written or upgraded, or is of
            a later version. Nothing is written unless every layer can be upgraded.
    """
    path = expected(path, "USD file")
    if path.suffix.lower() == ".usdz":
        raise InputError(
            f"{path}: files inside a package cannot be rewritten; `magtwin export {quote(str(path))} "
            "--out DIR` unpacks and upgrades it"
        )
    check_stage(path)
    diagnostics = UsdUtils.CoalescingDiagnosticDelegate()  # keeps USD's warnings off the terminal
    try:
        layers = [layer for layer in UsdUtils.ComputeAllDependencies(str(path))[0] if layer.realPath]
    except Tf.ErrorException as error:
        raise InputError(f"{path}: cannot be opened as USD") from error
    finally:
        diagnostics.TakeUncoalescedDiagnostics()
    if not layers:
        raise InputError(f"{path}: cannot be opened as USD")
    found = [check_named(path, Path(layer.realPath)) for layer in layers]
    files = {file: layer_sha256(file) for file in found}
    copies = {file: Sdf.Layer.OpenAsAnonymous(str(file)) for file in files}
    older = [file for file, copy in copies.items() if _is_changed(copy, file)]
    with transaction(), ExitStack() as renamed:  # all files at the end

        def write(file: Path) -> Path:
            if not os.access(file, os.W_OK):
                raise InputError(f"{file}: cannot be written; upgrade a copy of the stage")
            aside = renamed.enter_context(output(file, force=True, in_place=True))
            export_like(copies[file], file, aside)
            return aside

        maps = [file for file in older if not _checksums_in(copies[file])]
        new = {files[file]: layer_sha256(write(file)) for file in maps}
        namers = [file for file, copy in copies.items() if _name_maps(copy, new) or file in older]
        done = [*maps, *(file for file in namers if file not in maps)]
        for file in done[len(maps) :]:
            stamp(copies[file])
            write(file)
    for layer in layers:
        layer.Reload(force=True)  # an open stage has it too
    return done


def _is_changed(copy: Sdf.Layer, file: Path) -> bool:
    """Upgrade the copy of a file's layer; whether it had older names. Errors name the file."""
    try:
        return upgrade_layer(copy) > 0
    except InputError as error:
        raise InputError(str(error).replace(copy.identifier, str(file))) from error


def _checksums_in(layer: Sdf.Layer) -> list[Sdf.AttributeSpec]:
    """The attributes of magnetometers that name a map by its checksum."""
    found: list[Sdf.AttributeSpec] = []

    def look(path: Sdf.Path) -> None:
        if path.IsPropertyPath() and path.name == MAP_CHECKSUM:
            found.append(layer.GetPropertyAtPath(path))

    layer.Traverse(Sdf.Path.absoluteRootPath, look)
    return found


def _name_maps(layer: Sdf.Layer, checksums: dict[str, str]) -> bool:
    """Replace the checksums of maps by their new ones; returns whether there were any."""
    named = [spec for spec in _checksums_in(layer) if str(spec.default).lower() in checksums]
    for spec in named:
        spec.default = checksums[spec.default.lower()]
    return bool(named)
