"""SLAM smoother: the most probable trajectory, map and calibration of a whole run."""

from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np

from magtwin.errors import InputError
from magtwin.localization.problem import Estimate, Problem, Reading
from magtwin.localization.readings import readings_of
from magtwin.localization.slam.batch import FAR, NEAR, Batch
from magtwin.localization.slam.incremental_slam import IncrementalSlam
from magtwin.localization.slam.model import Model, State
from magtwin.localization.slam.samples import has_vector, samples_of
from magtwin.localization.slam.settings import Settings
from magtwin.run.run import Run

LAST = 15
"""Most iterations at the true noise."""


@dataclass(kw_only=True)
class SlamSmoother(Settings):
    """Batch Gauss-Newton over all poses and the constants of `magtwin.localization.slam.model`.

    The cost has local minima: a loop may be laid on the one beside it. So the solver starts from several
    trajectories, with the noise of the field annealed, and keeps the solution of least cost. Covariances are
    those of the linearised problem at the solution.
    """

    functions: int = 150
    """Number of eigenfunctions."""

    soft_iron_sd: float = 0.1
    """Prior standard deviation of each entry of the soft-iron matrix W, for three axes. 0: no W."""

    starts: int = 2
    """Starts to try: dead reckoning; and the incremental filter's trajectory."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.starts not in (1, 2):
            raise InputError(f"starts must be 1 or 2, got {self.starts}", parameter="starts")

    def run(self, problem: Problem, readings: Run) -> list[Estimate]:
        """Estimates at the times of all readings."""
        rows = list(readings_of(readings))
        vector = has_vector(rows[0])
        samples = samples_of(rows, vector)
        self.model = Model(problem, self, samples.take(slice(0, 1)), vector)
        batch = Batch(self.model, samples)
        best, least = None, np.inf
        for start, levels in self._starts(problem, rows, batch):
            state, cost = batch.annealed(start, (*levels, (1.0, LAST)))
            if cost < least or best is None:
                best, least = state, cost
        assert best is not None
        self.state = best
        covariance = batch.linearised(best)[0].solve().pose_covariances()
        return [
            self.model.estimate(t, best.p[k], best.R[k], covariance[k], best.drift[k])
            for k, t in enumerate(samples.t.tolist())
        ]

    def _starts(
        self, problem: Problem, rows: list[Reading], batch: Batch
    ) -> Iterator[tuple[State, tuple[tuple[float, int], ...]]]:
        """Trajectories to start from, and how to anneal the noise."""
        yield batch.dead_reckoning(), FAR
        if self.starts > 1:
            shared = {f.name: getattr(self, f.name) for f in fields(Settings) if f.name not in OWN}
            causal = IncrementalSlam(**shared)
            causal.reset(problem)
            for row in rows:
                causal.step(row)
            yield causal.trajectory()[1]._replace(g=np.zeros(self.model.layout.count)), NEAR


OWN = ("functions", "soft_iron_sd")
"""Options that the incremental filter takes its own defaults for."""
