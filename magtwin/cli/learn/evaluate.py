"""`magtwin evaluate`: weights judged by recordings that they never saw, as in the paper's Table 1."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from magtwin.cli.app import app
from magtwin.cli.options import Force, Seed
from magtwin.cli.terminal import Done, progress, stdout_console, step
from magtwin.errors import InputError

if TYPE_CHECKING:
    from magtwin.figures.page import Section
    from magtwin.learn.data.dataset import Dataset
    from magtwin.learn.evaluation.evaluate import Chart, Contender, Evaluation, Trial
    from magtwin.run.run import Run
    from magtwin.spec.scene import Scene

Flag = Annotated[bool, Parameter(negative="")]
Files = Annotated[list[Path] | None, Parameter(negative="", consume_multiple=True)]
Names = Annotated[list[str] | None, Parameter(negative="", consume_multiple=True)]

MOST_CASES = 7
"""Rows of the table that a terminal has room for."""


@app.command
def evaluate(
    *weights: Annotated[Path, Parameter(required=True)],
    out: Path,
    runs: Files = None,
    dataset: Path | None = None,
    map: Files = None,  # noqa: A002
    train: Path | None = None,
    case: Names = None,
    scene: Path | None = None,
    overlay: Path | None = None,
    engine: Literal["kinematic", "newton"] | None = None,
    any_map: Flag = False,
    truth: Flag = False,
    seed: Seed = 0,
    force: Force = False,
) -> Done:
    """Measure the error of models on recordings, beside the naive model and Tolles and Lawson's.

    Errors are of the total field at the sensor. The report, DIR/evaluation.html, .md and .json, has Table
    1 with intervals, and the paper's Figures 2, 5, 6 and 7 of these recordings.

    Parameters
    ----------
    weights
        Weights files of any kind, the released .pth too.
    out
        Folder of the report to make.
    runs
        Recordings of any kind to judge by; a folder that `magtwin runs` made stands for all of its runs.
    dataset
        In place of runs, a data set: the recordings of it that no weights learned from.
    map
        Maps that the weights were trained on, each found by its checksum; the first, the paper's trilinear
        one, is the naive model's, and that of weights which record no map. Default: that of the scene.
    train
        Data set that the naive mean and the Tolles-Lawson baselines are fitted to, labelled on each map anew.
        Without it the mean is that of weights trained on the first map, and there are no baselines.
    case
        Rows of the table by the path that they are of, as D=lawnmower.csv, beside the paper's A to E.
    scene
        Stage of the twin that made the recordings, training's too: adds an error budget, how much of the
        error is map, lever arm, latency, sessions, platform and sensor. Needs train.
    overlay
        Another recording of a path that is judged by, laid over that one: the paper's Figure 8.
    engine
        Drive the first recording's path once more in the scene, moved by this engine and with another seed,
        and lay it over that one: the paper's Figure 8.
    any_map
        Take the first map for weights whose own is not at hand.
    truth
        Judge by the exact field, which simulated runs know, in place of the reading.
    seed
        Seed of the intervals' draws.
    """
    from json import loads

    import numpy as np

    from magtwin.figures.evaluations import page_of_evaluation, read_curve, write_evaluation
    from magtwin.figures.page import to_json
    from magtwin.files import check_free
    from magtwin.learn.evaluation import evaluate as room

    check_free(out, force=force)
    if scene is not None and map and train is None and engine is None:
        raise InputError(
            "--scene adds an error budget, for which --train is needed too; give it, or no --scene"
        )
    step("Reading maps and weights")
    charts = _charts(map, scene)
    names = _short(weights)
    own = [
        room.contender(path, charts, any_map=any_map, name=name)
        for path, name in zip(weights, names, strict=True)
    ]
    step("Reading the data set")
    trials, learned = _trials(runs, dataset, train, own)
    step("Fitting the Tolles-Lawson baselines")
    baselines = [] if train is None else _baselines(charts, own, *learned[0])
    first = room.naive(charts[0], dataset=learned[0][0], names=learned[0][1]) if learned else None
    first = first or room.naive(charts[0], weights=own)
    with progress("Judging", "recordings") as advance:
        found = room.evaluate(
            [first, *own, *baselines],
            trials,
            rng=np.random.default_rng(seed),
            cases=_cases(case),
            truth=truth,
            progress=advance,
        )
    sections, data = [], {}
    if scene is not None and train is not None:
        with progress("Error budgets", "models") as advance:
            section, told = _budget(found, scene, *learned[0], advance)
        sections.append(section)
        data["budget"] = told
    if overlay is not None or engine is not None:
        section, told = _traversals(found, scene, overlay, engine)
        sections.append(section)
        data["traversals"] = told
    step("Writing the report")
    curves = {name: read_curve(path) for path, name in zip(weights, names, strict=True)}
    page = page_of_evaluation(found, curves=curves, more=sections, data=data)
    write_evaluation(page, out, force=force)
    written = f"Wrote {out}: evaluation.html, evaluation.md, evaluation.json"
    return Done(table=lambda: _print(found), text=written, data=loads(to_json(page)))


def _charts(maps: Sequence[Path] | None, scene: Path | None) -> "list[Chart]":
    """The maps at hand; of a scene its own."""
    from magtwin.files import existing, sha256
    from magtwin.io.surveys.maps import open_map
    from magtwin.learn.evaluation.evaluate import chart_of

    files = list(maps or ())
    if not files and scene is not None:
        from magtwin.usd.scene import read_scene

        files = [read_scene(existing(scene, "scene"), check_network=False).map_layer]
    if not files:
        raise InputError(
            "no map: name those that the weights were trained on (--map), or the scene (--scene)"
        )
    found = []
    for path, name in zip(files, _short(files), strict=True):
        field = open_map(existing(path, "map"))
        found.append(chart_of(name, field, *([sha256(path)] if path.is_file() else [])))
    return found


def _short(files: Sequence[Path]) -> list[str]:
    """What to call files: their stems, or more of their paths where two have one."""
    for called in (lambda path: path.stem, lambda path: path.name, str):
        names = [called(path) for path in files]
        if len(set(names)) == len(names):
            return names
    twice = next(path for path in files if list(files).count(path) > 1)
    raise InputError(f"{twice} is named twice; name each file once")


def _trials(
    runs: Sequence[Path] | None, dataset: Path | None, train: Path | None, own: "Sequence[Contender]"
) -> "tuple[list[Trial], list[tuple[Dataset, tuple[str, ...]]]]":
    """Recordings to judge by; and the data set that baselines are fitted to, with its recordings for that."""
    from magtwin.cli.learn.dataset import _files, _sources
    from magtwin.learn.data.dataset import open_dataset
    from magtwin.learn.evaluation.evaluate import Trial, check_apart, trials_of, unlearned, unseen

    if (runs is None) == (dataset is None):
        raise InputError("judge by --runs or by a --dataset, one of the two")
    learning = None if train is None else open_dataset(train)
    learned = [] if learning is None else [(learning, learning.names)]
    if dataset is None:
        sources = _sources(_files(runs or []), "metadata", "metadata", {})
        trials = [Trial(one.name, one.read) for one in sources]
        return (trials if learning is None else unlearned(trials, learning)), learned
    judged = open_dataset(dataset)
    names, rest = unseen(judged, own)
    if learning is not None:
        if learning.folder.resolve() == judged.folder.resolve():
            learned = [(learning, tuple(name for name in rest if name not in names))]
        check_apart(*learned[0], judged, names)
    return trials_of(judged, names), learned


def _baselines(
    charts: "Sequence[Chart]", own: "Sequence[Contender]", dataset: "Dataset", names: Sequence[str]
) -> "list[Contender]":
    """Tolles and Lawson's on each map: as it stands, with the weights' lever arm and latency, and with terms
    of the map's gradient.
    """
    from magtwin.learn.data.labels import Alignment
    from magtwin.learn.evaluation.evaluate import tolles_lawson

    found = []
    for chart in charts:
        fitted = [one.alignment for one in own if one.chart is chart and one.alignment != Alignment()]
        found.append(tolles_lawson(chart, dataset, names))
        if fitted and found[-1].alignment == Alignment():
            found.append(tolles_lawson(chart, dataset, names, alignment=fitted[0]))
        aligned = found[-1].alignment if found[-1].alignment in fitted else None
        found.append(tolles_lawson(chart, dataset, names, gradient=True, alignment=aligned))
    return found


def _budget(
    found: "Evaluation", scene: Path, train: "Dataset", names: Sequence[str], advance: Any
) -> "tuple[Section, dict[str, Any]]":
    """The error budget of a twin, as a section and in figures."""
    from magtwin.figures.budgets import section_of_budget
    from magtwin.learn.evaluation.budget import Truth, budgets, steps, true_errors
    from magtwin.twin import Twin, check_scene, in_session_of, open_twin

    twins: dict[Any, Twin] = {}

    def opened(kind: Any) -> Twin:
        if kind not in twins:
            twins[kind] = open_twin(scene, magnetometer=kind)
        return twins[kind]

    def day_of(name: str, run: "Run") -> "Scene":
        day = in_session_of(opened(run.metadata.get("magnetometer")), run.metadata).scene
        check_scene(day, run.metadata, name)
        return day

    truth = Truth(opened("physical").scene, day_of)
    order = steps(found)
    made = budgets(found, order, truth, train, names, progress=advance)
    missed = true_errors(found, truth)
    told = {
        "models": [one.summary() for one in made],
        "maps": {one.chart: {k: v for k, v in vars(one).items() if k != "chart"} for one in missed},
        "steps": [found.names[m] for m in order],
    }
    return section_of_budget(found, made, missed, order), told


def _traversals(
    found: "Evaluation", scene: Path | None, overlay: Path | None, engine: str | None
) -> "tuple[Section, dict[str, Any]]":
    """One path driven twice, as a section and in figures."""
    from magtwin.figures.comparisons import section_of_traversals
    from magtwin.io.formats import read_run
    from magtwin.io.provenance import made_again
    from magtwin.run.compare import traversals

    if overlay is not None and engine is not None:
        raise InputError("--overlay and --engine both say what to lay over a recording; give one of them")
    first = found.judged[0]
    if overlay is not None:
        other, name = read_run(overlay), overlay.stem
        path = str(other.metadata.get("path", ""))
        able = [one for one in found.judged if one.path == path and one.name != name]
        first = able[0] if able else first
    else:
        seed = first.run.metadata.get("seed")
        seed = seed + 1 if isinstance(seed, int) and seed >= 0 else 1
        with progress(f"Driving {first.path}", "steps") as advance:
            other = made_again(first.run, scene, engine=engine, seed=seed, progress=advance)
        name = f"{first.path} by {engine}"
    both = traversals(first.run, other)
    return section_of_traversals(both, (first.name, name)), both.summary()


def _cases(given: Sequence[str] | None) -> dict[str, str]:
    """Rows by name from words such as D=lawnmower.csv."""
    from magtwin.learn.evaluation.evaluate import TOTALS

    found: dict[str, str] = {}
    for word in given or ():
        name, equals, path = word.partition("=")
        if not (name and equals and path) or name in found or name in TOTALS:
            raise InputError(f"--case is a row of the table and its path, as D=lawnmower.csv, got {word!r}")
        found[name] = path
    return found


def _print(found: "Evaluation") -> None:
    """Table 1 for people: a line a model, its error, and its ratio to the naive one by path."""
    from rich.table import Table
    from rich.text import Text

    console = stdout_console()
    most = MOST_CASES if console.is_terminal else len(found.cases)
    shown = [*found.cases[:most], *(case for case in found.cases[most:] if case is found.every)]
    table = Table(box=None, pad_edge=False)
    table.add_column("ratio to naive", overflow="fold")
    for column in (*(case.name for case in shown), "MAE", "90 %"):
        table.add_column(Text(column), justify="right", overflow="fold", min_width=4)
    for m, name in enumerate(found.names):
        score = found.every.scores[m]
        covered = "" if math.isnan(score.coverage) else f"{score.coverage:.0%}"
        ratios = [f"{case.scores[m].ratio:.3f}" for case in shown]
        table.add_row(*map(Text, (name, *ratios, f"{score.mae_nt:.0f} nT", covered)))
    readings = found.every.scores[0].rows
    console.print(Text(f"{readings:,} readings of {len(found.judged)} recordings", style="bold"))
    console.print(table)
    for name, line in found.verdicts().items():
        console.print(Text(f"{name}: {line}", style="bold"), soft_wrap=True)
    for why, count in found.left_out.items():
        console.print(Text(f"left out: {count:,} readings that {why}", style="dim"))
