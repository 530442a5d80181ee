"""Magnetometer models on plants that they never saw: the tables of docs/results.md.

A twin of the default lab is surveyed, and its robot drives in many worlds: the nominal plant, and plants of
the families of `magtwin.draw_plant`. Models learn on nominal sessions; a mixed model also learns how sessions
differ from worlds of all families but the one that is judged. Judged is the total field on the paths A to E
of the paper's Table 1, after a drive of 60 s along `loops`, in new sessions of a new world. The poses of that
drive, and those that become known 10 s late online, have an error of 3 cm on each axis, correlated over 2 s.

Ratios are the MAE divided by that of the naive model (trilinear map and mean training label), averaged over
the paths; beside them stands the share of readings in the models' own 90 % intervals. "all" has every effect
at once; its model has learned from the single families. "hybrid" is the shipped network, which learned on
other nominal sessions, and "its base" the linear part of it.

    python benchmarks/magnetometers.py [--sessions 4] [--draws 12] [--out FOLDER]

It prints three tables, after about ten minutes. FOLDER keeps data set and weights.
"""

import argparse
import contextlib
import math
import tempfile
import warnings
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

import magtwin as mt
from magtwin.errors import CalibrationWarning, MismatchWarning
from magtwin.field.maps.map import AnomalyMap
from magtwin.files.file import shipped
from magtwin.learn.data.alignment import Alignment, alignment_of, fit_alignment
from magtwin.learn.data.labels import labelled
from magtwin.learn.inference.magnetometer import NeuralMagnetometer
from magtwin.learn.inference.online import read_online
from magtwin.learn.mixed.mixed import Mixed
from magtwin.path import loops, path_named
from magtwin.report.verdict import Z_90
from magtwin.run.run import Run
from magtwin.twin import Twin, in_session, with_plant

FAMILIES = ("hysteresis", "warm-up", "nonlinear", "moving-part", "drawn")
JUDGED = ("nominal", *FAMILIES, "all")
WORLDS = 3
"""Training worlds of each family; 4 of the nominal plant."""

TRAINING = ("random", "sine", "lawnmower", "figure8", "continuous_cycle")
"""Path of each session of a training world."""

SECONDS, RATE_HZ = 360.0, 8.0
DRIVE_S, DRIVE_M = 60.0, 13.5
"""Length of the labelled drive, in time and along the path."""

POSE_SD_M, POSE_S = 0.03, 2.0
PATHS = {
    "A": "fast_sine",
    "B": "curvilinear",
    "C": "curvilinear_2",
    "D": "split_lawnmower",
    "E": "narrow_figure8",
}
DRAWN_PATHS = ("B", "C", "E")
"""The short paths, on which the freshly drawn plants are judged."""

MODELS = (
    *("naive + offset", "ridge, open loop", "ridge + offset", "hybrid's base", "hybrid", "hybrid + offset"),
    *("mixed, unknown plant", "mixed, calibrated", "mixed, online"),
)
VARIANTS = (
    ("10 s", 10.0, 0.03, 2.0, 0.03),
    ("20 s", 20.0, 0.03, 2.0, 0.03),
    ("30 s", 30.0, 0.03, 2.0, 0.03),
    ("60 s, exact poses", 60.0, 0.0, 2.0, 0.0),
    ("60 s, 3 cm", 60.0, 0.03, 2.0, 0.03),
    ("60 s, 3 cm, white", 60.0, 0.03, 0.0, 0.03),
    ("60 s, 10 cm", 60.0, 0.1, 2.0, 0.1),
    ("60 s, 10 cm, not told", 60.0, 0.1, 2.0, 0.0),
)
"""Drives: name, length [s], error of positions [m], its correlation time [s], the stated `pose_sd_m` [m]."""
Judged = dict[str, tuple[float, float]]
"""Error or ratio, and coverage, of each model."""


def world(twin: Twin, plant: str, session: int, seed: int) -> Twin:
    return in_session(with_plant(twin, plant), session, seed=seed)


def training_runs(twin: Twin) -> dict[str, Run]:
    worlds = [("nominal", k) for k in range(4)]
    worlds += [(family, k) for family in FAMILIES for k in range(101, 101 + WORLDS)]
    runs = {}
    for number, (family, k) in enumerate(worlds):
        for session, path in enumerate(TRAINING):
            robot = world(twin, f"{family}:{k}", session, 5000 + number)
            speed = (0.2, 0.25, 0.3, 0.22, 0.27)[session]
            seed = 9000 + 10 * number + session
            run = mt.simulate(robot, path, seed=seed, speed=speed, duration_s=SECONDS, rate_hz=RATE_HZ)
            runs[f"{family}_{k}_{session}"] = run
    return runs


def judged_run(twin: Twin, plant: str, session: int, case: str) -> Run:
    """The labelled drive, and the path of a case after it, in one run."""
    path = path_named(PATHS[case])
    points = [loops().at(np.linspace(0, DRIVE_M, 700)), path.at(np.linspace(0, path.length, 1500))]
    seed = 100 * session + list(PATHS).index(case)
    return mt.simulate(world(twin, plant, session, 777), np.vstack(points), seed=seed, rate_hz=RATE_HZ)


