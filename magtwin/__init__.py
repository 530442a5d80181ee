"""magtwin: magnetic digital twins of robots, authored in USD.

A Scene goes in (lab, robot, map, sensors), a Run comes out (what every sensor would have read).
Names are loaded when first used, so that `import magtwin` costs nothing.
"""

import importlib
from typing import TYPE_CHECKING, Any

from magtwin.version import __version__ as __version__

if TYPE_CHECKING:
    from magtwin.field.map import AnomalyMap
    from magtwin.io.plotting import plot
    from magtwin.names import MismatchWarning, RefusedError
    from magtwin.path import Path
    from magtwin.run import COLUMNS, Run
    from magtwin.spec import Scene
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
    "AnomalyMap": "magtwin.field.map",
    "COLUMNS": "magtwin.run",
    "MismatchWarning": "magtwin.names",
    "Path": "magtwin.path",
    "RefusedError": "magtwin.names",
    "Run": "magtwin.run",
    "Scene": "magtwin.spec",
    "Twin": "magtwin.twin",
    "author_scene": "magtwin.twin",
    "open_twin": "magtwin.twin",
    "plot": "magtwin.io.plotting",
    "scene_from_toml": "magtwin.twin",
    "simulate": "magtwin.twin",
    "simulate_many": "magtwin.twin",
    "simulate_robots": "magtwin.twin",
}

__all__ = [
    "COLUMNS",
    "AnomalyMap",
    "MismatchWarning",
    "Path",
    "RefusedError",
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
