"""A custom path: a circle of 1 m radius."""

import numpy as np

import magtwin as mt
from magtwin.extend import path
from magtwin.path import Path


@path("circle")
def circle():
    """Points in world [m], as a closed path."""
    angle = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    return Path("circle", np.column_stack([np.cos(angle), np.sin(angle)]), closed=True)


print(mt.simulate(mt.author_scene("lab", out="lab"), "circle", rate_hz=10))
