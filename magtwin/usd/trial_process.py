"""The process that opens stages before magtwin does. `trial` runs this file; it imports only pxr.

Each line of the input is a job, each line of the output its answer, both in JSON. A job has the file, the
working folder, the folders in which files may be named (`inside`), limits of memory, time and values, and
whether the stage is composed. The layers of a composed stage are opened one by one, and all files that they
name are checked before any of them is opened.
"""

import glob
import json
import os
import re
import sys
from typing import Any

from pxr import Ar, Sdf, Usd, UsdUtils

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

MOST_LAYERS = 100_000
"""Layers of a stage, each counted once for each set of expression variables."""

LISTED = 20
"""Names out of the folders that an answer lists at most."""

_ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://")
_PATTERN = re.compile(r"<UDIM>|#+")
"""The part of a texture's or a clip's name that stands for numbers."""


class Refused(Exception):
    """The text of a refusal."""


class Audit:
    """Layers of a stage, opened one by one; no file out of `inside` is opened.

    Attributes:
        layers: The layers, by identifier.
        outside: Files out of the folders that layers name: layer, prim or property, name and file.
    """

    def __init__(self, job: dict[str, Any]) -> None:
        self.inside: list[str] = job["inside"]
        self.room, self.most_values = job["room"], job["values"]
        self.layers: dict[str, Any] = {}
        self.outside: list[dict[str, str]] = []
        self.resolver = Ar.GetResolver()

    def is_inside(self, file: str) -> bool:
        """Whether a file is in one of the folders, with symlinks resolved."""
        real = os.path.realpath(file)
        return any(real.startswith(os.path.join(folder, "")) for folder in self.inside)

    def open(self, name: str) -> Any:
        """A layer that is inside, with its values tried; None if it cannot be opened, as USD says later."""
        file = Ar.SplitPackageRelativePathOuter(name)[0]
        if os.path.exists(file) and not os.path.isfile(file) and not os.path.isdir(file):
            raise Refused(f"names {file}, which is no regular file")
        if not os.path.isfile(file):
            return None
        if name not in self.layers:
            size = os.stat(file).st_size
            self.room += 4 * size
            limit_memory(self.room)
            with open(file, "rb") as head:
                crate = head.read(8) == b"PXR-USDC"
            self.layers[name] = None
            try:
                layer = Sdf.Layer.FindOrOpen(name)
                if crate and layer is not None and size <= self.most_values:
                    try_values(layer)
            except Exception as error:
                if crate:
                    raise Refused(f"cannot be opened as USD: {text_of(error)}") from error
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
                raise Refused(f"names over {MOST_LAYERS} layers")
            for file, may_be_sublayer in self.named(layer, variables):
                if Sdf.FileFormat.FindByExtension(file) is not None:
                    pending += [(file, variables, is_sublayer) for is_sublayer in {False, may_be_sublayer}]

    def named(self, layer: Any, variables: dict[str, Any]) -> list[tuple[str, bool]]:
        """The existing files that a layer names inside, and whether as sublayers; others go to `outside`."""
        copy = Sdf.Layer.CreateAnonymous(".usda")
        copy.TransferContent(layer)
        copy.expressionVariables = variables
        arcs = copy.GetCompositionAssetDependencies()
        names: dict[str, None] = {}

        def keep(asset: str) -> str:
            names[asset] = None
            return asset

        UsdUtils.ModifyAssetPaths(copy, keep)  # sublayers, arcs, values, clips and metadata, evaluated
        found = []
        for asset in [*names, *(arc for arc in arcs if arc not in names)]:
            if not asset or asset.startswith("anon:"):
                continue
            if address := _ADDRESS.match(asset):
                if asset in arcs or address.group()[:-3].lower() in Ar.GetRegisteredURISchemes():
                    where = place_of(layer, asset, variables)
                    raise Refused(f"{where} names {asset}, an address; download the file, and name the copy")
                continue  # nobody opens it
            for file in self.files(layer, Sdf.Layer.SplitIdentifier(asset)[0]):
                if self.is_inside(Ar.SplitPackageRelativePathOuter(file)[0]):
                    found.append((file, asset in copy.subLayerPaths))
                elif len(self.outside) < LISTED:
                    where = place_of(layer, asset, variables)
                    self.outside.append({"where": where, "asset": asset, "file": file})
        return found

    def files(self, layer: Any, asset: str) -> list[str]:
        """The existing files that a name stands for: one, or those of a pattern such as `wood.<UDIM>.png`."""
        absolute = layer.ComputeAbsolutePath(asset)
        resolved = str(self.resolver.Resolve(absolute))
        files = [resolved] if resolved else []
        if _PATTERN.search(asset):
            home = os.path.dirname(layer.realPath)
            for base in {absolute, os.path.join(home, asset), os.path.abspath(asset)}:
                parts = (glob.escape(part) for part in _PATTERN.split(base))
                files += sorted(glob.glob("*".join(parts)))
        return [file for file in files if not os.path.isdir(file)]


def limit_memory(room: int) -> None:
    """Let this process take `room` more bytes than it has now."""
    if resource is not None and os.path.exists("/proc/self/statm"):
        with open("/proc/self/statm") as file:
            size = int(file.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        hard = resource.getrlimit(resource.RLIMIT_AS)[1]
        resource.setrlimit(resource.RLIMIT_AS, (size + room, hard))


def limit_time(seconds: float) -> None:
    """End this process after `seconds` of each core, should the process that gave the job be gone."""
    if resource is not None:
        used = sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
        most = int(used + seconds * (os.cpu_count() or 1)) + 1
        resource.setrlimit(resource.RLIMIT_CPU, (most, resource.getrlimit(resource.RLIMIT_CPU)[1]))


def try_values(layer: Any) -> None:
    """Read every value of a layer."""

    def read(path: Any) -> None:
        if path.IsPropertyPath():
            spec = layer.GetObjectAtPath(path)
            spec.GetInfo("default"), spec.GetInfo("timeSamples")

    layer.Traverse("/", read)


def place_of(layer: Any, asset: str, variables: dict[str, Any]) -> str:
    """Layer, and prim or property, that names a file."""
    found = []

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
        file = Ar.SplitPackageRelativePathOuter(layer.realPath)[0]
        if file and not audit.is_inside(file):
            audit.outside.append({"where": root, "asset": layer.identifier, "file": file})


def answer_to(job: dict[str, Any]) -> dict[str, Any]:
    """Do a job: `refused`, `memory`, `outside`, or nothing but the `files` that were opened."""
    limit_time(job["seconds"])
    audit = Audit(job)
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
    except Refused as error:
        memory = isinstance(error.__cause__, MemoryError) or "bad_alloc" in str(error)
        return {"memory": True} if memory else {"refused": str(error)}
    except Exception as error:  # what cannot be checked is not opened
        return {"refused": f"cannot be opened as USD: {text_of(error)}"}
    return {"outside": audit.outside, "files": [Ar.SplitPackageRelativePathOuter(f)[0] for f in audit.layers]}


def main() -> None:
    """Answer jobs until the input ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    if resource is not None:
        for kind in (resource.RLIMIT_CORE, resource.RLIMIT_FSIZE):  # it writes nothing
            resource.setrlimit(kind, (0, 0))
    for line in sys.stdin:
        print(json.dumps(answer_to(json.loads(line))), flush=True)


if __name__ == "__main__":
    main()
