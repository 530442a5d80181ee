"""Readings: what a magnetometer measured at known poses, from which maps are made."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.field.days import check_texts
from magtwin.field.grid import FARTHEST_M, Grid
from magtwin.report.report import Figure, Report
from magtwin.report.summary import Summarized, Summary, listed, rectangle, span

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Readings(Summarized):
    """Readings of a magnetometer on a robot at known poses, one per row.

    A reading has a magnitude, a vector, or both. Arrays are copied and read-only.
    """

    p_xy: Array  # Positions of base_link in world [m], shape (N, 2)
    yaw: Array  # Recorded headings of the robot [rad], shape (N,)
    # Field magnitude [nT], shape (N,). Default: that of `b_body_nt`.
    b_nt: Array = None  # type: ignore[assignment]
    # Field in the robot's axes, forward, left, up [nT], shape (N, 3); None if only magnitudes are known
    b_body_nt: Array | None = None
    # Index into `runs` of each row, shape (N,). Default: 0.
    run: NDArray[np.intp] = None  # type: ignore[assignment]
    runs: tuple[str, ...] = ("",)  # Names of the runs or files that the rows come from
    t: Array | None = None  # Time of each row in its run [s], shape (N,); None if unknown
    # What the robot did at each row, 0 where it stood with its LiDAR off, shape (N, K), see `onboard`
    signals: Array | None = None
    signal_names: tuple[str, ...] = ()  # Names of the signals
    # Rows that are field, not a stuck sensor, shape (N,). Default: all.
    good: NDArray[np.bool_] = None  # type: ignore[assignment]
    grid: Grid | None = None  # Nodes of a gridded survey; None for a scattered one
    # Heading, row and column of each row's node, shape (N, 3); given with `grid`
    node: NDArray[np.intp] | None = None
    height_m: float | None = None  # Height of the sensor above the floor [m]; None if unknown
    name: str = ""  # Name of the survey
    source: str = ""  # Files that the rows come from, with checksums
    licence: str = ""  # SPDX name of their licence
    created: str = ""  # Day of the survey, YYYY-MM-DD; "" if unknown
    frame: str = ""  # Axes of x, y and heading, such as "world: x east, y north, z up"; "" if unknown
    datum: str = ""  # Origin of that frame in the room or on Earth; "" if unknown
    # The Earth's field in that frame [nT]; None if unknown
    earth_nt: tuple[float, float, float] | None = None
    rounding_nt: float = 0.0  # Standard deviation of rounding errors that are alike in neighbours [nT]
    by_hand: bool = False  # Whether no robot carried the sensor, so that it reads alike at all headings

    def __post_init__(self) -> None:
        p = np.asarray(self.p_xy, float)
        if p.ndim != 2 or p.shape[1] != 2 or not len(p):
            raise InputError(f"p_xy of Readings must have shape (N, 2), N 1 or more, got {p.shape}")
        n = len(p)
        body = self.b_body_nt
        if self.b_nt is None:
            if body is None:
                raise InputError("Readings need b_nt or b_body_nt, got neither")
            object.__setattr__(self, "b_nt", np.linalg.norm(np.asarray(body, float), axis=-1))
        if self.run is None:
            object.__setattr__(self, "run", np.zeros(n, np.intp))
        if self.good is None:
            object.__setattr__(self, "good", np.ones(n, bool))
        for name, (columns, kind) in SHAPES.items():
            given = getattr(self, name)
            if given is None:
                continue
            array: NDArray[Any] = np.array(given, kind)
            columns = len(self.signal_names) if name == "signals" else columns
            shape = (n, columns) if columns else (n,)
            if array.shape != shape:
                raise InputError(f"{name} of Readings must have shape {shape}, got {array.shape}")
            if not np.all(np.isfinite(array)):
                row = int(np.argwhere(~np.isfinite(array))[0][0])
                raise InputError(f"{name} of Readings must be finite, got {array[row]} in row {row}")
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        beyond = np.argwhere(np.abs(self.p_xy) > FARTHEST_M)
        if len(beyond):
            row = int(beyond[0][0])
            text = f"p_xy of Readings lies within {FARTHEST_M:g} m of the origin"
            raise InputError(f"{text}, got {self.p_xy[row]} in row {row}")
        if not np.all(self.b_nt > 0):
            row = int(self.b_nt.argmin())
            least = f"{self.b_nt[row]:g} in row {row}"
            raise InputError(f"b_nt of Readings is a magnitude, above 0 nT, got {least}")
        if self.height_m is not None and not 0 <= self.height_m < np.inf:
            text = "height_m of Readings is a height above the floor, 0 m or more"
            raise InputError(f"{text}, got {self.height_m!r}")
        if self.earth_nt is not None:
            object.__setattr__(self, "earth_nt", checked_earth_nt(self.earth_nt))
        if not (self.run.min() >= 0 and self.run.max() < len(self.runs)):
            text = f"run of Readings must index runs ({len(self.runs)})"
            raise InputError(f"{text}, got {self.run.min()}..{self.run.max()}")
        check_texts(self, TEXTS)
        if (self.grid is None) != (self.node is None):
            raise InputError("Readings of a gridded survey need both grid and node, got one of them")
        if self.grid is None or self.node is None:
            return
        if self.node.min() < 0 or np.any(self.node.max(axis=0) >= self.grid.shape):
            raise InputError(f"node of Readings must lie in the grid's {self.grid.shape}")

    def __len__(self) -> int:
        return len(self.p_xy)

    @property
    def about(self) -> dict[str, Any]:
        """Metadata that a map of the readings shares, by name."""
        return {name: getattr(self, name) for name in (*TEXTS, "height_m")}

    def take(self, rows: ArrayLike) -> "Readings":
        """Select readings by their indices, or by flags of shape (N,)."""
        index = np.asarray(rows)
        given = {name: getattr(self, name) for name in SHAPES}
        some: dict[str, Any] = {k: None if rows is None else rows[index] for k, rows in given.items()}
        return replace(self, **some)

    def report(self) -> Report:
        """Statistics of the good readings."""
        good = self.take(self.good) if self.good.any() else self
        (x0, y0), (x1, y1) = good.p_xy.min(axis=0), good.p_xy.max(axis=0)
        figures = [
            Figure("readings", len(self), note="with vectors" if self.b_body_nt is not None else ""),
            Figure("good readings", int(self.good.sum())),
            Figure("runs", len(self.runs)),
            Figure("extent", f"x {x0:.3f}..{x1:.3f}, y {y0:.3f}..{y1:.3f}", "m"),
            Figure("mean", round(float(good.b_nt.mean()), 1), "nT", spread=round(float(good.b_nt.std()), 1)),
            Figure("least", round(float(good.b_nt.min()), 1), "nT"),
            Figure("greatest", round(float(good.b_nt.max()), 1), "nT"),
        ]
        files = [part for part in self.source.split("; ") if not part.startswith(TAKEN)]
        metadata = {"source": files, "licence": self.licence, "created": self.created}
        return Report(f"readings {self.name}", tuple(figures), {k: v for k, v in metadata.items() if v})

    def with_(self, **changes: Any) -> "Readings":
        """A copy with other values of some fields, such as `good`."""
        return replace(self, **changes)

    def _summary(self) -> Summary:
        good = self.b_nt[self.good] if self.good.any() else self.b_nt
        (x0, y0), (x1, y1) = self.p_xy.min(axis=0), self.p_xy.max(axis=0)
        bad = len(self) - int(self.good.sum())
        about = [self.created or "day unknown"]
        about.append("height unknown" if self.height_m is None else f"sensor at {self.height_m:.3g} m")
        about += [text for text in (self.licence, self.frame) if text]
        vectors = "" if self.b_body_nt is None else ", with vectors"
        gridded = "" if self.grid is None else f", on a grid of {' x '.join(map(str, self.grid.shape))}"
        return Summary(
            f"Readings {self.name or 'without a name'}: {len(self):,} rows"
            + (f", {bad:,} of them not field" if bad else ""),
            (
                ("over", rectangle(x0, x1, y0, y1) + gridded),
                ("field", f"{span(good.min(), good.max(), 'nT')}, mean {good.mean():,.0f} nT{vectors}"),
                ("runs", f"{len(self.runs):,}: {listed(self.runs)}" if any(self.runs) else ""),
                ("known", ", ".join(about)),
                ("signals", listed(self.signal_names)),
                ("source", self.source),
            ),
        )


def masked_words(readings: Readings) -> str:
    """For a refusal: how many readings are masked, and how to keep them; "" if none are."""
    masked = len(readings) - int(np.count_nonzero(readings.good))
    return f", {masked} are masked as stuck (`keep_stuck=True` keeps them)" if masked else ""


TAKEN = "taken "  # Start of a part of `source` that lists what was deduced from names or sizes
TEXTS = ("name", "source", "licence", "created", "frame", "datum")  # Metadata that are texts


def taken_of(readings: Readings) -> list[str]:
    """What was repaired or deduced, by the source of readings."""
    return [part.removeprefix(TAKEN) for part in readings.source.split("; ") if part.startswith(TAKEN)]


def checked_earth_nt(earth_nt: ArrayLike) -> tuple[float, float, float]:
    """The Earth's field in world axes [nT]; InputError unless it is three finite numbers, not all 0."""
    field = np.asarray(earth_nt, float)
    if field.shape != (3,) or not np.all(np.isfinite(field)) or not np.any(field):
        text = "earth_nt must be three numbers [nT], those of the world's x, y and z"
        raise InputError(f"{text}, got {earth_nt!r}")
    x, y, z = field.tolist()
    return x, y, z


# Columns (0 for a plain column) and type of each array of rows
SHAPES: dict[str, tuple[int, type]] = {
    "p_xy": (2, float),
    "yaw": (0, float),
    "b_nt": (0, float),
    "b_body_nt": (3, float),
    "run": (0, np.intp),
    "t": (0, float),
    "signals": (-1, float),
    "good": (0, bool),
    "node": (3, np.intp),
}
