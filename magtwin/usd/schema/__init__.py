"""The `magtwin` schema library: registered with USD, checked, and applied to prims.

The library is codeless: `schema.usda` is its source, `generate.py` makes `generatedSchema.usda` and
`plugInfo.json` from it. USD reads schema plugins once, when its schema registry is first used, and is
silent about those that come later; `register` therefore asks the registry whether it knows each one.
"""

from pathlib import Path

from pxr import Plug, Usd

from magtwin.errors import InputError, find

FOLDER = Path(__file__).resolve().parent

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
    "platform": "MagtwinPlatformFieldAPI",
    "lab": "MagtwinLabAPI",
}
"""Applied API schema of each noun; its attributes are named `magtwin:<noun>:<attribute>`."""


def register() -> None:
    """Make the schemas known to USD; once more does nothing.

    Raises:
        InputError: USD's schema registry was in use before, and will not take them any more.
    """
    Plug.Registry().RegisterPlugins(str(FOLDER))
    registry = Usd.SchemaRegistry()
    unknown = [api for api in NOUNS.values() if not registry.FindAppliedAPIPrimDefinition(api)]
    if unknown:
        raise InputError(
            f"the USD schemas {', '.join(unknown)} came too late: USD reads schemas once, at the first use "
            "of a stage; import magtwin.usd before opening one, or add "
            f"{FOLDER} to PXR_PLUGINPATH_NAME"
        )


def attribute_name(noun: str, field: str) -> str:
    """The attribute that stands for a field of a spec: ("drive", "wheel_radius_m") gives
    `magtwin:drive:wheelRadiusM`.
    """
    first, *rest = field.split("_")
    return f"magtwin:{noun}:{first}{''.join(word.capitalize() for word in rest)}"


def place(prim: Usd.Prim) -> str:
    """Where a prim is, for refusals: file and path."""
    layer = prim.GetStage().GetRootLayer()
    return f"{layer.realPath or layer.identifier} <{prim.GetPath()}>"


def apply_api(prim: Usd.Prim, noun: str) -> Usd.Prim:
    """Apply the schema of `noun` to `prim`, in the stage's edit target, unless it has it already.

    Raises:
        InputError: It may not be applied to a prim of that type.
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
    """The types of prim that a schema goes on, in words."""
    *others, last = Usd.SchemaRegistry().GetAPISchemaCanOnlyApplyToTypeNames(api)
    return f"an {', '.join(others)} or {last}" if others else f"an {last}"


def require_api(prim: Usd.Prim, noun: str) -> Usd.Prim:
    """`prim`, if it has the schema of `noun`.

    Raises:
        InputError: It has not.
    """
    api = find("schema", noun, NOUNS)
    if not prim.HasAPI(api):
        raise InputError(f"{place(prim)}: has no {api}; it is not a {noun} that magtwin authored")
    return prim


def prims_with(root: Usd.Prim, noun: str) -> list[Usd.Prim]:
    """The prims at and below `root` that have the schema of `noun`, in order of the stage."""
    api = find("schema", noun, NOUNS)
    return [prim for prim in Usd.PrimRange(root) if prim.HasAPI(api)]


def only_prim_with(root: Usd.Prim, noun: str) -> Usd.Prim:
    """The one prim at or below `root` that has the schema of `noun`.

    Raises:
        InputError: There is none, or there are several.
    """
    prims = prims_with(root, noun)
    if len(prims) != 1:
        seen = ", ".join(str(prim.GetPath()) for prim in prims) or "none"
        raise InputError(f"{place(root)}: needs one prim with {NOUNS[noun]} below it, found {seen}")
    return prims[0]
