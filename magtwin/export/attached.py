"""Files attached to a layer as bytes: a .usdz may hold no networks, only layers, pictures and sounds.

Each file becomes a prim below the scope `Files` of the default prim, with its bytes, its checksum and a
relationship to the properties that named it; these are empty meanwhile. To get a file with usd-core alone:

    Path("net.safetensors").write_bytes(bytes(prim.GetAttribute("magtwin:file:bytes").Get()))
"""

import hashlib
import re
from pathlib import Path

import numpy as np
from pxr import Sdf, Usd, UsdUtils, Vt

from magtwin.errors import InputError
from magtwin.export.contents import kind_of, named_files
from magtwin.files.file import read_bytes, sha256
from magtwin.usd.layers import open_stage, relative_asset, translates
from magtwin.usd.schema import place as prim_place
from magtwin.usd.schema.versions import creator
from magtwin.usd.trial import check_named

SCOPE = "Files"
"""Name of the scope, below the default prim."""

KINDS = ("weights", "paths")
"""Kinds of files to attach, see `contents.KINDS`."""

NAME, BYTES, SHA256, OF = (f"magtwin:file:{name}" for name in ("name", "bytes", "sha256", "of"))


@translates
def attach(root: Path, *more: Path) -> None:
    """Move files of a stage's folder into a new sublayer of the root layer, `files.usdc`.

    Args:
        root: Root layer; its folder contains all files.
        more: Further files of that folder to attach, which no property names.

    Raises:
        InputError: The stage has no default prim, or a prim has the path of the scope.
    """
    stage = open_stage(root)
    named = {file.resolve(): list[Sdf.Path]() for file in more}
    for prim in stage.TraverseAll():
        for attribute in prim.GetAuthoredAttributes():
            value = attribute.Get() if attribute.GetTypeName() == Sdf.ValueTypeNames.Asset else None
            if value and value.resolvedPath and kind_of(value.path) in KINDS:
                file = check_named(root, Path(value.resolvedPath), f"<{attribute.GetPath()}>")
                named.setdefault(file.resolve(), []).append(attribute.GetPath())
    if not named:
        return
    default = stage.GetDefaultPrim()
    if not default:
        raise InputError(f"{root}: has no default prim to attach files below; set one")
    scope, meta = default.GetPath().AppendChild(SCOPE), stage.GetRootLayer()
    if stage.GetPrimAtPath(scope):
        raise InputError(f"{root} <{scope}>: is the scope of attached files; rename that prim")
    layers = [layer for layer in stage.GetUsedLayers() if layer.realPath]
    for layer in layers:
        if any(kind_of(file.path) in KINDS for file in named_files(layer)):
            UsdUtils.ModifyAssetPaths(layer, lambda asset: "" if kind_of(asset) in KINDS else asset)
            layer.Save()
    names = ("files.usdc", *(f"files_{i}.usdc" for i in range(2, 99)))
    place = next(path for path in map(root.with_name, names) if not path.exists())
    files = Sdf.Layer.CreateNew(str(place))
    files.documentation = "Files as bytes, which a package may not hold otherwise"
    files.customLayerData = creator()
    for key in ("metersPerUnit", "upAxis", "kilogramsPerUnit"):
        if meta.pseudoRoot.HasInfo(key):
            files.pseudoRoot.SetInfo(key, meta.pseudoRoot.GetInfo(key))
    files.defaultPrim = scope.GetParentPath().name
    _define(files, scope, named)
    files.Save()
    meta.subLayerPaths.append(f"./{place.name}")
    meta.Save()
    for file in named:
        file.unlink()
        if not any(file.parent.iterdir()):
            file.parent.rmdir()


def _define(layer: Sdf.Layer, scope: Sdf.Path, named: dict[Path, list[Sdf.Path]]) -> None:
    """Author a prim for each file."""
    Sdf.CreatePrimInLayer(layer, scope.GetParentPath())
    top = Sdf.CreatePrimInLayer(layer, scope)
    top.specifier, top.typeName = Sdf.SpecifierDef, "Scope"
    taken: set[str] = set()
    kinds = Sdf.ValueTypeNames
    for file in sorted(named):
        plain = re.sub(r"\W", "_", file.name, flags=re.ASCII)
        names = (f"file_{plain}" if plain[0].isdigit() else plain, *(f"file_{i}_{plain}" for i in range(99)))
        name = next(n for n in names if n not in taken)
        taken.add(name)
        prim = Sdf.CreatePrimInLayer(layer, scope.AppendChild(name))
        prim.specifier, prim.typeName = Sdf.SpecifierDef, "Scope"
        given = (
            (NAME, kinds.String, file.name),
            (SHA256, kinds.String, sha256(file)),
            (
                BYTES,
                kinds.UCharArray,
                Vt.UCharArray.FromNumpy(
                    np.frombuffer(read_bytes(file, "file of a stage", "weights"), np.uint8)
                ),
            ),
        )
        for key, kind, value in given:
            Sdf.AttributeSpec(prim, key, kind, Sdf.VariabilityUniform, declaresCustom=True).default = value
        of = Sdf.RelationshipSpec(prim, OF, custom=True)
        for path in named[file]:
            of.targetPathList.explicitItems.append(path)


