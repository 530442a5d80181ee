"""Layout: split one authored layer into the layers of Isaac Sim's asset structure 3.0.

    robot.usda                      interface: references base, variant set Physics
    edits.usda                      the user's changes; a sublayer of the interface, and never written again
    payloads/base.usda              links, frames and sensors with their poses and looks
    payloads/instances.usda         visuals and colliders of each link
    payloads/geometries.usdc        triangles
    payloads/materials.usda         looks
    payloads/robot.usda             schemas of Isaac Sim and magtwin; a sublayer of base
    payloads/arrays.usdc            long arrays of sensors, if there are any; a sublayer of base
    payloads/Physics/physics.usda   bodies, masses, joints, colliders, friction: UsdPhysics and Newton
    payloads/Physics/physx.usda     attributes for PhysX only, over physics
    payloads/Physics/mujoco.usda    attributes for MuJoCo only, over physics

Structure and roles follow NVIDIA's "Asset Structure" (Isaac Sim 6.0.1 documentation). Each opinion of the
authored layer goes to exactly one of these layers, so that the asset composes to the same stage.
"""

import os
from collections.abc import Callable
from pathlib import Path

from pxr import Sdf, Usd, UsdUtils

from magtwin.errors import InputError
from magtwin.files.file import read_bytes
from magtwin.files.outputs import check_free, output
from magtwin.urdf.material import LOOKS
from magtwin.urdf.shape import COLLISIONS, VISUALS
from magtwin.usd.layers import open_layer
from magtwin.usd.schema.versions import creator

PAYLOADS = "payloads"
"""Folder of the layers beside the interface."""

GEOMETRIES = "geometries.usdc"

EDITS = "edits.usda"
"""Layer of the user's changes, which a new conversion keeps."""

VARIANT_SET = "Physics"

VARIANTS = {
    "none": "",
    "physics": "Physics/physics.usda",
    "physx": "Physics/physx.usda",
    "mujoco": "Physics/mujoco.usda",
}
"""Layer of each physics variant, below PAYLOADS."""

DEFAULT_VARIANT = "physx"
"""Default of Isaac Sim 6.0.1; Newton and MuJoCo read the attributes below it. Those of mjc: are among them,
because Newton has no other attribute for the priority of a contact; the layer of MuJoCo is the user's."""

LAYERS = {
    "base": ("base.usda", "links, frames and sensors"),
    "instances": ("instances.usda", "visuals and colliders of its links"),
    "materials": ("materials.usda", "looks"),
    "robot": ("robot.usda", "schemas of Isaac Sim and magtwin"),
    "arrays": ("arrays.usdc", "long arrays of its sensors"),
    "physics": (VARIANTS["physics"], "bodies, joints and contact, for any engine"),
    "physx": (VARIANTS["physx"], "attributes for PhysX only"),
    "mujoco": (VARIANTS["mujoco"], "attributes for MuJoCo only"),
}
"""File and contents of each layer with opinions, by the names used below."""

FILES = {name: file for name, (file, _) in LAYERS.items()}

SCHEMAS = (
    ("Physx", "physx"),
    ("Mjc", "physics"),
    ("Physics", "physics"),
    ("Newton", "physics"),
    ("Isaac", "robot"),
)
"""Layer of an applied schema by the start of its name."""

NAMESPACES = (
    ("physx", "physx"),
    ("mjc:", "physics"),
    ("physics:", "physics"),
    ("drive:", "physics"),
    ("limit:", "physics"),
    ("state:", "physics"),
    ("newton:", "physics"),
    ("material:binding:physics", "physics"),
    ("isaac:", "robot"),
)
"""Layer of a property by the start of its name."""

PLACED = ("specifier", "typeName", "apiSchemas", "variantSetNames", "variantSelection", "primOrder")
"""Metadata of a prim that are authored apart from the others."""

LONG = 64
"""Longest array in a layer of text; usd-validation-nvidia refuses longer ones."""

INSTANCES = Sdf.Path("/Instances")
SHAPES = (VISUALS, COLLISIONS)
"""Children of a link with its shapes."""


