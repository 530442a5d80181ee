"""Find stuck and outlying readings of a survey, without being told where they are.

Three tests, each with its rate of false alarms:

- **Frozen.** A frozen sensor repeats the same number to the last digit while the robot moves. A field seldom
  does: over a distance d it stays within the sensor's step q (`steps_nt`) by chance with probability q f / d,
  where f is the density at 0 of the field's slopes nearby; distances of `REACH_M` or more count as
  independent. One in a hundred of the stretches found is false, and one sound survey in a hundred shows any
  (Benjamini & Hochberg 1995, at `FALSE_FROZEN`). A coarse sensor often repeats itself. It is frozen where it
  did so for long and then jumps by far more than its step (`_released`).
- **Stuck.** A sensor that lost lock reads about one level at any place and heading. If frozen stretches
  agree on a level, every node (every stretch of a drive) near that level is tested: are its readings more
  likely to be the level, or the field that its neighbours in place and heading predict? It is masked at odds
  of 19 to 1 for stuck, prior included (`SURE`), so fewer than five in a hundred masked readings are field. A
  stretch of a drive that stays within the sensor's noise is also
  masked if its neighbours refute it, at `FALSE_FLAT` per survey. Wrong poses refute sound stretches as well.
  The report gives the number of readings masked falsely: at most the frozen ones that their neighbours
  predict as well, and the expected number of others.
- **Outlying.** A reading that differs from its neighbours' prediction by more than chance allows once per
  survey is listed with its size, but kept: it may be iron.

Not found: a sensor that clips on a drive without repeating itself, since its neighbours are clipped as well,
and more than one level.

Chance is Student's t with 4 degrees of freedom about a Gaussian process on the nearest readings
(`magtwin.field.survey.neighbours`).
"""

import itertools
from dataclasses import dataclass
from math import lgamma

import numpy as np
from numpy.typing import NDArray

from magtwin.field.survey.hold import DIGITS, in_order, repeats
from magtwin.field.survey.neighbours import FREEDOM, LEAST, LocalFit, deviation
from magtwin.field.survey.readings import Readings
from magtwin.frames import wrap_angle
from magtwin.report.report import Figure, Report

Array = NDArray[np.float64]
Rows = NDArray[np.intp]
Flags = NDArray[np.bool_]

FALSE_FROZEN = 0.01  # Share of frozen stretches that are false, and of sound surveys that show any
FALSE_FLAT = 0.01  # Expected number of sound flat stretches per survey that are masked
SURE = 0.95  # Probability from which a reading counts as stuck
REACH_M = 0.1  # Distance over which the field's slope is assumed constant
# Slopes nearest to a stretch from which the field's roughness is estimated; slopes of 0 do not count
BESIDE = 48
# Range about the level in which stuck readings are searched, in standard deviations of the level
WIDTH = 12.0
CELL_M = 0.05  # Length of a drive whose readings are averaged for the fit
COARSE = 3.0  # Steps by which the field usually changes in a trial; with less, the sensor is too coarse
STUCK_DRIVE, STUCK_NODES = 0.002, 0.02  # Groups of equal values that may be stuck, as a share of all
MOST_CHANGES = 0.75  # Quantile of changes that stands for them; steel makes a few far larger
NORMAL = np.sqrt(2 * np.pi) / 1.1503  # Step by that quantile and the share of repeats, if changes are normal
LEAST_SLOPES = 8  # With fewer slopes the roughness is unknown, and no stretch is called frozen
FLAT_M = 0.25  # Least length of a flat stretch of a drive
MOST_TOGETHER = 12  # Most readings of one place that are tested jointly; more are thinned evenly
MOST_OTHERS = 48  # Most other stretches whose misfit is compared with that of a flat one
UPPER = 0.9  # Quantile of their misfits
ROUNDS = 4  # Rounds in which level, spread and share of stuck readings converge
SPREAD_ROWS = 51  # Readings of a drive from which the usual size of a jump is estimated
MANY = 1 / 3  # Share of stuck readings above which the report doubts them
NAMED = 20  # Most outliers listed in the report, the largest first


