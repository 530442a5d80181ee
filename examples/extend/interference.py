"""A custom interference term: a pump that hums at 0.8 Hz along the robot's x axis."""

import numpy as np

import magtwin as mt
from magtwin.extend import interference


@interference("pump")
def pump_nt(columns, robot, rng):
    """Field in base_link axes [nT], shape (N, 3)."""
    hum = 300.0 * np.sin(2 * np.pi * 0.8 * columns["t"])
    return np.column_stack([hum, 0 * hum, 0 * hum])


twin = mt.open_twin(mt.author_scene("lab", out="lab"), magnetometer="physical")
options = {"duration_s": 10, "rate_hz": 20, "seed": 1}
quiet = mt.simulate(twin, **options)
humming = mt.simulate(twin, interference=["pump"], **options)
print(f"Root mean square of the hum: {np.std(humming['b_truth_nt'] - quiet['b_truth_nt']):.0f} nT")
