"""Inversion of a survey: the dipoles, the uniform field and the platform that explain its readings.

The unknowns are the moments of dipoles on layers below and above the sensor (equivalent sources: Dampney
1969; Blakely 1995, section 12.1), a uniform field and the robot's hard iron, soft iron and lever arm. The
moments have normal priors, so the field is a Gaussian process with curl- and divergence-free covariance
(Wahlstrom et al. 2013; Solin et al. 2018). Three things adapt it to real floors:

- Recorded positions and headings have errors, so a reading's variance is noise^2 + position^2 |grad|^2 +
  heading^2 (d/dyaw)^2 at the field's slopes (noisy-input processes: McHutchon & Rasmussen 2011). Readings
  follow Student's t about it, by reweighting (Lange et al. 1989).
- Iron is unevenly distributed, so each dipole's prior strength is that of the dipoles around it in its layer,
  drawn slightly towards the layer's.
- All these hyperparameters are learnt: strengths by MacKay's (1992) fixed point of the evidence (Rasmussen &
  Williams 2006, section 5.4, with Laplace's approximation), noises and tail by expectation-maximization. The
  width of intervals is learnt from positions left out in turn, and between headings that are far apart from
  headings left out in turn, since a platform is more than iron.

The magnitude is not linear in the field. Gauss-Newton steps, halved until the posterior grows, solve it. Each
needs one factorisation, of a matrix as large as the number of readings or of unknowns, whichever is smaller.
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

EARTH_SD_NT = 1000.0  # Prior standard deviation of the uniform field about `earth_nt`, per component [nT]
ROUNDS = 30  # Most rounds of learning
LAYERWISE = 4  # First rounds, in which a layer has one strength
# Change of the logarithms of hyperparameters in a round (of strengths, in the mean) at which learning ends
STILL = 0.03


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
    """Fit a field without curl or divergence, and the platform, to a survey.

    Vectors are fitted if the survey has them, else magnitudes. A platform is fitted if the headings differ;
    otherwise it is part of the field. Readings of a drive within a short distance are averaged.

    Magnitudes leave the field's sign open: B and -B read the same with the hard iron reversed. If the Earth's
    field is unknown, the uniform field is assumed to point down with the readings' median magnitude, with a
    standard deviation of half of it per component (valid on the northern hemisphere). The fit starts from
    several directions and continues from the likeliest. Give the Earth's field if it is known
    (`magtwin.field.sources.earth`), above all if vectors are wanted. For vector readings, the uniform field
    is assumed near their mean.

    Args:
        readings: A survey; only its good readings are used.
        depth_m: Depths of the layers of dipoles below the sensor [m], negative above it. Default: 1.8
            spacings of the survey (0.9 of a drive), at least `LEAST_DEPTH_M` and the sensor's height, twice
            and four times that, and, if the evidence is for it, a layer above at twice that.
        spacing_m: Distance between the dipoles of the first layer [m], in other layers in proportion to
            depth. Default: 0.6 of the depth.
        earth_nt: The Earth's field in world axes [nT]. Default: that of the readings.
        earth_sd_nt: Standard deviation of the uniform field from it, per component [nT].
        height_m: Height of the sensor above the floor [m]. Default: that of the readings, or 0 if unknown;
            heights then count from the sensor.
        like: A model whose layers and hyperparameters are used, and its field as the start; only the field is
            fitted then.
        progress: Called as progress(done, total, what), once per round.

    Raises:
        InputError: There are too few good readings, all are at one place, or an option is invalid.
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
    """Progress of the k-th of several fits, as a part of all."""
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
    """The layers of a model; their areas matter only for learning."""
    places = model.forward.p_world_dipole
    heights, layer = np.unique(-places[:, 2], return_inverse=True)
    depths = tuple(float(d) + model.forward.height_m for d in heights)
    return Layers(places, np.ones(len(places)), layer.astype(np.intp), depths)


def _solve(
    problem: Problem, like: HarmonicModel | None, progress: Progress | None, begins: list[Array]
) -> Solution:
    """Fit, and learn the hyperparameters unless the model `like` has them; `begins` are uniform fields to
    start from [nT].
    """
    if like is not None:
        return Solution(problem, like.figures, like.unknowns, problem.at(like.unknowns)).settle()
    tried = len(begins) if len(begins) > 1 else 0
    total = tried * (1 + LAYERWISE) + ROUNDS

    def report(done: int) -> None:
        if progress is not None:
            progress(done, total, "learning")

    report(0)
    begun = []
    for k, uniform in enumerate(begins):
        solution = Solution.start(problem, problem.first(), uniform)
        for step in range(LAYERWISE if tried else 0):
            report(k * (1 + LAYERWISE) + step + 1)
            solution = solution.learnt(None).step()
        begun.append(solution)
    solution = max(begun, key=Solution.evidence) if tried else begun[0]
    shares = problem.layers.shares()
    for done in range(ROUNDS):
        report(total - ROUNDS + done)
        before = solution.figures
        solution = solution.learnt(shares if done >= LAYERWISE else None).step()
        if done > LAYERWISE and solution.figures.change(before) < STILL:
            break
    solution = solution.settle()
    report(total)
    return solution
