"""Batch: the most probable trajectory and constants of a run, by Gauss-Newton.

It minimises half the sum of squares of all residuals, each divided by its standard deviation,

    x_1 - start,  g,  x_(k+1) - move(x_k, g),  y_k - measure(x_k, g)

with the functions of `magtwin.localization.slam.model`. Every iteration relinearises all of them and solves
one `Arrow`; a step that does not lower the cost is halved.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.localization.arrow import Arrow, Solution
from magtwin.localization.slam.model import Model, State, cross
from magtwin.localization.slam.samples import Samples

Array = NDArray[np.float64]

HALVINGS = 6
"""Times that a step is halved before the iteration ends."""

FAR = ((10.0, 4), (5.0, 4), (3.0, 3), (2.0, 3), (1.4, 3))
"""Noise and iterations from dead reckoning, which may be far off."""

NEAR = ((3.0, 4), (2.0, 3), (1.4, 3))
"""Noise and iterations from a trajectory that is about right."""

DONE = 1e-3
"""Fall of the cost at which iterations end."""


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals divided by their standard deviations."""

    start: Array
    """First state, shape (D,)."""

    steps: Array
    """Motion, shape (N - 1, D)."""

    readings: Array
    """Field, shape (N, m); 0 where there is no reading."""

    constants: Array
    """Prior of the constants, shape (G,)."""

    @property
    def cost(self) -> float:
        """Half the sum of squares."""
        return 0.5 * float(sum((part**2).sum() for part in vars(self).values()))


