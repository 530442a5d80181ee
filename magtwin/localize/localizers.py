"""Localizers by name: those of magtwin, registered ones, those of installed packages, or `module:Class`."""

import importlib
import inspect
from collections.abc import Mapping
from typing import Any

from magtwin.errors import InputError, hint
from magtwin.extend import Registry
from magtwin.localize.problem import Localizer, Smoother

LOCALIZERS: Registry[Any] = Registry(
    "localizer",
    "localizers",
    {
        "ekf-slam": "magtwin.localize.slam.ekf_slam:EkfSlam",
        "incremental-slam": "magtwin.localize.slam.incremental_slam:IncrementalSlam",
        "odometry": "magtwin.localize.odometry:Odometry",
        "slam-smoother": "magtwin.localize.slam.slam_smoother:SlamSmoother",
    },
)
"""Classes of localizers and smoothers by name."""

localizer = LOCALIZERS.register
"""Decorator that gives a class a name."""


def load_localizer(name: str, options: Mapping[str, Any] | None = None) -> Localizer | Smoother:
    """A new localizer or smoother.

    Args:
        name: A name in `LOCALIZERS`, or "module:Class" of an importable module.
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
                raise InputError(f"localizer {name!r} has no option {key!r}; {hint(key, known)}")
    try:
        algorithm = made(**options)
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"localizer {name!r} cannot be made: {type(error).__name__}: {error}") from error
    if not isinstance(algorithm, Localizer | Smoother):
        raise InputError(f"localizer {name!r} must have the methods reset and step, or run")
    return algorithm


def _class_of(name: str) -> Any:
    if ":" not in name:
        return LOCALIZERS[name]
    module, _, attribute = name.partition(":")
    try:
        made: Any = importlib.import_module(module)
        for part in attribute.split("."):
            made = getattr(made, part)
    except Exception as error:
        raise InputError(f"localizer {name!r} cannot be imported: {type(error).__name__}: {error}") from error
    return made