def mask_stuck(readings: Readings) -> tuple[Readings, Report]:
    """Find the readings that are not field, and mark them as not good.

    Rows that are not `good` stay so and are ignored. The report has counts, the level, nodes stuck at every
    heading and the number masked falsely.
    """
    findings = find_stuck(readings)
    good = readings.good & ~findings.frozen & ~findings.stuck
    return readings.with_(good=good), findings.report(readings)


@dataclass(frozen=True)
class Findings:
    """What is wrong with which readings."""

    frozen: Flags  # Repeats to the last digit, shape (N,)
    stuck: Flags  # At the level of a sensor that lost lock, shape (N,); may also be frozen
    # Probability that a masked reading is field, shape (N,); 1 if it is frozen at what its neighbours predict
    doubt: Array
    outlier: Array  # Difference from the neighbours' prediction [nT], shape (N,); 0 if it is not unusual
    level_nt: float | None  # Level of the stuck sensor; None if no stretches agree on one
    spread_nt: float  # Standard deviation of stuck readings about the level [nT]
    judged: bool  # Whether there were enough readings to compare with neighbours

    def report(self, readings: Readings) -> Report:
        """Counts, level, doubt and outliers of the findings."""
        masked = self.frozen | self.stuck
        figures = [
            Figure("frozen readings", int(self.frozen.sum()), note="repeat to the last digit, robot moving"),
            Figure("stuck readings", int(masked.sum()), note="frozen ones included"),
        ]
        metadata: dict[str, object] = {}
        if self.level_nt is not None:
            level, spread = round(self.level_nt, 1), round(self.spread_nt, 1)
            figures.append(Figure("stuck level", level, "nT", spread=spread))
        if masked.any():
            if self.judged:
                doubt, note = round(float(self.doubt[masked].sum()), 2), "at most; others nearby predict them"
                figures.append(Figure("masked falsely", doubt, "readings", note=note))
            if readings.grid is not None and readings.node is not None:
                at = np.zeros(readings.grid.shape, bool)
                at[tuple(readings.node[masked].T)] = True
                every = int(at.all(axis=0).sum())
                figures.append(Figure("stuck nodes", int(at.any(axis=0).sum()), note="at any heading"))
                figures.append(Figure("stuck at every heading", every, "nodes"))
                metadata["stuck"] = {
                    f"{np.degrees(h):g} deg": f"{int(layer.sum())} nodes"
                    for h, layer in zip(readings.grid.headings_rad, at, strict=True)
                }
            else:
                metadata["stuck"] = {
                    readings.runs[r] or f"run {r}": f"{int(masked[readings.run == r].sum())} readings"
                    for r in np.unique(readings.run[masked])
                }
        if masked.sum() > MANY * max(1, readings.good.sum()):
            metadata["doubts"] = [
                f"{masked.sum()} of {readings.good.sum()} readings are masked as stuck: a sound sensor with "
                "wrong poses looks the same; check them, or keep the readings (--keep-stuck)"
            ]
        outliers = np.flatnonzero(self.outlier)
        figures.append(Figure("outliers", len(outliers), note="left in"))
        if not self.judged:
            where = "good readings" if readings.node is not None else f"good readings {CELL_M:g} m apart"
            metadata["note"] = f"fewer than {LEAST} {where}: only repeats were looked for"
        if len(outliers):
            first = outliers[np.argsort(-np.abs(self.outlier[outliers]), kind="stable")][:NAMED]
            metadata["outliers"] = [_place_and_size(readings, row, self.outlier[row]) for row in first]
        return Report(f"stuck and outlying readings of {readings.name}", tuple(figures), metadata)


