"""Widen: how much wider a model's intervals must be on robots that it was not trained on.

    sd^2 = floor + sum_j slope_j z_j^2

is fitted to the squares of a model's errors on recordings of many robots (`Spread`), and scaled so that 90 %
intervals hold 90 % of their readings. Each robot has the same weight, and Student's t accounts for their
number. Predictions do not change. A mixed model learns its intervals on other robots in its training, and a
drive narrows them (`magtwin.learn.inference.calibrate`).
"""

import copy
from collections.abc import Sequence

import numpy as np

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.learn.data.origin import same_map
from magtwin.learn.data.recording import Source, plant_name
from magtwin.learn.inference.calibrate import labelled_drive
from magtwin.learn.models.calibration import few_groups_factor, fit_spread, quantile_factor
from magtwin.learn.models.predictor import Predictor

LEAST_ROBOTS = 4
"""Least number of robots: how they differ is unknown with fewer."""


def widened(model: Predictor, recordings: Sequence[Source], field: AnomalyMap) -> Predictor:
    """A model that knows its errors on other robots: `magtwin.tasks.learning.widen` for a model and sources.

    A plant is a robot; recordings without one are told apart by their sessions.
    """
    if model.kind == "mixed":
        raise InputError(
            "a mixed model learned how robots differ in its training; its intervals are wide as it is"
        )
    if "map_samples_nt" in model.metadata and not same_map(model.metadata, field):
        raise InputError(
            f"the model was trained on the map {model.metadata.get('map', '')!r}, and its errors on another, "
            f"{field.name!r}, are not those of its robot; name its own map"
        )
    robots, errors, inputs = [], [], []
    for source in recordings:
        run = source.read()
        drive = labelled_drive(model, run, field, name=source.name)
        drive = drive.part(np.isfinite(drive.y))
        robots += [plant_name(run.metadata) or source.session_and_path(run)[0]] * len(drive.y)
        errors.append(model.predict(drive.x)[0] - drive.y)
        inputs.append(model.inputs.scaled(drive.x))
    names, number = np.unique(robots, return_inverse=True)
    if len(names) < LEAST_ROBOTS:
        raise InputError(
            f"recordings of {len(names)} robots: how robots differ is learned from {LEAST_ROBOTS} or more; "
            "record more, or simulate plants (magtwin sweep --plant all:1)"
        )
    error, z = np.concatenate(errors), np.concatenate(inputs)
    spread = fit_spread(z, error)
    factor = quantile_factor(error, spread.sd_nt(z), number) * few_groups_factor(error, number)
    wide = copy.copy(model)
    wide.wide = spread.scaled(factor)
    wide.metadata = {**model.metadata, "wide_robots": len(names), "wide_readings": len(error)}
    return wide
