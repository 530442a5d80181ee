"""Split: which recordings are learned from, which stop the learning, and which judge it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError, find
from magtwin.report import Figure, Report
from magtwin.summary import Summarized, Summary, listed

By = Literal["session", "run", "path", "row"]
Part = Literal["train", "validation", "test"]

PARTS: tuple[Part, ...] = ("train", "validation", "test")
SHARES = (0.7, 0.15, 0.15)

LEAK = (
    "split by row: rows a hundredth of a second apart lie on both sides, so that the test repeats what was "
    "learned; its error shows the leak, not how well a run that was never seen is predicted"
)
"""What is said of a split by row."""

_DEAL = (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
"""Constants of splitmix64 (Steele, Lea and Flood 2014), which deals rows."""


class Recorded(Protocol):
    """What a split needs to know of a recording."""

    @property
    def name(self) -> str:
        """What it is called."""

    @property
    def session(self) -> str:
        """The session that it is of."""

    @property
    def path(self) -> str:
        """The path that was driven."""

    @property
    def labelled(self) -> int:
        """How many of its rows have a label."""


_KEYS: Mapping[str, Callable[[Recorded], str]] = MappingProxyType(
    {
        "session": lambda recording: recording.session,
        "run": lambda recording: recording.name,
        "path": lambda recording: recording.path,
        "row": lambda recording: recording.name,
    }
)


@dataclass(frozen=True, repr=False)
class Split(Summarized):
    """Recordings by what they are for; by row, every recording is in each part with rows of its own."""

    train: tuple[str, ...]
    """Names of those that weights are fitted to."""

    validation: tuple[str, ...]
    """Names of those that end the training and calibrate."""

    test: tuple[str, ...]
    """Names of those that judge; nothing else looks at them."""

    by: By = "run"
    """What is never on two sides."""

    held_out: tuple[str, ...] = ()
    """Names that were asked to be in the test."""

    row_seed: int = 0
    """Of a split by row: what deals the rows."""

    row_shares: tuple[float, float, float] = field(default=SHARES)
    """Of a split by row: the shares of its parts."""

    @property
    def leak(self) -> str:
        """What is wrong with it, for whoever is told of its results; "" where nothing is."""
        return LEAK if self.by == "row" else ""

    def names(self, part: Part) -> tuple[str, ...]:
        """Names of the recordings that have rows in a part.

        Raises:
            InputError: There is no such part.
        """
        return find(
            "part of a split", part, {"train": self.train, "validation": self.validation, "test": self.test}
        )

    def rows(self, part: Part, name: str, count: int) -> NDArray[np.bool_]:
        """Which of the rows of a recording are in a part, shape (N,).

        Args:
            part: "train", "validation" or "test".
            name: The recording's.
            count: How many rows it has, labelled or not.

        Raises:
            InputError: There is no such part.
        """
        if name not in self.names(part):
            return np.zeros(count, bool)
        if self.by != "row" or name in self.held_out:
            return np.ones(count, bool)
        drawn = _uniform(self.row_seed, name, count)
        edges = np.cumsum((0.0, *self.row_shares))
        i = PARTS.index(part)
        return (drawn >= edges[i]) & (drawn < (edges[i + 1] if part != "test" else 2.0))

    def report(self, title: str = "Split") -> Report:
        """How many recordings are in each part, and what is wrong with it."""
        figures = [Figure(part, len(self.names(part)), "recordings") for part in PARTS]
        metadata: dict[str, object] = {"by": self.by}
        if self.leak:
            metadata["warning"] = self.leak
        return Report(title, tuple(figures), metadata)

    def _summary(self) -> Summary:
        return Summary(
            f"Split by {self.by}",
            (
                *((part, f"{len(self.names(part)):,}: {listed(self.names(part), 70)}") for part in PARTS),
                ("caution", self.leak),
            ),
        )


def split(
    recordings: Sequence[Recorded],
    by: By = "session",
    shares: tuple[float, float, float] = SHARES,
    hold_out: Sequence[str] = (),
    *,
    rng: np.random.Generator,
) -> Split:
    """Deal recordings to training, validation and test, whole sessions, runs or paths at a time.

    Groups are dealt in a random order, each to the part that is furthest below its share of labelled rows;
    a part with a share never stays empty.

    Args:
        recordings: Such as those of a `Dataset`.
        by: What is never on two sides: a session, a run or a path. "row" deals single rows, to show
            what that hides; it says so in `Split.leak`.
        shares: Of labelled rows in training, validation and test; they sum to 1.
        hold_out: Sessions, runs or paths (by `by`), or names of recordings, that are all in the test;
            where given, the other recordings are dealt to training and validation alone.
        rng: Source of the order.

    Raises:
        InputError: There are fewer groups than parts, shares do not sum to 1, or what is to be held out is
            not there.
    """
    key = find("way to split", by, _KEYS)
    numbers = np.asarray(shares, float)
    if numbers.shape != (3,) or not (np.isfinite(numbers).all() and (numbers >= 0).all() and numbers[0] > 0):
        raise InputError(f"shares must be three, none below 0 and training's above it, got {tuple(shares)}")
    if abs(numbers.sum() - 1) > 1e-6:
        raise InputError(f"shares must sum to 1, got {tuple(shares)}, which sum to {numbers.sum():g}")
    if not recordings:
        raise InputError("there is no recording to split")
    known = {key(one) for one in recordings} | {one.name for one in recordings}
    for wanted in hold_out:
        find(f"{by if by != 'row' else 'run'} or recording to hold out", wanted, dict.fromkeys(known))
    held = {one.name for one in recordings if key(one) in hold_out or one.name in hold_out}
    if by in ("session", "path"):  # a recording of it that was held out takes the others along
        groups_held = {key(one) for one in recordings if one.name in held}
        held = {one.name for one in recordings if key(one) in groups_held}
    left = [one for one in recordings if one.name not in held]
    if held:
        numbers = np.array([numbers[0], numbers[1], 0.0]) / (numbers[0] + numbers[1])
    if by == "row":
        names = tuple(one.name for one in left)
        train, validation, test = (names if share > 0 else () for share in numbers)
        test = (*test, *(one.name for one in recordings if one.name in held))
        row_shares = (float(numbers[0]), float(numbers[1]), float(numbers[2]))
        return Split(
            train, validation, test, by, _in_order(recordings, held), int(rng.integers(2**63)), row_shares
        )
    parts = _dealt(left, key, numbers, rng, by)
    parts["test"] |= held
    train, validation, test = (_in_order(recordings, parts[part]) for part in PARTS)
    return Split(train, validation, test, by, _in_order(recordings, held))


def _dealt(
    recordings: Sequence[Recorded],
    key: Callable[[Recorded], str],
    shares: NDArray[np.float64],
    rng: np.random.Generator,
    by: str,
) -> dict[str, set[str]]:
    """Names by part."""
    groups: dict[str, list[Recorded]] = {}
    for one in recordings:
        groups.setdefault(key(one), []).append(one)
    wanted = [part for part, share in zip(PARTS, shares, strict=True) if share > 0]
    if len(groups) < len(wanted):
        finer = {"session": "run", "path": "run"}.get(by)
        raise InputError(
            f"{len(groups)} {by}{'s' if len(groups) != 1 else ''} cannot be dealt to {len(wanted)} parts "
            f"({', '.join(wanted)}); record more" + (f", or split by {finer}" if finer else "")
        )
    names = sorted(groups)
    names = [names[i] for i in rng.permutation(len(names))]
    rows = {name: max(1, sum(one.labelled for one in groups[name])) for name in names}
    total = sum(rows.values())
    parts: dict[str, set[str]] = {part: set() for part in PARTS}
    held = dict.fromkeys(wanted, 0)
    share_of = dict(zip(PARTS, shares.tolist(), strict=True))
    for i, name in enumerate(names):
        empty = [part for part in wanted if not parts[part]]
        open_to = empty if len(names) - i <= len(empty) else wanted
        part = max(open_to, key=lambda part: share_of[part] - held[part] / total)
        parts[part] |= {one.name for one in groups[name]}
        held[part] += rows[name]
    return parts


def _in_order(recordings: Sequence[Recorded], names: set[str]) -> tuple[str, ...]:
    return tuple(one.name for one in recordings if one.name in names)


def _uniform(seed: int, name: str, count: int) -> NDArray[np.float64]:
    """Numbers in [0, 1) that a row's place in a named recording decides, so that blocks can be read alone."""
    state = np.uint64(seed)
    with np.errstate(over="ignore"):
        for byte in name.encode():
            state = (state ^ np.uint64(byte)) * np.uint64(_DEAL[1])
        z = state + np.arange(1, count + 1, dtype=np.uint64) * np.uint64(_DEAL[0])
        z = (z ^ (z >> np.uint64(30))) * np.uint64(_DEAL[1])
        z = (z ^ (z >> np.uint64(27))) * np.uint64(_DEAL[2])
        z = z ^ (z >> np.uint64(31))
    return (z >> np.uint64(11)).astype(float) * 2.0**-53