def with_pose_error(run: Run, sd_m: float = POSE_SD_M, time_s: float = POSE_S) -> Run:
    """The run with errors of its poses on each axis: an Ornstein-Uhlenbeck process, or white noise."""
    rng = np.random.default_rng(int(run.metadata["seed"]))
    a = math.exp(-1 / (RATE_HZ * time_s)) if time_s else 0.0
    error = rng.standard_normal((run.rows, 2))
    for k in range(1, run.rows):
        error[k] = a * error[k - 1] + math.sqrt(1 - a * a) * error[k]
    return run.with_columns(mocap_p=run["mocap_p"] + sd_m * np.column_stack([error, np.zeros(run.rows)]))


def judge(
    run: Run, mixed: Mixed, hybrid: NeuralMagnetometer, maps: tuple[AnomalyMap, AnomalyMap], naive_nt: float
) -> Judged:
    """MAE [nT] and coverage of every model on the path, and of the naive model."""
    trilinear, harmonic = maps
    rough = with_pose_error(run)
    early, late = run["t"] < DRIVE_S, run["t"] > DRIVE_S + 5
    exact = labelled(run, harmonic, alignment_of(mixed.metadata))
    label, noisy = exact["label_nt"], labelled(rough, harmonic, alignment_of(mixed.metadata))["label_nt"]
    late &= np.isfinite(label)
    plain, plain_noisy = labelled(run, trilinear)["label_nt"], labelled(rough, trilinear)["label_nt"]
    scores = {}

    def score(name: str, error: np.ndarray, sd: np.ndarray | None = None) -> None:
        known = late & np.isfinite(error)
        held = math.nan if sd is None else float(np.mean(np.abs(error[known]) < Z_90 * sd[known]))
        scores[name] = float(np.mean(np.abs(error[known]))), held

    score("naive", naive_nt - plain)
    score("naive + offset", np.nanmean(plain_noisy[early]) - plain)
    own = labelled(run, harmonic, alignment_of(hybrid.net.metadata))
    own_noisy = labelled(rough, harmonic, alignment_of(hybrid.net.metadata))["label_nt"]
    base = NeuralMagnetometer(hybrid.net.base)
    for name, net, truth, given in (
        ("ridge, open loop", NeuralMagnetometer(mixed), exact, noisy),
        ("hybrid's base", base, own, own_noisy),
        ("hybrid", hybrid, own, own_noisy),
    ):
        read = net.read([truth], outside=False)[0]
        error = read.disturbance_nt - truth["label_nt"]
        score(name, error, read.sd_nt)
        offset = np.nanmean((read.disturbance_nt - given)[early])
        score(f"{name.removesuffix(', open loop')} + offset", error - offset)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        drive = mt.calibrate(mixed, rough, anomaly_map=harmonic, duration_s=DRIVE_S, pose_sd_m=POSE_SD_M)
    for name, model in (
        ("mixed, unknown plant", mixed.open_loop(unknown_plant=True)),
        ("mixed, calibrated", drive),
    ):
        read = NeuralMagnetometer(model).read([exact], outside=False)[0]
        score(name, read.disturbance_nt - label, read.sd_nt)
    read = read_online(mixed, rough, harmonic, pose_sd_m=POSE_SD_M)
    score("mixed, online", read.disturbance_nt - label, read.sd_nt)
    return scores


def drives(run: Run, mixed: Mixed, maps: tuple[AnomalyMap, AnomalyMap], naive_nt: float) -> Judged:
    """MAE [nT] and coverage after drives of several lengths and poses, and of the naive model."""
    trilinear, harmonic = maps
    exact = labelled(run, harmonic, alignment_of(mixed.metadata))
    late = (run["t"] > DRIVE_S + 5) & np.isfinite(exact["label_nt"])
    scores = {
        "naive": (float(np.nanmean(np.abs(naive_nt - labelled(run, trilinear)["label_nt"])[late])), math.nan)
    }
    for name, seconds, error_m, time_s, told_m in VARIANTS:
        rough = with_pose_error(run, error_m, time_s)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CalibrationWarning)
            model = mt.calibrate(mixed, rough, anomaly_map=harmonic, duration_s=seconds, pose_sd_m=told_m)
        read = NeuralMagnetometer(model).read([exact], outside=False)[0]
        error = np.abs(read.disturbance_nt - exact["label_nt"])[late]
        scores[name] = float(np.mean(error)), float(np.mean(error < Z_90 * read.sd_nt[late]))
    return scores


def means(scores: Iterator[tuple[str, Judged]]) -> Judged:
    """Ratios and coverages, each path with the same weight."""
    by_path: dict[str, dict[str, list[tuple[float, float]]]] = defaultdict(lambda: defaultdict(list))
    for path, models in scores:
        for name, values in models.items():
            by_path[path][name].append(values)
    paths = [{name: np.mean(values, axis=0) for name, values in of.items()} for of in by_path.values()]
    return {
        name: (
            float(np.mean([models[name][0] / models["naive"][0] for models in paths])),
            float(np.mean([models[name][1] for models in paths])),
        )
        for name in paths[0]
        if name != "naive"
    }


