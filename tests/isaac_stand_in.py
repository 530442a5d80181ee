"""Run a script for Isaac Sim where there is none: its modules' names, and a robot that rolls without slip.

    python isaac_stand_in.py SCRIPT.py ARGUMENTS...

Shows that the script itself is sound, not that Isaac Sim has what it calls.
"""

import math
import runpy
import sys
import types
from pathlib import Path

import numpy as np
from pxr import Usd

RADIUS, SEPARATION = 0.03575, 0.233


class Array:
    """As Warp's."""

    def __init__(self, values):
        self.values = np.asarray(values)

    def numpy(self):
        return self.values

    def list(self):
        return self.values.tolist()


class Robot:
    """The one robot: pose, speeds, and the rates that its wheels were told."""

    x = y = yaw = v = w = dt = 0.0
    told = np.zeros(2)


class Articulation:
    """Left and right are the degrees of freedom 1 and 0, so that their order counts."""

    def __init__(self, path):
        self.path = path

    def get_dof_indices(self, name):
        return Array([["right_wheel_joint", "left_wheel_joint"].index(name)])

    def set_world_poses(self, *, positions, orientations):
        Robot.x, Robot.y, _ = positions
        Robot.yaw = 2 * math.atan2(orientations[3], orientations[0])

    def set_dof_velocity_targets(self, rates, *, dof_indices):
        Robot.told[dof_indices] = rates


class RigidPrim:
    """The base."""

    def __init__(self, path):
        self.path = path

    def get_world_poses(self):
        half = Robot.yaw / 2
        return Array([[Robot.x, Robot.y, 0.0]]), Array([[math.cos(half), 0.0, 0.0, math.sin(half)]])

    def get_velocities(self):
        along = Robot.v * np.array([math.cos(Robot.yaw), math.sin(Robot.yaw), 0.0])
        return Array([along]), Array([[0.0, 0.0, Robot.w]])


class SimulationManager:
    @staticmethod
    def setup_simulation(*, dt, device):
        Robot.dt = dt

    @staticmethod
    def step(*, steps):
        right, left = Robot.told * RADIUS
        Robot.v, Robot.w = (left + right) / 2, (right - left) / SEPARATION
        for _ in range(steps):
            Robot.yaw += Robot.w * Robot.dt
            Robot.x += Robot.v * math.cos(Robot.yaw) * Robot.dt
            Robot.y += Robot.v * math.sin(Robot.yaw) * Robot.dt


class SimulationApp:
    def __init__(self, settings):
        self.settings = settings

    def update(self):
        pass

    def close(self):
        pass


def module(name, **things):
    """A module of this name, with all above it."""
    parts = name.split(".")
    for k in range(1, len(parts)):
        sys.modules.setdefault(".".join(parts[:k]), types.ModuleType(".".join(parts[:k])))
    made = sys.modules.setdefault(name, types.ModuleType(name))
    vars(made).update(things)
    for k in range(len(parts) - 1, 0, -1):
        setattr(sys.modules[".".join(parts[:k])], parts[k], sys.modules[".".join(parts[: k + 1])])


module("isaacsim", SimulationApp=SimulationApp)
module("isaacsim.core.experimental.utils.stage", open_stage=lambda path: (True, Usd.Stage.Open(path)))
module("isaacsim.core.experimental.prims", Articulation=Articulation, RigidPrim=RigidPrim)
module("isaacsim.core.simulation_manager", SimulationManager=SimulationManager)
module(
    "omni.timeline",
    get_timeline_interface=lambda: types.SimpleNamespace(play=lambda: None),
)

if __name__ == "__main__":
    del sys.argv[0]
    sys.path.insert(0, str(Path(sys.argv[0]).parent))
    runpy.run_path(sys.argv[0], run_name="__main__")
