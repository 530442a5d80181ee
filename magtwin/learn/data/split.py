"""Split: the recordings of training, validation and test."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError, find
from magtwin.learn.data.recording import Recording
from magtwin.report.summary import Summarized

By = Literal["session", "run", "path", "row"]
Part = Literal["train", "validation", "test"]

PARTS: tuple[Part, ...] = ("train", "validation", "test")
SHARES = (0.7, 0.15, 0.15)

LEAK = (
    "split by row: rows a hundredth of a second apart lie on both sides, so that the test repeats what was "
    "learned; its error shows the leak, not how well a run that was never seen is predicted"
)
"""Warning about a split by row."""

_DEAL = (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
"""Constants of splitmix64 (Steele, Lea and Flood 2014), which assigns rows."""


_KEYS: Mapping[str, Callable[[Recording], str]] = MappingProxyType(
    {
        "session": lambda recording: recording.session,
        "run": lambda recording: recording.name,
        "path": lambda recording: recording.path,
        "row": lambda recording: recording.name,
    }
)


@dataclass(frozen=True, repr=False)
class Split(Summarized):
    """Recordings of training, validation and test; by row, each part has some rows of every recording."""

    train: tuple[str, ...]
    """Names of recordings to fit to."""

    validation: tuple[str, ...]
    """Names of recordings to stop and calibrate by."""

    test: tuple[str, ...]
    """Names of recordings to judge by, used for nothing else."""

    by: By = "run"
    """Unit kept whole."""

    held_out: tuple[str, ...] = ()
    """Names that were put into the test on request."""

    row_seed: int = 0
    """Seed of a split by row."""

    row_shares: tuple[float, float, float] = SHARES
    """Shares of the parts of a split by row."""

    @property
    def leak(self) -> str:
        """Warning that goes with its results, or ""."""
        return LEAK if self.by == "row" else ""

    def names(self, part: Part) -> tuple[str, ...]:
        """Names of the recordings of a part.

        Raises:
            InputError: No such part.
        """
        return find(
            "part of a split", part, {"train": self.train, "validation": self.validation, "test": self.test}
        )

    def rows(self, part: Part, name: str, count: int) -> NDArray[np.bool_]:
        """Mask of the rows of a recording that are in a part, shape (N,).

        Args:
            part: "train", "validation" or "test".
            name: Name of the recording.
            count: Number of its rows.

        Raises:
            InputError: No such part.
        """
        if name not in self.names(part):
            return np.zeros(count, bool)
        if self.by != "row" or name in self.held_out:
            return np.ones(count, bool)
        drawn = _uniform(self.row_seed, name, count)
        edges = np.cumsum((0.0, *self.row_shares))
        i = PARTS.index(part)
        return (drawn >= edges[i]) & (drawn < (edges[i + 1] if part != "test" else 2.0))


def split(
    recordings: Sequence[Recording],
    by: By = "session",
    hold_out: Sequence[str] = (),
    *,
    rng: np.random.Generator,
) -> Split:
    """Split recordings into training, validation and test, keeping sessions, runs or paths whole.

    Groups are taken in random order. Each goes to the part that is furthest below its share of labelled rows,
    of `SHARES`; no part with a share stays empty.

    Args:
        recordings: Such as those of a `Dataset`.
        by: Unit kept whole. "row" splits single rows, for comparison; `Split.leak` warns of it.
        hold_out: Sessions, runs or paths (by `by`), or names of recordings, to put into the test. The others
            then go to training and validation only.
        rng: Source of the order.

    Raises:
        InputError: There are fewer groups than parts, or a name in `hold_out` is unknown.
    """
    key, numbers = find("way to split", by, _KEYS), np.array(SHARES)
    known = {key(each) for each in recordings} | {each.name for each in recordings}
    for wanted in hold_out:
        find(f"{by if by != 'row' else 'run'} or recording to hold out", wanted, dict.fromkeys(known))
    held = {each.name for each in recordings if key(each) in hold_out or each.name in hold_out}
    if by in ("session", "path"):  # holding out a recording holds out its group
        groups_held = {key(each) for each in recordings if each.name in held}
        held = {each.name for each in recordings if key(each) in groups_held}
    left = [each for each in recordings if each.name not in held]
    if held:
        numbers = np.array([numbers[0], numbers[1], 0.0]) / (numbers[0] + numbers[1])
    if by == "row":
        names = tuple(each.name for each in left)
        train, validation, test = (names if share > 0 else () for share in numbers)
        test = (*test, *_in_order(recordings, held))
        row_shares = (float(numbers[0]), float(numbers[1]), float(numbers[2]))
        return Split(
            train, validation, test, by, _in_order(recordings, held), int(rng.integers(2**63)), row_shares
        )
    parts = _dealt(left, key, numbers, rng, by)
    parts["test"] |= held
    train, validation, test = (_in_order(recordings, parts[part]) for part in PARTS)
    return Split(train, validation, test, by, _in_order(recordings, held))


def _dealt(
    recordings: Sequence[Recording],
    key: Callable[[Recording], str],
    shares: NDArray[np.float64],
    rng: np.random.Generator,
    by: str,
) -> dict[str, set[str]]:
    """Names by part."""
    groups: dict[str, list[Recording]] = {}
    for recording in recordings:
        groups.setdefault(key(recording), []).append(recording)
    wanted = [part for part, share in zip(PARTS, shares, strict=True) if share > 0]
    if len(groups) < len(wanted):
        finer = {"session": "run", "path": "run"}.get(by)
        raise InputError(
            f"{len(groups)} {by}{'s' if len(groups) != 1 else ''} cannot be dealt to {len(wanted)} parts "
            f"({', '.join(wanted)}); record more" + (f", or split by {finer}" if finer else "")
        )
    names = sorted(groups)
    names = [names[i] for i in rng.permutation(len(names))]
    rows = {name: max(1, sum(each.labelled for each in groups[name])) for name in names}
    total = sum(rows.values())
    parts: dict[str, set[str]] = {part: set() for part in PARTS}
    held = dict.fromkeys(wanted, 0)
    share_of = dict(zip(PARTS, shares.tolist(), strict=True))
    for i, name in enumerate(names):
        empty = [part for part in wanted if not parts[part]]
        open_to = empty if len(names) - i <= len(empty) else wanted
        part = max(open_to, key=lambda part: share_of[part] - held[part] / total)
        parts[part] |= {each.name for each in groups[name]}
        held[part] += rows[name]
    return parts


def _in_order(recordings: Sequence[Recording], names: set[str]) -> tuple[str, ...]:
    return tuple(each.name for each in recordings if each.name in names)


def _uniform(seed: int, name: str, count: int) -> NDArray[np.float64]:
    """Numbers in [0, 1) that depend on name and row only, so that blocks can be read alone."""
    state = np.uint64(seed)
    with np.errstate(over="ignore"):
        for byte in name.encode():
            state = (state ^ np.uint64(byte)) * np.uint64(_DEAL[1])
        z = state + np.arange(1, count + 1, dtype=np.uint64) * np.uint64(_DEAL[0])
        z = (z ^ (z >> np.uint64(30))) * np.uint64(_DEAL[1])
        z = (z ^ (z >> np.uint64(27))) * np.uint64(_DEAL[2])
        z = z ^ (z >> np.uint64(31))
    return (z >> np.uint64(11)).astype(float) * 2.0**-53
