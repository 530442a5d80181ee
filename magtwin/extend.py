"""Decorators that add to magtwin without a fork. `examples/extend/` has examples.

| decorator | what it registers | use |
|---|---|---|
| `@sensor("name")` | `magtwin.sim.extensions.Sensor` | `simulate(..., sensors=["name"])` |
| `@interference("name")` | `magtwin.sim.extensions.Interference` | `simulate(..., interference=["name"])` |
| `@controller("name")` | `magtwin.sim.motion.controllers.Controller` | `simulate(..., controller="name")` |
| `@engine("name")` | `magtwin.sim.motion.engine.Engine` | `simulate(..., engine="name")` |
| `@path("name")` | a function that returns points or a `Path` | `simulate(twin, "name")` |
| `@map_method("name")` | `magtwin.field.fit.methods.MapMethod` | `fit_map(survey, "name")` |
| `@network("name")` | a `torch.nn.Module` of your own | `load_predictor`, `open_twin(..., network="file")` |
| `@predictor("name")` | `magtwin.learn.models.predictor.PredictorKind` | `train(dataset, model="name")` |
| `@log_format(".suffix")` | `magtwin.io.formats.Format` | `run.save("run.suffix")`, `load_run` |
| `@localizer("name")` | `magtwin.localization.problem.Localizer` | `localize(run, map, method="name")` |
| `@rule("magtwin", advice)` | a function that checks a stage | `validate(stage)` |

An installed package can announce them as entry points instead, in the groups `magtwin.sensors`,
`magtwin.interference`, `magtwin.controllers`, `magtwin.engines`, `magtwin.paths`, `magtwin.map_methods`,
`magtwin.predictors`, `magtwin.networks`, `magtwin.localizers`, `magtwin.formats` and `magtwin.rules`; then
the command line knows those that it has an option for:

    [project.entry-points."magtwin.map_methods"]
    kriging = "my_package.kriging:fit_kriging"
"""

import importlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar

from magtwin.errors import InputError, find

T = TypeVar("T")
C = TypeVar("C")

_NAMES = {
    "Column": "run.run:Column",
    "controller": "sim.extensions:controller",
    "engine": "sim.extensions:engine",
    "interference": "sim.extensions:interference",
    "localizer": "localization.localizers:localizer",
    "log_format": "io.formats:FORMATS.register",
    "map_method": "field.fit.methods:map_method",
    "network": "learn.models.predictor:NETWORKS.register",
    "path": "path:path",
    "predictor": "learn.models.predictor:PREDICTORS.register",
    "rule": "export.validation.rule:rule",
    "sensor": "sim.extensions:sensor",
}
"""Place of each decorator, loaded when first used."""


class Registry(Mapping[str, T]):
    """Objects by name, such as map methods: built-in, registered by a decorator, or of installed packages.

    Values of the mapping are loaded when first read.

    Args:
        kind: What an entry is, in the singular, for messages ("map method").
        group: Entry points of group `magtwin.<group>` belong to it.
        builtin: "module:object" by name.
    """

    def __init__(self, kind: str, group: str, builtin: Mapping[str, str] | None = None) -> None:
        self.kind, self.group = kind, f"magtwin.{group}"
        self._builtin = dict(builtin or {})
        self._loaded: dict[str, T] = {}
        self._installed: dict[str, Any] | None = None

    def register(self, name: str) -> Callable[[C], C]:
        """Decorate a function or a class: it gets a name in this registry.

        Raises:
            InputError: The name is taken.
        """

        def add(entry: C) -> C:
            if name in self._builtin or self._loaded.get(name, entry) is not entry:
                raise InputError(f"{self.kind} {name!r} exists already; use another name")
            self._loaded[name] = entry  # type: ignore[assignment]
            return entry

        return add

    def __getitem__(self, name: str) -> T:
        """The entry called `name`.

        Raises:
            UnknownNameError: No such entry; the text has the nearest name.
            InputError: An installed package announces the entry, but it cannot be loaded.
        """
        if name not in self._loaded:
            if name in self._builtin:
                module, _, path = self._builtin[name].partition(":")
                self._loaded[name] = getattr(importlib.import_module(module), path)
            else:
                find(self.kind, name, dict.fromkeys(self))
                point = self._entry_points()[name]
                try:
                    self._loaded[name] = point.load()
                except Exception as error:
                    raise InputError(
                        f"{self.kind} {name!r}: {point.value} of group {self.group} does not load: {error}"
                    ) from error
        return self._loaded[name]

    def __iter__(self) -> Iterator[str]:
        """All names: built-in ones first, then registered and installed ones."""
        return iter(dict.fromkeys([*self._builtin, *self._loaded, *self._entry_points()]))

    def __len__(self) -> int:
        return len(list(iter(self)))

    def __contains__(self, name: object) -> bool:
        return name in self._builtin or name in self._loaded or name in self._entry_points()

    def _entry_points(self) -> dict[str, Any]:
        if self._installed is None:
            from importlib.metadata import entry_points

            self._installed = {point.name: point for point in entry_points(group=self.group)}
        return self._installed


def __getattr__(name: str) -> Any:
    if name not in _NAMES:
        raise AttributeError(f"module 'magtwin.extend' has no attribute {name!r}")
    module, _, attributes = _NAMES[name].partition(":")
    found: Any = importlib.import_module(f"magtwin.{module}")
    for attribute in attributes.split("."):
        found = getattr(found, attribute)
    return found


def __dir__() -> list[str]:
    return sorted(_NAMES)
