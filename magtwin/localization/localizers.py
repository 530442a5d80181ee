"""Localizers by name: those of magtwin, registered ones, those of installed packages, or `module:Class`."""

import importlib
import inspect
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from magtwin.errors import InputError, hint, is_termination
from magtwin.extend import Registry
from magtwin.localization.problem import Localizer, Smoother

SHIPPED = {
    "bootstrap": "magtwin.localization.particles:Bootstrap",
    "ekf": "magtwin.localization.ekf:Ekf",
    "incremental-slam": "magtwin.localization.slam.incremental_slam:IncrementalSlam",
    "odometry": "magtwin.localization.odometry:Odometry",
    "point-mass": "magtwin.localization.grid.point_mass:PointMass",
    "rbpf": "magtwin.localization.particles:RaoBlackwell",
    "rbpf-iron": "magtwin.localization.particles:RaoBlackwellIron",
    "rbpf-network": "magtwin.localization.particles:RaoBlackwellNetwork",
    "ros": "magtwin.ros.localization.ros_node:RosNode",
    "slam-smoother": "magtwin.localization.slam.slam_smoother:SlamSmoother",
    "smoother": "magtwin.localization.smoother:MapSmoother",
}
"""Places of the classes of magtwin by name."""

LOCALIZERS: Registry[Any] = Registry("localizer", "localizers", SHIPPED)
"""Classes of localizers and smoothers by name."""

localizer = LOCALIZERS.register
"""Decorator that gives a class a name."""


def load_localizer(name: str, options: Mapping[str, Any] | None = None) -> Localizer | Smoother:
    """A new localizer or smoother.

    Args:
        name: A name in `LOCALIZERS`, or "module:Class" of an importable module or of a file in the current
            folder.
        options: Keyword arguments of its class.

    Raises:
        InputError: There is no such localizer, it cannot be imported, an option is unknown or refused, or the
            class has neither the methods `reset` and `step` nor `run`.
    """
    made = _class_of(name)
    options = dict(options or {})
    try:
        known = inspect.signature(made).parameters
    except (TypeError, ValueError):
        known = None
    if known is not None and not any(p.kind is p.VAR_KEYWORD for p in known.values()):
        for key in options:
            if key not in known:
                near = hint(key, known) if known else "it has none"
                raise InputError(f"localizer {name!r} has no option {key!r}; {near}")
    try:
        algorithm = made(**options)
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        if is_termination(error):
            raise
        raise InputError(f"localizer {name!r} cannot be made: {type(error).__name__}: {error}") from error
    if not isinstance(algorithm, Localizer | Smoother):
        raise InputError(f"localizer {name!r} must have the methods reset and step, or run")
    return algorithm


def _class_of(name: str) -> Any:
    if ":" not in name:
        return LOCALIZERS[name]
    module, _, attribute = name.partition(":")
    if module.startswith(".") or module.endswith(".py") or {"/", "\\"} & set(module):
        raise InputError(
            f"localizer {name!r}: give MODULE:CLASS, without folders and .py, such as filters:Mine for the "
            "class Mine in filters.py of the working folder"
        )
    if (here := str(Path.cwd())) not in sys.path:
        sys.path.append(here)  # last, so that a file here hides no installed module
    try:
        made: Any = importlib.import_module(module)
        for part in attribute.split("."):
            if not hasattr(made, part):
                classes = [word for word, value in vars(made).items() if inspect.isclass(value)]
                raise InputError(f"localizer {name!r}: there is no {part!r}; {hint(part, classes)}")
            made = getattr(made, part)
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        if is_termination(error):
            raise
        raise InputError(f"localizer {name!r} cannot be imported: {type(error).__name__}: {error}") from error
    return made
