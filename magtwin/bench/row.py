"""Row: run the localizers of a chunk, and score each run as one row of the results."""

import contextlib
import signal
import threading
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from magtwin.bench.case import Case
from magtwin.bench.sealed import Contestant, foreign, seals, seed_of
from magtwin.bench.store import ROWS, SCHEMAS, TIMES, TRACKS, TRUTHS
from magtwin.bench.suite import Chunk, Entry, Scenario, Suite
from magtwin.errors import InputError
from magtwin.localization.bounds import Bounds, bounds
from magtwin.localization.localizers import load_localizer
from magtwin.localization.problem import Localizer, Smoother
from magtwin.localization.scores import SCALE_M, Scores, score
from magtwin.localization.track import Track, track
from magtwin.parallel import beat

WITHIN_S = 30.0
"""Time within which a localizer must find its pose after an unknown start or a kidnapping [s]."""

TRACK_HZ = 2.0
"""Rate of the errors over time that are kept for the report [Hz]."""

SETUP = 10.0
"""Time to make a case, in time limits of a localizer: the first case opens a scene and compiles loops."""

Row = dict[str, Any]

_warm: set[str] = set()
"""Localizers that this worker has compiled or loaded."""


class TimeLimitError(BaseException):
    """A localizer took longer than its time limit; localizers cannot catch it as an Exception."""


def run_chunk(
    suite: Suite,
    chunk: Chunk,
    fields: Path | None = None,
    failures: Mapping[tuple[int, str], str] | None = None,
    done: Collection[tuple[int, str]] = (),
) -> dict[str, list[Row]]:
    """Run and score a chunk of a suite.

    Args:
        suite: The suite.
        chunk: One of its chunks.
        fields: Folder with a folder of `magtwin.bench.world.fit_field` for each survey in the suite's data.
        failures: Reasons by run and localizer of those that are known to fail and are not run, as they would
            end the process.
        done: Runs and localizers to leave out.

    Returns:
        Rows by kind of table in `magtwin.bench.store`. All but the times are the same in every call.
    """
    scenario = suite.scenarios[chunk.scenario]
    made: dict[str, list[Row]] = {kind: [] for kind in SCHEMAS}
    for run in range(chunk.first, chunk.first + chunk.runs):
        names = [name for name in chunk.entries if (run, name) not in done]
        if not names:
            continue
        beat(f"{run}", times=SETUP)
        case = make_case(suite, scenario, run, fields)
        limits = bounds_of(case)
        made[TRUTHS].append({"scenario": scenario.name, "run": run, **_bound_over_time(case, limits)})
        for name in names:
            _warm_up(suite.localizers[name], case)
        for name in names:
            entry = suite.localizers[name]
            entry = replace(entry, compensator=suite.path(entry.compensator))
            key = {"scenario": scenario.name, "localizer": name, "run": run}
            beat(f"{run} {name}")
            if failures and (run, name) in failures:
                found, scores, smooth = None, Scores(failed=failures[run, name]), False
            else:
                seed = case.problem.seed
                if foreign(entry.method) or scenario.source == "drawn":
                    salt = bytes.fromhex(suite.salt)
                    seed = seed_of(
                        f"{suite.name} {suite.version}", scenario.name, suite.first_seed + run, name, salt
                    )
                found, scores, smooth = run_localizer(entry, case, suite.time_limit_s, limits, scenario, seed)
            row = scores.row()
            made[TIMES].append({**key, "step_us": row.pop("step_us")})
            reason = row.pop("failed")
            made[ROWS].append(
                {
                    **key,
                    "seed": suite.first_seed + run,
                    "session": run % scenario.sessions,
                    "status": "failed" if reason else "ok",
                    "reason": reason,
                    "readings": case.readings.rows,
                    "smoother": smooth,
                    "global_start": scenario.prior != "tracking",
                    "recovered_in_time": sum(after <= WITHIN_S for after in scores.recovery_s),
                    **row,
                }
            )
            made[TRACKS].append({**key, **_over_time(case, found)})
    return made


def make_case(suite: Suite, scenario: Scenario, run: int, fields: Path | None = None) -> Case:
    """One run of a scenario; the arguments are those of `run_chunk`, with the number of the run."""
    seed = suite.first_seed + run
    if scenario.source == "twin":
        from magtwin.bench.twin_case import twin_case

        own = fields / scenario.data if scenario.data and fields is not None else None
        session = suite.first_seed + run % scenario.sessions
        scenario = replace(scenario, paths=tuple(map(suite.path, scenario.paths)))
        return twin_case(scenario, str(suite.scene(scenario)), seed, session, own)
    if scenario.source == "drawn":
        from magtwin.bench.drawn import drawn_case

        return drawn_case(scenario, seed, suite.salt)
    folder = suite.folder(scenario)
    if scenario.source == "magnetic-data":
        from magtwin.bench.magnetic_data import magnetic_data_case

        return magnetic_data_case(
            folder,
            scenario.number,
            seed,
            start=scenario.prior,
            odometry=scenario.told_odometry,
            rate_hz=scenario.rate_hz,
        )
    from magtwin.bench.magslam import HAND_LOOPS, hand_case, ship_case

    if scenario.source == "ship":
        return ship_case(folder, scenario.number, seed)
    if 1 <= scenario.number <= len(HAND_LOOPS):
        return hand_case(folder, HAND_LOOPS[scenario.number - 1])
    known = ", ".join(f"{k} ({name})" for k, name in enumerate(HAND_LOOPS, 1))
    raise InputError(f"scenario {scenario.name!r}: number must be one of {known}, got {scenario.number}")