def print_table(title: str, rows: dict[str, Judged], names: Sequence[str]) -> None:
    """Models by row and plants by column, in Markdown."""
    print(f"| {title} | {' | '.join(rows)} |\n|---|{'---|' * len(rows)}")
    for name in names:
        cells = []
        for scores in rows.values():
            ratio, held = scores[name]
            cells.append(
                f"{ratio:.3f}".removeprefix("0") + ("" if math.isnan(held) else f" / {100 * held:.0f} %")
            )
        print(f"| {name} | {' | '.join(cells)} |")
    print(flush=True)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--sessions", type=int, default=4, help="judged sessions of each plant")
    parser.add_argument("--draws", type=int, default=12, help="freshly drawn plants of each family")
    parser.add_argument("--plants", nargs="+", choices=JUDGED, default=JUDGED)
    parser.add_argument("--out", type=Path, help="folder of data set and weights")
    given = parser.parse_args(argv)
    twin = mt.open_twin(shipped("scenes", "lab", "lab.usda"), magnetometer="physical")
    harmonic = mt.load_map(shipped("maps", "lab", "lab.usdc"))
    with contextlib.ExitStack() as stack:
        out = given.out or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        warnings.simplefilter("ignore", MismatchWarning)
        maps = trilinear_map(twin, out), harmonic
        data, naive_nt = training_set(twin, out, maps)
        hybrid = NeuralMagnetometer.load(shipped("weights", "turtlebot4_hybrid.safetensors"))
        first, median, worst, driven = {}, {}, {}, {}
        for family in given.plants:
            left = tuple(r.session for r in data.recordings if r.plant.startswith(f"{family}:"))
            weights = out / f"without_{family}.safetensors"
            model = mt.train(data, out=weights, model="mixed", hold_out=left, force=True).predictor

            def runs(plant: str, cases: Sequence[str], count: int) -> Iterator[tuple[str, Run]]:
                return ((c, judged_run(twin, plant, k, c)) for k in range(count) for c in cases)

            plant = "nominal" if family == "nominal" else f"{family}:0"
            every = list(runs(plant, tuple(PATHS), given.sessions))
            first[family] = means((c, judge(run, model, hybrid, maps, naive_nt)) for c, run in every)
            short = [(c, run) for c, run in every if c in DRAWN_PATHS]
            driven[family] = means((c, drives(run, model, maps, naive_nt)) for c, run in short)
            if family == "nominal" or not given.draws:
                continue
            draws = [
                means(
                    (c, judge(run, model, hybrid, maps, naive_nt))
                    for c, run in runs(f"{family}:{k}", DRAWN_PATHS, 1)
                )
                for k in range(1, given.draws + 1)
            ]
            arrays = {name: np.array([draw[name] for draw in draws]) for name in MODELS}
            median[family] = {
                n: (float(np.median(v[:, 0])), float(np.median(v[:, 1]))) for n, v in arrays.items()
            }
            worst[family] = {n: (float(v[:, 0].max()), float(v[:, 1].min())) for n, v in arrays.items()}
        print_table("one plant of each family, paths A to E", first, MODELS)
        if median:
            for name, table in (("median", median), ("worst", worst)):
                print_table(f"{name} of {given.draws} other plants, paths B, C, E", table, MODELS)
        print_table("calibrated by other drives, paths B, C, E", driven, [name for name, *_ in VARIANTS])


def trilinear_map(twin: Twin, out: Path) -> AnomalyMap:
    """The paper's map: trilinear, of a survey by the twin's robot, with errors as in the published one."""
    from magtwin.cli import main as magtwin

    out.mkdir(parents=True, exist_ok=True)
    survey, layer = out / "survey.parquet", out / "trilinear.usdc"
    errors = ("--heading-error-deg", "7", "--position-error-m", "0.015", "--readings", "135", "--seed", "7")
    scene = str(shipped("scenes", "lab", "lab.usda"))
    magtwin(["map", "survey", scene, "--out", str(survey), *errors, "--quiet", "--force"])
    magtwin(["map", "fit", str(survey), "--method", "trilinear", "--out", str(layer), "--quiet", "--force"])
    return mt.load_map(layer)


def training_set(
    twin: Twin, out: Path, maps: tuple[AnomalyMap, AnomalyMap]
) -> tuple["mt.learn.data.dataset.Dataset", float]:
    """Training recordings of all worlds, and the mean nominal label on the trilinear map [nT]."""
    runs = training_runs(twin)
    nominal = [run for name, run in runs.items() if name.startswith("nominal")]
    alignment: Alignment = fit_alignment(nominal, maps[1])
    naive_nt = np.nanmean(np.concatenate([labelled(run, maps[0])["label_nt"] for run in nominal]))
    data = mt.build_dataset(runs, out=out / "set", anomaly_map=maps[1], alignment=alignment, force=True)
    return data, float(naive_nt)


if __name__ == "__main__":
    main()
