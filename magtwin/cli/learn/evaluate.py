"""`magtwin evaluate`: errors of models on recordings that they never saw, as in the paper's Table 1."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from magtwin.cli.app import app
from magtwin.cli.options import Flag, Force, Names, Seed, pairs
from magtwin.cli.terminal import Done, progress, stdout_console, step
from magtwin.errors import InputError

if TYPE_CHECKING:
    from magtwin.figures.page import Section
    from magtwin.learn.evaluation.evaluation import Evaluation

Files = Annotated[list[Path] | None, Parameter(consume_multiple=True)]

MOST_CASES = 7
"""Most rows of the table on a terminal."""


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
    """Measure the errors of models on recordings, beside the naive model and Tolles and Lawson's.

    Errors are of the total field at the sensor. The report, DIR/evaluation.html and .json, has Table
    1 with intervals, and the paper's Figures 2, 5, 6 and 7 of these recordings.

    Parameters
    ----------
    weights
        Weights files of any kind, the released .pth too.
    out
        Folder of the report to make.
    runs
        Recordings of any kind to judge by; a folder that `magtwin sweep` made stands for all of its runs.
    dataset
        Data set in place of runs: its held-out recordings are used.
    map
        Maps that the weights were trained on, each found by its checksum. The first, in the paper the
        trilinear one, is the naive model's, and that of weights that record no map. Default: the map of the
        scene.
    train
        Data set that the naive mean and the Tolles-Lawson baselines are fitted to, labelled anew on each map.
        Without it the mean is that of weights trained on the first map, and there are no baselines.
    case
        Rows of the table and their paths, such as D=lawnmower.csv, beside the paper's A to E.
    scene
        Stage of the twin that made the recordings and the training recordings. Adds an error budget: map,
        lever arm, latency, sessions, platform and sensor. Needs train.
    overlay
        Another recording of a path, to compare with the one that is judged by: the paper's Figure 8.
    engine
        Drive the first recording's path again in the scene, with this engine and another seed, and compare
        the two: the paper's Figure 8.
    any_map
        Use the first map for weights whose own map is not at hand.
    truth
        Judge by the exact field of simulated runs instead of the reading.
    seed
        Seed of the intervals.
    """
    from json import loads

    from magtwin.figures.budgets import section_of_budget
    from magtwin.figures.evaluations import page_of_evaluation, read_curve, write_evaluation
    from magtwin.figures.page import to_json
    from magtwin.files.outputs import check_free
    from magtwin.learn.evaluation.evaluation import TOTALS
    from magtwin.tasks.learning import error_budget, map_of_scene, short_names
    from magtwin.tasks.learning import evaluate as evaluate_models

    check_free(out, force=force)
    if scene is not None and map and train is None and engine is None:
        raise InputError(
            "--scene adds an error budget, for which --train is needed too; give it, or no --scene"
        )
    if (runs is None) == (dataset is None):
        raise InputError("judge by --runs or by a --dataset, one of the two")
    if overlay is not None and engine is not None:
        raise InputError("--overlay and --engine both name a drive to compare with; give one of them")
    cases = pairs("case", case, "a row of the table and its path, such as D=lawnmower.csv")
    if taken := cases.keys() & set(TOTALS):
        raise InputError(f"--case {min(taken)} is a row of the table already; take another name")
    step("Reading maps, weights and recordings")
    with progress("Judging", "recordings") as advance:
        evaluation = evaluate_models(
            weights,
            dataset or runs or [],
            anomaly_map=map or ([] if scene is None else [map_of_scene(scene)]),
            train=train,
            cases=cases,
            any_map=any_map,
            truth=truth,
            seed=seed,
            progress=advance,
        )
    sections, data = [], {}
    if scene is not None and train is not None:
        with progress("Error budgets", "models") as advance:
            budget = error_budget(evaluation, scene, train, progress=advance)
        sections.append(section_of_budget(evaluation, budget.budgets, budget.map_errors, budget.order))
        data["budget"] = budget.summary()
    if overlay is not None or engine is not None:
        section, data["traversals"] = _traversals(evaluation, scene, overlay, engine)
        sections.append(section)
    step("Writing the report")
    curves = {name: read_curve(path) for path, name in zip(weights, short_names(weights), strict=True)}
    page = page_of_evaluation(evaluation, curves=curves, more=sections, data=data)
    write_evaluation(page, out, force=force)
    written = f"Wrote {out}: evaluation.html, evaluation.json"
    return Done(table=lambda: _print(evaluation), text=written, data=loads(to_json(page)))


def _traversals(
    evaluation: "Evaluation", scene: Path | None, overlay: Path | None, engine: str | None
) -> "tuple[Section, dict[str, Any]]":
    """One path driven twice, as a section and as figures."""
    from magtwin.figures.reports import section_of_traversals
    from magtwin.io.formats import read_run
    from magtwin.io.provenance import made_again
    from magtwin.run.compare import traversals

    first = evaluation.judged[0]
    if overlay is not None:
        other, name = read_run(overlay), overlay.stem
        path = str(other.metadata.get("path", ""))
        same = [each for each in evaluation.judged if each.path == path and each.name != name]
        first = same[0] if same else first
    else:
        seed = first.run.metadata.get("seed")
        seed = seed + 1 if isinstance(seed, int) and seed >= 0 else 1
        with progress(f"Driving {first.path}", "steps") as advance:
            other = made_again(first.run, scene, engine=engine, seed=seed, progress=advance)
        name = f"{first.path} by {engine}"
    both = traversals(first.run, other)
    return section_of_traversals(both, (first.name, name)), both.summary()


def _print(evaluation: "Evaluation") -> None:
    """Print Table 1: for each model its error, and the ratio to the naive error by path."""
    from rich.table import Table
    from rich.text import Text

    console = stdout_console()
    most = MOST_CASES if console.is_terminal else len(evaluation.cases)
    shown = [
        *evaluation.cases[:most],
        *(case for case in evaluation.cases[most:] if case is evaluation.every),
    ]
    table = Table(box=None, pad_edge=False)
    table.add_column("ratio to naive", overflow="fold")
    for column in (*(case.name for case in shown), "MAE", "90 %"):
        table.add_column(Text(column), justify="right", overflow="fold", min_width=4)
    for m, name in enumerate(evaluation.names):
        score = evaluation.every.scores[m]
        covered = "" if math.isnan(score.coverage) else f"{score.coverage:.0%}"
        ratios = [f"{case.scores[m].ratio:.3f}" for case in shown]
        table.add_row(*map(Text, (name, *ratios, f"{score.mae_nt:.0f} nT", covered)))
    readings = evaluation.every.scores[0].rows
    console.print(Text(f"{readings:,} readings of {len(evaluation.judged)} recordings", style="bold"))
    console.print(table)
    for name, line in evaluation.verdicts().items():
        console.print(Text(f"{name}: {line}", style="bold"), soft_wrap=True)
    for reason, count in evaluation.left_out.items():
        console.print(Text(f"left out: {count:,} readings that {reason}", style="dim"))