def find_stuck(readings: Readings) -> Findings:
    """Findings of `mask_stuck`, as flags of rows."""
    from scipy.special import stdtrit

    count, b = len(readings), readings.b_nt
    sequences = _sequences(readings)
    steps = steps_nt(readings, sequences)
    stretches = _frozen(readings, sequences, steps)
    frozen = np.zeros(count, bool)
    for rows in stretches:
        frozen[rows] = True
    stuck, doubt, outlier = np.zeros(count, bool), np.zeros(count), np.zeros(count)
    level, spread = _level(np.unique([b[rows[0]] for rows in stretches]), b[readings.good])
    sound = readings.good & ~frozen
    cells, cell = _cells(readings)
    near_level = np.zeros(count, bool) if level is None else np.abs(b - level) <= WIDTH * spread
    flats = _flats(readings, sound & ~near_level) if readings.grid is None else []
    suspect = frozen | near_level | ~readings.good
    known = np.flatnonzero(np.bincount(cell, suspect, len(cells)) == 0)
    for rows in flats:
        suspect[rows] = True
    pool = np.flatnonzero(np.bincount(cell, suspect, len(cells)) == 0)
    if len(pool) < LEAST:  # a coarse sensor is flat everywhere
        pool, flats = known, []
    if len(pool) < LEAST or np.ptp(cells.b_nt[pool]) == 0:
        return Findings(frozen, stuck, doubt, outlier, level, spread, judged=False)
    fit = LocalFit.to(cells, pool, known, max(steps) / float(np.sqrt(12)))
    for rows in _refuted(flats, cell, fit, pool, known):
        stuck[rows] = True
        doubt[rows] = FALSE_FLAT / len(flats)
    if level is not None:
        places = _places(readings, near_level & readings.good)
        held = [np.unique(cell[rows]) for rows in places]
        repeated = np.array([bool(frozen[rows].any()) for rows in places])
        sure, level, spread = _odds(cells, held, repeated, fit, pool, level, spread)
        for rows, probability in zip(places, sure, strict=True):
            if probability >= SURE:
                stuck[rows] = True
                doubt[rows] = 1 - probability
    alone = np.unique(cell[frozen & ~stuck])
    if len(alone):
        agrees = alone[np.abs(fit.left_out(alone, pool)[0]) <= stdtrit(FREEDOM, 0.95)]
        doubt[frozen & ~stuck & np.isin(cell, agrees)] = 1.0
    kept = np.bincount(cell, stuck | frozen | ~readings.good, len(cells)) == 0
    outlier = _outliers(readings, cells, cell, fit, np.flatnonzero(kept))
    return Findings(frozen, stuck, doubt, outlier, level, spread, judged=True)


def _sequences(readings: Readings) -> list[Rows]:
    """Good rows in orders in which neighbours follow each other: rows and columns of nodes, or runs."""
    if readings.node is None:
        return in_order(readings)
    good = np.flatnonzero(readings.good)
    h, j, i = readings.node.T
    sequences = []
    for inner, *outer in ((i, j, h), (j, i, h)):
        order = good[np.lexsort((inner[good], *(o[good] for o in outer)))]
        new = np.any([np.diff(o[order]) != 0 for o in outer], axis=0)
        sequences += np.split(order, np.flatnonzero(new) + 1)
    return sequences


def _moved(readings: Readings, rows: Rows) -> Array:
    """Distance from one row to the next [m]; a radian counts as `REACH_M`."""
    way = np.diff(readings.p_xy[rows], axis=0)
    turn = wrap_angle(np.diff(readings.yaw[rows]))
    return np.asarray(np.hypot(way[:, 0], way[:, 1]) + REACH_M * np.abs(turn))


