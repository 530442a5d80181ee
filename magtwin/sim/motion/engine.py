"""Engine: what moves a robot. All engines take the same commands, and sensors read each alike."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from magtwin.extend import Registry
from magtwin.run import mapped
from magtwin.sim.motion.closed_loop import BLOCK, Chassis, ClosedLoop, motion_of, run_loops
from magtwin.sim.motion.controllers import Controller
from magtwin.sim.motion.drive import Motion
from magtwin.sim.motion.sampling import Moving
from magtwin.spec.obstacles import Obstacles

Array = NDArray[np.float64]


class Travel(Moving, Protocol):
    """What a robot did, from its start to its end."""

    @property
    def duration_s(self) -> float:
        """Time from the start to the end [s]."""


class Engine(Protocol):
    """Moves a robot."""

    @property
    def name(self) -> str:
        """Its name in the metadata of a run."""

    def drive(
        self, closed_loop: ClosedLoop, controller: Controller | None, obstacles: Obstacles | None
    ) -> Travel:
        """Drive until the controller is done and the robot stands, or the steps are over.

        Args:
            closed_loop: The robot, its start, and its guide.
            controller: Replaces `closed_loop.guide`; None for that.
            obstacles: What stands in the room.
        """


ENGINES: Registry[Engine] = Registry(
    "engine", "engines", {"kinematic": "magtwin.sim.motion.engine:KINEMATIC"}
)
"""Registered engines; see `magtwin.sim.extensions`."""


class Kinematic:
    """The closed loop of `loop.py`: wheels follow their commands with a lag, slip, and stop at walls."""

    name = "kinematic"

    def drive(
        self, closed_loop: ClosedLoop, controller: Controller | None, obstacles: Obstacles | None
    ) -> Motion:
        """As for `Engine`."""
        if controller is None:
            return run_loops([closed_loop], obstacles)[0]
        chassis, rows, records = Chassis(closed_loop, obstacles), list[Array](), list[Array]()
        for k in range(closed_loop.steps):
            t = k * closed_loop.dt
            pose = closed_loop.pose_error.perceived(t, chassis.pose, *chassis.twist)
            rows.append(chassis.step(controller.command(t, *pose, *chassis.twist)))
            last = k + 1 == closed_loop.steps or (controller.done and chassis.twist == (0.0, 0.0))
            if last or len(rows) == BLOCK:
                records.append(np.array(rows).T)
                rows.clear()
                mapped.settle(records)
            if last:
                break
        return motion_of(closed_loop, mapped.joined(records))


KINEMATIC = Kinematic()
