"""The files of a stage, copied into one folder with relative names."""

import os
import re
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from pxr import Sdf, UsdUtils
from safetensors import SafetensorError, safe_open

from magtwin.errors import InputError
from magtwin.files.file import existing
from magtwin.usd.layers import SUFFIXES, open_stage, translates
from magtwin.usd.trial import check_named

KINDS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "textures": (".png", ".jpg", ".jpeg", ".exr", ".avif", ".hdr", ".tif", ".tiff", ".tga", ".bmp"),
        "weights": (".safetensors", ".pth", ".onnx"),
        "paths": (".csv",),
        "materials": (".mdl", ".mtlx"),
        "lights": (".ies",),
        "sounds": (".m4a", ".mp3", ".wav"),
    }
)
"""Suffixes of files other than layers, by their folder in the export. Other files are not exported: an
untrusted stage could otherwise leak any file of this machine."""

THUMBNAIL = Path(".thumbs", "256x256")
"""Folder of a layer's thumbnail, relative to the layer."""


def kind_of(file: str | os.PathLike[str]) -> str:
    """Kind of a file by its suffix: a key of `KINDS`, or ""."""
    suffix = Path(file).suffix.lower()
    return next((kind for kind, suffixes in KINDS.items() if suffix in suffixes), "")


@translates
def bring_together(root: Path, folder: Path, *, within: Path | None = None) -> Path:
    """Copy a stage and every file that it names, in any variant, into a folder.

    Files below the stage's folder keep their arrangement. Other layers are copied to a folder named
    after their own, other files to a folder by kind. A layer whose paths stay valid keeps its bytes.

    Args:
        root: The stage's root layer.
        folder: An existing empty folder.
        within: Folder that must contain all files. None allows any.

    Returns:
        The root layer's copy.

    Raises:
        InputError: A file is missing, of a kind that is not exported, or outside `within`; or the stage
            cannot be opened. The text has layer and prim.
    """
    open_stage(root)  # raises if a layer is missing
    root = root.resolve()
    diagnostics = UsdUtils.CoalescingDiagnosticDelegate()  # keeps USD's warnings off the terminal
    try:
        layers, assets, lost = UsdUtils.ComputeAllDependencies(str(root))
    finally:
        diagnostics.TakeUncoalescedDiagnostics()
    files = {Path(layer.realPath).resolve(): layer for layer in layers}
    others = [Path(asset).resolve() for asset in assets]
    for name in lost:
        if Path(name).suffix.lower() != ".mdl" or "/" in name:  # a material of Omniverse, such as OmniPBR.mdl
            raise InputError(
                f"{_namer(layers, name)}: names {name}, which does not exist; add the file or remove the name"
            )
    for file in (*files, *others):
        _check_carried(file, layers, within)
        check_named(root, file)
    places = _places(root, files, others)
    for file, layer in files.items():
        _copy_layer(file, layer, folder, places)
    for file in others:
        copied(file, folder / places[file])
    return folder / places[root]


class NamedFile(NamedTuple):
    """The path of a file as a layer writes it, and the prim or property that names it ("": the layer)."""

    path: str
    where: str


def named_files(layer: Sdf.Layer) -> list[NamedFile]:
    """Every asset path that a layer authors, in any variant, in order of the layer."""
    files = [NamedFile(path, "") for path in layer.subLayerPaths]

    def visit(path: Sdf.Path) -> None:
        spec = layer.GetObjectAtPath(path)
        if isinstance(spec, Sdf.PrimSpec):
            for arcs in (spec.referenceList, spec.payloadList):
                named = [arc.assetPath for arc in arcs.GetAddedOrExplicitItems() if arc.assetPath]
                files.extend(NamedFile(name, str(path)) for name in named)
        elif isinstance(spec, Sdf.AttributeSpec) and spec.typeName in _ASSETS:
            times = layer.ListTimeSamplesForPath(path)
            for value in [spec.default, *(layer.QueryTimeSample(path, time) for time in times)]:
                assets = [value] if isinstance(value, Sdf.AssetPath) else value or ()
                files.extend(NamedFile(asset.path, str(path)) for asset in assets if asset.path)

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    seen = {file.path for file in files}
    copy = Sdf.Layer.CreateAnonymous(".usda")
    copy.TransferContent(layer)

    def keep(path: str) -> str:  # paths in metadata, such as clips
        if path and path not in seen:
            files.append(NamedFile(path, ""))
        return path

    UsdUtils.ModifyAssetPaths(copy, keep)
    return files


