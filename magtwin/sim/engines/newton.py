"""Newton: physics in the stage itself, with its bodies, contacts and drives (extra `physics`)."""

import importlib.util
import math
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from magtwin.errors import InputError
from magtwin.sim.engines.sampled import SampledMotion
from magtwin.sim.engines.world_process import WorldProcess
from magtwin.sim.motion.closed_loop import ClosedLoop
from magtwin.sim.motion.controllers import Controller
from magtwin.sim.motion.drive import limiter, wheel_rates
from magtwin.sim.motion.loop import LATE_S, REST_M_S, wrapped
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.robot import RobotSpec

STEP_S = 0.001
"""Default length of a physics step [s]."""

TOUCH_M = 0.003
"""Distance at which the footprint counts as touching an obstacle [m], since shapes are not circles."""

PLACED = "placed.usda"
"""Name of the stage with its lab at the origin."""

UPRIGHT = 0.8
"""Cosine of the tilt at which the robot counts as fallen over."""


@dataclass(frozen=True)
class Newton:
    """A robot in Newton on the CPU; the same commands give the same bytes.

    Commands are limited, and the wheels' set speeds follow with the motors' lag, as in the kinematic engine;
    the rest is physics. Wheels slip according to the stage's contact and scrub on curves according to their
    width. If the drive's `yaw_slip` is 0, they roll on the middle of their treads. Errors of radius and
    separation scale the set speeds.
    """

    stage: FilePath
    """Root layer of the scene."""

    robot: RobotSpec
    """The robot to drive; it is found in the stage by its name."""

    progress: Callable[[int, int, str], Any] | None = None
    """Called ten times a simulated second with steps done, steps at most, and the time as text."""

    step_s: float = STEP_S
    """Approximate length of a physics step [s]; a control step has a whole number of them."""

    placed: str = ""
    """Text of a stage that Newton loads instead: `stage` with its lab at the origin. "" loads `stage`."""

    name = "newton"

    def drive(
        self, closed_loop: ClosedLoop, controller: Controller | None, obstacles: Obstacles | None
    ) -> SampledMotion:
        """As for `magtwin.sim.motion.engine.Engine`."""
        check_installed()
        obstacles = obstacles or Obstacles()
        closed_loop.check(obstacles)
        drive, dt = closed_loop.drive, closed_loop.dt
        guide: Controller = replace(closed_loop.guide) if controller is None else controller
        limit, parts = limiter(drive, dt), max(1, round(dt / self.step_s))
        step = dt / parts
        left = math.exp(-step / drive.motor_lag_s) if drive.motor_lag_s else 0.0
        in_mean = drive.motor_lag_s / step * (1.0 - left)
        target, wheels, last, age = (0.0, 0.0), (0.0, 0.0), (0.0, 0.0), 0.0
        radius, separation = (1.0 + error for error in closed_loop.wheel_errors)
        rest_w = REST_M_S * 2 / drive.wheel_separation_m
        commanded: list[tuple[float, float]] = []
        with self.world(closed_loop, step) as world:
            rows = [world.seen()]
            yaw = rows[0][2]
            for k in range(closed_loop.steps):
                if self.progress is not None and k % max(1, round(0.1 / dt)) == 0:
                    self.progress(k, closed_loop.steps, f"{k * dt:.1f} s driven")
                pose = closed_loop.pose_error.perceived(k * dt, (rows[-1][0], rows[-1][1], yaw), *wheels)
                command = guide.command(k * dt, *pose, *wheels)
                age = 0.0 if command is not None else age + dt
                if command is not None:
                    last = float(command[0]), float(command[1])
                    if not all(map(math.isfinite, last)):
                        text = f"the command at {k * dt:.3f} s is not finite: v, w = {last!r}"
                        raise InputError(f"{text}; a controller must give numbers")
                elif age > drive.command_timeout_s + LATE_S:
                    last = 0.0, 0.0
                target = limit(*last, *target)
                rates = []
                for _ in range(parts):
                    mean = [b + in_mean * (a - b) for a, b in zip(wheels, target, strict=True)]
                    (v, w), (v0, w0) = wheels, target
                    wheels = v0 + left * (v - v0), w0 + left * (w - w0)
                    rolls = mean[0] * radius, mean[1] * radius / separation
                    rates.append(wheel_rates(*rolls, drive).tolist())
                if target == (0.0, 0.0) and abs(wheels[0]) < REST_M_S and abs(wheels[1]) < rest_w:
                    wheels = 0.0, 0.0
                rows.append(world.ask(rates))
                commanded.append(last)
                yaw += wrapped(rows[-1][2] - yaw)
                if rows[-1][8] < UPRIGHT or not math.isfinite(rows[-1][7]):
                    text = f"{self.robot.name} fell over in Newton after {(k + 1) * dt:.2f} s"
                    way = "drive more gently, or look at its masses and colliders"
                    raise InputError(f"{self.stage}: {text}; {way}")
                if guide.done and wheels == (0.0, 0.0):
                    break
        seen = np.array(rows)
        commands = np.array([*commanded, commanded[-1]])
        both, apart = (seen[:, 5] + seen[:, 6]) / radius, (seen[:, 6] - seen[:, 5]) * separation / radius
        distance, _ = obstacles.clearance(seen[:, :2], reach_m=closed_loop.footprint_radius_m + 1.0)
        return SampledMotion(
            t=np.arange(len(seen), dtype=float) * dt,
            pose=np.column_stack([seen[:, :2], np.unwrap(seen[:, 2])]),
            v=seen[:, 3],
            w=seen[:, 4],
            wheel_angle=np.column_stack([both - apart, both + apart]) / 2,
            v_cmd=commands[:, 0],
            w_cmd=commands[:, 1],
            bump=distance < closed_loop.footprint_radius_m + TOUCH_M,
            duration_s=(len(seen) - 1) * dt,
        )

    def world(self, closed_loop: ClosedLoop, step_s: float) -> WorldProcess:
        """The process that steps the stage."""
        drive, root = closed_loop.drive, str(FilePath(__file__).resolve().parents[3])
        job = {
            "stage": PLACED if self.placed else str(FilePath(self.stage).resolve()),
            "robot": self.robot.name,
            "base": "base_link",
            "joints": list(drive.sides),
            "sides": list(drive.sides.values()),
            "start": list(closed_loop.pose0),
            "step_s": step_s,
            "scrub": drive.yaw_slip > 0,
        }
        path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
        command = [sys.executable, "-m", "magtwin.sim.engines.newton_world"]
        files = {PLACED: self.placed} if self.placed else {}
        return WorldProcess(command, job, "Newton", changes={"PYTHONPATH": path}, files=files)


def check_installed() -> None:
    """Refuse to run without Newton; the text says how to install it."""
    lacking = [m for m in ("newton", "newton_usd_schemas", "mujoco") if importlib.util.find_spec(m) is None]
    if lacking:
        raise InputError(
            f"the engine newton needs {', '.join(lacking)}, which is not installed; get it (600 MB) with: "
            "pip install 'magtwin[physics]'"
        )