def _frozen(readings: Readings, sequences: list[Rows], steps: list[float]) -> list[Rows]:
    """Rows of each stretch that repeats to the last digit for longer than chance allows."""
    b = readings.b_nt
    candidates = list[tuple[float, Rows]]()
    channels = b[:, None] if readings.b_body_nt is None else readings.b_body_nt
    if not np.ptp(channels[readings.good], axis=0).any():  # one number everywhere
        still = len(sequences) == 0 or np.ptp(readings.p_xy[readings.good], axis=0).max() == 0
        return [] if still or readings.good.sum() <= LEAST_SLOPES else [np.flatnonzero(readings.good)]
    place, slope = _slopes(readings, b, sequences)
    for rows, step in zip(sequences, steps, strict=True):
        for part in _stretches(repeats(readings, rows)):
            held = rows[part.start : part.stop + 1]
            p = readings.p_xy[held]
            way = float(np.linalg.norm(np.ptp(p, axis=0)) + REACH_M * np.ptp(np.unwrap(readings.yaw[held])))
            if way == 0 or len(slope) < LEAST_SLOPES:
                continue
            trials = max(1, min(len(held) - 1, int(way / REACH_M)))
            near = np.argsort(np.linalg.norm(place - p.mean(axis=0), axis=1), kind="stable")[:BESIDE]
            # A quarter of changes lie within +-change
            change = float(np.quantile(slope[near], 0.25)) * way / trials
            if change >= COARSE * step:  # else the sensor is too coarse for this place to tell
                candidates.append((trials * float(np.log(step * 0.25 / (2 * change))), held))
    candidates.sort(key=lambda candidate: candidate[0])
    tests = sum(len(rows) - 1 for rows in sequences)
    allowed = np.log(FALSE_FROZEN / max(tests, 1) * np.arange(1, len(candidates) + 1))
    passed = [k for k, (chance, _) in enumerate(candidates) if chance <= allowed[k]]
    found = [held for _, held in candidates[: passed[-1] + 1]] if passed else []
    drives = sequences if readings.node is None else []
    return found + [rows for drive in drives for rows in _released(readings, drive)]


def _released(readings: Readings, drive: Rows) -> list[Rows]:
    """Repeats of `FLAT_M` or more that end in a jump which the sensor's step does not explain.

    A sound sensor leaves a value by a step, however long it stayed there. A stuck one leaves it by as much as
    the field changed meanwhile. The number of sound repeats that are as long, in readings and in metres, and
    end in such a jump is that of all so long by the share of other changes that are as large.
    """
    runs = list[tuple[Rows, float, float]]()  # rows, length [m] and change at the end [nT]
    for rows in _driven(readings, drive):
        first = np.append(0, np.flatnonzero(~repeats(readings, rows)) + 1)
        for held, after in itertools.pairwise(np.split(rows, first[1:])):
            way = float(np.linalg.norm(np.ptp(readings.p_xy[held], axis=0)))
            runs.append((held, way, abs(readings.b_nt[after[0]] - readings.b_nt[held[0]])))
    count = np.array([len(held) for held, *_ in runs])
    ways, jump = np.array([run[1:] for run in runs]).reshape(-1, 2).T
    others, found = np.sort(jump[ways < FLAT_M]), list[Rows]()
    for k in np.flatnonzero((ways >= FLAT_M) & (count > 1)):
        share = (1 + len(others) - np.searchsorted(others, jump[k])) / (1 + len(others))
        if share * np.count_nonzero((count >= count[k]) & (ways >= ways[k])) <= FALSE_FROZEN:
            found.append(runs[k][0])
    return found


def steps_nt(readings: Readings, sequences: list[Rows]) -> list[float]:
    """Step of the sensor in each sequence [nT]: the change of the field that the readings do not show.

    It is the least difference of two values, or what explains the share of readings that repeat the one
    before. If changes have the density f at 0, a step q repeats q f of them; f is that of normal changes with
    the quantile `MOST_CHANGES` of those seen. So the magnitudes of rounded vectors show their step too,
    though they have many digits. A share of repeats that is no larger than `STUCK_DRIVE` or `STUCK_NODES` may
    be that of a stuck sensor. Nodes are of one sensor, and each drive is of its own.
    """
    steps = list[float]()
    for part in [[rows] for rows in sequences] if readings.node is None else [sequences]:
        b = np.round(readings.b_nt[np.concatenate(part)], DIGITS) if part else np.zeros(0)
        gaps = np.diff(np.unique(b))
        least = float(gaps.min()) if gaps.size else 0.0
        change = np.concatenate([np.diff(readings.b_nt[rows], prepend=np.nan) for rows in part] or [b])
        size = np.abs(change[np.abs(change) >= 10.0**-DIGITS])
        same = np.abs(change) < 10.0**-DIGITS
        groups = max(1, len(change) - int(np.count_nonzero(same)))
        share = float(np.count_nonzero(same[1:] & ~same[:-1])) / groups
        share -= STUCK_DRIVE if readings.node is None else STUCK_NODES
        usual = float(np.quantile(size, MOST_CHANGES)) if size.size else 0.0
        steps.append(max(least, min(1.0, NORMAL * max(0.0, share)) * usual))
    return steps if readings.node is None else steps * len(sequences)


