"""Twin: a scene opened with its map and its network, ready to simulate.

`opening` opens scenes, `simulation` makes one run, `robots` one of each robot, `sweeps` many, and `authoring`
writes scenes from TOML. Names are loaded when first used, so that who simulates does not load who authors.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from magtwin.twin.authoring import *  # noqa: F403
    from magtwin.twin.maps import *  # noqa: F403
    from magtwin.twin.opening import *  # noqa: F403
    from magtwin.twin.robot_scene import *  # noqa: F403
    from magtwin.twin.robots import *  # noqa: F403
    from magtwin.twin.session import *  # noqa: F403
    from magtwin.twin.simulation import *  # noqa: F403
    from magtwin.twin.sweeps import *  # noqa: F403
    from magtwin.twin.twin import *  # noqa: F403

_NAMES = {
    "authoring": "author_scene new_scene scene_from_toml",
    "opening": "check_scene lab_and_map led_by locate open_twin open_unwritten scene_of twin_of",
    "maps": "survey",
    "robot_scene": "scene_with_robot",
    "robots": "simulate_robots",
    "simulation": "engine_named scan simulate",
    "sweeps": "MIXTURE sweep",
    "session": "in_session in_session_of model_error_of room_of trained_on with_plant",
    "twin": "Kind Session Twin",
}
"""Public names by their modules."""

_MODULES = {name: module for module, names in _NAMES.items() for name in names.split()}


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module 'magtwin.twin' has no attribute {name!r}")
    return getattr(importlib.import_module(f"magtwin.twin.{_MODULES[name]}"), name)