class Batch:
    """All samples of a run, or those until now.

    Args:
        model: Model of the run.
        samples: At least one sample.
        noise: Factor on the standard deviation of field readings.
    """

    def __init__(self, model: Model, samples: Samples, noise: float = 1.0) -> None:
        self.model, self.samples = model, samples
        self._steps = model.steps(samples)
        self._known: NDArray[np.bool_] = np.asarray(np.isfinite(samples.y_nt).all(axis=1))
        self._y = np.where(self._known[:, None], samples.y_nt, 0.0)
        self._root_steps = 1 / np.sqrt(self._steps.variance)
        self._root_start = 1 / np.sqrt(model.start_variance)
        self._root_constants = 1 / np.sqrt(model.constants_variance)
        self.set_noise(noise)

    def set_noise(self, factor: float) -> None:
        """Multiply the standard deviation of field readings by a factor."""
        variance = factor**2 * (self.model.problem.sensor.white_nt**2 + self.samples.extra_nt2)
        self._root_readings = np.where(self._known, 1 / np.sqrt(variance), 0.0)

    def dead_reckoning(self, g: Array | None = None) -> State:
        """The start moved by odometry; `g` are the constants (default 0)."""
        model, one = self.model, self.model.start
        state = one if g is None else one._replace(g=g)
        states = [state]
        for k in range(len(self._steps.dt)):
            step = type(self._steps)(*[part[k : k + 1] for part in self._steps])
            states.append(model.move(states[-1], step)[0])
        p, R, drift = (np.concatenate([getattr(s, name) for s in states]) for name in ("p", "R", "drift"))
        return State(p, R, drift, states[0].g)

    def residuals(self, state: State) -> Residuals:
        """Residuals of a trajectory."""
        expected = self.model.expected(state)
        moved = self.model.move(_rows(state, slice(0, -1)), self._steps)[0]
        return self._residuals(state, moved, expected)

    def _residuals(self, state: State, moved: State, expected: Array) -> Residuals:
        model = self.model
        return Residuals(
            model.difference(_rows(state, slice(0, 1)), model.start)[0] * self._root_start,
            model.difference(_rows(state, slice(1, None)), moved) * self._root_steps,
            (self._y - expected) * self._root_readings[:, None],
            state.g * self._root_constants,
        )

    def linearised(self, state: State) -> tuple[Arrow, Residuals]:
        """Normal equations of the errors that lower the cost, and the residuals."""
        model, size = self.model, self.model.size
        count, constants = len(state.p), model.layout.count
        motion = model.layout.motion.stop
        expected, h, hg = model.measure(state)
        moved, f, fg = model.move(_rows(state, slice(0, -1)), self._steps)
        r = self._residuals(state, moved, expected)
        diagonal, border = np.zeros((count, size, size)), np.zeros((count, size, constants + 1))

        root = self._root_readings[:, None, None]
        h, hg = h * root, hg * root
        ht = h.transpose(0, 2, 1)
        np.matmul(ht, h, out=diagonal)
        np.matmul(ht, hg, out=border[:, :, :-1])
        border[:, :, -1] = (ht @ r.readings[..., None])[..., 0]
        flat = hg.reshape(-1, constants)
        corner = flat.T @ flat
        right = flat.T @ r.readings.ravel()
        corner[range(constants), range(constants)] += self._root_constants**2
        right -= self._root_constants * r.constants

        after, before = self._turning(r)
        e1 = self._root_steps[..., None] * after
        e0 = -self._root_steps[..., None] * (before @ f)
        e1t, e0t, e = e1.transpose(0, 2, 1), e0.transpose(0, 2, 1), r.steps[..., None]
        diagonal[1:] += e1t @ e1
        diagonal[:-1] += e0t @ e0
        below = e1t @ e0
        border[1:, :, -1] -= (e1t @ e)[..., 0]
        border[:-1, :, -1] -= (e0t @ e)[..., 0]
        if motion:
            eg = -self._root_steps[..., None] * fg
            border[1:, :, :motion] += e1t @ eg
            border[:-1, :, :motion] += e0t @ eg
            flat = eg.reshape(-1, motion)
            corner[:motion, :motion] += flat.T @ flat
            right[:motion] -= flat.T @ r.steps.ravel()

        first = self._root_start[:, None] * self._left_inverse(r.start[None] / self._root_start)[0]
        diagonal[0] += first.T @ first
        border[0, :, -1] -= first.T @ r.start
        return Arrow(diagonal, below, border, corner, right), r

    def _turning(self, r: Residuals) -> tuple[Array, Array]:
        """Derivatives of the motion's residuals by the errors of the states after and before."""
        error = r.steps / self._root_steps
        return self._left_inverse(error), self._left_inverse(-error)

    def _left_inverse(self, error: Array) -> Array:
        """Derivative of log(exp(a) exp(v)) by a at 0, for rotations v in states' errors, shape (N, D, D).

        1 - [v]x / 2 + [v]x^2 / 12 - ...; the next term is of fourth order.
        """
        out = np.zeros((len(error), self.model.size, self.model.size))
        out[:, range(self.model.size), range(self.model.size)] = 1.0
        if self.model.vector:
            v = cross(error[:, 3:6])
            out[:, 3:6, 3:6] += -v / 2 + v @ v / 12
        return out

    def solved(self, state: State, most: int) -> tuple[State, float, Solution]:
        """Gauss-Newton, at most `most` iterations: the state, its cost and the system of the last one."""
        for _ in range(most):
            arrow, r = self.linearised(state)
            step = arrow.solve()
            state, cost = self._shortened(state, step, r.cost)
            if r.cost - cost < DONE:
                break
        return state, cost, step

    def _shortened(self, state: State, step: Solution, cost: float) -> tuple[State, float]:
        share = 1.0
        for _ in range(HALVINGS):
            tried = self.model.add(state, share * step.x, share * step.g)
            lower = self.residuals(tried).cost
            if lower < cost:
                return tried, lower
            share /= 2
        return state, cost

    def fit_constants(self, state: State) -> State:
        """The constants that fit best with all poses held, in one linear step.

        Without it a trajectory is lost at once: with weights of 0, no reading holds the poses.
        """
        arrow, _ = self.linearised(state)
        g = np.linalg.solve(arrow.corner, arrow.right)
        return state._replace(g=state.g + g)

    def annealed(self, state: State, levels: Sequence[tuple[float, int]]) -> tuple[State, float]:
        """Iterations at falling noise, which makes wide basins of what are narrow ones at the true noise.

        Args:
            state: Start. Its constants are fitted to its poses first.
            levels: Factors on the standard deviation of readings, and most iterations at each.

        Returns:
            The state and its cost at the last level.
        """
        self.set_noise(levels[0][0])
        state, cost = self.fit_constants(state), math.inf
        for factor, most in levels:
            self.set_noise(factor)
            state, cost, _ = self.solved(state, most)
        return state, cost


def _rows(state: State, rows: slice) -> State:
    return State(state.p[rows], state.R[rows], state.drift[rows], state.g)


def joined(states: list[State]) -> State:
    """One trajectory of consecutive states, with the constants of the last one."""
    p, R, drift = (np.concatenate([getattr(s, name) for s in states]) for name in ("p", "R", "drift"))
    return State(p, R, drift, states[-1].g)