@translates
def detach(root: Path) -> tuple[Path, ...]:
    """Write a stage's attached files beside its root layer, and restore the properties that named them.

    Returns:
        Files that no property named.

    Raises:
        InputError: A file is damaged, or has a name or kind that magtwin does not attach.
    """
    stage = open_stage(root)
    prims, unnamed = _file_prims(stage), []
    for prim in prims:
        name, data = str(prim.GetAttribute(NAME).Get() or ""), _bytes(prim)
        if Path(name).name != name or "\\" in name or kind_of(name) not in KINDS:
            raise InputError(f"{prim_place(prim)}: {NAME} {name!r} is not a valid name of an attached file")
        if hashlib.sha256(data).hexdigest() != prim.GetAttribute(SHA256).Get():
            raise InputError(f"{prim_place(prim)}: the bytes of {name} do not match their checksum")
        file = root.parent / kind_of(name) / name
        if file.exists():
            raise InputError(f"{prim_place(prim)}: a second file {name}; rename one")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(data)
        targets = prim.GetRelationship(OF).GetTargets()
        if not targets:
            unnamed.append(file)
        for path in targets:
            attribute = stage.GetAttributeAtPath(path)
            if not attribute or attribute.GetTypeName() != Sdf.ValueTypeNames.Asset:
                raise InputError(f"{prim_place(prim)}: {OF} names {path}, which is no asset attribute")
            layer = next((spec.layer for spec in attribute.GetPropertyStack()), stage.GetRootLayer())
            with Usd.EditContext(stage, layer):
                attribute.Set(Sdf.AssetPath(relative_asset(layer, file)))
    if not prims:
        return ()
    handles = stage.GetLayerStack(includeSessionLayers=False)
    layers = [Sdf.Layer.FindOrOpen(layer.identifier) for layer in handles]  # keeps them open
    _remove(layers, prims[0].GetParent().GetPath())
    for layer in layers:
        if layer.dirty:
            layer.Save()
    return tuple(unnamed)


def attached_sha256(attribute: Usd.Attribute) -> str:
    """SHA-256 of the file attached for an attribute; "" if there is none."""
    for prim in _file_prims(attribute.GetStage()):
        if attribute.GetPath() in prim.GetRelationship(OF).GetTargets():
            return hashlib.sha256(_bytes(prim)).hexdigest()
    return ""


def _file_prims(stage: Usd.Stage) -> list[Usd.Prim]:
    """The prims of attached files."""
    default = stage.GetDefaultPrim()
    scope = default.GetChild(SCOPE) if default else Usd.Prim()
    return [prim for prim in scope.GetChildren() if prim.HasAttribute(BYTES)] if scope else []


def _bytes(prim: Usd.Prim) -> bytes:
    value = prim.GetAttribute(BYTES).Get()
    return bytes(np.array(value, np.uint8)) if isinstance(value, Vt.UCharArray) else b""


def _remove(layers: list[Sdf.Layer], scope: Sdf.Path) -> None:
    """Remove a scope from its layers, and delete layers that are then empty."""
    for layer in layers:
        if not layer.GetPrimAtPath(scope):
            continue
        edit = Sdf.BatchNamespaceEdit()
        edit.Add(scope, Sdf.Path.emptyPath)
        layer.Apply(edit)
        users = [
            (u, n) for u in layers for n in u.subLayerPaths if u.ComputeAbsolutePath(n) == layer.realPath
        ]
        if users and not (
            layer.subLayerPaths or any(p.nameChildren or p.properties for p in layer.rootPrims)
        ):
            for user, name in users:
                user.subLayerPaths.remove(name)
            layer.Save()
            Path(layer.realPath).unlink()
