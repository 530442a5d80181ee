"""Robots on a stage, read back: in their own asset, or in a scene that refers to it."""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pxr import Gf, Sdf, Usd, UsdGeom, Vt

from magtwin.errors import InputError, about
from magtwin.files.file import existing, sha256
from magtwin.frames import IDENTITY_XYZW, canonical, xyzw_from_wxyz
from magtwin.spec.base import Quat, Vec3
from magtwin.spec.robot import RobotSpec
from magtwin.usd.geometry import BASE_LINK
from magtwin.usd.layers import open_stage, translates
from magtwin.usd.schema import only_prim_with, place
from magtwin.usd.sensors import (
    ON_ROOT,
    joints_of,
    read_battery,
    read_drive,
    read_footprint,
    read_imu,
    read_lidar,
    read_magnetometer,
    read_on_root,
)

PARALLEL = 1e-12
"""Largest sine of half the angle between parallel axes."""


@translates
def load_robot(file: str | os.PathLike[str], *, own: bool = False) -> RobotSpec:
    """The spec of a robot's asset. Whether the weights that it names exist is not checked.

    Args:
        file: The asset.
        own: As for `open_stage`.

    Raises:
        InputError: The file is missing, is not USD, or is not an asset that `build_robot` made.
    """
    path = existing(file, "robot asset").resolve()
    stage = open_stage(path, own=own)
    if not stage.GetDefaultPrim():
        raise InputError(f"{path}: has no default prim, so no robot; make the asset with `magtwin robot`")
    return read_robot(stage.GetDefaultPrim(), path)


def read_robot(prim: Usd.Prim, asset: Path | None = None) -> RobotSpec:
    """The spec of the robot rooted at `prim`, in its own asset or in a scene that refers to it.

    Args:
        prim: Has the robot, drive and platform schemas; one magnetometer, IMU, LiDAR and battery below it.
        asset: USD file of the robot. Default: the file that the prim refers to.

    Raises:
        InputError: A part is missing or there twice, or a value is out of range; names the prim.
    """
    if asset is None:
        arcs = Usd.PrimCompositionQuery.GetDirectReferences(prim).GetCompositionArcs()
        layer = arcs[0].GetTargetLayer() if arcs else prim.GetStage().GetRootLayer()
        asset = Path(layer.realPath).resolve()
    magnetometer, imu, lidar = (only_prim_with(prim, noun) for noun in ("magnetometer", "imu", "lidar"))
    parts: dict[str, Any] = {
        "drive": read_drive(prim),
        "battery": read_battery(only_prim_with(prim, "battery")),
        "magnetometer": read_magnetometer(magnetometer),
        "imu": read_imu(imu),
        "lidar": read_lidar(lidar),
        **{noun: read_on_root(prim, noun) for noun in ON_ROOT},
    }
    with about(f"{place(prim)}:"):
        return RobotSpec(
            name=prim.GetName(),
            asset=asset,
            footprint_radius_m=read_footprint(prim),
            base_height_m=_p_root(prim, _base(prim))[2],
            p_base_magnetometer=_p_base(prim, magnetometer),
            q_base_magnetometer_link_xyzw=_q_base(prim, magnetometer.GetParent()),
            q_base_imu_link_xyzw=_q_base(prim, imu.GetParent()),
            p_base_lidar=_p_base(prim, lidar),
            q_base_lidar_link_xyzw=_q_base(prim, lidar.GetParent()),
            **parts,
        )


def read_notes(asset: str | os.PathLike[str]) -> tuple[str, ...]:
    """What was repaired, guessed or left out when an asset was converted from its URDF, one line each.

    Raises:
        InputError: The file is missing or is not USD, or what the converter wrote was damaged.
    """
    return tuple(map(str, _conversion(asset).get("notes", ())))


def urdf_of(asset: str | os.PathLike[str]) -> Path | None:
    """The URDF that an asset was converted from. None if it is not beside the asset, or was changed."""
    metadata = _conversion(asset)
    source = Path(asset).parent / Path(str(metadata.get("source", ""))).name
    if source.suffix != ".urdf" or not source.is_file() or sha256(source) != metadata.get("sourceSha256"):
        return None
    return source


@translates
def description_names(asset: str | os.PathLike[str]) -> tuple[dict[str, str], dict[str, str]]:
    """Names of an asset's links and of its joints in its description, by their names in USD.

    Raises:
        InputError: The file is missing or is not USD.
    """
    stage = open_stage(existing(asset, "robot asset"))
    robot = stage.GetDefaultPrim() or stage.GetPseudoRoot()
    joints = set(joints_of(robot).values())

    def named(prims: Iterable[Usd.Prim]) -> dict[str, str]:
        return {str(prim.GetName()): str(prim.GetDisplayName() or prim.GetName()) for prim in prims}

    return named({prim for prim in Usd.PrimRange(robot) if prim.GetDisplayName()} - joints), named(joints)


@translates
def _conversion(asset: str | os.PathLike[str]) -> dict[str, Any]:
    """Metadata that the converter wrote to an asset."""
    stage = open_stage(existing(asset, "robot asset"))  # held in a name: a layer does not outlive its stage
    return conversion_data(stage.GetRootLayer(), asset)


def conversion_data(layer: Sdf.Layer, file: str | os.PathLike[str]) -> dict[str, Any]:
    """Metadata that the converter wrote to the layer of a file; empty if it wrote none.

    Raises:
        InputError: They are of another type.
    """
    data = layer.customLayerData.get("magtwin", {})
    if not isinstance(data, dict) or not isinstance(data.get("notes", ()), Vt.StringArray | list | tuple):
        raise InputError(f"{file}: customLayerData magtwin is damaged; convert the robot again")
    return data


def _base(root: Usd.Prim) -> Usd.Prim:
    """The body of a robot called base_link, or else the root."""
    return next((p for p in Usd.PrimRange(root) if p.GetName() == BASE_LINK), root)


def _p_root(root: Usd.Prim, prim: Usd.Prim) -> Vec3:
    """A prim's origin in the axes of its robot's root [m]."""
    return tuple(UsdGeom.XformCache().ComputeRelativeTransform(prim, root)[0].ExtractTranslation())


def _p_base(root: Usd.Prim, sensor: Usd.Prim) -> Vec3:
    """A sensor's origin in the axes of its robot's base [m]."""
    to_root = UsdGeom.XformCache().ComputeRelativeTransform(_base(root), root)[0]
    return tuple(to_root.GetInverse().Transform(_p_root(root, sensor)))


def _q_base(root: Usd.Prim, link: Usd.Prim) -> Quat:
    """A link's axes in those of its robot's base (xyzw, w >= 0)."""
    cache = UsdGeom.XformCache()
    link_to_root, base_to_root = (
        cache.ComputeRelativeTransform(prim, root)[0].RemoveScaleShear() for prim in (link, _base(root))
    )
    q: Gf.Quatd = (link_to_root * base_to_root.GetInverse()).ExtractRotationQuat().GetNormalized()
    if q.GetImaginary().GetLength() <= PARALLEL:
        return IDENTITY_XYZW
    x, y, z, w = canonical(xyzw_from_wxyz((q.GetReal(), *q.GetImaginary()))).tolist()
    return (x, y, z, w)
