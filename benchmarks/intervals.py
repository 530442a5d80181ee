"""Share of the true field in the 90 % intervals of maps that were fitted to surveys of the default lab.

    python benchmarks/intervals.py [--seeds 2] [--spacing-m 0.25 0.4] [--method trilinear cubic gp harmonic]

The lab is surveyed as `magtwin map survey` does by default: four headings, places off by 1 cm and headings
by 2 degrees. The reference is the field that the same robot reads at rest at random places and headings
inside the map, where it can stand, without noise. `map` is `AnomalyMap.lookup_with_sd` of the map that
`magtwin map fit` would save; `nodes` is the same with the variance of the nodes alone. `vector` is
`HarmonicModel.predict_vector` at these places, by component; "platform" is given the robot's hard and soft
iron, and without them the vector is nan. All shares are means over the seeds, with the least and the
greatest. Then times, as ratios: value, standard deviation and gradient by `AnomalyMap.lookup_all`, and by
two calls.
"""

import argparse
import statistics
import time
from dataclasses import replace

import numpy as np

from magtwin.field.fit.fit import fit, raster
from magtwin.field.maps.lookup import warm_up
from magtwin.field.survey.stuck import mask_stuck
from magtwin.files.file import shipped
from magtwin.report.verdict import Z_90
from magtwin.sim.at_rest import field_at_rest_nt
from magtwin.sim.interference import ambient_field_nt
from magtwin.sim.survey import blocked_by, survey_readings
from magtwin.usd.lab.obstacles import read_obstacles
from magtwin.usd.scene import read_scene

FILE = shipped("scenes", "lab", "lab.usda")
POSES = 1_500


def poses(field, blocked, seed):
    """Random places inside the map where the robot can stand, and headings."""
    rng = np.random.default_rng([seed, 1])
    x0, x1, y0, y1 = field.extent
    p = rng.uniform((x0, y0), (x1, y1), (POSES, 2))
    yaw = rng.uniform(0, 2 * np.pi, POSES)
    free = ~blocked(p)
    return p[free], yaw[free]


def share(error, sd):
    """Share of errors in the 90 % intervals, of those that are known."""
    known = np.isfinite(error)
    return float(np.mean(np.abs(error[known]) < Z_90 * sd[known])) if known.any() else float("nan")


def measured(scene, blocked, method, spacing, seed):
    """Shares of one survey and fit, by name."""
    options = {"heading_error_rad": np.radians(2.0), "position_error_m": 0.01, "readings": 135}
    rng = np.random.default_rng(seed)
    readings = survey_readings(scene, rng=rng, spacing_m=spacing, blocked=blocked, **options)
    readings, _ = mask_stuck(readings)
    given = {}
    if method == "harmonic, platform":
        iron = scene.robot.platform
        given = {"hard_iron_nt": iron.hard_iron_nt, "soft_iron": np.reshape(iron.soft_iron, (3, 3))}
    start = time.process_time()
    model = fit(readings, method.split(",")[0], **given)
    field = raster(model, readings)
    took = time.process_time() - start
    p, yaw = poses(field, blocked, seed)
    want = field_at_rest_nt(scene, p, yaw)
    value, sd = field.lookup_with_sd(p, yaw)
    nodes = replace(field, between_nt2=None).lookup_with_sd(p, yaw)[1]
    known = np.isfinite(value)
    figures = {
        "RMSE": float(np.sqrt(np.mean((value - want)[known] ** 2))),
        "nodes": share(value - want, nodes),
        "map": share(value - want, sd),
    }
    if method.startswith("harmonic"):
        x, y, z = scene.robot.p_base_magnetometer
        c, s = np.cos(yaw), np.sin(yaw)
        at = np.column_stack([p[:, 0] + c * x - s * y, p[:, 1] + s * x + c * y, np.zeros(len(p))])
        at[:, 2] = scene.robot.base_height_m + z
        vector, variance = model.predict_vector(at)
        off = vector - ambient_field_nt(scene, at)
        for name, error, one in zip("xyz", off.T, np.sqrt(variance).T, strict=True):
            figures[f"vector {name}"] = share(error, one)
    return {**figures, "seconds": took}


def text(values):
    """Mean share with its range, in per cent."""
    if not np.isfinite(values).all():
        return "nan"
    low, high = (f"{100 * f(values):.0f}" for f in (min, max))
    return f"{100 * np.mean(values):.1f} ({low}-{high})"


def coverage(methods, spacings, seeds, first):
    scene = read_scene(FILE, check_network=False)
    blocked = blocked_by(scene, read_obstacles(FILE))
    names = ("RMSE [nT]", "nodes", "map", "vector x", "vector y", "vector z", "s")
    print(f"| method | spacing [m] | {' | '.join(names)} |\n|{'---|' * (len(names) + 2)}")
    for method in methods:
        for spacing in spacings:
            found = [measured(scene, blocked, method, spacing, seed) for seed in range(first, first + seeds)]
            columns = {name: [one[name] for one in found] for name in found[0]}
            cells = [f"{np.mean(columns.pop('RMSE')):.0f}"]
            took = np.mean(columns.pop("seconds"))
            cells += [text(values) for values in columns.values()]
            cells += [""] * (6 - len(cells)) + [f"{took:.0f}"]
            print(f"| {method} | {spacing:g} | {' | '.join(cells)} |", flush=True)


def speed(rounds=15):
    """Ratio of two calls to one, for some numbers of poses."""
    scene = read_scene(FILE, check_network=False)
    readings = survey_readings(scene, rng=np.random.default_rng(0))
    field = raster(fit(readings, "trilinear"), readings)
    warm_up()
    rng, (x0, x1, y0, y1) = np.random.default_rng(0), field.extent
    for count in (1_000, 100_000, 1_000_000):
        p, yaw = rng.uniform((x0, y0), (x1, y1), (count, 2)), rng.uniform(0, 2 * np.pi, count)
        ways = {
            "two": lambda p=p, yaw=yaw: (field.lookup_with_sd(p, yaw), field.lookup_with_gradient(p, yaw)),
            "one": lambda p=p, yaw=yaw: field.lookup_all(p, yaw),
        }
        took = {name: [] for name in ways}
        for _ in range(rounds):
            for name, way in ways.items():
                start = time.perf_counter()
                way()
                took[name].append(time.perf_counter() - start)
        two, one = (statistics.median(took[name]) for name in ("two", "one"))
        each = one / count * 1e9
        print(f"{count:,} poses: two calls {two / one:.2f} times as long as one, {each:.0f} ns a pose")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--spacing-m", type=float, nargs="+", default=[0.25, 0.4])
    known = ["trilinear", "cubic", "gp", "harmonic", "harmonic, platform"]
    parser.add_argument("--method", nargs="+", choices=known, default=known)
    options = parser.parse_args()
    coverage(options.method, options.spacing_m, options.seeds, options.first_seed)
    speed()


if __name__ == "__main__":
    main()
