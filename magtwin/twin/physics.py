"""Physics: the engines that move a robot in the bodies of its stage."""

from collections.abc import Callable
from typing import Any

from magtwin.sim.engines.newton import Newton, check_installed
from magtwin.twin.twin import Twin
from magtwin.usd.scene import as_layer, open_alone


def newton(twin: Twin, progress: Callable[[int, int, str], Any] | None) -> Newton:
    """Newton in the stage of a twin; arguments as for `magtwin.twin.simulation.engine_named`."""
    check_installed()
    placed, robot = "", twin.scene.robot
    if {"lab", "lab_pose"} & twin.metadata.keys():
        placed = as_layer(open_alone(twin.scene_file, robot.name, lab=str(twin.metadata.get("lab", ""))))
    return Newton(twin.scene_file, robot, progress, placed=placed)
