"""Layers: create them with units and default prim, open them, and name files relative to them."""

import functools
import hashlib
import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any, ParamSpec, TypeVar

import numpy as np
from pxr import Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdUtils

from magtwin.errors import InputError
from magtwin.files.budget import check_depth
from magtwin.files.file import existing, existing_file, sha256
from magtwin.files.kinds import USD_SUFFIXES, kind_of, refused
from magtwin.files.outputs import afterwards, output
from magtwin.usd.schema.versions import check_schema, creator
from magtwin.usd.trial import try_stage

P = ParamSpec("P")
R = TypeVar("R")

WORLD = Sdf.Path("/World")
"""Default prim of maps and scenes."""

SUFFIXES = (".usd", ".usda", ".usdc")


@contextmanager
def new_stage(
    path: str | os.PathLike[str], documentation: str, *, force: bool = False
) -> Iterator[Usd.Stage]:
    """A stage that becomes the file `path` when the block ends: metres, kilograms, Z up, /World.

    Args:
        path: File to make; the suffix selects text or crate.
        documentation: Description of the layer.
        force: Whether to replace an existing file.

    Raises:
        InputError: The suffix is not USD's, or the file exists and `force` was not given.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: a USD file ends in {', '.join(SUFFIXES)}")
    with output(path, force=force) as aside:
        stage = Usd.Stage.CreateNew(str(aside))
        describe_stage(stage, documentation)
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, WORLD).GetPrim())
        yield stage
        stage.Save()


def describe_stage(stage: Usd.Stage, documentation: str) -> None:
    """Author a stage's units, up axis, description and creator."""
    UsdGeom.SetStageMetersPerUnit(stage, UsdGeom.LinearUnits.meters)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdPhysics.SetStageKilogramsPerUnit(stage, UsdPhysics.MassUnits.kilograms)
    layer = stage.GetRootLayer()
    layer.documentation = documentation
    layer.customLayerData = creator()


def open_stage(path: str | os.PathLike[str], *, own: bool = False) -> Usd.Stage:
    """Open the stage of a USD file, reloaded from disk.

    Attributes of magtwin that the schema does not define cause a warning.

    Args:
        path: The file.
        own: Whether this process has just written it; then it is not tried in another process first.

    Raises:
        InputError: The file is missing or not USD, or a sublayer or reference is missing; the text has USD's
            own message. It names a file outside its folder that is not allowed (`check_stage`). Or a layer
            has changes in this process that are not saved, which would be lost; or is of a later version of
            the schema.
    """
    path = check_stage(path, own=own)
    with translated(path, "cannot be opened as USD"):
        stage = Usd.Stage.Open(str(path))
        if unsaved := [x.identifier for x in stage.GetUsedLayers() if x.realPath and x.dirty]:
            way = "save them (`stage.Save()`), or drop them (`layer.Reload()`)"
            raise InputError(f"{path}: {unsaved[0]} has changes in this process that are not saved; {way}")
        stage.Reload()  # a layer that is still held elsewhere would be stale
        errors = stage.GetCompositionErrors()
    if errors:
        said = _one_line(_text(errors[0])).removesuffix("; skipping.")
        link = f"; it is a link, beside which USD looks: give {path.resolve()}" if path.is_symlink() else ""
        raise InputError(f"{path}: {said}{link}")
    check_schema(stage, str(path))
    return stage


def open_layer(path: str | os.PathLike[str]) -> Sdf.Layer:
    """A layer of its own, read from disk, without the files that it names.

    Raises:
        InputError: The file is missing or not USD; the text has USD's own message.
    """
    path = check_stage(path, composed=False)
    with translated(path, "cannot be opened as USD"):
        layer = Sdf.Layer.OpenAsAnonymous(str(path))
    if layer is None:
        raise InputError(f"{path}: cannot be opened as USD; it is damaged, cut short, or not USD")
    return layer


_LONGEST = 500
"""Most characters of a message of USD that are shown."""

_NESTED = 1 << 24
"""Bytes of text whose nesting is counted at once."""