def bounds_of(case: Case) -> Bounds | None:
    """Bounds of a case; None for SLAM, which has no map."""
    truth = case.truth
    field = truth.field if truth.field is not None else case.problem.belief
    if field is None or case.problem.belief is None:
        return None
    return bounds(
        case.problem,
        truth.pose,
        truth.t,
        field,
        used=np.isfinite(case.readings["b_measured_nt"]),
        kidnapped_s=truth.kidnapped_s,
    )


def run_localizer(
    entry: Entry, case: Case, limit_s: float, limits: Bounds | None, scenario: Scenario, seed: int
) -> tuple[Track | None, Scores, bool]:
    """A track, its scores, and whether it is a smoother's; None and the reason if the localizer failed.

    Args:
        entry: The localizer, which runs in a jailed process of its own if its code is not magtwin's.
        case: The case.
        limit_s: Longest time [s].
        limits: Bounds of the case.
        scenario: What the case was drawn from.
        seed: Seed of the localizer's random numbers.
    """
    contestant, smooth = None, False
    try:
        with time_limit(limit_s):
            readings = case.readings
            if entry.compensator != "none":
                from magtwin.tasks.own_field import with_own_field

                readings = with_own_field(readings, entry.compensator, case.problem)
        if seals(entry.method):
            contestant = Contestant(entry, case.problem, seed, readings, limit_s)
        with time_limit(limit_s):
            if contestant is not None:
                smooth = contestant.load().smooths
                made = track(contestant, case.problem, readings, name=contestant.name)
                made = replace(made, step_s=contestant.step_s)
            else:
                algorithm = load_localizer(entry.method, entry.options)
                smooth = smooths(algorithm)
                made = track(algorithm, replace(case.problem, seed=seed), readings)
    except (InputError, MemoryError) as error:
        return None, Scores(failed=str(error)), smooth
    except (TimeLimitError, TimeoutError):
        return None, Scores(failed=f"took longer than the time limit of {limit_s:g} s"), smooth
    finally:
        if contestant is not None:
            contestant.end()
    scores = score(
        made,
        case.truth.pose,
        global_start=scenario.prior != "tracking",
        kidnapped_s=case.truth.kidnapped_s,
        bounds=limits,
        scale_m=SCALE_M if case.truth.scale_m is None else case.truth.scale_m,
    )
    return made, scores, smooth


def smooths(algorithm: Localizer | Smoother) -> bool:
    """Whether an algorithm uses later readings for its estimates, and so has another bound."""
    return isinstance(algorithm, Smoother) and not isinstance(algorithm, Localizer)


def _warm_up(entry: Entry, case: Case) -> None:
    """Run a localizer of magtwin on a few readings once, so that no run's time has compilation in it.

    Those of others are left alone: what they do wrong counts in their runs.
    """
    if foreign(entry.method) or repr(entry) in _warm:
        return
    _warm.add(repr(entry))
    with contextlib.suppress(InputError):  # which its runs will say
        track(load_localizer(entry.method, entry.options), case.problem, case.readings.take(slice(0, 4)))


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise `TimeLimitError` after a time, in the main thread of a process; elsewhere the runner ends it."""
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "setitimer"):
        yield
        return

    def late(*_: object) -> None:
        raise TimeLimitError

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds, 1.0)  # again and again: callbacks of libraries swallow it
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def _over_time(case: Case, made: Track | None) -> Row:
    """Position error and flag at `TRACK_HZ`, as float32."""
    truth = case.truth
    unknown = np.full(len(truth.t), np.nan)
    error = unknown if made is None else np.hypot(*(made.pose - truth.pose)[:, :2].T)
    return _thinned(case, error_m=error, lost=unknown if made is None else made.lost)


def _bound_over_time(case: Case, limits: Bounds | None) -> Row:
    t = case.truth.t
    bound = np.full(len(t), np.nan) if limits is None else limits.correlated
    return _thinned(case, t=t - t[0], bound_m=bound)


def _thinned(case: Case, **curves: Any) -> Row:
    rows = slice(None, None, max(1, round(case.problem.rate_hz / TRACK_HZ)))
    return {name: np.asarray(values[rows], np.float32) for name, values in curves.items()}
