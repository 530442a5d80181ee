"""Magnetometer models on plants that they never saw: the tables of docs/calibrate.md.

A twin of the default lab is surveyed, and its robot drives in many worlds: the nominal plant, and plants of
the families of `magtwin.draw_plant`. Models learn on nominal sessions; a mixed model also learns how sessions
differ from worlds of all families but the one that is judged. Judged is the total field on the paths A to E
of the paper's Table 1, after a drive of 60 s along `loops`, in new sessions of a new world. The poses of that
drive, and those that become known 10 s late online, have an error of 3 cm on each axis, correlated over 2 s.

Ratios are the MAE divided by that of the naive model (trilinear map and mean training label), averaged over
the paths; beside them stands the share of readings in the models' own 90 % intervals. "all" has every effect
at once; its model has learned from the single families.

    python benchmarks/plants.py [--sessions 4] [--draws 12] [--out FOLDER]

FOLDER keeps data sets and weights. Takes some minutes.
"""

import argparse
import contextlib
import math
import tempfile
import time
import warnings
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

import magtwin as mt
from magtwin.errors import MismatchWarning
from magtwin.field.maps.map import AnomalyMap
from magtwin.files import shipped
from magtwin.learn.data.alignment import Alignment, alignment_of, fit_alignment
from magtwin.learn.data.labels import labelled, labels
from magtwin.learn.inference.magnetometer import NeuralMagnetometer
from magtwin.learn.inference.online import read_online
from magtwin.learn.models.mixed import Mixed
from magtwin.path import loops, path_named
from magtwin.run.run import Run
from magtwin.twin import Twin, in_session, with_plant
from magtwin.verdict import Z_90

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
    *("naive + offset", "ridge", "ridge + offset", "hybrid", "hybrid + offset"),
    *("mixed", "mixed, unknown plant", "mixed, calibrated", "mixed, online"),
)
Scores = dict[str, tuple[float, float]]
"""Ratio and coverage of each model."""


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


def with_pose_error(run: Run, seed: int) -> Run:
    """The run with errors of its poses, an Ornstein-Uhlenbeck process on each axis."""
    rng = np.random.default_rng(seed)
    a = math.exp(-1 / (RATE_HZ * POSE_S))
    error = rng.standard_normal((run.rows, 2))
    for k in range(1, run.rows):
        error[k] = a * error[k - 1] + math.sqrt(1 - a * a) * error[k]
    return run.with_columns(mocap_p=run["mocap_p"] + POSE_SD_M * np.column_stack([error, np.zeros(run.rows)]))


