"""Layers: new ones with units and defaults said, old ones opened, files named relative to them."""

import hashlib
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pxr import Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdUtils

from magtwin.errors import InputError
from magtwin.files import existing, output, sha256

WORLD = Sdf.Path("/World")
"""Default prim of maps and scenes."""

SUFFIXES = (".usd", ".usda", ".usdc")


@contextmanager
def new_stage(
    path: str | os.PathLike[str], documentation: str, *, force: bool = False
) -> Iterator[Usd.Stage]:
    """A stage that becomes the file `path` when the block ends: metres, kilograms, Z up, /World.

    Args:
        path: File to make; the suffix says whether it is text or crate.
        documentation: What the layer is, for people.
        force: Whether one that exists is replaced.

    Raises:
        InputError: The suffix is not USD's, or the file exists and `force` was not given.
    """
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise InputError(f"{path}: a USD file ends in {', '.join(SUFFIXES)}")
    with output(path, force=force) as aside:
        stage = Usd.Stage.CreateNew(str(aside))
        describe_stage(stage, documentation)
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, WORLD).GetPrim())
        yield stage
        stage.Save()


def describe_stage(stage: Usd.Stage, documentation: str) -> None:
    """Say a stage's units and axes, what it is and what wrote it."""
    UsdGeom.SetStageMetersPerUnit(stage, UsdGeom.LinearUnits.meters)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdPhysics.SetStageKilogramsPerUnit(stage, UsdPhysics.MassUnits.kilograms)
    layer = stage.GetRootLayer()
    layer.documentation = documentation
    layer.customLayerData = {"creator": "magtwin"}


def open_stage(path: str | os.PathLike[str]) -> Usd.Stage:
    """The stage of a USD file, as it is on disk now, with every layer that it names.

    Raises:
        InputError: No such file, or not USD, or one of its sublayers or references is missing; the
            text says what USD said of it.
    """
    path = existing(path, "USD file")
    if path.is_dir():
        raise InputError(f"{path}: a folder; give a USD file in it")
    heard = (
        UsdUtils.CoalescingDiagnosticDelegate()
    )  # keeps USD's warnings off the terminal: they are refusals
    try:
        stage = Usd.Stage.Open(str(path))
        stage.Reload()  # a layer that someone still holds would be shown as it was
        errors = stage.GetCompositionErrors()
    except Tf.ErrorException as error:
        raise InputError(f"{path}: cannot be opened as USD: {_reason(error)}") from error
    finally:
        heard.TakeUncoalescedDiagnostics()
    if errors:
        raise InputError(f"{path}: {_one_line(_text(errors[0]))}")
    return stage


def layer_files(path: str | os.PathLike[str]) -> list[Path]:
    """The files of a stage's root layer and its sublayers, strongest first; references are not among them.

    Raises:
        InputError: As for `open_stage`.
    """
    stage = open_stage(path)  # held in a name: its layers go with it
    layers = stage.GetLayerStack(includeSessionLayers=False)
    return [Path(layer.realPath) for layer in layers if layer.realPath]


def stage_sha256(path: str | os.PathLike[str]) -> str:
    """Checksum of a stage: of its root layer and of every file that it names, and those in turn.

    A layer that names no file counts with its bytes. One that does counts with its text, in which the
    checksum of each file stands in the place of its name. So the checksum is of what the files hold, not of
    where they lie.

    Raises:
        InputError: No such file, or it or a layer that it names is not USD.
    """
    return _content_sha256(existing(path, "USD file").resolve(), ())


def _content_sha256(file: Path, above: tuple[Path, ...]) -> str:
    """Checksum of a file, layer or not, that the files `above` name."""
    if file in above:
        return "circle"  # which composition refuses; here it must only end
    if file.suffix not in SUFFIXES:
        return sha256(file)
    try:
        if not any(UsdUtils.ExtractExternalReferences(str(file))):
            return sha256(file)
        layer = Sdf.Layer.OpenAsAnonymous(str(file))
    except Tf.ErrorException as error:
        raise InputError(f"{file}: cannot be opened as USD: {_reason(error)}") from error

    def checksum(asset: str) -> str:
        named = file.parent / asset
        return _content_sha256(named.resolve(), (*above, file)) if named.is_file() else asset

    UsdUtils.ModifyAssetPaths(layer, checksum)
    return hashlib.sha256(layer.ExportToString().encode()).hexdigest()


def _reason(error: Tf.ErrorException) -> str:
    """What USD said first, without where in its sources it said so; what it says later follows from that."""
    said = getattr(error.args[0], "commentary", str(error)) if error.args else str(error)
    return re.sub(r"pxrInternal_\w*?pxrReserved__(::|_)", "", _one_line(said))


def _text(error: object) -> str:
    """What USD says of an error; it quotes a damaged layer as it is, UTF-8 or not."""
    try:
        return str(error)
    except UnicodeDecodeError as undecoded:
        return undecoded.object.decode(errors="replace")


def _one_line(text: str) -> str:
    return " ".join(text.split())


def relative_asset(layer: Sdf.Layer, path: Path) -> str:
    """`path` as an asset path relative to `layer`'s file; absolute where the layer has none."""
    path = path.resolve()
    if layer.anonymous or not layer.realPath:
        return path.as_posix()
    relative = Path(os.path.relpath(path, Path(layer.realPath).resolve().parent)).as_posix()
    return relative if relative.startswith("../") else f"./{relative}"
