"""Stand-ins for the Kit modules that Isaac Sim's rule files import, so that the rules run on usd-core.

A rule that calls anything else of Kit, such as a step of PhysX, raises `NeedsKitError` and is listed as not
run.
Used only in the process of `isaac_run`, since it replaces methods of `Usd.Prim`.
"""

import importlib.abc
import importlib.machinery
import sys
import types
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pxr
from pxr import Usd

from magtwin.export.validation.findings import Severity

KIT = ("omni", "carb", "usdrt")
"""Packages of Kit. Any module in them can be imported; a call of what it holds raises `NeedsKitError`."""

APPLIED_AS = {"JointStateAPI": "PhysicsJointStateAPI"}
"""Name with which a class of PhysxSchema is applied, where it differs from the name of the class."""

FALLBACKS: dict[str, tuple[str, float]] = {
    "JointStateAPI.Position": ("state:{}:physics:position", 0.0),
    "JointStateAPI.Velocity": ("state:{}:physics:velocity", 0.0),
    "PhysxJointAPI.MaxJointVelocity": ("physxJoint:maxJointVelocity", 1e6),
    "PhysxMimicJointAPI.Gearing": ("physxMimicJoint:{}:gearing", 1.0),
}
"""Attributes of PhysxSchema's classes that rules read: name on the prim, and value if it is not authored."""


class NeedsKitError(Exception):
    """A rule called a part of Kit that has no stand-in."""


@dataclass(frozen=True)
class Issue:
    """What a rule found."""

    severity: Severity
    text: str
    at: Any = None
    """Stage, prim or property; None for nothing of the stage."""

    advice: str = ""


class BaseRuleChecker:
    """Base class of rules: collects what they find."""

    def __init__(self, *_: Any, **__: Any) -> None:
        self.issues: list[Issue] = []

    def _add(self, severity: Severity, message: str, at: Any, suggestion: Any) -> None:
        advice = suggestion.message if isinstance(suggestion, Suggestion) else ""
        self.issues.append(Issue(severity, message, at, advice))

    def _AddError(self, message: str = "", at: Any = None, suggestion: Any = None, **_: Any) -> None:
        self._add("error", message, at, suggestion)

    _AddFailedCheck = _AddError

    def _AddWarning(self, message: str = "", at: Any = None, suggestion: Any = None, **_: Any) -> None:
        self._add("warning", message, at, suggestion)

    def _AddInfo(self, message: str = "", at: Any = None, suggestion: Any = None, **_: Any) -> None:
        self._add("note", message, at, suggestion)

    def CheckStage(self, stage: Usd.Stage) -> None:
        """Check a stage; rules override it."""

    def CheckPrim(self, prim: Usd.Prim) -> None:
        """Check a prim; rules override it."""


class Suggestion:
    """A fix of an issue. Only its message is kept: magtwin never calls it."""

    def __init__(self, message: str = "", *_: Any, **__: Any) -> None:
        self.message = message


REGISTERED: list[tuple[str, type[BaseRuleChecker]]] = []
"""Category and class of every rule, in the order in which the files register them."""


def register_rule(category: str, *_: Any, **__: Any) -> Any:
    """Decorator with which a file registers a rule."""

    def register(rule: type[BaseRuleChecker]) -> type[BaseRuleChecker]:
        REGISTERED.append((category, rule))
        return rule

    return register


class _Absent:
    """Part of Kit without a stand-in. It can be named, subclassed and passed on, but not called."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> "_Absent":
        if name.startswith("__"):
            raise AttributeError(name)
        return _Absent(f"{self._name}.{name}")

    def __mro_entries__(self, bases: Any) -> tuple[type, ...]:
        return ()

    def __call__(self, *_: Any, **__: Any) -> Any:
        raise NeedsKitError(self._name)


class _Module(types.ModuleType):
    """A module whose names are all there: those that it is given, else `_Absent`."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.__path__ = []

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _Absent(f"{self.__name__}.{name}")