def check_payloads(out: Path, *, force: bool) -> Path:
    """Folder of the layers of the asset `out`.

    Raises:
        InputError: It exists and `force` is not set, or it does not belong to this asset.
    """
    folder = out.parent / PAYLOADS
    if folder.exists() and force:
        base = folder / FILES["base"]
        data = open_layer(base).customLayerData.get("magtwin") if base.is_file() else None
        owner = data.get("interface") if isinstance(data, dict) else None
        if owner != out.name:
            whose = f"is of {owner}" if owner else "was not made by a conversion"
            raise InputError(f"{folder}: {whose}; give each robot its own folder")
    return check_free(folder, force=force)


NO_EDITS = """#usda 1.0
(
    defaultPrim = "{robot}"
    doc = "{robot}: your changes. A new conversion keeps this file."
)

over "{robot}"
{{
}}
"""


def keep_edits(folder: Path, robot: str) -> None:
    """Write an empty layer for the user's changes to the prim `robot`, unless the folder has one."""
    if not (folder / EDITS).exists():
        with output(folder / EDITS) as aside:
            aside.write_text(NO_EDITS.format(robot=robot), encoding="utf-8")


def lost_edits(folder: Path, stage: Usd.Stage) -> list[str]:
    """Paths of the outermost prims that the user's changes in a folder edit and a stage does not have."""
    empty = NO_EDITS.format(robot=stage.GetDefaultPrim().GetName()).encode()
    if not (folder / EDITS).is_file() or read_bytes(folder / EDITS, "layer", "USD text") == empty:
        return []
    lost: list[Sdf.Path] = []
    layer = open_layer(folder / EDITS)

    def visit(path: Sdf.Path) -> None:
        over = path.IsPrimPath() and layer.GetPrimAtPath(path).specifier == Sdf.SpecifierOver
        if over and not stage.GetPrimAtPath(path):
            lost.append(path)

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    return [str(path) for path in sorted(lost) if path.GetParentPath() not in lost]


def write_layers(flat: Sdf.Layer, out: Path, folder: Path, final: Path, *, edits: bool = False) -> None:
    """Write an authored layer as an asset of layers.

    Args:
        flat: Layer with the whole robot below its default prim, in the folder of `out`.
        out: Interface layer to write.
        folder: Folder for the other layers; contains the geometries already.
        final: Final path of `out`, beside PAYLOADS.
        edits: Whether EDITS lies beside it.
    """
    parts = split(flat)
    if edits:
        parts["interface"].subLayerPaths.append(f"./{EDITS}")
    for name, layer in parts.items():
        path = out if name == "interface" else folder / FILES[name]
        path.parent.mkdir(parents=True, exist_ok=True)
        home = final if name == "interface" else final.parent / PAYLOADS / FILES[name]
        UsdUtils.ModifyAssetPaths(layer, _moved(Path(flat.realPath).parent, final, home))
        layer.Export(str(path))


def split(flat: Sdf.Layer) -> dict[str, Sdf.Layer]:
    """The layers of an authored layer, by the names in FILES and "interface".

    Asset paths between these layers are final; all others are as in `flat`.
    """
    robot = flat.GetPrimAtPath(flat.rootPrims[flat.defaultPrim].path)
    parts = {name: Sdf.Layer.CreateAnonymous(f"{name}.usda") for name in ("interface", *FILES)}
    with Sdf.ChangeBlock():
        _Splitter(flat, parts).route(robot)
    for name in [variants.name for variants in robot.variantSets]:  # of contacts
        home = _prim(parts["physics"], robot.path)
        home.variantSetNameList.prependedItems.append(name)
        home.variantSelections[name] = robot.variantSelections[name]
        variants = robot.path.AppendVariantSelection(name, "")
        Sdf.CopySpec(flat, variants, parts["physics"], variants)
    if not parts["arrays"].rootPrims:
        del parts["arrays"]
    for name, layer in parts.items():
        layer.RemoveInertSceneDescription()
        _describe(layer, flat, name, robot.name)
    _compose(parts, robot)
    return parts