def check_stage(path: str | os.PathLike[str], *, composed: bool = True, own: bool = False) -> Path:
    """A USD file that this process may open. Every file that a user names passes through here.

    Args:
        path: The file.
        composed: Whether the files that it names will be opened too.
        own: Whether this process has just written it; then it is not tried.

    Raises:
        InputError: It is missing, no regular file, or larger than the budget; or as for `try_stage`.
    """
    path = existing(path, "USD file")
    if path.is_dir():
        held = ", ".join(sorted(each.name for each in path.glob("*.usd*"))[:8])
        raise InputError(f"{path}: a folder; give a USD file in it" + (f": {held}" if held else ""))
    if path.suffix.lower() not in USD_SUFFIXES:
        if kind := kind_of(path):
            raise refused(path, kind, "USD file")
        raise InputError(f"{path}: no USD file; its name must end in {', '.join(USD_SUFFIXES)}")
    if not path.stat().st_size:
        raise InputError(f"{path}: is empty (0 bytes); make or copy it again")
    binary = _is_crate(path) or path.suffix.lower() == ".usdz"
    existing_file(path, "USD file", "USD" if binary else "USD text")
    if not binary:
        _check_nesting(path)
    if not own:
        try_stage(path, composed=composed)
    return path


def _is_crate(path: Path) -> bool:
    """Whether a USD file is binary, by its first bytes."""
    with path.open("rb") as file:
        return file.read(8) == b"PXR-USDC"


def _check_nesting(path: Path) -> None:
    """Refuse text whose braces nest so deep that the parser's stack ends."""
    depth = 0
    with path.open("rb") as file:
        while block := file.read(_NESTED):
            text = np.frombuffer(block, np.uint8)
            steps = (text == ord("{")).astype(np.int32) - (text == ord("}"))
            levels = depth + np.cumsum(steps)
            check_depth(path, "USD text", int(levels.max()))
            depth = int(levels[-1])


@contextmanager
def translated(where: object, what: str = "damaged USD") -> Iterator[None]:
    """Raise USD's own errors in the block as an `InputError`, and keep its warnings off the terminal.

    USD reports damaged contents when they are used, by errors of its own kinds: `Tf.ErrorException`, and
    ArgumentError of the Boost library for values of another type. A value whose type USD does not know is an
    `UnregisteredValue`.

    Args:
        where: The file, or the place in it.
        what: What the errors mean.
    """
    diagnostics = UsdUtils.CoalescingDiagnosticDelegate()  # takes the warnings, which quote the file
    try:
        yield
    except (Tf.ErrorException, UnicodeDecodeError, TypeError, AttributeError) as error:
        wrong_type = type(error).__name__ == "ArgumentError" or "UnregisteredValue" in _text(error)
        if isinstance(error, TypeError | AttributeError) and not wrong_type:
            raise
        raise InputError(f"{where}: {what}: {_reason(error)}") from error
    finally:
        diagnostics.TakeUncoalescedDiagnostics()


def translates(function: Callable[P, R]) -> Callable[P, R]:
    """A function that reads USD, with USD's own errors `translated`.

    Its first argument is a file, a stage, a layer or a prim, which the errors name.
    """

    @functools.wraps(function)
    def translating(*args: P.args, **options: P.kwargs) -> R:
        with translated(_place(next(iter((*args, *options.values())), None))):
            return function(*args, **options)

    return translating


def _place(given: Any) -> object:
    """The name of a file, stage, layer or prim, for errors."""
    if isinstance(given, Usd.Prim):
        return f"{given.GetStage().GetRootLayer().identifier} <{given.GetPath()}>" if given else "a prim"
    if isinstance(given, Usd.Stage):
        return given.GetRootLayer().identifier
    if isinstance(given, Sdf.Layer):
        return given.identifier
    return given if isinstance(given, str | os.PathLike) else "a stage"


def save_layer(layer: Sdf.Layer, sublayers: Mapping[str, str] = MappingProxyType({})) -> None:
    """Write a changed layer to its file, aside and then renamed, as text or crate as before.

    Args:
        layer: The layer. It is reloaded at the end of the transaction.
        sublayers: Names in the file of sublayers that have other names until then.
    """
    path = Path(layer.realPath)
    copy = Sdf.Layer.CreateAnonymous(path.name)
    copy.TransferContent(layer)
    copy.subLayerPaths = [sublayers.get(name, name) for name in layer.subLayerPaths]
    kind = "usdc" if _is_crate(path) else "usda"
    with output(path, force=True, in_place=True) as aside:
        copy.Export(str(aside), args={"format": kind} if path.suffix.lower() == ".usd" else {})
    afterwards(functools.partial(layer.Reload, force=True))


