"""The robot's own field along a run, as a compensator or a trained network predicts it for localization."""

import numpy as np

from magtwin.errors import InputError, find
from magtwin.frames import into_base
from magtwin.localization.compensators import COMPENSATORS, DISTURBANCE_COLUMNS, is_weights, with_iron
from magtwin.localization.localizers import load_localizer
from magtwin.localization.problem import Problem
from magtwin.localization.readings import onboard
from magtwin.localization.track import track
from magtwin.run.run import Run

PILOT = "rbpf-iron"
"""Method whose estimates are the poses of networks that read them."""

POSE = {"yaw", "b_map_gradient_nt_m"}
"""Inputs of networks that depend on the pose."""


def with_own_field(run: Run, compensator: str, problem: Problem) -> Run:
    """A run with the columns `disturbance_nt` and `disturbance_sd_nt`, which the method rbpf-network uses.

    A network that reads the heading or the map's gradient gets those at the causal estimates of `PILOT`,
    which runs first. Where these are off the map, the network predicts nothing.

    Args:
        run: The run; models get its on-board columns.
        compensator: "none", which changes nothing; "iron", fitted to the problem's calibration drive; or the
            weights of a trained network (.safetensors, .pth).
        problem: What the method is told.

    Raises:
        InputError: There is no such model, a named one has no calibration drive or no map, or a column is
            missing.
    """
    if compensator == "none":
        return run
    if is_weights(compensator):
        return _with_network(run, compensator, problem)
    find("compensator", compensator, dict.fromkeys(COMPENSATORS))
    if problem.belief is None or problem.calibration is None:
        raise InputError(
            f"the `compensator` {compensator!r} needs a map and a `calibration` drive",
            parameter="calibration",
        )
    return with_iron(run, problem.calibration, problem.belief)


def _with_network(run: Run, weights: str, problem: Problem) -> Run:
    from magtwin.learn.inference.magnetometer import NeuralMagnetometer

    network, told = NeuralMagnetometer.load(weights), onboard(run)
    if lacking := sorted(network.columns - set(told) - POSE):
        text = f"{weights}: the network reads {', '.join(lacking)}, which a localizer is not told"
        raise InputError(f"{text}; train one on other features", parameter="compensator")
    if network.columns & POSE:
        if problem.belief is None:
            text = f"{weights}: the network reads the heading or the map's gradient, so it needs a map"
            raise InputError(text, parameter="compensator")
        pose = track(load_localizer(PILOT), problem, run).pose
        slopes = np.asarray(problem.belief.gradient(pose[:, :2], pose[:, 2]), float)[:, :2]
        told = told.with_columns(yaw=pose[:, 2], b_map_gradient_nt_m=into_base(slopes, pose[:, 2]))
    (made,) = network.read([told], outside=False, known=[network.knows(run.metadata)])
    columns = {"disturbance_nt": made.disturbance_nt, "disturbance_sd_nt": made.stated_sd_nt}
    return run.with_columns(**columns).with_specs(**DISTURBANCE_COLUMNS)