class _KitFinder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds every module below `KIT`."""

    def find_spec(self, fullname: str, path: Any, target: Any = None) -> Any:
        if fullname.split(".")[0] not in KIT:
            return None
        return importlib.machinery.ModuleSpec(fullname, self, is_package=True)

    def create_module(self, spec: Any) -> types.ModuleType:
        return _Module(spec.name)

    def exec_module(self, module: types.ModuleType) -> None:
        pass


class _Unauthored:
    """An attribute of an applied schema that no layer authors."""

    def __init__(self, prim: Usd.Prim, name: str, value: float) -> None:
        self.prim, self.name, self.value = prim, name, value

    def IsDefined(self) -> bool:
        return True

    def Get(self) -> float:
        return self.value

    def GetPath(self) -> Any:
        return self.prim.GetPath().AppendProperty(self.name)


class _PhysxApi:
    """Class of PhysxSchema: a schema by its applied name, and the attributes in `FALLBACKS`."""

    schema = ""

    def __init__(self, prim: Usd.Prim, instance: str = "") -> None:
        self.prim, self.instance = prim, str(instance)

    def __bool__(self) -> bool:
        return has_api(self.prim, type(self), self.instance or None)

    def __getattr__(self, name: str) -> Any:
        kind = type(self).__name__
        known = FALLBACKS.get(f"{kind}.{name.removeprefix('Get').removesuffix('Attr')}")
        if known is None and name == "GetReferenceJointRel":
            return lambda: self.prim.GetRelationship(f"physxMimicJoint:{self.instance}:referenceJoint")
        if known is None:
            return _Absent(f"PhysxSchema.{kind}.{name}")
        attribute = self.prim.GetAttribute(known[0].format(self.instance))
        if self and not (attribute and attribute.HasAuthoredValue()):
            return lambda: _Unauthored(self.prim, known[0].format(self.instance), known[1])
        return lambda: attribute


class _PhysxSchema(types.ModuleType):
    """Module in which every name is a class of a schema."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        made = type(name, (_PhysxApi,), {"schema": APPLIED_AS.get(name, name)})
        setattr(self, name, made)
        return made


def applied(prim: Usd.Prim) -> list[str]:
    """Names of the schemas applied to a prim, also of those whose plugins are not installed."""
    return list(prim.GetPrimTypeInfo().GetAppliedAPISchemas())


_native_has_api = Usd.Prim.HasAPI


def has_api(prim: Usd.Prim, schema: Any, instance: str | None = None) -> bool:
    """Whether a schema is applied: by a name, a class of PhysxSchema, or as usd-core's `HasAPI`."""
    if isinstance(schema, type) and issubclass(schema, _PhysxApi):
        schema = schema.schema
    if not isinstance(schema, str):
        given = (schema,) if instance is None else (schema, instance)
        return bool(_native_has_api(prim, *given))
    if instance is not None:
        return f"{schema}:{instance}" in applied(prim)
    return any(name == schema or name.startswith(f"{schema}:") for name in applied(prim))


class _Result:
    """omni.client.Result."""

    OK, ERROR_NOT_FOUND = "OK", "ERROR_NOT_FOUND"


class _ItemFlags:
    """omni.client.ItemFlags."""

    CAN_HAVE_CHILDREN = 4


def _entry(path: Path) -> types.SimpleNamespace:
    flags = _ItemFlags.CAN_HAVE_CHILDREN if path.is_dir() else 0
    return types.SimpleNamespace(relative_path=path.name, flags=flags)


def _list(folder: str) -> tuple[str, list[types.SimpleNamespace]]:
    try:
        return _Result.OK, [_entry(path) for path in sorted(Path(folder).iterdir())]
    except OSError:
        return _Result.ERROR_NOT_FOUND, []


def _stat(file: str) -> tuple[str, types.SimpleNamespace | None]:
    path = Path(file)
    return (_Result.OK, _entry(path)) if path.exists() else (_Result.ERROR_NOT_FOUND, None)


def install() -> None:
    """Make the stand-ins importable, and let `Usd.Prim` see schemas without a plugin."""
    sys.meta_path.insert(0, _KitFinder())
    known: dict[str, dict[str, Any]] = {
        "omni.asset_validator.core": {
            "AuthoringLayers": lambda *_: None,
            "BaseRuleChecker": BaseRuleChecker,
            "Suggestion": Suggestion,
            "registerRule": register_rule,
        },
        "omni.client": {"ItemFlags": _ItemFlags, "Result": _Result, "list": _list, "stat": _stat},
    }
    for name, contents in known.items():
        vars(importlib.import_module(name)).update(contents)
    for made in (_PhysxSchema("pxr.PhysxSchema"), _Module("pxr.PhysicsSchemaTools")):
        sys.modules[made.__name__] = made
        setattr(pxr, made.__name__.removeprefix("pxr."), made)
    Usd.Prim.HasAPI = has_api
    Usd.Prim.GetAppliedSchemas = applied
