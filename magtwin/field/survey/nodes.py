"""Nodes: the map whose values are a gridded survey's own readings, and maps written as survey folders."""

import json
import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from magtwin.errors import InputError
from magtwin.field.grid import Grid
from magtwin.field.maps.curvature import interpolation_error_nt2
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.maps.statistics import statistics
from magtwin.field.survey.folder import (
    COLUMNS,
    ERROR,
    KEPT,
    MASKED,
    SUFFIX,
    Layer,
    common,
    degrees,
    heading_doubts,
    read_layers,
)
from magtwin.field.survey.node_errors import node_errors
from magtwin.field.survey.readings import Readings, taken_of
from magtwin.field.survey.stuck import mask_stuck
from magtwin.files.outputs import output
from magtwin.frames import wrap_angle
from magtwin.report.report import Figure, Report

# Method of a map whose values are readings
METHOD = "survey, one reading a node and heading, the robot at rest"


OFF_NODE = 0.02  # Largest distance of a place from its node, in spacings
FULL = 0.25  # Least share of the nodes of a lattice that have a reading


def on_lattice(readings: Readings) -> Readings:
    """The readings as a gridded survey if they are one: a reading at each of many nodes of one heading.

    Other readings are returned as they are.
    """
    p, yaw = readings.p_xy, readings.yaw % (2 * np.pi)
    if readings.grid is not None or np.ptp(yaw) > 0:
        return readings
    axes, node = [], [np.zeros(len(p), np.intp)]
    for values in p.T[::-1]:
        places = np.unique(values)
        gaps = np.diff(places)
        if not len(gaps):
            return readings
        step = float(np.median(gaps[gaps > gaps.max() / 1e3]))
        at = np.round((values - places[0]) / step).astype(np.intp)
        if np.abs(values - places[0] - at * step).max() > OFF_NODE * step:
            return readings
        axes.append((float(places[0]), step, int(at.max()) + 1))
        node.append(at)
    (y0, dy, rows), (x0, dx, columns) = axes
    if len(np.unique(node[1] * columns + node[2])) < len(p) or len(p) < FULL * rows * columns:
        return readings
    grid = Grid(origin_m=(x0, y0), cell_m=(dx, dy), headings_rad=(float(yaw[0]),), rows=rows, columns=columns)
    return readings.with_(grid=grid.in_memory(), node=np.column_stack(node))


def node_map(readings: Readings) -> AnomalyMap:
    """The map whose values are the readings themselves, each at its node.

    Several good readings at one node are averaged. Nodes without one are not valid; their value is the mean
    of the others, or nan. The variance is estimated from the survey (`magtwin.field.survey.node_errors`); it
    is None for a survey of one heading.
    """
    if readings.grid is None or readings.node is None:
        raise InputError(
            f"survey {readings.name!r} is not gridded, so that its nodes make no map; fit one to it (fit_map)"
        )
    grid = readings.grid
    flat = np.ravel_multi_index(tuple(readings.node.T), grid.shape)
    size = int(np.prod(grid.shape))
    means, counts = [], []
    for rows in (readings.good, ~readings.good):
        count = np.bincount(flat[rows], minlength=size)
        total = np.bincount(flat[rows], weights=readings.b_nt[rows], minlength=size)
        counts.append(np.maximum(count, 1).reshape(grid.shape))
        means.append(np.divide(total, count, out=np.full(size, np.nan), where=count > 0))
    recorded = None
    if len(flat) == size == len(np.unique(flat)):  # every node has exactly one reading
        recorded = readings.yaw[np.argsort(flat)].reshape(grid.shape)
    valid = np.isfinite(means[0])
    values, known = np.where(valid, *means).reshape(grid.shape), valid.reshape(grid.shape)
    errors = node_errors(readings, grid, means[0].reshape(grid.shape), known)
    variance = between = None
    if errors.estimated:
        variance = errors.variance_nt2 / counts[0]
        between = interpolation_error_nt2(values, known, grid.headings_rad, variance)
    return AnomalyMap(
        values_nt=values,
        valid=known,
        variance_nt2=variance,
        between_nt2=between,
        recorded_yaw=recorded,
        origin_m=grid.origin_m,
        cell_m=grid.cell_m,
        headings_rad=np.asarray(grid.headings_rad),
        method=METHOD,
        **readings.about,
    )


