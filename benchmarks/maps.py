"""How well each method tells what it was not shown, on three data sets and in one process, with times.

    python benchmarks/maps.py [--data FOLDER] [--only aprilab|magnetic-data|own] [--method NAME ...]

The APRILab survey (4 x 375 nodes, |B|): every other node is left out at all its headings, then the others;
latched nodes count on neither side. `harmonic` and `auto` are told the Earth's field of the place; "harmonic,
no Earth" is not. `auto` chooses on the readings that it is given: it never sees those left out.
Of trilinear three figures are told, for they differ much: of all nodes, bridged from what is left in
their row and column; of those between four neighbours that were read, where it is their mean and nothing is
bridged; and of these the ones two nodes or more off those that latched, where the field is steepest.
magnetic-data (Solin et al. 2018; vectors in world axes, so headings are 0 and no platform is fitted):
runs 1, 3 and 5 tell of runs 2 and 4 within 10 cm of their readings. "harmonic, course" takes the direction of
travel for the heading, which the data do not state: the platform then explains what turns with the robot.
own: a simulated survey of the default lab, split as the APRILab survey. "on map" is the share of these
readings in the intervals of the map that `magtwin map fit` saves (`lookup_with_sd(..., reading=True)`): its
variance, the error of interpolation and the stored noise of a reading.
Seconds are processor time of all turns together.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from magtwin.field.fit.fit import fit, raster
from magtwin.field.fit.methods import METHODS
from magtwin.field.survey.folder import read_grid
from magtwin.field.survey.readings import Readings
from magtwin.field.survey.stuck import mask_stuck
from magtwin.files.file import shipped
from magtwin.sim.survey import blocked_by, survey_readings
from magtwin.usd.lab.obstacles import read_obstacles
from magtwin.usd.scene import read_scene

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
EARTH_NT = (-2_700.0, 24_000.0, -38_400.0)  # IGRF-14, Gainesville, Florida
NINETY = 1.6448536269514722
BRIDGED = {"trilinear": {"fill": True}, "cubic": {"fill": True}}  # as `magtwin map validate` does
NEAR_M = 0.1
AHEAD = 15  # readings, 0.3 s, over which a direction of travel is taken


def own(seed):
    """As `aprilab`, of a simulated survey."""
    scene = read_scene(shipped("scenes", "lab", "lab.usda"), check_network=False)
    blocked = blocked_by(scene, read_obstacles(shipped("scenes", "lab", "lab.usda")))
    errors = {"heading_error_rad": np.radians(2.0), "position_error_m": 0.01}
    return split(survey_readings(scene, rng=np.random.default_rng(seed), blocked=blocked, **errors))


def split(gridded):
    """Readings to fit and to predict, a pair a turn."""
    readings, _ = mask_stuck(gridded)
    parity = (readings.node[:, 1] + readings.node[:, 2]) % 2
    return [
        tuple(readings.take(readings.good & (parity == side)) for side in (kept, 1 - kept)) for kept in (0, 1)
    ]


def amid(turns, off_latched):
    """Which readings left out lie between four that were read, and so far off nodes that latched [nodes]."""
    grid = turns[0][0].grid
    read = np.zeros(grid.shape, bool)
    for part in turns[0]:
        read[tuple(part.node.T)] = True
    wide = np.pad(read, ((0, 0), (1, 1), (1, 1)))
    four = wide[:, 1:-1, :-2] & wide[:, 1:-1, 2:] & wide[:, :-2, 1:-1] & wide[:, 2:, 1:-1]
    latched = ~read
    for _ in range(off_latched):
        wide = np.pad(latched, ((0, 0), (1, 1), (1, 1)))
        latched = latched | wide[:, 1:-1, :-2] | wide[:, 1:-1, 2:] | wide[:, :-2, 1:-1] | wide[:, 2:, 1:-1]
    inner = four & ~latched
    return np.concatenate([inner[tuple(rest.node.T)] for _, rest in turns])


def course(p):
    row = np.arange(len(p))
    way = p[np.minimum(row + AHEAD, len(p) - 1)] - p[np.maximum(row - AHEAD, 0)]
    return np.arctan2(way[:, 1], way[:, 0])


def runs(folder, numbers, *, headed):
    t, p, b = (
        [np.loadtxt(folder / "magnetic-data" / f"{n}-{what}.csv", delimiter=",") for n in numbers]
        for what in ("time", "loc", "mag")
    )
    yaw = np.concatenate([course(q) if headed else np.zeros(len(q)) for q in p])
    c, s = np.cos(yaw), np.sin(yaw)
    world = 1e3 * np.concatenate(b)
    body = np.column_stack(
        [c * world[:, 0] + s * world[:, 1], c * world[:, 1] - s * world[:, 0], world[:, 2]]
    )
    return Readings(
        p_xy=np.concatenate(p),
        yaw=yaw,
        b_body_nt=body,
        t=np.concatenate(t),
        run=np.repeat(np.arange(len(t)), [len(part) for part in t]),
        runs=tuple(map(str, numbers)),
        name="magnetic-data",
    )


def magnetic(folder, *, headed=False):
    shown, rest = runs(folder, (1, 3, 5), headed=headed), runs(folder, (2, 4), headed=headed)
    return [(shown, rest.take(cKDTree(shown.p_xy).query(rest.p_xy)[0] < NEAR_M))]


def measure(turns, method, options):
    """Misses [nT], whether they lie in the 90 % intervals, by the model and on the map, and seconds."""
    off, inside, mapped, start = [], [], [], time.process_time()
    for shown, rest in turns:
        model = fit(shown, method, **options)
        nominal = rest.grid is not None and method in BRIDGED
        yaw = np.asarray(rest.grid.headings_rad)[rest.node[:, 0]] if nominal else rest.yaw
        value, variance = model.predict(rest.p_xy, yaw)
        off.append(rest.b_nt - value)
        inside.append(np.abs(off[-1]) <= NINETY * np.sqrt(variance + model.noise_nt2))
        on, sd = raster(model, shown).lookup_with_sd(rest.p_xy, rest.yaw, reading=True)
        mapped.append(np.where(np.isfinite(on), np.abs(rest.b_nt - on) <= NINETY * sd, np.nan))
    took = time.process_time() - start
    return np.concatenate(off), np.concatenate(inside), np.concatenate(mapped), took


def table(title, rows):
    print(
        f"{title}\n  {'':22}{'RMSE':>8}{'MAE':>8}{'median':>8}{'in 90 %':>9}{'on map':>9}{'told':>8}{'s':>8}"
    )
    for name, turns, method, options in rows:
        off, inside, mapped, seconds = measure(turns, method, options)
        row(name, off, inside, mapped, seconds)
        if method == "trilinear" and turns[0][0].grid is not None:
            for note, nodes in (("  amid four neighbours", 0), ("  and 2 off latched", 2)):
                row(note, np.where(amid(turns, nodes), off, np.nan), inside, mapped, seconds)


def row(name, off, inside, mapped, seconds):
    known = np.isfinite(off)
    size = np.abs(off[known])
    print(
        f"  {name:22}{np.sqrt(np.mean(size**2)):8.0f}{size.mean():8.0f}{np.median(size):8.0f}"
        f"{100 * inside[known].mean():8.1f}%{100 * np.nanmean(mapped[known]):8.1f}%"
        f"{known.mean():8.1%}{seconds:8.1f}",
        flush=True,
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of aprilab/ and magnetic-data/")
    parser.add_argument("--only", choices=["aprilab", "magnetic-data", "own"])
    parser.add_argument("--method", nargs="+", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--seed", type=int, default=0, help="of the simulated survey")
    options = parser.parse_args()
    if not options.data.is_dir():
        parser.exit(message=f"the real data are not at {options.data}; `magtwin fetch` gets the survey\n")
    if options.only in (None, "aprilab"):
        turns = split(read_grid(options.data / "aprilab" / "maps"))
        told = {**BRIDGED, "auto": {"earth_nt": EARTH_NT}}
        rows = [(m, turns, m, {**told.get(m, {})}) for m in options.method if m != "harmonic"]
        if "harmonic" in options.method:
            rows += [
                ("harmonic", turns, "harmonic", {"earth_nt": EARTH_NT}),
                ("harmonic, no Earth", turns, "harmonic", {}),
            ]
        table("APRILab, checkerboard, nT", rows)
    if options.only in (None, "own"):
        turns = own(options.seed)
        table(
            "default lab, checkerboard, nT", [(m, turns, m, {**BRIDGED.get(m, {})}) for m in options.method]
        )
    if options.only in (None, "magnetic-data"):
        turns = magnetic(options.data)
        rows = [(m, turns, m, {}) for m in options.method]
        if "harmonic" in options.method:
            rows.append(("harmonic, course", magnetic(options.data, headed=True), "harmonic", {}))
        table("magnetic-data, runs 2 and 4 from 1, 3 and 5, nT", rows)


if __name__ == "__main__":
    main()