def _slopes(readings: Readings, b: Array, sequences: list[Rows]) -> tuple[Array, Array]:
    """Places (N, 2) and sizes [nT/m] of the field's slopes along the way, over at least `REACH_M`."""
    places, slopes = [], []
    for rows in sequences:
        moved = _moved(readings, rows)
        if len(moved) and moved.min() < REACH_M:  # a drive
            way = np.concatenate([[0.0], np.cumsum(moved)])
            _, first = np.unique((way / REACH_M).astype(np.intp), return_index=True)
            rows = rows[first]
            moved = _moved(readings, rows)
        change = np.abs(np.diff(b[rows]))
        kept = (moved > 0) & (change > 0)
        places.append((readings.p_xy[rows][1:] + readings.p_xy[rows][:-1])[kept] / 2)
        slopes.append(change[kept] / moved[kept])
    return np.concatenate(places), np.concatenate(slopes)


def _stretches(flags: NDArray[np.bool_]) -> list[slice]:
    """Slices in which flags are true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [slice(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _level(levels: Array, b_nt: Array) -> tuple[float | None, float]:
    """Level on which at least three frozen stretches agree, and its spread [nT]; None if there is none."""
    if len(levels) < 3 or (spread := deviation(levels)) > deviation(b_nt) / 10:
        return None, 0.0
    gap = float(np.diff(levels).min())
    return float(np.median(levels)), max(spread, gap)


def _cells(readings: Readings) -> tuple[Readings, Rows]:
    """The survey with each `CELL_M` of a drive as one reading, its median; and the cell of each row."""
    if readings.node is not None:
        return readings, np.arange(len(readings))
    cell = np.empty(len(readings), np.intp)
    first = 0
    for rows in _sequences(readings.with_(good=np.ones(len(readings), bool))):
        way = np.concatenate([[0.0], np.cumsum(_moved(readings, rows))])
        _, cell[rows] = np.unique((way / CELL_M).astype(np.intp), return_inverse=True)
        cell[rows] += first
        first = int(cell[rows].max()) + 1
    order = np.lexsort((readings.b_nt, cell))
    starts = np.flatnonzero(np.diff(cell[order], prepend=-1))
    size = np.diff(np.append(starts, len(order)))

    def mean(values: Array) -> Array:
        return np.asarray(np.add.reduceat(values[order], starts, axis=0).T / size).T

    return Readings(
        p_xy=mean(readings.p_xy),
        yaw=np.arctan2(mean(np.sin(readings.yaw)), mean(np.cos(readings.yaw))),
        b_nt=readings.b_nt[order][starts + size // 2],
    ), cell


def _driven(readings: Readings, rows: Rows) -> list[Rows]:
    """Parts of a sequence without a jump."""
    return np.split(rows, np.flatnonzero(_moved(readings, rows) > REACH_M) + 1)


def _flats(readings: Readings, sound: NDArray[np.bool_]) -> list[Rows]:
    """Stretches of a drive that stay within the sensor's noise for `FLAT_M` or more."""
    flats = []
    drives = (_driven(readings, rows) for rows in _sequences(readings.with_(good=sound)))
    for rows in itertools.chain.from_iterable(drives):
        b, p = readings.b_nt[rows], readings.p_xy[rows]
        if len(rows) < 8:
            continue
        # second differences have 6 times the noise's variance
        band = 6 * deviation(np.diff(b, 2)) / np.sqrt(6)
        at = 0
        while at < len(rows) - 1:
            end, low, high = at, b[at], b[at]
            while end < len(rows) and max(high, b[end]) - min(low, b[end]) <= band:
                low, high, end = min(low, b[end]), max(high, b[end]), end + 1
            long = float(np.linalg.norm(np.ptp(p[at:end], axis=0))) >= FLAT_M
            if long:
                flats.append(rows[at:end])
            at = end if long else at + max(1, (end - at) // 4)
    return flats


def _refuted(flats: list[Rows], cell: Rows, fit: LocalFit, pool: Rows, known: Rows) -> list[Rows]:
    """Flat stretches that their neighbours refute.

    Stretches that are left out as a whole fit worse than single readings where the field is rougher than its
    prior. So the misfit of a flat stretch is divided by that of other stretches of its length (the quantile
    `UPPER` over its expectation), if these fit worse than expected.
    """
    from scipy.special import fdtrc, fdtri

    def misfit(cells: Rows, pool: Rows) -> float:
        held = _thinned(cells)
        residual, covariance = fit.together(held, pool)
        return float(residual @ np.linalg.solve(covariance, residual) / len(held))

    refuted = []
    for rows in flats:
        inner = np.unique(cell[rows])[1:-1]
        if not len(inner):
            continue
        count, limit = min(len(inner), MOST_TOGETHER), FALSE_FLAT / len(flats)
        size = misfit(inner, pool)
        if fdtrc(count, FREEDOM, size) > limit:
            continue
        rest = known[(known < inner[0]) | (known > inner[-1])]
        firsts = np.unique(np.linspace(0, max(0, len(rest) - len(inner)), MOST_OTHERS).astype(np.intp))
        others = [rest[first : first + len(inner)] for first in firsts]
        usual = [misfit(other, np.setdiff1d(pool, other)) for other in others]
        rough = np.quantile(usual, UPPER) / fdtri(count, FREEDOM, UPPER)
        if fdtrc(count, FREEDOM, size / max(1.0, rough)) <= limit:
            refuted.append(rows)
    return refuted


def _places(readings: Readings, rows: NDArray[np.bool_]) -> list[Rows]:
    """Groups of rows that are tested together: those at one node, or consecutive ones of a drive."""
    if readings.node is not None:
        index = np.flatnonzero(rows)
        place = readings.node[index, 1] * (readings.node[:, 2].max() + 1) + readings.node[index, 2]
        order = np.argsort(place, kind="stable")
        return np.split(index[order], np.flatnonzero(np.diff(place[order])) + 1) if len(index) else []
    return [part[stretch] for part in _sequences(readings) for stretch in _stretches(rows[part])]


def _odds(
    cells: Readings, places: list[Rows], known: Flags, fit: LocalFit, pool: Rows, level: float, spread: float
) -> tuple[Array, float, float]:
    """Probability that each place is stuck, with the level and its spread.

    Bayes' rule between two densities of a place's readings: Student's t about the level, and about the
    neighbours' prediction, with the share of stuck cells as the prior. Share, level and spread are updated
    from the result (empirical Bayes) in `ROUNDS` rounds, starting from the frozen readings.
    """
    held = [_thinned(cell) for cell in places]
    field = np.array([_log_t(*fit.together(cell, pool)) for cell in held])
    sure = known.astype(float)
    for _ in range(ROUNDS):
        share = sum(p * len(cell) for p, cell in zip(sure, places, strict=True)) / len(cells)
        share = min(max(share, 1 / len(cells)), 0.5)
        scaled = [(cells.b_nt[cell] - level) / spread for cell in held]
        stuck = np.array([float(np.sum(_log_t1(z) - np.log(spread))) for z in scaled])
        odds = np.log(share / (1 - share)) + stuck - field
        sure = 1 / (1 + np.exp(-np.clip(odds, -500, 500)))
        on_level = np.concatenate([cells.b_nt[cell] for p, cell in zip(sure, held, strict=True) if p >= SURE])
        if len(on_level) >= 3:
            level, spread = float(np.median(on_level)), max(deviation(on_level), spread)
    return sure, level, spread


def _thinned(rows: Rows) -> Rows:
    """At most `MOST_TOGETHER` of the rows, evenly spaced."""
    picked = np.unique(np.linspace(0, len(rows) - 1, min(len(rows), MOST_TOGETHER)).astype(np.intp))
    return rows[picked]


def _log_t(residual: Array, covariance: Array) -> float:
    """Logarithm of the multivariate t density with `FREEDOM` (Kotz & Nadarajah 2004, eq. 1.1)."""
    count = len(residual)
    size = residual @ np.linalg.solve(covariance, residual)
    constant = lgamma((FREEDOM + count) / 2) - lgamma(FREEDOM / 2) - count / 2 * np.log(FREEDOM * np.pi)
    tail = (FREEDOM + count) / 2 * np.log1p(size / FREEDOM)
    return float(constant - np.linalg.slogdet(covariance)[1] / 2 - tail)


def _log_t1(z: Array) -> Array:
    """Logarithm of the univariate t density."""
    constant = lgamma((FREEDOM + 1) / 2) - lgamma(FREEDOM / 2) - np.log(FREEDOM * np.pi) / 2
    return np.asarray(constant - (FREEDOM + 1) / 2 * np.log1p(z**2 / FREEDOM))


def _outliers(readings: Readings, cells: Readings, cell: Rows, fit: LocalFit, pool: Rows) -> Array:
    """Difference of each outlier from its neighbours' prediction [nT], shape (N,); 0 for other readings."""
    from scipy.special import stdtrit

    outlier = np.zeros(len(readings))
    limit = float(stdtrit(FREEDOM, 1 - 1 / (2 * len(pool))))
    scaled, residual = fit.left_out(pool, pool)
    for at in np.flatnonzero(np.abs(scaled) > limit):
        rows = np.flatnonzero(cell == pool[at])
        outlier[rows[len(rows) // 2]] = residual[at]
    if readings.node is None:
        sequences = _sequences(readings)
        for sequence, step in zip(sequences, steps_nt(readings, sequences), strict=True):
            for rows in _driven(readings, sequence):  # a field may jump with the pose
                off = _spikes(readings.b_nt[rows], step)
                outlier[rows[off != 0]] = off[off != 0]
    return outlier


def _spikes(b: Array, step: float) -> Array:
    """Difference of each spike of a drive from the mean of its two neighbours [nT]; 0 for other readings.

    Hampel's filter: the scale is the median difference over `SPREAD_ROWS`, since differences grow with speed
    and with the field's curvature. Of two adjacent spikes the larger counts.
    """
    from scipy.ndimage import maximum_filter1d, median_filter
    from scipy.special import stdtrit

    if len(b) < SPREAD_ROWS:
        return np.zeros(len(b))
    off = np.zeros(len(b))
    off[1:-1] = b[1:-1] - (b[:-2] + b[2:]) / 2
    size = np.abs(off)
    scale = 1.4826 * np.maximum(median_filter(size, SPREAD_ROWS, mode="reflect"), np.median(size))
    scale = np.maximum(scale, step * np.sqrt(1.5 / 12))  # sd of rounding in such a difference
    limit = float(stdtrit(FREEDOM, 1 - 1 / (2 * len(b))))
    spike = (size > limit * scale) & (size == maximum_filter1d(size, 3)) & (size > 0)
    return np.where(spike, off, 0.0)


def _place_and_size(readings: Readings, row: int, off_nt: float) -> str:
    x, y = readings.p_xy[row]
    run = readings.runs[readings.run[row]]
    return (
        f"{off_nt:+,.0f} nT at ({x:g}, {y:g}) m, heading {np.degrees(readings.yaw[row]) % 360:.0f} deg"
        f", reads {readings.b_nt[row]:,.0f} nT" + (f", in {run}" if run else "")
    )
