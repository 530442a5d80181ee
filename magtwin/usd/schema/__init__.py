"""The `magtwin` schema library: registered with USD, checked, and applied to prims.

The library is codeless: `schema.usda` is its source, `generate.py` makes `generatedSchema.usda` and
`plugInfo.json` from it. USD reads schema plugins once, when its schema registry is first used. A program may
open a stage before it imports magtwin, so nothing here asks that registry: applied schemas are read from a
prim's metadata, types and fallbacks from `schema.usda`.
"""

import functools
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pxr import Plug, Sdf, Usd

from magtwin.errors import InputError, find
from magtwin.files.outputs import output
from magtwin.usd.schema.names import VERSION
from magtwin.usd.schema.names import attribute_name as attribute_name

FOLDER = Path(__file__).resolve().parent
"""Folder of the schema library, for PXR_PLUGINPATH_NAME."""

FILES = ("plugInfo.json", "generatedSchema.usda", "schema.usda")
"""Files of the library; USD reads the first two, the third is their source."""

NOUNS = {
    "anomalyMap": "MagtwinAnomalyMapAPI",
    "harmonic": "MagtwinHarmonicFieldAPI",
    "magnetometer": "MagtwinMagnetometerAPI",
    "imu": "MagtwinImuAPI",
    "lidar": "MagtwinLidarAPI",
    "source": "MagtwinMagneticSourceAPI",
    "furniture": "MagtwinFurnitureAPI",
    "earth": "MagtwinEarthFieldAPI",
    "battery": "MagtwinBatteryAPI",
    "mocap": "MagtwinMotionCaptureAPI",
    "robot": "MagtwinRobotAPI",
    "drive": "MagtwinDifferentialDriveAPI",
    "plant": "MagtwinPlantAPI",
    "platform": "MagtwinPlatformFieldAPI",
    "lab": "MagtwinLabAPI",
    "wall": "MagtwinWallAPI",
    "door": "MagtwinDoorAPI",
    "window": "MagtwinWindowAPI",
}
"""Applied API schema of each noun; its attributes are named `magtwin:<noun>:<attribute>`."""


def register() -> None:
    """Register the schemas with USD; a second call does nothing.

    If a stage was opened before, other programs in this process do not see the schemas; magtwin does.

    Raises:
        InputError: USD has another version of the library.
    """
    Plug.Registry().RegisterPlugins(str(FOLDER))
    plugin = Plug.Registry().GetPluginWithName("magtwin")
    version, wanted = plugin.metadata.get("schemaVersion", "0.x"), ".".join(map(str, VERSION))
    if version != wanted:
        raise InputError(
            f"USD loads version {version} of magtwin's schemas from {plugin.resourcePath}, this magtwin "
            f"needs {wanted}; let PXR_PLUGINPATH_NAME name {FOLDER} instead"
        )


@functools.cache
def _source() -> Sdf.Layer:
    """The layer of `schema.usda`."""
    return Sdf.Layer.FindOrOpen(str(FOLDER / "schema.usda"))


@functools.cache
def declarations() -> dict[str, Sdf.PropertySpec]:
    """Every attribute and relationship of the schemas, by name."""
    return {item.name: item for schema in _source().rootPrims for item in schema.properties}


def declared(item: Usd.Property) -> Sdf.PropertySpec | None:
    """The declaration of a prim's property; None if it is not the schemas', or the prim lacks its schema."""
    spec = declarations().get(item.GetName())
    return spec if spec and spec.owner.name in _applied(item.GetPrim()) else None


def value_of(attribute: Usd.Attribute) -> Any:
    """Value of an attribute, or the schema's fallback; None if there is neither."""
    value = attribute.Get()
    if value is None and (spec := declared(attribute)):
        return spec.default
    return value


def type_of(attribute: Usd.Attribute) -> Sdf.ValueTypeName:
    """Type of an attribute: that of the schema, whatever a layer has."""
    spec = declared(attribute)
    return spec.typeName if spec else attribute.GetTypeName()


def author(attribute: Usd.Attribute, value: Any) -> None:
    """Set an attribute of a schema that its prim has, in the stage's edit target."""
    if not attribute and (spec := declared(attribute)):
        attribute.GetPrim().CreateAttribute(spec.name, spec.typeName, False, spec.variability)
    attribute.Set(value)


def author_targets(prim: Usd.Prim, name: str, paths: Sequence[Sdf.Path]) -> None:
    """Set the targets of a relationship of the schemas, in the stage's edit target."""
    (prim.GetRelationship(name) or prim.CreateRelationship(name, custom=False)).SetTargets(list(paths))


