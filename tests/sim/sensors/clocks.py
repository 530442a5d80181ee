"""The samples that readings see, by index."""

import numpy as np

from magtwin.sim.sensors.clock import SampleClock


def held(t, rate_hz, *, latency_s=0.0, jitter_s=0.0, rng=None):
    """Times of the samples [s], and the index of the one that each reading sees."""
    clock = SampleClock(rate_hz, latency_s, jitter_s, rng)
    stamps = clock.due(t[-1] + 1e-6)
    clock.add(stamps, {"index": np.arange(len(stamps))})
    return stamps, clock.at(t)["index"]