_ASSETS = (Sdf.ValueTypeNames.Asset, Sdf.ValueTypeNames.AssetArray)


def _check_carried(file: Path, layers: Iterable[Sdf.Layer], within: Path | None) -> None:
    """Refuse a file that must not be exported."""
    if "[" in file.as_posix() or file.suffix.lower() == ".usdz":
        text = "a part of a package; unpack that with `magtwin export FILE.usdz --out DIR`, and name a "
        text += "layer in it"
    elif within is not None and not file.is_relative_to(within.resolve()):
        text = "outside its package; a package must contain all of its files"
    elif file.suffix.lower() not in SUFFIXES and not kind_of(file):
        text = "which is no layer, texture, network or path, so it is not exported; remove the name"
    else:
        return
    raise InputError(f"{_namer(layers, str(file))}: names {file}, {text}")


def _namer(layers: Iterable[Sdf.Layer], name: str) -> str:
    """Which layer, and which prim or property of it, names a file."""
    layers = list(layers)
    for layer in layers:
        for file in named_files(layer):
            if name in (file.path, layer.ComputeAbsolutePath(file.path), str(_resolved(layer, file.path))):
                return f"{layer.realPath} <{file.where}>" if file.where else str(layer.realPath)
    return str(layers[0].realPath)


def _resolved(layer: Sdf.Layer, asset: str) -> Path:
    return Path(layer.ComputeAbsolutePath(asset)).resolve()


def _places(root: Path, layers: Iterable[Path], others: Iterable[Path]) -> dict[Path, Path]:
    """Place of each file in the folder."""
    everything = sorted({*layers, *others}, key=lambda file: (len(file.parts), file))
    inside = {file.relative_to(root.parent).parts[0] for file in everything if root.parent in file.parents}
    groups = {root.parent: Path()}
    taken = {name.lower() for name in inside}
    places = {}
    for file in everything:
        group = next((folder for folder in file.parents if folder in groups), None)
        if group is None:
            group = file.parent
            name = kind_of(file) or re.sub(r"[^\w.-]", "_", group.name) or "layers"
            free = (name, *(f"{name}_{i}" for i in range(2, len(everything) + 3)))
            groups[group] = Path(next(n for n in free if n.lower() not in taken))
            taken.add(groups[group].name.lower())
        places[file] = groups[group] / file.relative_to(group)
    return places


def _copy_layer(file: Path, layer: Sdf.Layer, folder: Path, places: Mapping[Path, Path]) -> None:
    """Copy a layer, with its asset paths changed to the new places."""
    place = places[file]
    changed = False

    def moved(asset: str) -> str:
        nonlocal changed
        target = places.get(_resolved(layer, asset)) if asset else None
        if target is None and "<UDIM>" in asset:  # a pattern for several files of one folder
            target = _udim(_resolved(layer, asset), places)
        if target is None:
            return asset
        relative = Path(os.path.relpath(target, place.parent)).as_posix()
        relative = relative if relative.startswith("../") else f"./{relative}"
        changed |= relative != asset
        return relative

    copy = Sdf.Layer.OpenAsAnonymous(str(file))
    UsdUtils.ModifyAssetPaths(copy, moved)
    if changed:
        (folder / place).parent.mkdir(parents=True, exist_ok=True)
        copy.Export(str(folder / place))
    else:
        copied(file, folder / place)
    picture = THUMBNAIL / f"{file.name}.png"
    found = (file.parent / picture).resolve()
    if found.is_file() and found.is_relative_to(file.parent):  # no link out of the layer's folder
        copied(found, folder / place.parent / picture)


def _udim(pattern: Path, places: Mapping[Path, Path]) -> Path | None:
    """The new place of a texture's tiles, as a pattern."""
    begin, mark, end = pattern.name.partition("<UDIM>")
    if not mark:  # it is in a folder's name
        return None
    for file, place in places.items():
        if file.parent == pattern.parent and file.name.startswith(begin) and file.name.endswith(end):
            return place.with_name(pattern.name)
    return None


def copied(file: Path, place: Path) -> None:
    """Copy a file, and make its folder."""
    place.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(existing(file, "file of a stage"), place)


def weights_metadata(file: Path) -> dict[str, str]:
    """Metadata in the header of a safetensors file; empty if it has none or cannot be read."""
    try:
        with safe_open(file, framework="numpy") as weights:
            return weights.metadata() or {}
    except (OSError, SafetensorError):
        return {}
