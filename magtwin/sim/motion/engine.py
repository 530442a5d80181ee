"""Engine: what moves a robot that is commanded. All are told the same, and sensors read each alike."""

from typing import Protocol

from magtwin.sim.motion.closed_loop import Chassis, ClosedLoop, run_loops
from magtwin.sim.motion.controllers import Controller
from magtwin.sim.motion.drive import Motion
from magtwin.sim.motion.sampling import Moving
from magtwin.spec.obstacles import Obstacles


class Travel(Moving, Protocol):
    """What a robot did, from its start to its end."""

    @property
    def duration_s(self) -> float:
        """Time from the start to the end [s]."""


class Engine(Protocol):
    """What moves a robot."""

    @property
    def name(self) -> str:
        """What it is called in the metadata of a run."""

    def drive(self, course: ClosedLoop, controller: Controller | None, obstacles: Obstacles | None) -> Travel:
        """Drive until the controller is done and the robot stands, or the course's steps are over.

        Args:
            course: The robot, its start, and what guides it.
            controller: What guides it in place of `course.guide`; None for that.
            obstacles: What stands in the room.
        """


class Kinematic:
    """The closed loop of `loop.py`: wheels that follow their commands with a lag, slip, and stop at walls."""

    name = "kinematic"

    def drive(self, course: ClosedLoop, controller: Controller | None, obstacles: Obstacles | None) -> Motion:
        """As for `Engine`."""
        if controller is None:
            return run_loops([course], obstacles)[0]
        chassis = Chassis(course, obstacles)
        for k in range(course.steps):
            chassis.step(controller.command(k * course.dt, *chassis.pose, *chassis.twist))
            if controller.done and chassis.twist == (0.0, 0.0):
                break
        return chassis.motion()
