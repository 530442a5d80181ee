"""Info: what a run, a stage, a map or a network holds."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

from magtwin.errors import InputError, hint
from magtwin.field.maps.statistics import map_metadata
from magtwin.field.survey.nodes import read_survey
from magtwin.files.file import existing
from magtwin.files.kinds import kind_of, shipped_or
from magtwin.io.formats import FORMATS, is_bag, read_run
from magtwin.io.surveys.columns import Columns
from magtwin.io.surveys.logs import is_survey
from magtwin.report.report import Figure, Report

STAGES = (".usd", ".usda", ".usdc", ".usdz")
NETWORKS = (".safetensors", ".pth", ".onnx")


def info_of(
    path: str | os.PathLike[str],
    *,
    columns: Columns | None = None,
    waypoints: Path | None = None,
    step_m: float | None = None,
    **reading: Any,
) -> Report:
    """A report on the content and origin of a file: a run, stage, map, survey, table, log or network.

    `columns`, `waypoints` and `step_m` are options of `magtwin.io.surveys.readings.read_readings`, for a
    survey, and `reading` those of `magtwin.io.formats.read_run`, for a run.
    """
    file = existing(shipped_or(Path(path)), "file")
    unit: dict[str, Any] = {name: reading.get(name) for name in ("unit", "scale")}
    told = columns or Columns(**unit)
    if not is_bag(file) and is_survey(file):
        if "topics" in reading:
            raise InputError(f"{file}: no bag; drop --field-topic, --pose-topic and --remap")
        from magtwin.io.surveys.doctor import info_of_survey

        return info_of_survey(file, told, waypoints, step_m)
    if waypoints is not None or step_m is not None or replace(told, unit=None, scale=None) != Columns():
        text = "no table of readings; drop --waypoints, --step-m and the options that name columns"
        raise InputError(f"{file}: {text}")
    if is_bag(file):
        from magtwin.io.recording.contents import info_of_bag

        report = info_of_bag(file, **reading)
        if "written by" not in report.metadata:
            return report
        run = info_of_run(file, **reading)
        return replace(run, metadata={**run.metadata, "topics": report.metadata["topics"]})
    if file.is_dir():
        gridded = any(file.glob("*_map.csv"))
        return map_metadata(read_survey(file)[0]) if gridded else info_of_run(file, **reading)
    if reading and file.suffix.lower() in (*NETWORKS, *STAGES):
        raise InputError(f"{file}: no recording; drop the option {next(iter(reading))!r}")
    if file.suffix.lower() in NETWORKS:
        from magtwin.learn.inference.onnx import report_onnx
        from magtwin.learn.models.predictor import load_predictor

        return report_onnx(file) if file.suffix.lower() == ".onnx" else load_predictor(file).report(str(file))
    if file.suffix.lower() in STAGES:
        return _info_of_usd(file)
    if file.suffix.lower() in FORMATS:
        return info_of_run(file, **reading)
    if kind := kind_of(file):
        raise InputError(f"{file}: is {kind.noun}; {kind.remedy.format(file=file)}")
    known = hint(file.suffix, {*FORMATS, *STAGES, *NETWORKS})
    raise InputError(f"{file}: unknown kind of file {file.suffix!r}; {known}")


def info_of_run(file: Path, **reading: Any) -> Report:
    """Rows, duration, what was driven and read, sources, and each column with its unit and frame."""
    run = read_run(file, **reading)
    report = run.report(str(file))
    columns = {}
    for name, values in run.items():
        spec, width = run.spec(name), f" x {values.shape[1]}" if values.ndim > 1 else ""
        words = (spec.unit or "-", spec.frame and f"in {spec.frame}", spec.doc)
        columns[name + width] = "  ".join(word for word in words if word)
    figures = (*report.figures[:2], Figure("columns", len(run)), *report.figures[2:])
    return replace(report, figures=figures, metadata={**report.metadata, "columns": columns})


def _info_of_usd(file: Path) -> Report:
    from magtwin.usd.animation import is_animation
    from magtwin.usd.info import info_of_stage
    from magtwin.usd.maps.layer import is_map_layer, load_map

    if file.suffix.lower() != ".usdz" and is_animation(file):
        run = info_of_run(file)
        try:
            return replace(run, figures=(*run.figures, *info_of_stage(file).figures))
        except InputError as error:  # the scene is missing, the run is complete
            return replace(run, metadata={**run.metadata, "stage": str(error)})
    if file.suffix.lower() == ".usdz" or not is_map_layer(file):
        return info_of_stage(file)
    card = map_metadata(load_map(file))
    stage = [figure for figure in info_of_stage(file).figures if figure.value != 0]
    return replace(card, title=f"{card.title} ({file})", figures=(*card.figures, *stage))