class _Splitter:
    """Copies the opinions of one layer to several."""

    def __init__(self, flat: Sdf.Layer, parts: dict[str, Sdf.Layer]) -> None:
        self.flat, self.parts = flat, parts

    def route(self, spec: Sdf.PrimSpec) -> None:
        """Copy a prim and everything below it to its layers."""
        owner, path = self._owner(spec)
        home = _prim(self.parts[owner], path)
        home.specifier = spec.specifier
        if spec.typeName:
            home.typeName = spec.typeName
        for key in spec.ListInfoKeys():
            if key not in PLACED:
                home.SetInfo(key, spec.GetInfo(key))
        if owner == "instances" and spec.name in SHAPES:
            scope = _prim(self.parts["instances"], INSTANCES)
            scope.specifier, scope.typeName = Sdf.SpecifierDef, "Scope"
            self._refer(spec, Sdf.Reference(f"./{FILES['instances']}", path))
        if owner == "materials" and spec.name == LOOKS:
            self._refer(spec, Sdf.Reference(f"./{FILES['materials']}"))
        self._schemas(spec, owner, path)
        for prop in spec.properties:
            name = _by_start(prop.name, NAMESPACES, owner)
            if owner == "instances" and prop.name.startswith("material:binding") and name == owner:
                name = "base"  # its target is outside the prims that base references
            if name == owner == "base" and _is_long(prop):
                name = "arrays"
            where = path if name == owner else spec.path
            _prim(self.parts[name], where)
            to = where.AppendProperty(prop.name)
            Sdf.CopySpec(self.flat, prop.path, self.parts[name], to)
            if where != spec.path:
                _repoint(self.parts[name].GetPropertyAtPath(to), spec.path, path)
        for child in spec.nameChildren:
            self.route(child)

    def _owner(self, spec: Sdf.PrimSpec) -> tuple[str, Sdf.Path]:
        """The layer that defines a prim, and its path there."""
        steps = spec.path.GetPrefixes()
        below = [child.typeName.startswith("Physics") for child in spec.nameChildren]
        if spec.typeName.startswith("Physics") or (spec.typeName == "Scope" and below and all(below)):
            return "physics", spec.path
        if len(steps) > 1 and steps[1].name == LOOKS:
            material = self.flat.GetPrimAtPath(steps[2]) if len(steps) > 2 else None
            if material is not None and not material.nameChildren:
                return "physics", spec.path  # a physics material has no shader
            return "materials", spec.path.ReplacePrefix(
                steps[1], Sdf.Path.absoluteRootPath.AppendChild(LOOKS)
            )
        if len(steps) > 2 and steps[2].name in SHAPES:
            prototype = INSTANCES.AppendChild(f"{steps[1].name}_{steps[2].name}")
            return "instances", spec.path.ReplacePrefix(steps[2], prototype)
        return "base", spec.path

    def _refer(self, spec: Sdf.PrimSpec, reference: Sdf.Reference) -> None:
        """Define a prim in base by reference to another layer."""
        here = _prim(self.parts["base"], spec.path)
        here.specifier, here.typeName = Sdf.SpecifierDef, spec.typeName
        here.referenceList.prependedItems.append(reference)

    def _schemas(self, spec: Sdf.PrimSpec, owner: str, path: Sdf.Path) -> None:
        """Copy applied schemas of a prim to their layers, in order."""
        names = spec.GetInfo("apiSchemas").GetAppliedItems() if spec.HasInfo("apiSchemas") else []
        by_layer: dict[str, list[str]] = {}
        root = spec.path.pathElementCount == 1
        for name in names:
            layer = _by_start(name, SCHEMAS, owner)
            if owner == "instances" and name == "MaterialBindingAPI":
                layer = "base"
            if root and name.startswith("Magtwin"):
                layer = "robot"
            by_layer.setdefault(layer, []).append(name)
        for layer, items in by_layer.items():
            listed = Sdf.TokenListOp()
            listed.prependedItems = items
            here = _prim(self.parts[layer], path if layer == owner else spec.path)
            here.SetInfo("apiSchemas", listed)


def _is_long(prop: Sdf.PropertySpec) -> bool:
    """Whether a property is a long array."""
    if not isinstance(prop, Sdf.AttributeSpec) or not prop.typeName.isArray:
        return False
    return prop.HasDefaultValue() and len(prop.default) > LONG


