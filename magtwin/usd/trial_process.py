"""The process that opens stages before magtwin does. `trial` runs this file; it imports only pxr.

Each line of the input is a job, each line of the output its answer, both in JSON. A job has the file, the
working folder, the folders in which files may be named (`inside`), limits of memory, time, values and
prims, and whether the stage is composed. The layers of a composed stage are opened one by one, and all
files that they name are checked before any of them is opened.
"""

import functools
import glob
import itertools
import json
import os
import re
import sys
import threading
from pathlib import Path
from typing import Any

from pxr import Ar, Sdf, Tf, Usd, UsdGeom, UsdShade, UsdUtils

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

MOST_LAYERS = 100_000
"""Layers of a stage, each counted once for each set of expression variables."""

DEEPEST = 128
"""Most levels of prims, and of instances within instances."""

STACK = 2 << 20
"""Most bytes of this process's stack, below magtwin's: what recurses too deep there ends it first."""

LISTED = 20
"""Names out of the folders that an answer lists at most."""

_MEMORY = Path("/proc/self/statm")
_ADDRESS = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)://")
_PATTERN = re.compile(r"<UDIM>|#+")
"""The part of a texture's or a clip's name that stands for numbers."""


class RefusedError(Exception):
    """The text of a refusal."""


class Audit:
    """Layers of a stage, opened one by one; no file out of `inside` is opened.

    Attributes:
        layers: The layers, by identifier.
        named_files: Every file that a layer names, even if there is none.
        outside: Files out of the folders that layers name: layer, prim or property, name and file.
        suspects: Names of attributes whose type is not the one of USD's schemas.
    """

    def __init__(self, job: dict[str, Any]) -> None:
        self.inside: list[str] = job["inside"]
        self.room, self.seconds, self.most_values = job["room"], job["seconds"], job["values"]
        self.most_prims: int = job["prims"]
        self.composed: bool = job["composed"]
        self.used = used_time()
        self.layers: dict[str, Any] = {}
        self.named_files: set[str] = set()
        self.outside: list[dict[str, str]] = []
        self.suspects: set[str] = set()
        self.resolver = Ar.GetResolver()

    def is_inside(self, file: str) -> bool:
        """Whether a file is in one of the folders, with symlinks resolved."""
        real = on_disk(file).resolve()
        return any(real.is_relative_to(folder) for folder in self.inside)

    def open(self, name: str) -> Any:
        """A layer that is inside, with its values tried; None if it cannot be opened, as USD says later."""
        file = on_disk(name)
        if file.exists() and not file.is_file() and not file.is_dir():
            raise RefusedError(f"names {file}, which is no regular file")
        if not file.is_file():
            return None
        if name not in self.layers:
            size = file.stat().st_size
            self.room += 4 * size
            self.seconds += size / 1e6
            limit_memory(self.room)
            limit_time(self.seconds, self.used)
            with file.open("rb") as head:
                crate = head.read(8) == b"PXR-USDC"
            self.layers[name] = None
            try:
                layer = Sdf.Layer.FindOrOpen(name)
                if layer is not None:
                    self.suspects |= wrong_types(layer)
                    if crate and not self.composed:  # `named` copies those of a composed stage
                        copy_of(layer)
                    elif crate and size <= self.most_values:
                        try_values(layer)
            except Exception as error:
                if crate:
                    text = f"cannot be opened as USD: {text_of(error)}; make or copy it again"
                    raise RefusedError(text) from error
                return None  # raised again, with its text, where it is opened
            self.layers[name] = layer
        return self.layers[name]

    def look(self, root: str) -> None:
        """Open a stage's root layer, and all layers that it names, in any variant or payload."""
        pending: list[tuple[str, dict[str, Any], bool]] = [(root, {}, False)]
        seen = set()
        while pending:
            name, given, is_sublayer = pending.pop()
            layer = self.open(name)
            if layer is None:
                continue
            # As USD composes them: those of the layer above win, and a sublayer's own do not count.
            variables = given if is_sublayer else {**layer.expressionVariables, **given}
            key = (name, json.dumps(variables, sort_keys=True, default=str))
            if key in seen:
                continue
            seen.add(key)
            if len(seen) > MOST_LAYERS:
                raise RefusedError(f"names over {MOST_LAYERS} layers")
            for file, may_be_sublayer in self.named(layer, variables):
                if Sdf.FileFormat.FindByExtension(file) is not None:
                    pending += [(file, variables, is_sublayer) for is_sublayer in {False, may_be_sublayer}]

    def named(self, layer: Any, variables: dict[str, Any]) -> list[tuple[str, bool]]:
        """The existing files that a layer names inside, and whether as sublayers; others go to `outside`."""
        copy = copy_of(layer)
        copy.expressionVariables = variables
        arcs = copy.GetCompositionAssetDependencies()
        names: dict[str, None] = {}

        def keep(asset: str) -> str:
            names[asset] = None
            return asset

        UsdUtils.ModifyAssetPaths(copy, keep)  # sublayers, arcs, values, clips and metadata, evaluated
        found = []
        for asset in filter(None, [*names, *(arc for arc in arcs if arc not in names)]):
            address = _ADDRESS.match(asset)
            if address and (asset in arcs or address[1].lower() in Ar.GetRegisteredURISchemes()):
                where = place_of(layer, asset, variables)
                raise RefusedError(f"{where} names {asset}, an address; download the file, and name the copy")
            for file in self.files(layer, Sdf.Layer.SplitIdentifier(asset)[0]):
                if self.is_inside(file):
                    found.append((file, asset in copy.subLayerPaths))
                elif len(self.outside) < LISTED:
                    self.leave_out(place_of(layer, asset, variables), asset, file)
        return found

    def leave_out(self, where: str, asset: str, file: str) -> None:
        """Note a file out of the folders."""
        real = on_disk(file).resolve()
        self.outside.append({"where": where, "asset": asset, "file": str(real), "folder": str(real.parent)})

    def files(self, layer: Any, asset: str) -> list[str]:
        """The existing files that a name stands for: one, or those of a pattern such as `wood.<UDIM>.png`.

        USD resolves every name: `foo://../../x.png` and `anon:x/../../x.png` can be files too.
        """
        absolute = layer.ComputeAbsolutePath(asset)
        resolved = str(self.resolver.Resolve(absolute))
        files = [resolved] if resolved else []
        if _PATTERN.search(asset):
            bases = (Path(absolute), Path(layer.realPath).parent / asset, Path(asset))
            for base in {Path(os.path.normpath(Path.cwd() / base)) for base in bases}:
                parts = map(glob.escape, _PATTERN.split(str(base.relative_to(base.anchor))))
                files += map(str, sorted(Path(base.anchor).glob("*".join(parts))))
        self.named_files.update(str(on_disk(file)) for file in (absolute, *files))
        return [file for file in files if not Path(file).is_dir()]


