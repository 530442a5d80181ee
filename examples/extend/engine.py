"""A custom engine: the kinematic engine on a slippery floor, where the robot turns 10 % too little."""

from dataclasses import replace

import magtwin as mt
from magtwin.extend import engine
from magtwin.sim.motion.engine import KINEMATIC


class Slippery:
    """Moves the robot by the kinematic engine, with wheels that are too far apart."""

    name = "slippery"

    def drive(self, closed_loop, controller, obstacles):
        drive = replace(closed_loop.drive, wheel_separation_m=1.1 * closed_loop.drive.wheel_separation_m)
        return KINEMATIC.drive(replace(closed_loop, drive=drive), controller, obstacles)


engine("slippery")(Slippery())
print(mt.simulate(mt.author_scene("lab", out="lab"), engine="slippery", duration_s=20, rate_hz=10))
