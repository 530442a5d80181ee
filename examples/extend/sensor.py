"""A custom sensor: a radar that measures forward speed."""

import magtwin as mt
from magtwin.extend import Column, sensor


@sensor("radar")
class Radar:
    """Forward speed with white noise."""

    columns = {"radar_v": Column("m/s", "base_link", "forward speed from a radar")}

    def __init__(self, scene, rng):
        self.rng = rng

    def sense(self, motion, t, until_s=None):
        return {"radar_v": motion.at(t).v + 0.02 * self.rng.standard_normal(len(t))}


run = mt.simulate(mt.author_scene("lab", out="lab"), duration_s=10, rate_hz=10, sensors=["radar"])
print(f"Mean speed from the radar: {run['radar_v'].mean():.2f} m/s")
