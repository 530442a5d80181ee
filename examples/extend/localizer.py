"""A localizer: a particle filter in 40 lines."""

import numpy as np

import magtwin as mt
from magtwin.extend import localizer
from magtwin.localization.odometry import increment
from magtwin.localization.problem import Estimate


@localizer("my-filter")
class ParticleFilter:
    """Particles of x, y, yaw and the magnetometer's offset."""

    def reset(self, problem):
        """Draw the particles from the prior."""
        self.problem, self.rng, self.last = problem, np.random.default_rng(problem.seed), None
        self.sd = np.append(problem.prior.sd, np.hypot(problem.sensor.offset_nt, problem.sensor.iron_nt))
        self.state = self.rng.normal(np.append(problem.prior.mean, 0), self.sd, (5000, 4))

    def step(self, reading):
        """Move the particles by odometry, weigh them by the reading, resample."""
        x, y, yaw, offset = self.state.T
        if self.last is not None:
            dt, move = reading.t - self.last.t, increment(self.last.odometry, reading.odometry)
            sd = np.sqrt(self.problem.odometry.variances(np.hypot(*move[:2]), move[2], dt))
            forward, left, turn = self.rng.normal(move, sd, (len(x), 3)).T
            x += forward * np.cos(yaw + turn / 2) - left * np.sin(yaw + turn / 2)
            y += forward * np.sin(yaw + turn / 2) + left * np.cos(yaw + turn / 2)
            yaw += turn
            sensor = self.problem.sensor
            offset += self.rng.normal(0, sensor.drift_nt * np.sqrt(2 * dt / sensor.drift_s), len(x))
        self.last = reading
        if np.isfinite(reading.b_nt):
            p = self.state[:, :2]
            error = reading.b_nt - self.problem.belief.mean(p, yaw) - offset
            variance = self.problem.belief.variance(p, yaw) + 150**2  # and what no model holds
            log = np.nan_to_num(
                -(error**2) / (2 * variance) - np.log(variance) / 2, nan=-1e3
            )  # nan: off the map
            weight = np.exp(log - log.max())
            chosen = self.rng.choice(len(x), len(x), p=weight / weight.sum())
            self.state = self.state[chosen] + self.rng.normal(0, self.sd / 50, self.state.shape)
        return Estimate(reading.t, *self.state[:, :3].mean(axis=0), np.cov(self.state[:, :3].T))


if __name__ == "__main__":
    run = mt.simulate("lab", "figure8", seed=3, duration_s=60, magnetometer="physical")
    estimated = mt.localize(run, "lab", method="my-filter")
    error = np.hypot(*(estimated["est_p_world_base"] - estimated["p_world_base"])[:, :2].T)
    print(f"RMSE {100 * np.sqrt(np.mean(error**2)):.1f} cm over {estimated.duration_s:.0f} s")
