"""Flatten a stage to one layer without references, variants or instances, for simple viewers."""

from pathlib import Path

from pxr import Sdf, Usd, UsdUtils

from magtwin.export.contents import kind_of
from magtwin.usd.layers import open_stage, relative_asset, translates


@translates
def flatten(root: Path, out: Path) -> None:
    """Write a stage as a single layer.

    Selected variants stay. Instances become plain prims, for viewers that do not show prototypes. Time
    samples and all attributes stay.

    Args:
        root: Root layer of the stage.
        out: Layer to write.

    Raises:
        InputError: The stage cannot be opened.
    """
    stage = open_stage(root)
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        instances = [prim for prim in stage.TraverseAll() if prim.IsInstance()]
        while instances:  # instances can be nested
            for prim in instances:
                prim.SetInstanceable(False)
            instances = [prim for prim in stage.TraverseAll() if prim.IsInstance()]
    flat = stage.Flatten(addSourceFileComment=False)
    source = stage.GetRootLayer()
    flat.documentation, flat.customLayerData = source.documentation, source.customLayerData
    made = Sdf.Layer.CreateNew(str(out))
    made.TransferContent(flat)
    UsdUtils.ModifyAssetPaths(made, lambda asset: _beside(made, asset))
    made.Save()


def _beside(layer: Sdf.Layer, asset: str) -> str:
    """An asset path, made relative again after flattening."""
    path = Path(asset)
    return relative_asset(layer, path) if kind_of(asset) and path.is_absolute() else asset