def check_not_part(stage: Usd.Stage, out: str | os.PathLike[str]) -> None:
    """Refuse an output that is a layer of a stage.

    Raises:
        InputError: The stage reads this file.
    """
    file = Path(os.path.realpath(out))
    if any(file == Path(layer.realPath).resolve() for layer in stage.GetUsedLayers() if layer.realPath):
        raise InputError(f"{out}: is a part of the scene; give another name")


def layer_files(path: str | os.PathLike[str]) -> list[Path]:
    """The files of a stage's root layer and its sublayers, strongest first, without references.

    Raises:
        InputError: As for `open_stage`.
    """
    stage = open_stage(path)  # held in a name: its layers go with it
    layers = stage.GetLayerStack(includeSessionLayers=False)
    return [Path(layer.realPath) for layer in layers if layer.realPath]


def layer_sha256(path: str | os.PathLike[str]) -> str:
    """Checksum of a layer's bytes."""
    return sha256(existing_file(path, "layer", "USD"))


def stage_sha256(path: str | os.PathLike[str]) -> str:
    """Checksum of a stage: of its root layer and, recursively, of every file that it names.

    A layer that names no file counts with its bytes. Another layer counts with its text, in which checksums
    replace the names of files. So the checksum depends on the contents of the files, not on their locations.

    Raises:
        InputError: No such file, or it or a layer that it names is not USD.
    """
    return _content_sha256(check_stage(path).resolve(), (), {})


def _content_sha256(file: Path, above: tuple[Path, ...], known: dict[Path, str]) -> str:
    """Checksum of a file; `above` are the files on the way to it, `known` those that are done."""
    if file in above:
        return "circle"  # composition refuses a circle; here it must end
    if file not in known:
        check_depth(file, "USD text", len(above), "files that name each other")
        known[file] = _new_sha256(file, above, known)
    return known[file]


def _new_sha256(file: Path, above: tuple[Path, ...], known: dict[Path, str]) -> str:
    """As `_content_sha256`, of a file that is not known."""
    if file.suffix.lower() not in SUFFIXES:
        return sha256(file)
    existing_file(file, "USD file", "USD")
    with translated(file, "cannot be opened as USD"):
        if not any(UsdUtils.ExtractExternalReferences(str(file))):
            return layer_sha256(file)
        layer = Sdf.Layer.OpenAsAnonymous(str(file))

    errors: list[InputError] = []

    def checksum(asset: str) -> str:
        named = file.parent / asset
        if errors:
            return asset
        try:
            return _content_sha256(named.resolve(), (*above, file), known) if named.is_file() else asset
        except InputError as error:  # USD would put its traceback into the text, at each level again
            errors.append(error)
            return asset

    UsdUtils.ModifyAssetPaths(layer, checksum)
    if errors:
        raise errors[0].with_traceback(None)
    return hashlib.sha256(layer.ExportToString().encode()).hexdigest()


def _reason(error: Exception) -> str:
    """USD's first message, without its place in USD's sources."""
    if isinstance(error, UnicodeDecodeError):
        return f"a text is not UTF-8 (byte 0x{error.object[error.start]:02x})"
    if isinstance(error, TypeError | AttributeError):
        return f"a value of another type ({_one_line(str(error)).partition(' did not match')[0]})"
    try:
        text = getattr(error.args[0], "commentary", None) if error.args else None
    except UnicodeDecodeError as undecoded:
        text = undecoded.object.decode(errors="replace")
    text = _text(error) if text is None else text
    text = re.sub(r"pxrInternal_\w*?pxrReserved__(::|_)", "", _one_line(text))
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]} ..."  # it quotes the line of the file


def _text(error: object) -> str:
    """Text of an error. USD quotes a damaged layer, which need not be UTF-8."""
    try:
        return str(error)
    except UnicodeDecodeError as undecoded:
        return undecoded.object.decode(errors="replace")


def _one_line(text: str) -> str:
    return " ".join(text.split())


def relative_asset(layer: Sdf.Layer, path: Path) -> str:
    """`path` as an asset path relative to `layer`'s file; absolute if the layer has no file."""
    path = path.resolve()
    if layer.anonymous or not layer.realPath:
        return path.as_posix()
    relative = Path(os.path.relpath(path, Path(layer.realPath).resolve().parent)).as_posix()
    return relative if relative.startswith("../") else f"./{relative}"
