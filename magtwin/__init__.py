"""magtwin: magnetic digital twins of robots, authored in USD.

A Scene goes in (lab, robot, map, sensors), a Run comes out (what every sensor would have read).
Names are loaded when first used, so that `import magtwin` costs nothing.
"""

import importlib
from typing import TYPE_CHECKING, Any

from magtwin.version import __version__ as __version__

if TYPE_CHECKING:
    from magtwin.errors import InputError, MismatchWarning
    from magtwin.field.maps.map import AnomalyMap
    from magtwin.figures.plot import plot
    from magtwin.path import Path
    from magtwin.run.run import COLUMNS, Run
    from magtwin.spec.scene import Scene
    from magtwin.twin import (
        Twin,
        author_scene,
        open_twin,
        scene_from_toml,
        simulate,
        simulate_many,
        simulate_robots,
    )

_HOME = {
    "AnomalyMap": "magtwin.field.maps.map",
    "COLUMNS": "magtwin.run.run",
    "MismatchWarning": "magtwin.errors",
    "Path": "magtwin.path",
    "InputError": "magtwin.errors",
    "Run": "magtwin.run.run",
    "Scene": "magtwin.spec.scene",
    "Twin": "magtwin.twin",
    "author_scene": "magtwin.twin",
    "open_twin": "magtwin.twin",
    "plot": "magtwin.figures.plot",
    "scene_from_toml": "magtwin.twin",
    "simulate": "magtwin.twin",
    "simulate_many": "magtwin.twin",
    "simulate_robots": "magtwin.twin",
}

__all__ = [
    "COLUMNS",
    "AnomalyMap",
    "InputError",
    "MismatchWarning",
    "Path",
    "Run",
    "Scene",
    "Twin",
    "author_scene",
    "open_twin",
    "plot",
    "scene_from_toml",
    "simulate",
    "simulate_many",
    "simulate_robots",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'magtwin' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