def _repoint(prop: Sdf.PropertySpec, old: Sdf.Path, new: Sdf.Path) -> None:
    """Update targets and connections of a property whose prims moved with it."""
    while old.name == new.name and old.pathElementCount > 1 and new.pathElementCount > 1:
        old, new = old.GetParentPath(), new.GetParentPath()
    attribute = isinstance(prop, Sdf.AttributeSpec)
    listed = prop.connectionPathList if attribute else prop.targetPathList
    for item in listed.GetAddedOrExplicitItems():
        if item.HasPrefix(old):
            listed.ReplaceItemEdits(item, item.ReplacePrefix(old, new))


def _by_start(name: str, table: tuple[tuple[str, str], ...], other: str) -> str:
    """The layer of the first matching prefix of a name."""
    return next((layer for start, layer in table if name.startswith(start)), other)


def _prim(layer: Sdf.Layer, path: Sdf.Path) -> Sdf.PrimSpec:
    """The spec at a path, created as an `over` if missing."""
    return layer.GetPrimAtPath(path) or Sdf.CreatePrimInLayer(layer, path)


def _describe(layer: Sdf.Layer, flat: Sdf.Layer, name: str, robot: str) -> None:
    """Set units, up axis, default prim and documentation of a layer."""
    for key in ("metersPerUnit", "upAxis", "kilogramsPerUnit"):
        layer.pseudoRoot.SetInfo(key, flat.pseudoRoot.GetInfo(key))
    if name == "interface":
        layer.documentation, layer.customLayerData = flat.documentation, flat.customLayerData
        layer.defaultPrim = robot
        return
    layer.defaultPrim = {"instances": INSTANCES.name, "materials": LOOKS}.get(name, robot)
    if not layer.GetPrimAtPath(Sdf.Path.absoluteRootPath.AppendChild(layer.defaultPrim)):
        root = _prim(layer, Sdf.Path.absoluteRootPath.AppendChild(layer.defaultPrim))
        if name in ("instances", "materials"):
            root.specifier, root.typeName = Sdf.SpecifierDef, "Scope"
    layer.documentation = f"{robot}: {LAYERS[name][1]}."
    layer.customLayerData = creator()
    if name == "base":
        layer.customLayerData = {**creator(), "magtwin": {"interface": Path(flat.realPath).name}}


def _compose(parts: dict[str, Sdf.Layer], robot: Sdf.PrimSpec) -> None:
    """Add the composition arcs between the layers."""
    for name in ("robot", "arrays"):
        if name in parts:
            parts["base"].subLayerPaths.append(f"./{FILES[name]}")
    for name in ("physx", "mujoco"):
        parts[name].subLayerPaths.append("./physics.usda")
    top = _prim(parts["interface"], robot.path)
    top.specifier, top.typeName = Sdf.SpecifierDef, robot.typeName
    if robot.HasInfo("kind"):
        top.SetInfo("kind", robot.GetInfo("kind"))
    top.referenceList.prependedItems.append(Sdf.Reference(f"./{PAYLOADS}/{FILES['base']}"))
    top.variantSetNameList.prependedItems.append(VARIANT_SET)
    variants = Sdf.VariantSetSpec(top, VARIANT_SET)
    for name, path in VARIANTS.items():
        variant = Sdf.VariantSpec(variants, name)
        if path:
            variant.primSpec.payloadList.prependedItems.append(Sdf.Payload(f"./{PAYLOADS}/{path}"))
    top.variantSelections[VARIANT_SET] = DEFAULT_VARIANT


def _moved(here: Path, final: Path, home: Path) -> Callable[[str], str]:
    """A function that converts asset paths from the temporary folder `here` to the final layer `home`."""
    own = {f"./{path}" for path in FILES.values()} | {"./physics.usda", f"./{EDITS}"}
    own |= {f"./{PAYLOADS}/{path}" for path in (*VARIANTS.values(), FILES["base"]) if path}

    def seen(path: str) -> str:
        if path in own or not path.startswith(("./", "../")):
            return path
        target = Path(os.path.normpath(here / path))
        if target.is_relative_to(here):
            target = final.resolve().parent / target.relative_to(here)
        relative = Path(os.path.relpath(target, home.resolve().parent)).as_posix()
        return relative if relative.startswith("../") else f"./{relative}"

    return seen
