"""A custom controller: drive straight on for 5 s, then stop."""

import magtwin as mt
from magtwin.extend import controller


@controller("straight")
class Straight:
    """Commands a forward speed [m/s] and a yaw rate [rad/s] 50 times per second."""

    def __init__(self, path, drive, speed):
        self.speed, self.done = speed, False

    def command(self, t, x, y, yaw, v, w):
        self.done = t > 5
        return (0.0, 0.0) if self.done else (self.speed, 0.0)


lab = mt.author_scene("lab", out="lab")
run = mt.simulate(lab, "sine", controller="straight", duration_s=8, rate_hz=10)
print(f"Drove {run['p_world_base'][-1, 0] - run['p_world_base'][0, 0]:.2f} m along x")
