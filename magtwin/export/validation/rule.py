"""Rule: one thing that a stage must hold to, with its name and its sentence; Subject: such a stage."""

import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from pxr import Sdf, Tf, Usd, UsdUtils

from magtwin.errors import InputError
from magtwin.export.validation.findings import Finding, Severity
from magtwin.usd.schema import prims_with

SAID = 120
"""Characters of what Python or USD said that a finding quotes."""

_WHERE = re.compile(r"^(?P<file>[^<]*)<(?P<prim>/[^>]*)>:? ?(?P<text>.*)$", re.S)
"""How refusals of usd/ begin, by `magtwin.usd.schema.place`."""


@dataclass(frozen=True)
class Wrong:
    """Something that breaks a rule."""

    text: str
    """What is wrong."""

    where: str = ""
    """Path of the prim, or name of the file."""

    advice: str = ""
    """What to do; the rule's own unless given."""

    severity: Severity = "error"


@dataclass
class Subject:
    """A stage that is looked at, and what is known of it from outside."""

    stage: Usd.Stage

    file: Path
    """Its root layer."""

    inputs: frozenset[str] | None = None
    """Names of the inputs that a network may have; None where nobody said."""

    packed: Path | None = None
    """Folder that it was unpacked to where it is a .usdz, which nothing may lead out of."""

    @property
    def folder(self) -> Path:
        """Folder that the stage and what it names lie in."""
        return (self.packed or self.file.resolve().parent).resolve()

    @cached_property
    def prims(self) -> list[Usd.Prim]:
        """Every prim that is active and defined, but none within instances."""
        return list(self.stage.Traverse())

    @cached_property
    def layers(self) -> list[Sdf.Layer]:
        """Every layer that was read from a file."""
        return [layer for layer in self.stage.GetUsedLayers() if layer.realPath]

    def having(self, noun: str) -> list[Usd.Prim]:
        """The prims with a schema of magtwin's, by its noun."""
        return prims_with(self.stage.GetPseudoRoot(), noun)

    def name_of(self, layer: Sdf.Layer) -> str:
        """A layer's file, as seen from the folder."""
        path = Path(layer.realPath).resolve()
        return path.relative_to(self.folder).as_posix() if path.is_relative_to(self.folder) else str(path)


@dataclass(frozen=True)
class Rule:
    """A rule."""

    name: str

    sentence: str
    """What holds of a stage that keeps it."""

    advice: str
    """What to do where it is broken."""

    look: Callable[[Subject], Iterator[Wrong]]

    def findings(self, subject: Subject) -> list[Finding]:
        """What breaks it; a refusal on the way breaks it too, and a stage too wrong to be looked at."""
        found: list[Wrong] = []
        try:
            found.extend(self.look(subject))
        except InputError as error:
            found.append(wrong_of(error))
        except (
            Tf.ErrorException,
            ArithmeticError,
            AttributeError,
            LookupError,
            TypeError,
            ValueError,
        ) as error:
            said = " ".join(str(error).split())
            text = f"cannot be looked at, a value is not of its kind ({type(error).__name__}: {said[:SAID]})"
            found.append(Wrong(text, advice="author it anew; docs/schema.md says what each value is"))
        return [
            Finding(self.name, wrong.text, wrong.where, wrong.advice or self.advice, wrong.severity)
            for wrong in found
        ]


def rule_into(
    rules: dict[str, Rule], advice: str
) -> Callable[[Callable[[Subject], Iterator[Wrong]]], Callable[[Subject], Iterator[Wrong]]]:
    """Enter a function among the rules: its name with hyphens, its docstring's first line the sentence."""

    def enter(look: Callable[[Subject], Iterator[Wrong]]) -> Callable[[Subject], Iterator[Wrong]]:
        name = look.__name__.replace("_", "-")
        rules[name] = Rule(name, (look.__doc__ or "").split("\n")[0], advice, look)
        return look

    return enter


def wrong_of(error: InputError) -> Wrong:
    """A refusal as what it says is wrong, its prim taken out of the text."""
    text = str(error)
    told = _WHERE.match(text)
    return Wrong(told["text"], told["prim"]) if told else Wrong(text)


@dataclass(frozen=True)
class Named:
    """A file that a layer names."""

    path: str
    """The asset path, as it is written."""

    where: str
    """Prim or property that names it, "" for the layer itself."""


def named_files(layer: Sdf.Layer) -> list[Named]:
    """Every asset path that a layer authors, with the prim that does, in order of the layer."""
    found = [Named(path, "") for path in layer.subLayerPaths]

    def visit(path: Sdf.Path) -> None:
        spec = layer.GetObjectAtPath(path)
        if isinstance(spec, Sdf.PrimSpec):
            for listed in (spec.referenceList, spec.payloadList):
                arcs = listed.GetAddedOrExplicitItems()
                found.extend(Named(arc.assetPath, str(path)) for arc in arcs if arc.assetPath)
        elif isinstance(spec, Sdf.AttributeSpec) and spec.typeName in _ASSETS:
            values = [spec.default, *map(spec.layer.QueryTimeSample, *_times(layer, path))]
            for value in values:
                many = [value] if isinstance(value, Sdf.AssetPath) else value or ()
                found.extend(Named(one.path, str(path)) for one in many if one.path)

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    seen = {named.path for named in found}
    copy = Sdf.Layer.CreateAnonymous(".usda")
    copy.TransferContent(layer)

    def keep(path: str) -> str:  # what stands in metadata, such as clips
        if path and path not in seen:
            found.append(Named(path, ""))
        return path

    UsdUtils.ModifyAssetPaths(copy, keep)
    return found


_ASSETS = (Sdf.ValueTypeNames.Asset, Sdf.ValueTypeNames.AssetArray)


def _times(layer: Sdf.Layer, path: Sdf.Path) -> tuple[list[Sdf.Path], list[float]]:
    times = layer.ListTimeSamplesForPath(path)
    return [path] * len(times), times


def is_absolute(path: str) -> bool:
    """Whether an asset path holds on one machine, or on a network, alone."""
    return bool(re.match(r"^(/|\\|[A-Za-z]:[\\/]|[A-Za-z][A-Za-z0-9+.-]+:)", path))


def climbs(path: str, layer: Sdf.Layer, folder: Path) -> bool:
    """Whether a relative asset path of a layer leads out of a folder."""
    lands = Path(os.path.normpath(Path(layer.realPath).resolve().parent / path))
    return not lands.is_relative_to(folder)
