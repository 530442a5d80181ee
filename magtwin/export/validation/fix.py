"""Fixes of a stage that need no guess. Each file is written aside and then renamed."""

import os
import re
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

from pxr import Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, UsdUtils

from magtwin.errors import find
from magtwin.export.contents import named_files
from magtwin.export.validation.rule import Subject
from magtwin.export.validation.rules import is_absolute
from magtwin.outputs import transaction
from magtwin.usd.layers import check_stage, save_layer
from magtwin.usd.schema import NOUNS


def mend(file: Path, names: Collection[str]) -> list[str]:
    """Fix a stage.

    Args:
        file: Its root layer. Layers in its folder are fixed too.
        names: Keys of `SAFE`.

    Returns:
        What was changed, one line each.

    Raises:
        InputError: A name is unknown, or a file cannot be written; no file is half-written.
    """
    fixes = [find("fix", name, SAFE) for name in names]
    stage, done = Usd.Stage.Open(str(check_stage(file, own=True))), list[str]()  # tried by `validate`
    with transaction():
        for fix in fixes:
            subject = Subject(stage, file)
            done += fix(subject)
            for layer in subject.layers:  # before the next fix
                if layer.dirty:
                    save_layer(layer)
    return done


def default_prim(subject: Subject) -> Iterator[str]:
    """A single root prim becomes the default prim if there is none."""
    layer = subject.stage.GetRootLayer()
    roots = [prim for prim in subject.stage.GetPseudoRoot().GetChildren() if not prim.IsAbstract()]
    if not subject.stage.GetDefaultPrim() and len(roots) == 1:
        layer.defaultPrim = roots[0].GetName()
        yield f"{subject.name_of(layer)}: its default prim is {roots[0].GetName()}"


def units(subject: Subject) -> Iterator[str]:
    """Missing units are authored (metres, kilograms, Z up) on a stage with magtwin's prims."""
    stage = subject.stage
    if not any(subject.having(noun) for noun in NOUNS):
        return  # another stage may rely on USD's defaults
    values = {
        "metersPerUnit": UsdGeom.LinearUnits.meters,
        "upAxis": UsdGeom.Tokens.z,
        "kilogramsPerUnit": UsdPhysics.MassUnits.kilograms,
    }
    for name, value in values.items():
        if not stage.HasAuthoredMetadata(name):
            stage.SetMetadata(name, value)
            yield f"{subject.name_of(stage.GetRootLayer())}: says {name}"


def relative_paths(subject: Subject) -> Iterator[str]:
    """Absolute paths to files in the stage's folder become relative to the layer."""
    for layer in subject.layers:
        moved = {}
        for named in named_files(layer) if subject.owns(layer) else ():
            file = _inside(named.path, subject.folder) if is_absolute(named.path) else None
            if file is not None:
                relative = Path(os.path.relpath(file, Path(layer.realPath).resolve().parent)).as_posix()
                moved[named.path] = relative if relative.startswith("../") else f"./{relative}"
        if moved:
            UsdUtils.ModifyAssetPaths(layer, lambda path, moved=moved: moved.get(path, path))
            yield from (f"{subject.name_of(layer)}: names {new}, was {old}" for old, new in moved.items())


def _inside(path: str, folder: Path) -> Path | None:
    """The file in a folder that an absolute path names, here or on the machine where it was written."""
    parts = [part for part in re.split(r"[\\/]", path.removeprefix("file:")) if part and part != ".."]
    for file in (Path(path), *(folder.joinpath(*parts[i:]) for i in range(1, len(parts)))):
        if file.is_file() and file.resolve().is_relative_to(folder):
            return file.resolve()
    return None


def extents(subject: Subject) -> Iterator[str]:
    """Shapes without an extent get one."""
    for prim in subject.prims:
        boundable = UsdGeom.Boundable(prim)
        if not boundable or prim.IsA(UsdGeom.PointInstancer) or boundable.GetExtentAttr().HasAuthoredValue():
            continue
        extent = UsdGeom.Boundable.ComputeExtentFromPlugins(boundable, Usd.TimeCode.Default())
        layer = _home(subject, prim)
        if extent and layer is not None:
            with Usd.EditContext(subject.stage, layer):
                boundable.CreateExtentAttr(extent)
            yield f"{subject.name_of(layer)}: <{prim.GetPath()}> says its extent"


def material_bindings(subject: Subject) -> Iterator[str]:
    """Prims with a bound material get MaterialBindingAPI."""
    for prim in subject.prims:
        bound = any(name.startswith("material:binding") for name in prim.GetAuthoredPropertyNames())
        layer = _home(subject, prim)
        if bound and not prim.HasAPI(UsdShade.MaterialBindingAPI) and layer is not None:
            with Usd.EditContext(subject.stage, layer):
                UsdShade.MaterialBindingAPI.Apply(prim)
            yield f"{subject.name_of(layer)}: <{prim.GetPath()}> has MaterialBindingAPI"


def _home(subject: Subject, prim: Usd.Prim) -> Sdf.Layer | None:
    """The layer of the stage's own layer stack that defines a prim; None if another asset does."""
    own = [layer for layer in subject.stage.GetLayerStack(includeSessionLayers=False) if layer.realPath]
    for spec in prim.GetPrimStack():
        if spec.specifier == Sdf.SpecifierDef:
            return spec.layer if spec.layer in own and subject.owns(spec.layer) else None
    return None


SAFE: dict[str, Callable[[Subject], Iterator[str]]] = {
    fix.__name__.replace("_", "-"): fix
    for fix in (default_prim, units, relative_paths, extents, material_bindings)
}
"""Fixes by name. A fix changes layers and yields what it changed."""
