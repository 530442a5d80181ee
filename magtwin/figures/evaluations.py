"""Evaluations: models against recordings as one report, with Table 1 and the figures of the paper."""

import csv
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.figures.canvas import Picture
from magtwin.figures.evaluation_pictures import (
    CURVES,
    EPOCH,
    floor_plan,
    learning_curves,
    path_errors,
    rank_correlations,
    time_series,
)
from magtwin.figures.page import WRITERS, Page, Section, Table
from magtwin.files import output
from magtwin.learn.evaluation.evaluation import PAPER, Case, Evaluation
from magtwin.learn.evaluation.scores import COVERED, DRAWS, LEVEL

NAME, PICTURES = "evaluation", "figures"
"""Name of the report's files, and of the folder with its pictures."""

MOST_COLUMNS = 12
"""Columns of a table. One with more paths is transposed."""


def page_of_evaluation(
    evaluation: Evaluation,
    *,
    title: str = "Evaluation",
    curves: Mapping[str, Sequence[Mapping[str, float]]] | None = None,
    more: Sequence[Section] = (),
    data: Mapping[str, Any] | None = None,
) -> Page:
    """The report of an evaluation.

    Args:
        evaluation: Result of `magtwin.learn.evaluation.evaluate.evaluate`.
        title: Title of the page.
        curves: Learning curves by model name, as `read_curve` gives them.
        more: Further sections, such as an error budget.
        data: Figures of these sections for the JSON form.
    """
    every = evaluation.every
    against = "the exact field" if evaluation.truth else "the reading"
    lead = (
        f"{len(evaluation.judged)} recordings of {every.sessions} sessions, {every.scores[0].rows:,} "
        "readings on which every model was evaluated. Errors: total field at the sensor, predicted minus "
        f"{against}."
    )
    verdicts = [f"{name}: {line}" for name, line in evaluation.verdicts().items()]
    tables = (_models(evaluation), _maps(evaluation), _left_out(evaluation))
    a_run = _known(time_series(evaluation), floor_plan(evaluation))
    by_path = _known(path_errors(evaluation), learning_curves(evaluation, curves or {}))
    sections = (
        Section("Table 1", _lead_of_table(evaluation), (), (_table(evaluation),)),
        Section("Models and maps", "", (), tables),
        Section("Inputs and the disturbance", "", _known(rank_correlations(evaluation))),
        Section("A run", "", a_run),
        Section("Errors by path", "", by_path),
        *more,
        Section("Every score", "", (), (_intervals(evaluation),)),
    )
    sections = tuple(section for section in sections if section.tables or section.pictures)
    return Page(title, " ".join([*verdicts, lead]), sections, data={**evaluation.summary(), **(data or {})})


