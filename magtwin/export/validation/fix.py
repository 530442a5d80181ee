"""Fixes of a stage that need no guess. Each file is written aside and then renamed."""

import os
import re
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from pxr import Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, UsdUtils

from magtwin.errors import InputError, find
from magtwin.export.contents import named_files
from magtwin.export.validation.rule import Subject
from magtwin.export.validation.rules import is_absolute
from magtwin.files import output
from magtwin.usd.schema import NOUNS

Mend = Callable[["EditedStage"], Iterator[str]]


@dataclass
class EditedStage(Subject):
    """A stage that is fixed, and its changed layers."""

    touched: list[Sdf.Layer] = field(default_factory=list)

    def edit(self, layer: Sdf.Layer) -> Sdf.Layer:
        """A layer to change.

        Raises:
            InputError: It is outside the stage's folder.
        """
        if not self.owns(layer):
            raise InputError(f"{layer.realPath}: is outside {self.folder}; fix it there")
        if layer not in self.touched:
            self.touched.append(layer)
        return layer

    def owns(self, layer: Sdf.Layer) -> bool:
        """Whether a layer is in the stage's folder."""
        return Path(layer.realPath).resolve().is_relative_to(self.folder)


@dataclass(frozen=True)
class Fix:
    """A fix."""

    name: str
    sentence: str
    mend: Mend


SAFE: dict[str, Fix] = {}
"""Fixes by name; the decorator `_into` fills it."""


def _into(fixes: dict[str, Fix]) -> Callable[[Mend], Mend]:
    def enter(mend: Mend) -> Mend:
        name = mend.__name__.replace("_", "-")
        fixes[name] = Fix(name, (mend.__doc__ or "").split("\n")[0], mend)
        return mend

    return enter


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
    fixes = {name: find("fix", name, SAFE) for name in names}
    edited, done = EditedStage(Usd.Stage.Open(str(file)), file), list[str]()
    for fix in fixes.values():
        done += fix.mend(edited)
        for layer in edited.touched:  # before the next fix
            path = Path(layer.realPath)
            with output(path, force=True) as aside:
                layer.Export(str(aside), args={"format": _format(path)} if path.suffix == ".usd" else {})
        edited.touched.clear()
    return done


def _format(path: Path) -> str:
    """Format of a .usd file: text or crate."""
    with path.open("rb") as file:
        return "usdc" if file.read(8) == b"PXR-USDC" else "usda"


@_into(SAFE)
def default_prim(edited: EditedStage) -> Iterator[str]:
    """A single root prim becomes the default prim if there is none."""
    layer = edited.stage.GetRootLayer()
    roots = [prim for prim in edited.stage.GetPseudoRoot().GetChildren() if not prim.IsAbstract()]
    if not edited.stage.GetDefaultPrim() and len(roots) == 1:
        edited.edit(layer).defaultPrim = roots[0].GetName()
        yield f"{edited.name_of(layer)}: its default prim is {roots[0].GetName()}"


@_into(SAFE)
def units(edited: EditedStage) -> Iterator[str]:
    """Missing units are authored (metres, kilograms, Z up) on a stage with magtwin's prims."""
    stage, layer = edited.stage, edited.stage.GetRootLayer()
    if not any(edited.having(noun) for noun in NOUNS):
        return  # another stage may rely on USD's defaults
    said = (
        ("metersPerUnit", lambda: UsdGeom.SetStageMetersPerUnit(stage, UsdGeom.LinearUnits.meters)),
        ("upAxis", lambda: UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)),
        (
            "kilogramsPerUnit",
            lambda: UsdPhysics.SetStageKilogramsPerUnit(stage, UsdPhysics.MassUnits.kilograms),
        ),
    )
    for name, say in said:
        if not stage.HasAuthoredMetadata(name):
            edited.edit(layer)
            say()
            yield f"{edited.name_of(layer)}: says {name}"


@_into(SAFE)
def relative_paths(edited: EditedStage) -> Iterator[str]:
    """Absolute paths to files in the stage's folder become relative to the layer."""
    for layer in edited.layers:
        here = Path(layer.realPath).resolve().parent
        moved = {}
        for named in named_files(layer) if edited.owns(layer) else ():
            file = _inside(named.path, edited.folder) if is_absolute(named.path) else None
            if file is not None:
                moved[named.path] = _relative(file, here)
        if moved:
            UsdUtils.ModifyAssetPaths(edited.edit(layer), lambda path, moved=moved: moved.get(path, path))
            yield from (f"{edited.name_of(layer)}: names {new}, was {old}" for old, new in moved.items())


def _inside(path: str, folder: Path) -> Path | None:
    """The file in a folder that an absolute path names, here or on the machine where it was written."""
    parts = [part for part in re.split(r"[\\/]", path.removeprefix("file:")) if part and part != ".."]
    there = Path(path)
    if there.is_file() and there.resolve().is_relative_to(folder):
        return there.resolve()
    for i in range(1, len(parts)):
        file = folder.joinpath(*parts[i:])
        if file.is_file() and file.resolve().is_relative_to(folder):
            return file.resolve()
    return None


def _relative(file: Path, here: Path) -> str:
    relative = Path(os.path.relpath(file, here)).as_posix()
    return relative if relative.startswith("../") else f"./{relative}"


@_into(SAFE)
def extents(edited: EditedStage) -> Iterator[str]:
    """Shapes without an extent get one."""
    for prim in edited.prims:
        boundable = UsdGeom.Boundable(prim)
        if not boundable or prim.IsA(UsdGeom.PointInstancer) or boundable.GetExtentAttr().HasAuthoredValue():
            continue
        extent = UsdGeom.Boundable.ComputeExtentFromPlugins(boundable, Usd.TimeCode.Default())
        layer = _home(edited, prim)
        if extent and layer is not None:
            with Usd.EditContext(edited.stage, edited.edit(layer)):
                boundable.CreateExtentAttr(extent)
            yield f"{edited.name_of(layer)}: <{prim.GetPath()}> says its extent"


@_into(SAFE)
def material_bindings(edited: EditedStage) -> Iterator[str]:
    """Prims with a bound material get MaterialBindingAPI."""
    for prim in edited.prims:
        bound = any(name.startswith("material:binding") for name in prim.GetAuthoredPropertyNames())
        layer = _home(edited, prim)
        if bound and not prim.HasAPI(UsdShade.MaterialBindingAPI) and layer is not None:
            with Usd.EditContext(edited.stage, edited.edit(layer)):
                UsdShade.MaterialBindingAPI.Apply(prim)
            yield f"{edited.name_of(layer)}: <{prim.GetPath()}> has MaterialBindingAPI"


def _home(edited: EditedStage, prim: Usd.Prim) -> Sdf.Layer | None:
    """The layer of the stage's own layer stack that defines a prim; None if another asset does."""
    own = [layer for layer in edited.stage.GetLayerStack(includeSessionLayers=False) if layer.realPath]
    for spec in prim.GetPrimStack():
        if spec.specifier == Sdf.SpecifierDef:
            return spec.layer if spec.layer in own and edited.owns(spec.layer) else None
    return None
