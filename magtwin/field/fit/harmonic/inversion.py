"""Inversion of a survey: the dipoles, the uniform field and the platform that explain its readings.

What is fitted are the moments of dipoles on layers below and above the sensor (equivalent sources: Dampney
1969; Blakely 1995, section 12.1), a uniform field and the robot's hard iron, soft iron and lever arm. The
moments have normal priors, which is a Gaussian process with curl- and divergence-free covariance
(Wahlstrom et al. 2013; Solin et al. 2018). Three things make it honest on a real floor:

- Places and headings are recorded with errors, so a reading's variance is noise^2 + position^2 |grad|^2 +
  heading^2 (d/dyaw)^2 at the field's own slopes (noisy-input processes: McHutchon & Rasmussen 2011), about
  which it follows Student's t, by reweighting (Lange et al. 1989).
- Iron lies in some places and not in others, so every dipole's prior strength is that of the dipoles
  around it in its layer, drawn a little towards the layer's.
- All these figures follow from the readings: strengths by MacKay's (1992) fixed point of the evidence
  (Rasmussen & Williams 2006, section 5.4, with Laplace's approximation), noises and tail by
  expectation-maximization. How wide the intervals are is learnt from places left out in turn, and
  between headings that are far apart from headings left out in turn: iron is not all that a robot changes.

The magnitude is not linear in the field; Gauss-Newton steps, halved until the posterior grows, solve it. Each
costs one factorisation, of a matrix as large as the readings where they are few, so that layers may be
fine, else as the unknowns.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.field.fit.harmonic.layers import Layers, ladders, layers_below
from magtwin.field.fit.harmonic.model import HarmonicModel
from magtwin.field.fit.harmonic.problem import Problem
from magtwin.field.fit.harmonic.solution import Solution
from magtwin.field.survey.readings import Readings, checked_earth_nt

Array = NDArray[np.float64]
Progress = Callable[[int, int, str], Any]

LEAST_READINGS = 8

EARTH_SD_NT = 1000.0
"""How far the uniform part may lie from `earth_nt` [nT], each way."""

ROUNDS = 30
"""Rounds in which the figures settle."""

LAYERWISE = 4
"""First rounds, in which a layer has one strength."""

STILL = 0.03
"""Change of the logarithms of figures in a round, in the mean over strengths, below which they are learnt."""


def fit_harmonic(
    readings: Readings,
    *,
    depth_m: float | Sequence[float] | None = None,
    spacing_m: float | None = None,
    earth_nt: Sequence[float] | None = None,
    earth_sd_nt: float = EARTH_SD_NT,
    height_m: float | None = None,
    like: HarmonicModel | None = None,
    progress: Progress | None = None,
) -> HarmonicModel:
    """The field without curl or divergence, and the platform, that make a survey's readings likeliest.

    Vectors are fitted where the survey has them, else magnitudes. A platform is fitted where the headings
    differ; else it counts as part of the field. Readings of a drive that follow each
    other within a short way count as one, their mean.

    Magnitudes alone leave the field's sign open: B and -B read the same, with the hard iron turned too.
    Where the Earth's field is unknown the uniform part is thought to point down with the readings' median
    magnitude, give or take half of it each way, as nowhere but in the northern hemisphere; the fit is begun
    in several directions, and goes on from the likeliest. Name the Earth's field where it is known
    (`magtwin.field.sources.earth`), above all where vectors are wanted. Where vectors are read it is
    thought to be their mean, as loosely.

    Args:
        readings: A survey; those that are not `good` count for nothing.
        depth_m: Depth of the dipoles' layers below the sensor [m], negative for layers above. Unless
            given, 1.8 spacings of the survey (0.9 of a drive), no nearer than `LEAST_DEPTH_M` or the floor,
            twice and four times that, and, if the evidence is for it, a layer above at twice that.
        spacing_m: Distance between the dipoles of the first layer [m]; 0.6 of a layer's depth unless
            given, and in every layer in proportion to its depth.
        earth_nt: The Earth's field in world axes [nT]; that of the readings unless given.
        earth_sd_nt: How far the uniform part of the lab's may lie from it, each way [nT].
        height_m: Height of the sensor above the floor [m]; that of the readings unless given, and 0
            where unknown: heights then count from the sensor.
        like: A model whose layers and figures are taken as they are, and its field to begin with; nothing but
            the field is learnt then.
        progress: Called as progress(done, total, what), once a round.

    Returns:
        The model.

    Raises:
        InputError: There are too few good readings, all at one place, or an option is none.
    """
    good = readings.take(readings.good)
    if len(good) < LEAST_READINGS:
        raise InputError(
            f"{len(good)} of {len(readings)} readings of {readings.name!r} are good; "
            f"a harmonic fit needs {LEAST_READINGS} at least"
        )
    height = height_m if height_m is not None else (readings.height_m or 0.0)
    earth_nt = earth_nt if earth_nt is not None else readings.earth_nt
    _check(earth_nt, earth_sd_nt, height, spacing_m)
    if like is not None:
        if depth_m is not None or spacing_m is not None:
            raise InputError("like brings its own layers; leave out depth_m and spacing_m")
        problem = Problem.of(good, _of_model(like), like.forward.height_m, earth_nt, earth_sd_nt)
        return _solve(problem, like, progress, []).model(good)
    tries = ladders(depth_m, good, max(height, 0.0))
    fits: list[Solution] = []
    for k, depths in enumerate(tries):
        layers = layers_below(good, depths, spacing_m, height)
        problem = Problem.of(good, layers, height, earth_nt, earth_sd_nt)
        begins = [fits[0].uniform] if fits else problem.begins
        fits.append(_solve(problem, None, _part(progress, k, len(tries)), begins))
    return max(fits, key=Solution.evidence).model(good)


def _part(progress: Progress | None, k: int, count: int) -> Progress | None:
    """Progress of the k-th of some fits, as a part of all."""
    if progress is None:
        return None
    return lambda done, total, what: progress(k * total + done, count * total, what)


def _check(
    earth_nt: Sequence[float] | None, earth_sd_nt: float, height: float, spacing_m: float | None
) -> None:
    if earth_nt is not None:
        checked_earth_nt(earth_nt)
    for name, value in (("earth_sd_nt", earth_sd_nt), ("spacing_m", spacing_m)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise InputError(f"{name} must be above 0, got {value!r}")
    if not np.isfinite(height):
        raise InputError(f"height_m must be a number, got {height!r}")


def _of_model(model: HarmonicModel) -> Layers:
    """The layers of a model; their areas matter to learning only."""
    places = model.forward.p_world_dipole
    heights, layer = np.unique(-places[:, 2], return_inverse=True)
    depths = tuple(float(d) + model.forward.height_m for d in heights)
    return Layers(places, np.ones(len(places)), layer.astype(np.intp), depths)


def _solve(
    problem: Problem, like: HarmonicModel | None, progress: Progress | None, begins: list[Array]
) -> Solution:
    """Fit, and learn the figures unless a model brings them.

    Args:
        problem: What is read where.
        like: Model whose figures are taken.
        progress: Called as progress(done, total, what).
        begins: Uniform fields to begin with [nT]; the fit goes on from the likeliest.
    """
    if like is not None:
        return Solution(problem, like.figures, like.unknowns, problem.at(like.unknowns)).settle()
    tried = len(begins) if len(begins) > 1 else 0
    total = tried * (1 + LAYERWISE) + ROUNDS

    def told(done: int) -> None:
        if progress is not None:
            progress(done, total, "learning")

    told(0)
    begun = []
    for k, uniform in enumerate(begins):
        solution = Solution.start(problem, problem.first(), uniform)
        for step in range(LAYERWISE if tried else 0):
            told(k * (1 + LAYERWISE) + step + 1)
            solution = solution.learnt(None).step()
        begun.append(solution)
    solution = max(begun, key=Solution.evidence) if tried else begun[0]
    shares = problem.layers.shares()
    for done in range(ROUNDS):
        told(total - ROUNDS + done)
        before = solution.figures
        solution = solution.learnt(shares if done >= LAYERWISE else None).step()
        if done > LAYERWISE and solution.figures.change(before) < STILL:
            break
    solution = solution.settle()
    told(total)
    return solution