def write_evaluation(page: Page, folder: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write a report as a folder: evaluation.html, .md and .json, and the pictures of the Markdown page.

    Args:
        page: The report.
        folder: The folder to make.
        force: Whether to replace an existing folder.

    Raises:
        InputError: The folder exists and `force` was not given.
    """
    with output(folder, force=force) as aside:
        (aside / PICTURES).mkdir(parents=True)
        sections = []
        for section in page.sections:
            pictures = []
            for k, picture in enumerate(section.pictures):
                file = f"{PICTURES}/{picture.file or f'picture_{k}'}.{picture.kind}"
                (aside / file).write_bytes(picture.data)
                pictures.append(replace(picture, file=file))
            sections.append(replace(section, pictures=tuple(pictures)))
        page = replace(page, sections=tuple(sections))
        for suffix, writer in WRITERS.items():
            (aside / f"{NAME}{suffix}").write_text(writer(page), encoding="utf-8")


def read_curve(weights: str | os.PathLike[str]) -> tuple[Mapping[str, float], ...]:
    """The learning curve that `magtwin train` wrote beside weights, by epoch; empty if there is none.

    Args:
        weights: The weights file.

    Raises:
        InputError: The CSV file beside the weights is not a learning curve.
    """
    path = Path(weights).with_suffix(".csv")
    if not path.is_file():
        return ()
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        if not rows or EPOCH not in rows[0]:
            return ()
        names = [EPOCH, *(name for name in CURVES if name in rows[0])]
        return tuple({name: float(row[name]) for name in names} for row in rows)
    except (OSError, ValueError, TypeError, csv.Error) as error:
        raise InputError(
            f"{path}: not a learning curve as `magtwin train` writes it ({error}); move it away"
        ) from error


def _known(*pictures: Picture | None) -> tuple[Picture, ...]:
    return tuple(picture for picture in pictures if picture is not None)


def _lead_of_table(evaluation: Evaluation) -> str:
    lead = (
        "Mean absolute error [nT], with its ratio to that of the naive model in brackets (lower is better). "
        "The naive model adds the mean training label to the first map. Intervals are "
        f"{LEVEL:.0%} bootstrap intervals: {DRAWS:,} draws of sessions, runs within them and blocks of time "
        "within those."
    )
    if evaluation.every.sessions == 1:
        lead += " With one session only runs and blocks are drawn: the intervals do not cover other sessions."
    return lead


def _table(evaluation: Evaluation) -> Table:
    """The paper's Table 1, transposed: one row per model."""
    cases = evaluation.cases
    head = ["model", *(_case_name(evaluation, case) for case in cases)]
    rows = [["readings", *(case.scores[0].rows for case in cases)]]
    for m, name in enumerate(evaluation.names):
        scores = [case.scores[m] for case in cases]
        rows.append([name, *(f"{s.mae_nt:.1f}" + (f" ({s.ratio:.3f})" if m else "") for s in scores)])
    paper = [PAPER.get(case.name) for case in cases]
    if any(paper):
        rows.append(["the paper's naive", *("" if p is None else f"{p[1]:.1f}" for p in paper)])
        network = ("" if p is None else f"{p[0]:.1f} ({p[2]:.3f})" for p in paper)
        rows.append(["the paper's network", *network])
    if len(head) > MOST_COLUMNS:
        head, *rows = (list(line) for line in zip(head, *rows, strict=True))
    note = "" if len(cases) < 3 else "mean: over the paths, with equal weights."
    return Table("Mean absolute errors", tuple(head), tuple(map(tuple, rows)), note)


def _case_name(evaluation: Evaluation, case: Case) -> str:
    """The name of a case, with its path if that differs."""
    path = next((one.path for one in evaluation.judged if one.case == case.name), case.name)
    return case.name if path == case.name else f"{case.name} ({path})"


def _intervals(evaluation: Evaluation) -> Table:
    """Every score with its interval, one row per model and case."""
    rows = tuple(
        (
            case.name,
            name,
            score.mae_nt,
            *score.mae_interval_nt,
            score.ratio,
            *score.ratio_interval,
            score.rmse_nt,
            score.bias_nt,
            f"{score.coverage:.1%}" if np.isfinite(score.coverage) else "no sd",
            f"{score.outside:.1%}",
        )
        for case in evaluation.cases
        for name, score in zip(evaluation.names, case.scores, strict=True)
    )
    head = ("path", "model", "MAE [nT]", "from", "to", "ratio", "from", "to", "RMSE [nT]", "bias [nT]")
    note = (
        f"from, to: {LEVEL:.0%} interval. coverage: share of the readings within the predicted "
        f"{COVERED:.0%} interval. out of distribution: share with an input outside the training ranges."
    )
    return Table("With intervals", (*head, "coverage", "out of distribution"), rows, note)


def _models(evaluation: Evaluation) -> Table:
    rows = tuple(
        (
            one.name,
            one.map.name,
            len(one.model.features),
            ", ".join(f"{1000 * part:.1f}" for part in one.alignment.lever_arm_m),
            1000 * one.alignment.latency_s,
            str(one.metadata.get("sha256", ""))[:12],
        )
        for one in evaluation.candidates
    )
    return Table("Models", ("model", "map", "inputs", "lever arm [mm]", "latency [ms]", "SHA-256"), rows)


def _maps(evaluation: Evaluation) -> Table:
    rows = []
    for named in evaluation.maps:
        mae, rms = evaluation.floor(named)
        expected = ("unknown", "unknown") if np.isnan(mae) else (mae, rms)
        rows.append((named.name, named.field.method, *expected, *_map_errors(evaluation, named.field)))
    head = ("map", "method", "expected MAE [nT]", "expected RMS [nT]", "map alone, MAE [nT]")
    note = (
        "expected: the map's error on these readings, according to its own variances; the noise floor of its "
        "labels. map alone: the map without a model of the robot, before and after its mean error is removed."
    )
    return Table("Maps", (*head, "less its mean [nT]"), tuple(rows), note)


def _map_errors(evaluation: Evaluation, field: AnomalyMap) -> tuple[float, float]:
    """MAE of a map without a model [nT], before and after its mean error on these readings is removed."""
    m = next(i for i, one in enumerate(evaluation.candidates) if one.map.field is field)
    error = np.concatenate([one.map_nt[m, one.kept] - one.measured_nt[one.kept] for one in evaluation.judged])
    return float(np.mean(np.abs(error))), float(np.mean(np.abs(error - error.mean())))


def _left_out(evaluation: Evaluation) -> Table:
    rows = tuple(evaluation.left_out.items())
    note = "All models are evaluated on the same readings." if rows else "None."
    return Table("Readings left out", ("reason", "readings"), rows, note)
