"""Timeline: the order of a topic's messages, by their stamps."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.io.bags.cdr import NS, Index

JUMP_S = 1.0  # Stamps further from those around them than this are wrong, or those of another clock [s]
WRONG = 0.01  # Share of messages with wrong stamps up to which they are left out
UNSET_NS = 10**7 * NS  # Median of stamps from which one of 0 was not set, and begins no simulation [ns]
AROUND = 5  # Number of messages around one, itself included, from whose median an outlier is told


class Order(NamedTuple):
    """The messages of a topic in the order of their times."""

    rows: NDArray[np.intp]  # Which messages are kept, in order
    ns: Index  # Their times, ascending [ns]
    sorted: int = 0  # How many came after a later one
    unset: int = 0  # How many were left out, as their stamp is 0
    outliers: int = 0  # How many were left out, as their stamp is far from those around it
    repeated: int = 0  # How many have the time of the one before

    def __str__(self) -> str:
        """What was done, in words; "" if nothing was."""
        words = {"sorted": self.sorted, "without a stamp left out": self.unset}
        words |= {"with the stamp of another time left out": self.outliers, "repeated": self.repeated}
        done = ", ".join(f"{count:,} {word}" for word, count in words.items() if count)
        return done and f"{done}, of {len(self.rows) + self.unset + self.outliers:,}"


def in_order(ns: Index, received: Index, where: Path, topic: str) -> Order:
    """Messages, given in the order of receipt, in the order of their times [ns], shape (M,).

    Messages that overtook each other are sorted. A few whose stamp is 0, or more than `JUMP_S` from those
    around it, are left out. Refused is a clock that jumps for good, or is wrong too often.
    """
    everyone = np.arange(len(ns))
    steps = np.diff(ns)
    usual = int(np.median(np.abs(steps))) if len(steps) else 0
    far = max(int(JUMP_S * NS), 20 * usual)
    if (steps >= 0).all() and (steps < far).all():
        return Order(everyone, ns, repeated=int(np.count_nonzero(steps == 0)))
    unset = (ns == 0) if np.median(ns) > UNSET_NS else np.zeros(len(ns), bool)
    kept = everyone[~unset]
    span = np.ptp(received[kept]) if len(kept) else 0
    trusted = span > 0.5 * abs(int(np.median(steps)) * len(kept))
    offset = ns[kept] - (received[kept] if trusted else kept * int(np.median(steps)))
    outlier = np.abs(offset - _median_around(offset)) > far
    kept = kept[~outlier]
    left = len(ns) - len(kept)
    if left > max(1, WRONG * len(ns)):
        k = int(np.argmax(~np.isin(everyone, kept)))
        first = f"first {ns[k] / NS:.6f} s after {ns[k - 1] / NS:.6f} s, in message {k + 1}"
        text = f"{left} of {len(ns)} stamps of {topic} are wrong, {first}"
        raise InputError(f"{where}: {text}; its clock is unsteady")
    steps, waits = np.diff(ns[kept]), np.diff(received[kept])
    jumps = (np.abs(steps - waits) > far) & ((steps < 0) | (steps > far)) if trusted else steps < -far
    late = np.maximum.accumulate(ns[kept]) > ns[kept]
    if jumps.any() or 2 * np.count_nonzero(late) > len(kept):
        k = int(np.argmax(jumps if jumps.any() else steps < 0))
        before, after = ns[kept[k]] / NS, ns[kept[k + 1]] / NS
        way = "run backwards" if after < before else "jump"
        text = (
            f"{way} for good, from {before:.6f} s to {after:.6f} s, in message {kept[k + 1] + 1} of {len(ns)}"
        )
        raise InputError(f"{where}: stamps of {topic} {text}: its clock was set; cut the recording there")
    rows = kept[np.argsort(ns[kept], kind="stable")]
    counts = (int(np.count_nonzero(each)) for each in (late, unset, outlier, np.diff(ns[rows]) == 0))
    return Order(rows, ns[rows], *counts)


def _median_around(values: Index) -> NDArray[np.float64]:
    """Median of each value and those around it, shape (M,) -> (M,)."""
    half = AROUND // 2
    if len(values) < AROUND:
        return np.full(len(values), np.median(values))
    padded = np.pad(values, half, mode="reflect")
    return np.median(np.lib.stride_tricks.sliding_window_view(padded, AROUND), axis=1)
