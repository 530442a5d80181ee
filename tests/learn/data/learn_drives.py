"""Drives over a field of hills with every column that features are made of, for tests of learning."""

import numpy as np

from magtwin.field.maps.map import AnomalyMap
from magtwin.run.run import COLUMNS, Run


def hills(name="hills", level=41e3, **given):
    """A map with slopes of up to 5 uT/m."""
    x, y = np.arange(-2, 2.01, 0.1), np.arange(-1.6, 1.61, 0.1)
    values = level + 1500 * np.sin(3.1 * x[None, :]) * np.cos(2.3 * y[:, None])
    grid = {"origin_m": (-2.0, -1.6), "cell_m": (0.1, 0.1), "headings_rad": np.zeros(1)}
    if "variance" in given:
        given["variance_nt2"] = np.full((1, *values.shape), given.pop("variance"))
    return AnomalyMap(values_nt=values[None], name=name, **grid, **given)


def random_run(rows=50, seed=0, **here):
    """A run whose columns are random numbers, so that a swap of any two shows, but for those given."""
    rng = np.random.default_rng(seed)
    columns = {}
    for name, spec in COLUMNS.items():
        values = rng.normal(size=(rows,) if spec.width == 1 else (rows, spec.width))
        columns[name] = values > (9 if name.startswith("flag") else 0) if spec.unit == "bool" else values
    return Run(columns | here)


HILLS = hills()


def a_drive(seed=0, rows=240, noise_nt=2.0, mean_nt=0.0, **metadata):
    """A Lissajous drive at 10 Hz; its disturbance is a mean, 100 nT a m/s of speed, and noise."""
    t = np.arange(rows) / 10
    phase = 0.2 * t + seed
    p = np.column_stack([1.7 * np.sin(phase), 1.2 * np.cos(2 * phase), 0 * t])
    yaw = np.arctan2(-2.4 * np.sin(2 * phase), 1.7 * np.cos(phase))
    run = random_run(rows, seed, t=t, p_world_base=p, yaw=yaw)
    noise = np.random.default_rng(1000 + seed).normal(0, noise_nt, rows)
    b = HILLS.lookup(p[:, :2], yaw) + mean_nt + 100 * run["odom_v"][:, 0] + noise
    kept = {name: run[name] for name in run if not name.startswith("mocap")}
    return Run({**kept, "b_measured_nt": b}, metadata)
