"""The `magtwin` schema library: registered with USD, checked, and applied to prims.

The library is codeless: `schema.usda` is its source, `generate.py` makes `generatedSchema.usda` and
`plugInfo.json` from it. USD reads schema plugins once, when its schema registry is first used, and is
silent about those that come later; `register` therefore asks the registry whether it knows each one.
"""

import os
import shutil
from pathlib import Path

from pxr import Plug, Usd

from magtwin.errors import InputError, find
from magtwin.outputs import output
from magtwin.usd.schema.names import VERSION, attribute_name

__all__ = [
    "FOLDER",
    "NOUNS",
    "apply_api",
    "attribute_name",
    "only_prim_with",
    "place",
    "prims_with",
    "publish",
    "register",
    "require_api",
]

FOLDER = Path(__file__).resolve().parent
"""Folder of the schema library, for PXR_PLUGINPATH_NAME."""

FILES = ("plugInfo.json", "generatedSchema.usda", "schema.usda")
"""Files of the library; USD reads the first two, the third is their source."""

NOUNS = {
    "anomalyMap": "MagtwinAnomalyMapAPI",
    "mapTile": "MagtwinMapTileAPI",
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
}
"""Applied API schema of each noun; its attributes are named `magtwin:<noun>:<attribute>`."""


def register() -> None:
    """Register the schemas with USD; a second call does nothing.

    Raises:
        InputError: USD's schema registry was used before, so it cannot add schemas; or it has another version
            of the library.
    """
    Plug.Registry().RegisterPlugins(str(FOLDER))
    plugin = Plug.Registry().GetPluginWithName("magtwin")
    version, wanted = plugin.metadata.get("schemaVersion", "0.x"), ".".join(map(str, VERSION))
    if version != wanted:
        raise InputError(
            f"USD loads version {version} of magtwin's schemas from {plugin.resourcePath}, this magtwin "
            f"needs {wanted}; let PXR_PLUGINPATH_NAME name {FOLDER} instead"
        )
    registry = Usd.SchemaRegistry()
    unknown = [api for api in NOUNS.values() if not registry.FindAppliedAPIPrimDefinition(api)]
    if unknown:
        raise InputError(
            f"the USD schemas {', '.join(unknown)} are registered too late: USD reads schemas at the first "
            "use of a stage; import magtwin.usd before opening one, or add "
            f"{FOLDER} to PXR_PLUGINPATH_NAME"
        )


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
    api = find("schema", noun, NOUNS)
    if prim.HasAPI(api):
        return prim
    allowed = prim.CanApplyAPI(api)
    if not allowed:
        raise InputError(
            f"{place(prim)}: {api} goes on {_kinds(api)} only, not on a {prim.GetTypeName() or 'def'}"
        )
    prim.ApplyAPI(api)
    return prim


def _kinds(api: str) -> str:
    """The types of prim of a schema, in words."""
    *others, last = Usd.SchemaRegistry().GetAPISchemaCanOnlyApplyToTypeNames(api)
    return f"an {', '.join(others)} or {last}" if others else f"an {last}"


def require_api(prim: Usd.Prim, noun: str) -> Usd.Prim:
    """`prim`, if it has the schema of `noun`.

    Raises:
        InputError: It lacks the schema.
    """
    api = find("schema", noun, NOUNS)
    if not prim.HasAPI(api):
        raise InputError(f"{place(prim)}: has no {api}, so it is no {noun} of magtwin")
    return prim


def prims_with(root: Usd.Prim, noun: str) -> list[Usd.Prim]:
    """The prims at and below `root` with the schema of `noun`, in order of the stage."""
    api = find("schema", noun, NOUNS)
    return [prim for prim in Usd.PrimRange(root) if prim.HasAPI(api)]


def _advice(root: Usd.Prim, noun: str) -> str:
    """What a whole file is, if it lacks the prim that is looked for, and which command takes it."""
    file = root.GetStage().GetRootLayer().realPath
    if not root.IsPseudoRoot() or prims_with(root, noun) or not file:
        return ""
    if noun in ("lab", "robot", "earthField") and prims_with(root, "anomalyMap"):
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
