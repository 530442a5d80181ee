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

The magnitude is not linear in the field. Gauss-Newton steps, halved until the posterior grows, solve it. A
round of learning is one such step and one of the hyperparameters. It needs one factorisation, of a matrix as
large as the number of readings or of unknowns, whichever is smaller.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.field.fit.harmonic.layers import Layers, ladders, layers_below
from magtwin.field.fit.harmonic.model import HarmonicModel
from magtwin.field.fit.harmonic.problem import Hyperparameters, Platform, Problem
from magtwin.field.fit.harmonic.solution import Solution
from magtwin.field.fit.methods import in_own_axes
from magtwin.field.survey.readings import Readings, checked_earth_nt

Array = NDArray[np.float64]
Progress = Callable[[int, int, str], Any]
Known = tuple[Layers, Hyperparameters, Array]  # An earlier fit: its layers, hyperparameters and unknowns

LEAST_READINGS = 8
ROUNDS = 30  # Most rounds of learning
LAYERWISE = 4  # First rounds, in which a layer has one strength
SETTLING = 8  # The same from each start, if the readings have signals: their fields settle more slowly
# Change of the logarithms of hyperparameters in a round (of strengths, in the mean) at which learning ends
STILL = 0.03
# Gain of the log evidence in a round below which learning from an earlier fit ends: less is no strong
# evidence (Kass & Raftery 1995: a Bayes factor of 20)
GAIN = 3.0


@in_own_axes
def fit_harmonic(
    readings: Readings,
    *,
    earth_nt: Sequence[float] | None = None,
    hard_iron_nt: ArrayLike | None = None,
    soft_iron: ArrayLike | None = None,
    above: bool | None = None,
    most_dipoles: int | None = None,
    like: HarmonicModel | None = None,
    gain: float | None = None,
    progress: Progress | None = None,
) -> HarmonicModel:
    """Fit a field without curl or divergence, and the platform, to a survey.

    Vectors are fitted if the survey has them, else magnitudes. A platform is fitted if the headings differ;
    otherwise it is part of the field. Readings of a drive within a short distance are averaged. If the
    sensor's height is unknown, heights count from the sensor.

    Layers of dipoles are 1.8 spacings of the survey (0.9 of a drive) below the sensor, at least
    `LEAST_DEPTH_M` and the sensor's height, at twice and four times that, and, if the evidence is for it,
    above the sensor at twice that.

    Magnitudes leave the field's sign open: B and -B read the same with the hard iron reversed. If the Earth's
    field is unknown, the uniform field is assumed to point down with the readings' median magnitude, with a
    standard deviation of half of it per component (valid on the northern hemisphere). The fit starts from
    several directions and continues from the likeliest. Give the Earth's field if it is known
    (`magtwin.field.sources.earth`). For vector readings, the uniform field is assumed near their mean.

    Magnitudes of a robot that turns about the vertical alone do not tell its hard and soft iron from the
    uniform field. The magnitudes of the map hardly depend on how they are shared, but the vectors do: without
    a known platform `HarmonicModel.predict_vector` gives nan.

    Args:
        readings: A survey; only its good readings are used.
        earth_nt: The Earth's field in world axes [nT]. Default: that of the readings.
        hard_iron_nt: The robot's hard iron in base_link axes [nT], shape (3,), if it is known. An error of 50
            nT moves the vector field by 2,000 nT.
        soft_iron: Its soft iron [nT per nT], shape (3, 3), given with `hard_iron_nt`. Default: 0 then.
        above: Whether a layer of dipoles lies above the sensor. Default: if the evidence is for it.
        most_dipoles: Most dipoles. Default: 500 for the magnitudes of a drive, 1,500 otherwise, or 800 if
            there are many readings.
        like: A fit to other readings of the same survey. Learning starts from it, which saves most rounds.
        gain: Gain of the log evidence in a round below which learning ends. Default: it ends when the
            hyperparameters hardly change, or at `GAIN` from an earlier fit.
        progress: Called as progress(done, total, what), once per round.

    Raises:
        InputError: There are too few good readings, all are at one place, or `earth_nt`, `hard_iron_nt` or
            `soft_iron` is not such a field.
    """
    good = readings.take(readings.good)
    if len(good) < LEAST_READINGS:
        raise InputError(
            f"{len(good)} of {len(readings)} readings of {readings.name!r} are good; "
            f"a harmonic fit needs {LEAST_READINGS} at least"
        )
    height = readings.height_m or 0.0
    earth = readings.earth_nt if earth_nt is None else checked_earth_nt(earth_nt)
    platform = _platform(hard_iron_nt, soft_iron)
    tries = [d for d in ladders(good, height) if above is None or above == (min(d) < 0)]
    known = None if like is None else (like.layers, like.figures, like.unknowns)
    least = GAIN if gain is None and like is not None else gain
    fits = list[Solution]()
    for k, depths in enumerate(tries):
        problem = Problem.of(good, layers_below(good, depths, height, most_dipoles), height, earth, platform)
        begins: Any = [fits[0].uniform] if fits else problem.begins
        if fits and problem.signals is not None:
            begins = fits[0].problem.layers, fits[0].figures, fits[0].unknowns
        fits.append(_solve(problem, known or begins, least, progress, k, len(tries)))
    return max(fits, key=Solution.evidence).model(good)