def on_disk(name: str) -> Path:
    """The file of a layer, which can be a member of a package: `a.usdz[b.usda]`."""
    return Path(Ar.SplitPackageRelativePathOuter(name)[0])


def limit_memory(room: int) -> None:
    """Let this process take `room` more bytes than it has now."""
    if resource is not None and _MEMORY.exists():
        size = int(_MEMORY.read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        _limit(resource.RLIMIT_AS, size + room)


def used_time() -> float:
    """Processor time of this process so far [s]."""
    return 0.0 if resource is None else sum(resource.getrusage(resource.RUSAGE_SELF)[:2])


def limit_time(seconds: float, used: float) -> None:
    """End this process, by SIGXCPU, when it has had `seconds` of the processor beyond `used`."""
    if resource is not None:
        _limit(resource.RLIMIT_CPU, int(used + seconds) + 1)


def _limit(kind: int, most: int) -> None:
    """Set a limit of this process, at most to the one that the user has set (`ulimit`)."""
    hard = resource.getrlimit(kind)[1]
    resource.setrlimit(kind, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


BLOCKS = tuple(getattr(Sdf, name) for name in ("ValueBlock", "AnimationBlock") if hasattr(Sdf, name))
"""What stands for no value."""


def copy_of(layer: Any) -> Any:
    """A copy of a layer, which decodes every value and all metadata, however large."""
    copy = Sdf.Layer.CreateAnonymous(".usda")
    copy.TransferContent(layer)
    return copy


def try_values(layer: Any) -> None:
    """Convert every value of a layer to Python; refuse one that is not of its attribute's type."""

    def read(path: Any) -> None:
        if not path.IsPropertyPath():
            return
        spec = layer.GetObjectAtPath(path)
        values = [spec.GetInfo("default"), *(spec.GetInfo("timeSamples") or {}).values()]
        if not isinstance(spec, Sdf.AttributeSpec) or (of_type := spec.typeName.defaultValue) is None:
            return
        kinds = (type(of_type), type(None), *BLOCKS)
        if wrong := [value for value in values if not isinstance(value, kinds)]:
            raise ValueError(f"<{path}> is {spec.typeName}, but holds {type(wrong[0]).__name__}")

    layer.Traverse("/", read)


def wrong_types(layer: Any) -> set[str]:
    """Names of a layer's attributes whose type is that of no schema of USD which has the name."""
    found = set()

    def look(path: Any) -> None:
        if path.IsPrimPropertyPath() and (kinds := schema_kinds().get(_plain(path.name))):
            spec = layer.GetAttributeAtPath(path)
            if spec is not None and kind_of(spec.typeName) not in kinds:
                found.add(path.name)

    layer.Traverse("/", look)
    return found


_NAMED = re.compile(r"^(drive|limit|collection):[^:]+:|^(xformOp:[^:]+):.*")
"""Attributes with a name of their own: of schemas that are applied several times, and transforms."""

_TRANSFORMS = {"translate": "Vec3", "scale": "Vec3", "orient": "Quat", "transform": "Matrix4"}
_TRANSFORMS |= {f"{op}{axis}": "number" for op in ("translate", "scale", "rotate") for axis in "XYZ"}
_TRANSFORMS |= {f"rotate{''.join(order)}": "Vec3" for order in itertools.permutations("XYZ")}
"""Kinds of value of transforms, which are in no schema."""


def _plain(name: str) -> str:
    """Name of an attribute without the part that is its own."""
    return _NAMED.sub(lambda match: match[2] or f"{match[1]}:", name)


@functools.cache
def schema_kinds() -> dict[str, set[tuple[bool, str]]]:
    """Kinds of value of each attribute of USD's schemas, by name; of several applied ones without theirs."""
    registry = Usd.SchemaRegistry()
    kinds = {f"xformOp:{name}": {(False, kind)} for name, kind in _TRANSFORMS.items()}
    for schema in Tf.Type.FindByName("UsdSchemaBase").GetAllDerivedTypes():
        name = registry.GetSchemaTypeName(schema)
        prim = registry.FindConcretePrimDefinition(name) or registry.FindAppliedAPIPrimDefinition(name)
        for attribute in prim.GetPropertyNames() if prim else ():
            if defined := prim.GetAttributeDefinition(attribute):
                plain = attribute.replace(":__INSTANCE_NAME__", "")
                kinds.setdefault(plain, set()).add(kind_of(defined.GetTypeName()))
    return kinds


def kind_of(type_name: Any) -> tuple[bool, str]:
    """Whether a type is an array, and of what: numbers of any precision are one kind."""
    python = type_name.scalarType.type.pythonClass or type(type_name.scalarType.defaultValue)
    name = "number" if issubclass(python, int | float) else python.__name__
    return type_name.isArray, name[:-1] if name.startswith(("Vec", "Quat", "Matrix")) else name


def check_types(stage: Any, names: set[str]) -> None:
    """Refuse attributes of some names whose type is not the one of their prim's schema."""
    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
        for name in names.intersection(prim.GetAuthoredPropertyNames()):
            defined = prim.GetPrimDefinition().GetAttributeDefinition(name)
            kinds = {kind_of(defined.GetTypeName())} if defined else set[tuple[bool, str]]()
            if name.startswith("xformOp:") and prim.IsA(UsdGeom.Xformable):
                kinds = schema_kinds()[_plain(name)]
            for spec in prim.GetProperty(name).GetPropertyStack() if kinds else ():
                if not isinstance(spec, Sdf.AttributeSpec) or kind_of(spec.typeName) not in kinds:
                    said = spec.typeName if isinstance(spec, Sdf.AttributeSpec) else "relationship"
                    wanted = defined.GetTypeName() if defined else next(iter(kinds))[1]
                    raise RefusedError(
                        f"<{prim.GetPath()}> has {name} as {said}, USD as {wanted}; correct it"
                    )


def place_of(layer: Any, asset: str, variables: dict[str, Any]) -> str:
    """Layer, and prim or property, that names a file."""
    found: list[str] = []

    def names(value: Any) -> bool:
        if isinstance(value, str):
            if Sdf.VariableExpression.IsExpression(value):
                value = Sdf.VariableExpression(value).Evaluate(variables).value
            return bool(value == asset)
        if isinstance(value, Sdf.AssetPath):
            return names(value.path)
        if isinstance(value, Sdf.Reference | Sdf.Payload):
            return names(value.assetPath) or names(getattr(value, "customData", {}))
        if isinstance(value, dict):
            return any(map(names, value.values()))
        if isinstance(value, Sdf.ReferenceListOp | Sdf.PayloadListOp):
            return any(map(names, (*value.GetAddedOrExplicitItems(), *value.deletedItems)))
        return isinstance(value, Sdf.AssetPathArray | list | tuple) and any(map(names, value))

    def visit(path: Any) -> None:
        spec = None if found or path.IsAbsoluteRootPath() else layer.GetObjectAtPath(path)
        if spec is not None and any(names(spec.GetInfo(key)) for key in spec.ListInfoKeys()):
            found.append(f" <{path}>")

    layer.Traverse("/", visit)
    return layer.identifier + "".join(found)


def text_of(error: Exception) -> str:
    """The text of an error, in one line."""
    said = getattr(error.args[0], "commentary", None) if error.args else None
    return " ".join(str(said or error).split())


def compose(root: str, audit: Audit) -> None:
    """Open a stage whole, and look at its layers once more, should a name have escaped the audit."""
    try:
        stage = Usd.Stage.Open(root)
    except MemoryError:
        raise
    except Exception:
        return  # raised again, with its text, where it is opened
    for layer in stage.GetUsedLayers():
        if layer.realPath and not audit.is_inside(layer.realPath):
            audit.leave_out(root, layer.identifier, layer.realPath)
    if (prims := count_prims(stage)) > audit.most_prims:
        raise RefusedError(
            f"has {prims:.3g} prims with those of instances; at most {audit.most_prims:,} are read"
        )
    if audit.suspects:
        check_types(stage, audit.suspects)
    follow_chains(stage)
    purposes = [UsdGeom.Tokens.default_, UsdGeom.Tokens.render]
    UsdGeom.BBoxCache(Usd.TimeCode.Default(), purposes).ComputeWorldBound(stage.GetPseudoRoot())


def count_prims(stage: Any) -> int:
    """Prims of a stage, those of instances in each place where they stand."""
    known: dict[Any, int] = {}

    def count(top: Any, level: int) -> int:
        if level > DEEPEST:
            raise RefusedError(f"nests instances over {DEEPEST} levels deep; use fewer levels")
        total = 0
        for prim in Usd.PrimRange(top):
            total += 1
            if prim.GetPath().pathElementCount > DEEPEST:
                raise RefusedError(
                    f"nests prims over {DEEPEST} levels deep, in <{prim.GetPath().GetPrefixes()[0]}>"
                )
            if prim.IsInstance():
                prototype = prim.GetPrototype()
                if prototype.GetPath() not in known:
                    known[prototype.GetPath()] = count(prototype, level + 1)
                total += known[prototype.GetPath()] - 1  # the instance is the prototype's root
        return total

    return count(stage.GetPseudoRoot(), 0)


def follow_chains(stage: Any) -> None:
    """Follow relationships, bindings and connections to their ends, which USD does by recursion."""
    for top in (stage.GetPseudoRoot(), *stage.GetPrototypes()):
        for prim in Usd.PrimRange(top):
            relationships = prim.GetAuthoredRelationships()
            for relationship in relationships:
                relationship.GetForwardedTargets()
            if any(relationship.GetName().startswith("material:binding") for relationship in relationships):
                UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
            if prim.IsA(UsdShade.Material):
                UsdShade.Material(prim).ComputeSurfaceSource()


def answer_to(job: dict[str, Any]) -> dict[str, Any]:
    """Do a job. The answer has `refused`, `memory`, or names `outside` and the `files` that it depends on."""
    audit = Audit(job)
    limit_time(audit.seconds, audit.used)
    try:
        os.chdir(job["folder"])
        if job["composed"]:
            with Ar.ResolverContextBinder(audit.resolver.CreateDefaultContextForAsset(job["file"])):
                audit.look(job["file"])
            if not audit.outside:
                compose(job["file"], audit)
        else:
            audit.open(job["file"])
    except MemoryError:
        return {"memory": True}
    except RefusedError as error:
        memory = isinstance(error.__cause__, MemoryError) or "bad_alloc" in str(error)
        return {"memory": True} if memory else {"refused": str(error)}
    except Exception as error:  # what cannot be checked is not opened
        return {"refused": f"cannot be opened as USD: {text_of(error)}"}
    return {
        "outside": audit.outside,
        "files": sorted({str(on_disk(name)) for name in audit.layers} | audit.named_files),
    }


def main() -> None:
    """Answer jobs until the input ends, with less room for recursion than magtwin has."""
    stack = STACK
    if resource is not None and (most := resource.getrlimit(resource.RLIMIT_STACK)[0]) > 0:
        stack = min(stack, most // 4)
    threading.stack_size(max(stack // 4096 * 4096, 1 << 16))
    work = threading.Thread(target=answer_all)
    work.start()
    work.join()


def answer_all() -> None:
    """Answer jobs until the input ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    if resource is not None:
        for kind in (resource.RLIMIT_CORE, resource.RLIMIT_FSIZE):  # it writes nothing
            resource.setrlimit(kind, (0, 0))
    for line in sys.stdin:
        sys.stdout.write(json.dumps(answer_to(json.loads(line))) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
