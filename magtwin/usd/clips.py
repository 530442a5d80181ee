"""Clips: a long run's samples as value clips, a layer for each block, so that no layer holds the whole run.

USD keeps a layer in memory until it is saved. Value clips are its way to spread samples over layers: the root
layer declares the attributes and names the clips with their times, and a stage opens a clip when a time in it
is asked for. The clips of `run.usdc` are in the folder `run.usdc.clips`, with a manifest of what they hold.
"""

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Sdf, Usd, Vt

from magtwin.errors import InputError
from magtwin.run import mapped
from magtwin.usd.layers import describe_stage, open_layer
from magtwin.usd.trial import folders_of

Samples = Mapping[Sdf.Path, tuple[Sequence[float], Sequence[Any]]]
"""Time codes and values of attributes."""

MANIFEST = "manifest.usda"
_SET = "default"
"""Name of the set of clips."""


def folder_of(path: Path) -> Path:
    """The folder of a layer's clips."""
    return path.with_name(f"{path.name}.clips")


def remove_clips(path: Path) -> None:
    """Remove the clips of a layer that was replaced by one without clips."""
    if (folder_of(path) / MANIFEST).is_file():
        shutil.rmtree(folder_of(path), ignore_errors=True)


class ClipWriter:
    """Clips that are written block by block."""

    def __init__(self, folder: Path, declared: Sdf.Layer) -> None:
        """Begin.

        Args:
            folder: The folder to make.
            declared: The layer that declares the attributes.
        """
        folder.mkdir()
        self._folder, self._declared = folder, declared
        self._starts: list[float] = []
        self._waiting: tuple[Samples, Mapping[Sdf.Path, Any]] | None = None
        self._before: dict[Sdf.Path, tuple[float, Any]] = {}
        self._paths: dict[Sdf.Path, None] = {}

    def append(self, start: float, samples: Samples, arrays: Mapping[Sdf.Path, Any]) -> None:
        """Add a block.

        A clip also gets the last sample before its block and the first one after it, as some readers of USD
        do not interpolate between clips.

        Args:
            start: Time code at which it begins.
            samples: Its samples.
            arrays: Attributes whose value in the whole block is one array.
        """
        self._write(samples)
        self._starts.append(start)
        self._waiting = samples, arrays

    def close(self, prim: Sdf.PrimSpec, folder: str) -> None:
        """Write the last clip and the manifest, and let a prim have the clips.

        Args:
            prim: The prim above all attributes.
            folder: Name of the folder beside the prim's layer.
        """
        self._write({})
        self._layer(MANIFEST, self._paths).Save()
        end = self._declared.endTimeCode
        files = [Sdf.AssetPath(f"./{folder}/{_name(k)}") for k in range(len(self._starts))]
        clips = {
            "assetPaths": Sdf.AssetPathArray(files),
            "primPath": str(prim.path),
            "active": Vt.Vec2dArray([(start, k) for k, start in enumerate(self._starts)]),
            "times": Vt.Vec2dArray([(0.0, 0.0), (end, end)]),
            "manifestAssetPath": Sdf.AssetPath(f"./{folder}/{MANIFEST}"),
        }
        prim.SetInfo("clips", {_SET: clips})

    def _write(self, after: Samples) -> None:
        """Write the block that waits, as a clip."""
        if self._waiting is None:
            return
        samples, arrays = self._waiting
        paths = dict.fromkeys((*samples, *arrays))
        self._paths |= paths
        layer = self._layer(_name(len(self._starts) - 1), paths)
        with Sdf.ChangeBlock():
            for path, (codes, values) in samples.items():
                if path in self._before:
                    layer.SetTimeSample(path, *self._before[path])
                for code, value in zip(codes, values, strict=True):
                    layer.SetTimeSample(path, code, value)
                if path in after and len(after[path][0]):
                    layer.SetTimeSample(path, after[path][0][0], after[path][1][0])
                if len(codes):
                    self._before[path] = codes[-1], values[-1]
            for path, array in arrays.items():
                layer.SetTimeSample(path, self._starts[-1], array)
        layer.Save()
        self._waiting = None

    def _layer(self, name: str, paths: Mapping[Sdf.Path, None]) -> Sdf.Layer:
        """A new layer that declares attributes."""
        layer = Sdf.Layer.CreateNew(str(self._folder / name))
        describe_stage(Usd.Stage.Open(layer), "Samples of a run of magtwin; its root layer names this file")
        layer.defaultPrim = self._declared.defaultPrim
        layer.timeCodesPerSecond = layer.framesPerSecond = self._declared.timeCodesPerSecond
        for path in paths:
            kind = self._declared.GetAttributeAtPath(path).typeName
            prim = Sdf.CreatePrimInLayer(layer, path.GetPrimPath())
            Sdf.AttributeSpec(prim, path.name, kind, declaresCustom=True)
        return layer


def _name(number: int) -> str:
    return f"clip_{number:05d}.usdc"


def clips_of(layer: Sdf.Layer, path: Path) -> list[Path]:
    """The files of a run's clips, in order; empty if it has none.

    Args:
        layer: Its root layer.
        path: The file of that layer.

    Raises:
        InputError: The prim's clips are damaged, or outside of the layer's folder.
    """
    prim = layer.GetPrimAtPath(Sdf.Path.absoluteRootPath.AppendChild(layer.defaultPrim or "World"))
    if not prim or not prim.HasInfo("clips"):
        return []
    said = prim.GetInfo("clips")
    named = said.get(_SET, {}).get("assetPaths", []) if hasattr(said, "get") else None
    if not isinstance(named, Sdf.AssetPathArray | list):
        raise InputError(f"{path}: <{prim.path}> names no clips of a run; write it again")
    files = [path.resolve().parent / asset.path for asset in named]
    for file in files:
        if not any(file.resolve().is_relative_to(folder) for folder in folders_of(path)):
            raise InputError(f"{path}: names {file}, outside the stage's folder; copy it there")
    return files


def read_clips(
    files: Sequence[Path], columns: Mapping[Sdf.Path, tuple[str, int]]
) -> dict[Sdf.Path, NDArray[Any]]:
    """Arrays that clips hold in parts, joined; long ones are mapped.

    Args:
        files: The clips.
        columns: Type in numpy's letters and numbers per row of each attribute.

    Returns:
        Arrays of shape (N,), or (N, width) if the width is not 0.

    Raises:
        InputError: A clip is missing, damaged, or has other rows than its first column.
    """
    first, (_, width) = next(iter(columns.items()))
    rows = [len(_part(open_layer(file), first, file)) // max(width, 1) for file in files]
    arrays = {
        path: mapped.empty((sum(rows), width) if width else sum(rows), dtype)
        for path, (dtype, width) in columns.items()
    }
    end = 0
    for file, count in zip(files, rows, strict=True):
        layer, begin, end = open_layer(file), end, end + count
        for path, array in arrays.items():
            part = np.asarray(_part(layer, path, file))
            if part.size != array[begin:end].size:
                raise InputError(
                    f"{file}: <{path}> has {part.size:,} numbers for {count:,} rows; write the run again"
                )
            array[begin:end] = part.reshape(array[begin:end].shape)
        mapped.release()
    return arrays


def _part(layer: Sdf.Layer, path: Sdf.Path, file: Path) -> Any:
    """The array of an attribute in a clip."""
    codes = layer.ListTimeSamplesForPath(path)
    value = layer.QueryTimeSample(path, codes[0]) if len(codes) == 1 else None
    if not hasattr(value, "__len__") or isinstance(value, str):
        raise InputError(f"{file}: <{path}> must have one array of numbers; write the run again")
    return value