def _platform(hard_iron_nt: ArrayLike | None, soft_iron: ArrayLike | None) -> Platform | None:
    """A known platform; None if its hard iron is not given."""
    if hard_iron_nt is None:
        if soft_iron is not None:
            raise InputError("soft_iron of a harmonic fit needs hard_iron_nt as well", parameter="soft_iron")
        return None
    given: dict[str, Any] = {"hard_iron_nt": hard_iron_nt, "soft_iron": np.zeros((3, 3))}
    if soft_iron is not None:
        given["soft_iron"] = soft_iron
    arrays = {name: np.asarray(value, float) for name, value in given.items()}
    for (name, array), shape in zip(arrays.items(), ((3,), (3, 3)), strict=True):
        if array.shape != shape or not np.isfinite(array).all():
            text = f"{name} of a harmonic fit must be finite, of shape {shape}"
            raise InputError(f"{text}, got {given[name]!r}", parameter=name)
    return Platform(**arrays)


def _solve(
    problem: Problem,
    begin: list[Array] | Known,
    gain: float | None,
    progress: Progress | None,
    turn: int,
    turns: int,
) -> Solution:
    """Fit from each of several uniform fields, continue from the likeliest, and learn the hyperparameters.

    With an earlier fit to begin with, continue from that.
    """
    begins, like = (begin, None) if isinstance(begin, list) else ([], begin)
    settling = LAYERWISE if problem.signals is None else SETTLING
    tried = len(begins) if len(begins) > 1 else 0
    total = tried * (1 + settling) + ROUNDS

    def report(done: int) -> None:
        if progress is not None:
            progress(turn * total + done, turns * total, "learning")

    report(0)
    begun = []
    for k, uniform in enumerate(begins):
        solution = Solution.start(problem, problem.first(), uniform)
        for step in range(settling if tried else 0):
            report(k * (1 + settling) + step + 1)
            solution = solution.learnt(
                None, step=False
            ).step()  # the starts are compared where they have settled
        begun.append(solution)
    if like is not None:
        solution = Solution.resumed(problem, *like)
    else:
        solution = max(begun, key=Solution.evidence) if tried else begun[0]
    shares, evidence = problem.layers.shares(), -np.inf
    layerwise = LAYERWISE if like is None else 0
    for done in range(ROUNDS):
        report(total - ROUNDS + done)
        old, before = solution.figures, evidence
        by_layer = shares if done >= layerwise else None
        if gain is not None:
            solution = solution.learnt(by_layer)
            evidence = solution.evidence()
            still = evidence - before < gain
        else:  # in full: a step with what was learned, from a factorisation of its own
            solution = solution.learnt(by_layer, step=False).step()
            still = solution.figures.change(old) < STILL
        if done > layerwise and still:
            break
    solution = solution.settle()
    report(total)
    return solution
