"""Decorators that add to magtwin without a fork. `examples/extend/` has an example of each.

| decorator | what it registers | use |
|---|---|---|
| `@sensor("name")` | `magtwin.sim.extensions.Sensor` | `simulate(..., sensors=["name"])` |
| `@interference("name")` | `magtwin.sim.extensions.Interference` | `simulate(..., interference=["name"])` |
| `@controller("name")` | `magtwin.sim.motion.controllers.Controller` | `simulate(..., controller="name")` |
| `@engine("name")` | `magtwin.sim.motion.engine.Engine` | `simulate(..., engine="name")` |
| `@path("name")` | a function that returns points or a `Path` | `simulate(twin, "name")` |
| `@map_method("name")` | `magtwin.field.fit.methods.MapMethod` | `fit_map(survey, "name")` |
| `@predictor("name")` | `magtwin.learn.models.predictor.PredictorKind` | `train(dataset, model="name")` |
| `@log_format(".suffix")` | `magtwin.io.formats.Format` | `run.save("run.suffix")`, `load_run` |
| `@rule("magtwin", advice)` | a function that checks a stage | `validate(stage)` |

An installed package can announce them as entry points instead, in the groups `magtwin.sensors`,
`magtwin.interference`, `magtwin.controllers`, `magtwin.engines`, `magtwin.paths`, `magtwin.map_methods`,
`magtwin.predictors` and `magtwin.formats`; then they are known on the command line too.
"""

import importlib
from typing import Any

_NAMES = {
    "Column": "run.run:Column",
    "controller": "sim.extensions:controller",
    "engine": "sim.extensions:engine",
    "interference": "sim.extensions:interference",
    "log_format": "io.formats:FORMATS.register",
    "map_method": "field.fit.methods:map_method",
    "path": "path:path",
    "predictor": "learn.models.predictor:PREDICTORS.register",
    "rule": "export.validation.rule:rule",
    "sensor": "sim.extensions:sensor",
}


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