def judge(
    run: Run, mixed: Mixed, hybrid: NeuralMagnetometer, maps: tuple[AnomalyMap, AnomalyMap], naive_nt: float
) -> dict[str, tuple[float, float]]:
    """MAE [nT] and coverage of every model on the path, and of the naive model."""
    trilinear, harmonic = maps
    rough = with_pose_error(run, int(run.metadata["seed"]))
    early, late = run["t"] < DRIVE_S, run["t"] > DRIVE_S + 5
    exact = labelled(run, harmonic, alignment_of(mixed.metadata))
    label, noisy = exact["label_nt"], labelled(rough, harmonic, alignment_of(mixed.metadata))["label_nt"]
    late &= np.isfinite(label)
    plain, plain_noisy = labels(run, trilinear).value_nt, labels(rough, trilinear).value_nt
    scores = {}

    def score(name: str, error: np.ndarray, sd: np.ndarray | None = None) -> None:
        known = late & np.isfinite(error)
        held = math.nan if sd is None else float(np.mean(np.abs(error[known]) < Z_90 * sd[known]))
        scores[name] = float(np.mean(np.abs(error[known]))), held

    score("naive", naive_nt - plain)
    score("naive + offset", np.nanmean(plain_noisy[early]) - plain)
    own = labelled(run, harmonic, alignment_of(hybrid.net.metadata))
    own_noisy = labelled(rough, harmonic, alignment_of(hybrid.net.metadata))["label_nt"]
    for name, net, truth, given in (
        ("ridge", NeuralMagnetometer(mixed), exact, noisy),
        ("hybrid", hybrid, own, own_noisy),
    ):
        read = net.read([truth], outside=False)[0]
        error = read.disturbance_nt - truth["label_nt"]
        score(name, error, read.sd_nt)
        score(f"{name} + offset", error - np.nanmean((read.disturbance_nt - given)[early]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        drive = mt.calibrate(mixed, rough, anomaly_map=harmonic, duration_s=DRIVE_S, pose_sd_m=POSE_SD_M)
    for name, model in (
        ("mixed", mixed),
        ("mixed, unknown plant", mixed.open_loop(unknown_plant=True)),
        ("mixed, calibrated", drive),
    ):
        read = NeuralMagnetometer(model).read([exact], outside=False)[0]
        score(name, read.disturbance_nt - label, read.sd_nt)
    read = read_online(mixed, rough, harmonic, pose_sd_m=POSE_SD_M)
    score("mixed, online", read.disturbance_nt - label, read.sd_nt)
    return scores


def table(scores: Iterator[tuple[str, dict[str, tuple[float, float]]]]) -> Scores:
    """Ratios and coverages, each path with the same weight."""
    by_path: dict[str, dict[str, list[tuple[float, float]]]] = defaultdict(lambda: defaultdict(list))
    for path, models in scores:
        for name, values in models.items():
            by_path[path][name].append(values)
    means = {p: {n: np.mean(v, axis=0) for n, v in models.items()} for p, models in by_path.items()}
    return {
        name: (
            float(np.mean([models[name][0] / models["naive"][0] for models in means.values()])),
            float(np.mean([models[name][1] for models in means.values()])),
        )
        for name in MODELS
    }


def show(title: str, scores: Scores) -> None:
    cells = (f"{name} {ratio:.3f}/{held:.2f}" for name, (ratio, held) in scores.items())
    print(f"{title:24s} {'  '.join(cells)}".replace("/nan", ""), flush=True)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--sessions", type=int, default=4, help="judged sessions of each plant")
    parser.add_argument("--draws", type=int, default=12, help="freshly drawn plants of each family")
    parser.add_argument("--plants", nargs="+", choices=JUDGED, default=JUDGED)
    parser.add_argument("--out", type=Path, help="folder of data sets and weights")
    given = parser.parse_args(argv)
    begun = time.perf_counter()
    twin = mt.open_twin(shipped("scenes", "lab", "lab.usda"), magnetometer="physical")
    harmonic = mt.load_map(shipped("maps", "lab", "lab.usdc"))
    with contextlib.ExitStack() as stack:
        out = given.out or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        warnings.simplefilter("ignore", MismatchWarning)
        maps = trilinear_map(twin, out), harmonic
        data, naive_nt = training_set(twin, out, maps)
        hybrid = NeuralMagnetometer.load(shipped("weights", "turtlebot4_hybrid.safetensors"))
        for family in given.plants:
            left = [r.session for r in data.recordings if r.plant.startswith(f"{family}:")]
            weights = out / f"without_{family}.safetensors"
            model = mt.train(data, out=weights, model="mixed", hold_out=tuple(left), force=True).predictor
            assert isinstance(model, Mixed)
            plant = "nominal" if family == "nominal" else f"{family}:0"

            def scored(plant: str, cases: Sequence[str], sessions: int, model: Mixed = model) -> Scores:
                return table(
                    (case, judge(judged_run(twin, plant, k, case), model, hybrid, maps, naive_nt))
                    for k in range(sessions)
                    for case in cases
                )

            show(family, scored(plant, tuple(PATHS), given.sessions))
            if family != "nominal" and given.draws:
                draws = [scored(f"{family}:{k}", DRAWN_PATHS, 1) for k in range(1, given.draws + 1)]
                every = {name: np.array([draw[name] for draw in draws]) for name in MODELS}
                show("  median of draws", {n: tuple(np.median(v, axis=0)) for n, v in every.items()})
                worst = {n: (float(v[:, 0].max()), float(v[:, 1].min())) for n, v in every.items()}
                show("  worst of draws", worst)
    print(f"{(time.perf_counter() - begun) / 60:.1f} min")


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
    naive_nt = np.nanmean(np.concatenate([labels(run, maps[0]).value_nt for run in nominal]))
    data = mt.build_dataset(runs, out=out / "set", anomaly_map=maps[1], alignment=alignment, force=True)
    return data, float(naive_nt)


if __name__ == "__main__":
    main()