def publish(folder: str | os.PathLike[str], *, force: bool = False) -> None:
    """Copy the library to a folder, for PXR_PLUGINPATH_NAME of programs that cannot read this package.

    Args:
        folder: Folder to make.
        force: Whether to replace an existing folder.

    Raises:
        InputError: The folder exists and `force` is False, or cannot be written.
    """
    with output(folder, force=force) as aside:
        aside.mkdir()
        for name in FILES:
            shutil.copyfile(FOLDER / name, aside / name)


def place(prim: Usd.Prim) -> str:
    """File and path of a prim, for error messages."""
    layer = prim.GetStage().GetRootLayer()
    return f"{layer.realPath or layer.identifier} <{prim.GetPath()}>"


def apply_api(prim: Usd.Prim, noun: str) -> Usd.Prim:
    """Apply the schema of `noun` to `prim` in the stage's edit target, if it does not have it.

    Raises:
        InputError: The schema is not for a prim of that type.
    """
    if has_api(prim, noun):
        return prim
    kinds = _source().GetPrimAtPath(NOUNS[noun]).customData["apiSchemaCanOnlyApplyTo"]
    if not any(map(prim.IsA, kinds)):
        *others, last = kinds
        words = f"an {', '.join(others)} or {last}" if others else f"an {last}"
        raise InputError(
            f"{place(prim)}: {NOUNS[noun]} goes on {words} only, not on a {prim.GetTypeName() or 'def'}"
        )
    prim.AddAppliedSchema(NOUNS[noun])
    return prim


def has_api(prim: Usd.Prim, noun: str) -> bool:
    """Whether the schema of `noun` is applied to `prim`."""
    return find("schema", noun, NOUNS) in _applied(prim)


def _applied(prim: Usd.Prim) -> list[str]:
    """The applied schemas of a prim, by its metadata."""
    names: list[str] = prim.GetPrimTypeInfo().GetAppliedAPISchemas()
    return names


def require_api(prim: Usd.Prim, noun: str) -> Usd.Prim:
    """`prim`, if it has the schema of `noun`.

    Raises:
        InputError: It lacks the schema.
    """
    if not has_api(prim, noun):
        raise InputError(f"{place(prim)}: has no {NOUNS[noun]}, so it is no {noun} of magtwin")
    return prim


def prims_with(root: Usd.Prim, noun: str) -> list[Usd.Prim]:
    """The prims at and below `root` with the schema of `noun`, in order of the stage."""
    api = find("schema", noun, NOUNS)
    return [prim for prim in Usd.PrimRange(root) if api in _applied(prim)]


def _advice(root: Usd.Prim, noun: str) -> str:
    """What a whole file is, if it lacks the prim that is looked for, and which command takes it."""
    file = root.GetStage().GetRootLayer().realPath
    if not root.IsPseudoRoot() or prims_with(root, noun) or not file:
        return ""
    if noun in ("lab", "robot", "earth") and prims_with(root, "anomalyMap"):
        return (
            f"; it is a map without a scene: magtwin map info {file}, or name it as `map` in a scene's TOML"
        )
    if noun == "lab" and prims_with(root, "robot"):
        return f"; it is a robot without a scene: magtwin scene --urdf {file} --out FOLDER makes one"
    if noun in ("lab", "robot") and any(
        prim.HasAPI("PhysicsArticulationRootAPI") for prim in root.GetStage().Traverse()
    ):
        return (
            "; it is a robot without magtwin's sensors and a scene: magtwin scene --urdf F.urdf --out FOLDER "
            "makes them from its URDF"
        )
    if noun == "anomalyMap":
        return "; give a map layer (magtwin map fit) or a scene (magtwin scene)"
    if noun in ("lab", "robot"):
        return (
            "; it is a stage without a scene of magtwin, which makes rooms from a TOML: magtwin new "
            "room.toml, magtwin scene room.toml; this stage may then reference that room (docs/scenes.md, "
            "A lab in another place)"
        )
    return ""


def only_prim_with(root: Usd.Prim, noun: str) -> Usd.Prim:
    """The only prim at or below `root` with the schema of `noun`.

    Raises:
        InputError: There is none, or more than one.
    """
    prims = prims_with(root, noun)
    if len(prims) != 1:
        seen = ", ".join(str(prim.GetPath()) for prim in prims) or "none"
        raise InputError(
            f"{place(root)}: needs one prim with {NOUNS[noun]} below it, found {seen}{_advice(root, noun)}"
        )
    return prims[0]
