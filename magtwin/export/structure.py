"""Split a robot's layer into the layers of Isaac Sim's asset structure 3.0."""

import os
from pathlib import Path

from pxr import Sdf, UsdUtils

from magtwin.errors import InputError
from magtwin.urdf.layout import GEOMETRIES, PAYLOADS, write_layers
from magtwin.usd.layers import check_stage, open_stage, translates


@translates
def structure(asset: Path) -> None:
    """Split a robot's asset in place, unless it has the structure already.

    The asset composes to the same stage. Its triangles move to `payloads/geometries.usdc`.

    Args:
        asset: Root layer of the robot, text, in a folder that may be changed.

    Raises:
        InputError: The asset has no default prim, or names several layers.
    """
    folder = asset.parent / PAYLOADS
    layer = Sdf.Layer.FindOrOpen(str(check_stage(asset, own=True)))  # a copy of a stage that was opened
    named = sorted(layer.GetCompositionAssetDependencies())
    if f"./{PAYLOADS}/base.usda" in named:
        return
    if not layer.defaultPrim or len(named) > 1 or folder.exists() or asset.suffix.lower() != ".usda":
        raise InputError(
            f"{asset}: is not a robot in one text layer and one layer of meshes, as Isaac Sim's structure "
            "needs; convert its URDF with `magtwin robot`"
        )
    folder.mkdir()
    if named:
        meshes = Path(layer.ComputeAbsolutePath(named[0]))
        _move(meshes, folder / GEOMETRIES)
        here = f"./{PAYLOADS}/{GEOMETRIES}"
        UsdUtils.ModifyAssetPaths(layer, lambda name: here if name == named[0] else name)
        layer.Save()
    made = asset.with_name(f"{asset.stem}_interface.usda")
    write_layers(layer, made, folder, asset)
    made.replace(asset)
    layer.Reload(force=True)
    open_stage(asset)


def _move(layer: Path, place: Path) -> None:
    """Move a layer, and adapt its relative paths."""

    def moved(name: str) -> str:
        if not name.startswith(("./", "../")):
            return name
        target = os.path.relpath(layer.parent / name, place.parent)
        return Path(target).as_posix() if target.startswith("..") else f"./{Path(target).as_posix()}"

    copy = Sdf.Layer.OpenAsAnonymous(str(layer))
    if copy.GetExternalReferences():
        UsdUtils.ModifyAssetPaths(copy, moved)
        copy.Export(str(place))
        layer.unlink()
    else:
        layer.rename(place)