def write_survey(field: AnomalyMap, folder: str | os.PathLike[str], *, force: bool = False) -> list[Path]:
    """Write a map as a survey folder, one CSV per heading, for `read_survey`.

    Comment lines hold the metadata, statistics and masked rows. Below them is one row per node, x fastest: x
    and y in world [m], the recorded heading, else the nominal one [rad], and the field [nT], all without
    rounding. So the CSVs of a survey are restored from its map row by row.

    Of the variance only the median per heading is kept, and no harmonic field. Returns the files, one per
    heading.
    """
    lost = int(np.count_nonzero(~np.isfinite(field.values_nt)))
    if lost:
        raise InputError(
            f"map {field.name!r} has no value at {lost} of its nodes, and a survey's CSV has one at each; "
            "`magtwin map fit` fills them in"
        )
    names = [f"{degrees(heading)}{SUFFIX}" for heading in field.headings_rad]
    with output(folder, force=force) as aside:
        aside.mkdir()
        x, y = np.meshgrid(field.x_m, field.y_m)
        for h, name in enumerate(names):
            yaw = np.full(x.shape, field.headings_rad[h])
            if field.recorded_yaw is not None:
                yaw = field.recorded_yaw[h]
            rows = np.stack([x, y, yaw, field.values_nt[h]], axis=-1).reshape(-1, len(COLUMNS)).tolist()
            header = [f"# {','.join(COLUMNS)}", *_header_lines(field, h)]
            lines = [*header, *(",".join(map(repr, row)) for row in rows)]
            (aside / name).write_text("\n".join(lines) + "\n", encoding="utf-8")
    return [Path(folder, name) for name in names]


def read_survey(
    folder: str | os.PathLike[str], *, keep_stuck: bool = False, **options: Any
) -> tuple[AnomalyMap, Report]:
    """The map of a survey folder's nodes, and its report.

    In the map stuck nodes are not valid unless `keep_stuck`; options are those of `read_grid`. A fitted map
    from `write_survey` is restored as it was, except that its variance is uniform per heading and its
    harmonic field is lost. The report has statistics of the map, deviation of recorded from nominal headings,
    repeated readings, and what was found stuck.
    """
    layers, readings = read_layers(folder, **options)
    parameters = common(layers, "parameters") or {}
    if (method := common(layers, "method")) not in ("", METHOD):  # fitted before it was written
        field = node_map(readings)
        sd = np.square([layer.metadata.get(ERROR, math.nan) for layer in layers])
        variance = np.broadcast_to(sd[:, None, None], field.grid.shape) if np.isfinite(sd).all() else None
        about: dict[str, Any] = {"method": method, "parameters": parameters}
        field = replace(field, variance_nt2=variance, between_nt2=None, recorded_yaw=None, **about)
        return field, _report(layers, readings, field, folder, Report(""))
    masked, findings = mask_stuck(readings)
    if not (keep_stuck or masked.good.any()):
        raise InputError(
            f"{folder}: all {len(readings)} readings are those of a sensor that was stuck; "
            "survey it again, or import them as they are with `keep_stuck=True`"
        )
    field = replace(node_map(readings if keep_stuck else masked), parameters=parameters)
    return field, _report(layers, readings, field, folder, findings)


def _header_lines(field: AnomalyMap, heading: int) -> list[str]:
    """Comment lines for the file of one heading, by its index: metadata, statistics and masked rows."""
    figures = {name: value for name, value in statistics(field, heading).items() if math.isfinite(value)}
    named = {name: getattr(field, name) for name in (*KEPT, "source")}
    metadata: dict[str, Any] = {name: value for name, value in named.items() if value not in ("", None)}
    metadata["parameters"] = dict(field.parameters)
    metadata |= {"units": ["m", "m", "rad", "nT"], "spacing_m": list(field.cell_m), **figures}
    metadata[MASKED] = np.flatnonzero(~field.valid[heading].ravel()).tolist()
    metadata = {name: value for name, value in metadata.items() if value not in ({}, [])}
    try:
        return [f"# {name}: {json.dumps(value, allow_nan=False)}" for name, value in metadata.items()]
    except (TypeError, ValueError) as error:
        raise InputError(
            f"parameters of map {field.name!r} must be finite numbers, texts and lists of them ({error})"
        ) from error


def _report(
    layers: list[Layer],
    readings: Readings,
    field: AnomalyMap,
    folder: str | os.PathLike[str],
    findings: Report,
) -> Report:
    """Statistics of the survey, and how well its headings were kept."""
    deviation = [np.degrees(np.abs(wrap_angle(s.theta - np.radians(s.heading_deg)))) for s in layers]
    worst = max(range(len(layers)), key=lambda k: deviation[k].max())
    row = int(deviation[worst].argmax())
    layer = layers[worst]
    where = f"{layer.path.name}:{layer.lines[row]}, at ({layer.x[row]:g}, {layer.y[row]:g}) m"
    repeated = int(np.count_nonzero(np.diff(field.values_nt, axis=2) == 0))
    every = np.concatenate(deviation)
    figures = (
        *field.report().figures,
        Figure("median heading deviation", round(float(np.median(every)), 3), "deg"),
        Figure("largest heading deviation", round(float(every.max()), 3), "deg", note=where),
        Figure("repeated readings", repeated, note="equal to the one before in the row to the last digit"),
        *findings.figures,
    )
    metadata: dict[str, Any] = {"files": {s.path.name: s.sha256 for s in layers}, **findings.metadata}
    metadata |= {"taken": taken} if (taken := taken_of(readings)) else {}
    metadata |= {"doubts": doubts} if (doubts := heading_doubts(readings)) else {}
    return Report(f"survey {folder}", figures, metadata)
