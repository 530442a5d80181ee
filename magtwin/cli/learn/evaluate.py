"""`magtwin evaluate`: errors of models on recordings that they never saw, as in the paper's Table 1."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from magtwin.cli.app import app
from magtwin.cli.options import Flag, Force, Names, Seed, pairs, reads_recordings
from magtwin.cli.terminal import Done, named, progress, step, width
from magtwin.errors import InputError
from magtwin.report.summary import aligned, clipped

if TYPE_CHECKING:
    from magtwin.learn.evaluation.evaluation import Evaluation
    from magtwin.run.compare import Traversals

Files = Annotated[list[Path] | None, Parameter(consume_multiple=True)]

MOST_CASES = 7
"""Most rows of the table on a terminal."""


@app.command
@reads_recordings
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
    any_map
        Use the first map for weights whose own map is not at hand.
    truth
        Judge by the exact field of simulated runs instead of the reading.
    seed
        Seed of the intervals.
    """
    from json import loads

    from magtwin.figures.evaluations import NAME, page_of_evaluation
    from magtwin.figures.page import to_json, write_pages
    from magtwin.learn.evaluation.evaluation import TOTALS
    from magtwin.tasks.learning import error_budget, map_of_scene
    from magtwin.tasks.learning import evaluate as evaluate_models

    if scene is not None and map and train is None:
        raise InputError(
            "--scene adds an error budget, for which --train is needed too; give it, or no --scene"
        )
    if (runs is None) == (dataset is None):
        raise InputError("judge by --runs or by a --dataset, one of the two")
    cases = pairs("case", case, "a row of the table and its path, such as D=lawnmower.csv")
    if taken := cases.keys() & set(TOTALS):
        raise InputError(f"--case {min(taken)} is a row of the table already; take another name")
    out = named(out, force=force)
    step("Reading maps, weights and recordings")
    with progress("Judging", "recordings") as advance:
        how: Any = {"train": train, "cases": cases, "any_map": any_map, "truth": truth, "seed": seed}
        how["anomaly_map"] = map or ([] if scene is None else [map_of_scene(scene)])
        evaluation = evaluate_models(weights, dataset or runs or [], progress=advance, **how)
    budgets: tuple[Any, ...] = ()
    if scene is not None and train is not None:
        with progress("Error budgets", "models") as advance:
            budgets = error_budget(evaluation, scene, train, progress=advance)
    both = None if overlay is None else _overlaid(evaluation, overlay)
    step("Writing the report")
    page = page_of_evaluation(evaluation, budgets=budgets, both=both)
    write_pages(page, out, NAME, force=force)
    html = out / f"{NAME}.html"
    wrote, following = (html, html.with_suffix(".json")), [("magtwin", "info", weights[0])]
    data, lines = loads(to_json(page)), _lines(evaluation)
    return Done(lines=lines, wrote=wrote, data=data, rest=str(html), next=following)


def _overlaid(evaluation: "Evaluation", overlay: Path) -> "tuple[Traversals, tuple[str, str]]":
    """The judged recording of an overlay's path, else the first, over the overlay, and their names."""
    from magtwin.io.formats import read_run
    from magtwin.run.compare import traversals

    other, name = read_run(overlay), overlay.stem
    same = [each for each in evaluation.judged if each.path == str(other.metadata.get("path", ""))]
    first = next((each for each in same if each.name != name), evaluation.judged[0])
    return traversals(first.run, other), (first.name, name)


def _lines(evaluation: "Evaluation") -> list[str]:
    """Verdicts, and Table 1: for each model the ratio to the naive error by path, its error and coverage."""
    lines = [f"{name}: {line}" for name, line in evaluation.verdicts().items()]
    lines.append(f"{evaluation.every.scores[0].rows:,} readings of {len(evaluation.judged)} recordings")
    room, table = width() or 100, list[str]()
    for most in range(MOST_CASES, -1, -1):  # as many paths as are not wider than the terminal
        shown = [case for case in evaluation.cases[:most] if case is not evaluation.every]
        rows = [("ratio to naive", *(case.name for case in (*shown, evaluation.every)), "MAE", "90 %")]
        for m, name in enumerate(evaluation.names):
            score = evaluation.every.scores[m]
            covered = "" if math.isnan(score.coverage) else f"{score.coverage:.0%}"
            ratios = [f"{case.scores[m].ratio:.3f}" for case in (*shown, evaluation.every)]
            rows.append((clipped(name, 40), *ratios, f"{score.mae_nt:.0f} nT", covered))
        table = aligned(rows, right=range(1, len(rows[0])))
        if max(map(len, table)) <= room:
            break
    left = [f"left out: {count:,} readings that {reason}" for reason, count in evaluation.left_out.items()]
    return [*lines, *left, *table]
