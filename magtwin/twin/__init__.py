"""Twin: a scene opened with its map and its network, ready to simulate.

`opening` opens scenes, `simulation` makes one run, `sweeps` many, and `authoring` writes scenes from TOML.
"""

from magtwin.files.kinds import scene_file, shipped_or
from magtwin.twin.authoring import author_scene, new_scene, scene_from_toml
from magtwin.twin.opening import (
    check_scene,
    lab_and_map,
    led_by,
    locate,
    open_twin,
    scene_of,
    twin_of,
)
from magtwin.twin.robot_scene import scene_with_robot
from magtwin.twin.simulation import engine_named, path_metadata, scan, simulate, simulate_robots
from magtwin.twin.sweeps import MIXTURE, sweep
from magtwin.twin.twin import (
    Kind,
    Session,
    Twin,
    in_session,
    in_session_of,
    model_error_of,
    room_of,
    trained_on,
    with_plant,
    without_model_error,
)

__all__ = [
    "MIXTURE",
    "Kind",
    "Session",
    "Twin",
    "author_scene",
    "check_scene",
    "engine_named",
    "in_session",
    "in_session_of",
    "lab_and_map",
    "led_by",
    "locate",
    "model_error_of",
    "new_scene",
    "open_twin",
    "path_metadata",
    "room_of",
    "scan",
    "scene_file",
    "scene_from_toml",
    "scene_of",
    "scene_with_robot",
    "shipped_or",
    "simulate",
    "simulate_robots",
    "sweep",
    "trained_on",
    "twin_of",
    "with_plant",
    "without_model_error",
]
