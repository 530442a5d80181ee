"""AnomalyMap: the magnitude of the magnetic field over a floor, by position and heading."""

import importlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.field.days import check_texts
from magtwin.field.grid import Grid, check_axes
from magtwin.field.maps.lookup import EDGE, NONE, Lookup
from magtwin.field.maps.made_from import MadeFrom
from magtwin.field.sources.harmonic import HarmonicField
from magtwin.report.report import Figure, Report
from magtwin.report.summary import Summarized, Summary, listed, rectangle, span

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture

Array = NDArray[np.float64]

TEXTS = ("name", "method", "source", "licence", "created", "frame", "datum")  # Metadata that are texts
CONSTANT_NT = 1e-3  # Range of values up to which a map is constant [nT]
# Parameters of a map: see `AnomalyMap.offset_sd_nt` and `AnomalyMap.noise_nt2`
OFFSET, NOISE = "offset sd [nT]", "noise of a reading [nT]"
TABLED = "greatest error of the table [nT]"  # Parameter of a map: see `AnomalyMap.exact`
SINGLE_NT = 0.05  # Rounding of a field to single precision, with some margin [nT]

Outside = Literal["nan", "clamp", "raise"]


@dataclass(frozen=True)
class Known:
    """The values of a map's valid nodes in short; nan if there is none."""

    nodes: int  # Number of valid nodes, over all headings
    least_nt: float
    greatest_nt: float
    mean_nt: float


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class AnomalyMap(Summarized):
    """Total field on a grid over x, y and heading, as read by a robot at rest at each node.

    Node (h, j, i) is at x = origin_m[0] + i cell_m[0], y = origin_m[1] + j cell_m[1] in world, at heading
    headings_rad[h]. Arrays are copied and read-only. Two maps are equal if every field is.
    """

    # Field magnitude at the nodes [nT], shape (H, Y, X); any value, also nan, where not `valid`
    values_nt: Array
    origin_m: tuple[float, float]  # World x and y of node [0, 0] [m]
    cell_m: tuple[float, float]  # Distance between nodes along x and y [m]
    headings_rad: Array  # Headings of the layers [rad], ascending in [0, 2 pi), shape (H,)
    # Nodes whose value is field, shape (H, Y, X). Default: all.
    valid: NDArray[np.bool_] = None  # type: ignore[assignment]
    variance_nt2: Array | None = None  # Variance of each value [nT^2], shape (H, Y, X); None if unknown
    # Mean squared error of interpolation in the middle of a cell and midway between headings [nT^2], shape
    # (2, H, Y, X), see `magtwin.field.maps.curvature`; None: not part of the standard deviation
    between_nt2: Array | None = None
    name: str = ""  # Name of the map and of its layer
    method: str = ""  # How the values were obtained
    source: str = ""  # Source files with checksums, or a script with its seed
    licence: str = ""  # SPDX name of their licence
    created: str = ""  # Day of the survey, YYYY-MM-DD; "" if unknown
    frame: str = ""  # Axes of x, y and heading, such as "world: x east, y north, z up"
    datum: str = ""  # Origin of that frame in the room or on Earth, and the reference of heights
    height_m: float | None = None  # Height of the sensor above the floor [m]; None if unknown
    # Recorded yaw of the robot at each node [rad], shape (H, Y, X); None if values are not single readings
    recorded_yaw: Array | None = None
    # Parameters of the method by name: numbers, texts, and lists of them, as in JSON
    parameters: Mapping[str, Any] = field(default_factory=dict)
    # The vector field from which the values were computed; None if there is none
    harmonic: HarmonicField | None = None
    # The room and the robot that the map was made from; None if that is not known
    made_from: MadeFrom | None = None

    def __post_init__(self) -> None:
        values = _frozen(self.values_nt, float)
        if values.ndim != 3 or not (values.shape[0] >= 1 and min(values.shape[1:]) >= 2):
            text = "values_nt of AnomalyMap must have shape (H, Y, X), one heading and 2 x 2 nodes or more"
            raise InputError(f"{text}, got {values.shape}")
        valid = np.ones(values.shape, bool) if self.valid is None else self.valid
        arrays: dict[str, Any] = {"values_nt": values, "valid": _frozen(valid, bool)}
        arrays["headings_rad"] = _frozen(self.headings_rad, float)
        if self.variance_nt2 is None:  # without the variance of the nodes, that between them has no use
            object.__setattr__(self, "between_nt2", None)
        for name in ("variance_nt2", "between_nt2", "recorded_yaw"):
            if getattr(self, name) is not None:
                arrays[name] = _frozen(getattr(self, name), float)
        shapes = {"headings_rad": values.shape[:1], "between_nt2": (2, *values.shape)}
        for name, array in arrays.items():
            shape = shapes.get(name, values.shape)
            if array.shape != shape:
                raise InputError(f"{name} of AnomalyMap must have shape {shape}, got {array.shape}")
            object.__setattr__(self, name, array)
        check_axes(self)
        check_texts(self, TEXTS)
        if not isinstance(self.parameters, Mapping):
            raise InputError(f"parameters of AnomalyMap must be figures by name, got {self.parameters!r}")
        if self.height_m is not None and not 0 <= self.height_m < np.inf:
            text = "height_m of AnomalyMap is a height above the floor, 0 m or more"
            raise InputError(f"{text}, got {self.height_m!r}")
        bad = self.valid & ~np.isfinite(self.values_nt)
        if bad.any():
            h, j, i = np.argwhere(bad)[0]
            raise InputError(
                f"values_nt of AnomalyMap must be finite at valid nodes, got {self.values_nt[h, j, i]} at "
                f"heading {h}, row {j}, column {i}; mask the node in `valid`"
            )
        for name in ("variance_nt2", "between_nt2"):
            part = getattr(self, name)
            if part is not None and not np.all(is_variance(part[..., self.valid])):
                raise InputError(f"{name} of AnomalyMap must not be below 0, nan or infinite where valid")

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, AnomalyMap):
            return NotImplemented
        return all(_same(getattr(self, f.name), getattr(other, f.name)) for f in fields(self))

    @cached_property
    def grid(self) -> Grid:
        """The nodes."""
        _, rows, columns = self.values_nt.shape
        axes: dict[str, Any] = {name: getattr(self, name) for name in ("origin_m", "cell_m", "headings_rad")}
        return Grid(**axes, rows=rows, columns=columns)

    @property
    def x_m(self) -> Array:
        """World x of the columns [m], shape (X,)."""
        return self.grid.x_m

    @property
    def y_m(self) -> Array:
        """World y of the rows [m], shape (Y,)."""
        return self.grid.y_m

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Least x, greatest x, least y, greatest y of the nodes, in world [m]."""
        return self.grid.extent

    def contains(self, p_xy: ArrayLike) -> NDArray[np.bool_]:
        """Whether points are on the grid, including its border and masked nodes.

        Args:
            p_xy: Points in world [m], shape (..., 2).

        Returns:
            Flags, shape (...); false for nan.
        """
        u = (np.asarray(p_xy, float) - self.origin_m) / self.cell_m
        _, rows, columns = self.grid.shape
        return np.all((u >= -EDGE) & (u <= np.array([columns - 1, rows - 1]) + EDGE), axis=-1)

    def lookup(self, p_xy: ArrayLike, yaw: ArrayLike, *, outside: Outside = "nan") -> Array:
        """Field at poses, trilinear in heading, y and x.

        B = sum over the 8 nodes around of w_h w_y w_x B_hyx. Heading is periodic. A map of one heading does
        not depend on it. A pose gives the same bytes alone and among others.

        Args:
            p_xy: Points in world [m], shape (..., 2).
            yaw: Headings [rad], any real number, shape (...); the two shapes are broadcast.
            outside: Result off the grid: "nan", "clamp" (the field of the nearest point on it) or "raise".

        Returns:
            Field magnitude [nT], shape (...); nan if an input is nan or a masked node has weight.

        Raises:
            InputError: A point is off the grid and `outside` is "raise".
        """
        return self._look(p_xy, yaw, outside, gradient=False)[0]

    def gradient(self, p_xy: ArrayLike, yaw: ArrayLike, *, outside: Outside = "nan") -> Array:
        """Exact derivatives of `lookup` within a cell. Arguments and errors are those of `lookup`.

        At a border they are those of the cell at greater x, y or heading. With "clamp" the field does not
        change across the border of the grid.

        Returns:
            dB/dx, dB/dy [nT/m] and dB/dyaw [nT/rad], shape (..., 3); nan if `lookup` is, or if a masked node
            would enter.
        """
        return self._look(p_xy, yaw, outside, gradient=True)[1]

    def lookup_with_gradient(
        self, p_xy: ArrayLike, yaw: ArrayLike, *, outside: Outside = "nan"
    ) -> tuple[Array, Array]:
        """Results of `lookup` and `gradient`, shapes (...) and (..., 3), in one pass."""
        return self._look(p_xy, yaw, outside, gradient=True)[:2]

    def lookup_with_sd(
        self, p_xy: ArrayLike, yaw: ArrayLike, *, outside: Outside = "nan", reading: bool = False
    ) -> tuple[Array, Array]:
        """Field at poses, as by `lookup`, and its standard deviation.

        That is the root of the interpolated variance of the nodes and, if `between_nt2` is known, of the
        error of linear interpolation between nodes and between headings. It is 0 at nodes, where only their
        own variance is left. The reference is the field that the survey's robot reads at rest; with
        `reading`, a reading like those of the survey, so that `noise_nt2` is added.

        Returns:
            Field magnitude and its standard deviation [nT], each of shape (...).

        Raises:
            InputError: The map has no variance; or an error of `lookup`.
        """
        value, _, sd = self._look(p_xy, yaw, outside, gradient=False, sd=True)
        return value, np.sqrt(sd**2 + self.noise_nt2) if reading else sd

    def lookup_all(
        self, p_xy: ArrayLike, yaw: ArrayLike, *, outside: Outside = "nan"
    ) -> tuple[Array, Array, Array]:
        """Results of `lookup_with_sd` and of `gradient` in one pass. Arguments and errors are theirs.

        Returns:
            Field magnitude [nT], its standard deviation [nT], shapes (...), and dB/dx, dB/dy [nT/m] and
            dB/dyaw [nT/rad], shape (..., 3).
        """
        value, slopes, sd = self._look(p_xy, yaw, outside, gradient=True, sd=True)
        return value, sd, slopes

    def exact(self, p_xy: ArrayLike, yaw: ArrayLike) -> Array:
        """Field at poses by the fitted field itself, smooth across nodes and headings [nT], shape (...).

        It is known where `lookup` is. The nodes are a table of it, for speed: between them `lookup` differs
        by at most the map's parameter `TABLED` at 2,000 poses that were tried.

        Raises:
            InputError: The map does not hold the field of its nodes (`holds_model`).
        """
        if self.harmonic is None or not self.holds_model:
            text = "does not hold the field that its values are of; fit it with `method='harmonic'`"
            raise InputError(f"map {self.name!r} {text}, or use lookup")
        tabled = self.lookup(p_xy, yaw)
        return np.where(np.isnan(tabled), np.nan, self.harmonic.magnitude_nt(p_xy, yaw, compiled=True))

    @cached_property
    def holds_model(self) -> bool:
        """Whether the values of the nodes are those of `harmonic`, in single precision."""
        nodes = np.argwhere(self.valid)[:: max(1, self.known.nodes // 100)]
        if self.harmonic is None or not len(nodes):
            return False
        p, yaw = self.grid.poses()
        h, j, i = nodes.T
        off = self.harmonic.magnitude_nt(p[0][j, i], yaw[h, 0, 0]) - self.values_nt[h, j, i]
        return bool(np.abs(off).max() < SINGLE_NT)

    def mean(self, p_xy: ArrayLike, yaw: ArrayLike) -> Array:
        """Same as `lookup`; with `gradient` and `variance` the map is a belief of the field."""
        return self.lookup(p_xy, yaw)

    def variance(self, p_xy: ArrayLike, yaw: ArrayLike) -> Array:
        """Square of the standard deviation of `lookup_with_sd` [nT^2]; 0 for a map without variance."""
        if not self.has_variance:
            return self.lookup(p_xy, yaw) * 0.0
        return self.lookup_with_sd(p_xy, yaw)[1] ** 2

    def tables(self) -> tuple[Array, Array]:
        """Values and variances as flat read-only arrays, for compiled code; see `trilinear`.

        Returns:
            The table of the map, and the planes of its variance, of length 0 if it has none.
        """
        return self._lookup.table, np.empty(0) if self.variance_nt2 is None else self._spreads

    def at(self, x: float, y: float, yaw: float, *, outside: Outside = "nan") -> float:
        """Field at one pose (x, y [m], yaw [rad]) [nT], as `lookup`, without the overhead of arrays."""
        if outside != "nan":
            self._check_outside(np.array([[x, y]]), outside)
        return self._lookup.at(x, y, yaw, clamp=outside == "clamp")

    def at_with_gradient(
        self, x: float, y: float, yaw: float, *, outside: Outside = "nan"
    ) -> tuple[float, float, float, float]:
        """Field at one pose [nT], dB/dx, dB/dy [nT/m] and dB/dyaw [nT/rad]; otherwise as `at`."""
        if outside != "nan":
            self._check_outside(np.array([[x, y]]), outside)
        return self._lookup.at_with_gradient(x, y, yaw, clamp=outside == "clamp")

    def plot(self, quantity: str = "overview", headings: Sequence[float] | None = None) -> "Picture":
        """Draw the map as filled contours; see `magtwin.plot`.

        Args:
            quantity: "overview", "field", "gradient", "variance", "mask" or "headings".
            headings: Headings to show [rad]. None: the map's own, at most four if there are more than eight.

        Returns:
            A matplotlib figure.

        Raises:
            InputError: No heading is to be shown, or the map does not have the quantity.
        """
        return importlib.import_module("magtwin").plot(self, quantity=quantity, headings=headings)  # loads io

    def save(self, path: str | os.PathLike[str], **options: Any) -> Any:
        """Write the map as a USD layer; see `magtwin.save_map`."""
        return importlib.import_module("magtwin").save_map(self, path, **options)  # loads usd

    def report(self) -> Report:
        """Statistics over the valid nodes.

        The gradient is that of the magnitude along the floor, by central differences, one-sided at the
        border. The heading amplitude is that of a + c cos(heading) + s sin(heading), a least-squares fit to
        the layers' means over the nodes valid in all of them; it needs three layers.
        """
        values = np.where(self.valid, self.values_nt, np.nan)
        along_y, along_x = np.gradient(values, self.cell_m[1], self.cell_m[0], axis=(1, 2))
        slope = np.hypot(along_x, along_y)
        slope = slope[np.isfinite(slope)] / 1000
        known = values[self.valid]
        figures = [
            Figure("headings", len(self.headings_rad)),
            Figure("nodes", int(self.values_nt[0].size), note="a heading"),
            Figure("masked nodes", int(np.count_nonzero(~self.valid)), note="over all headings"),
        ]
        if known.size:
            figures += [
                Figure("mean", round(float(known.mean()), 1), "nT", spread=round(float(known.std()), 1)),
                Figure("least", round(float(known.min()), 1), "nT"),
                Figure("greatest", round(float(known.max()), 1), "nT"),
            ]
        if slope.size:
            sizes = {"median": np.median(slope), "mean": slope.mean(), "greatest": slope.max()}
            figures += [Figure(f"{k} gradient", round(float(v), 3), "uT/m") for k, v in sizes.items()]
        everywhere = self.valid.all(axis=0)
        if len(self.headings_rad) >= 3 and everywhere.any():
            figures.append(amplitude(self.values_nt[:, everywhere].mean(axis=1), self.headings_rad))
        return Report(f"map {self.name}", tuple(figures), {"method": self.method, "licence": self.licence})

    @property
    def offset_sd_nt(self) -> float:
        """Standard deviation of an error that is alike all over the map [nT]; part of every variance."""
        return self._parameter(OFFSET)

    @property
    def noise_nt2(self) -> float:
        """Variance of a reading of the survey about the map [nT^2], as its fit estimates it; 0 if unknown."""
        return self._parameter(NOISE) ** 2

    def _parameter(self, name: str) -> float:
        known = self.parameters.get(name)
        return float(known) if isinstance(known, int | float) and 0 < known < np.inf else 0.0

    def relative(self) -> "AnomalyMap":
        """The map up to a constant: its variance without that of the offset, for users that estimate one."""
        if not self.offset_sd_nt or self.variance_nt2 is None:
            return self
        return replace(
            self,
            variance_nt2=np.maximum(self.variance_nt2 - np.square(self.offset_sd_nt), 0.0),
            parameters={name: value for name, value in self.parameters.items() if name != OFFSET},
        )

    @property
    def has_variance(self) -> bool:
        """Whether the variance of the values is known."""
        return self.variance_nt2 is not None

    @cached_property
    def known(self) -> Known:
        """The values of the valid nodes in short."""
        values = self.values_nt[self.valid]
        if not values.size:
            return Known(0, np.nan, np.nan, np.nan)
        return Known(values.size, float(values.min()), float(values.max()), float(values.mean()))

    @cached_property
    def mean_nt(self) -> float:
        """Mean of the values, which stands for the field beside masked nodes [nT]."""
        return float(np.nanmean(self.values_nt))

    @cached_property
    def is_constant(self) -> bool:
        """Whether all valid nodes have the same value within 1 pT, or no node is valid."""
        return not self.known.nodes or self.known.greatest_nt - self.known.least_nt <= CONSTANT_NT

    @cached_property
    def turns(self) -> bool:
        """Whether the values depend on the heading by more than 1 pT at any node."""
        values = np.where(self.valid, self.values_nt, np.nan)
        return bool(np.any(np.abs(values - values[:1]) > CONSTANT_NT))

    @cached_property
    def _lookup(self) -> Lookup:
        return Lookup(self.values_nt, self.valid, self.origin_m, self.cell_m, self.headings_rad)

    @cached_property
    def _spreads(self) -> Array:
        """The variances, laid out for lookup."""
        if self.variance_nt2 is None:
            text = "has no variance; fit one with `magtwin map fit`, or use lookup instead"
            raise InputError(f"map {self.name!r} {text}")
        layers = [self.variance_nt2, *([] if self.between_nt2 is None else self.between_nt2)]
        return self._lookup.spreads(*(np.where(self.valid, layer, 0.0) for layer in layers))

    def __getstate__(self) -> dict[str, Any]:
        return {f.name: getattr(self, f.name) for f in fields(self)}

    def _look(
        self,
        p_xy: ArrayLike,
        yaw: ArrayLike,
        outside: Outside,
        *,
        gradient: bool,
        sd: bool = False,
    ) -> tuple[Array, Array, Array]:
        spreads = self._spreads if sd else NONE
        p, yaw = np.asarray(p_xy, float), np.asarray(yaw, float)
        if p.ndim == 0 or p.shape[-1] != 2:
            raise InputError(f"p_xy must have shape (..., 2), got {p.shape}")
        shape = yaw.shape
        if p.shape[:-1] != shape:
            shape = np.broadcast_shapes(p.shape[:-1], shape)
            p, yaw = np.broadcast_to(p, (*shape, 2)), np.broadcast_to(yaw, shape)
        p, yaw = p.reshape(-1, 2), yaw.reshape(-1)
        if outside != "nan":
            self._check_outside(p, outside)
        clamp = outside == "clamp"
        b, slopes, sds = self._lookup.lookup(p, yaw, clamp=clamp, gradient=gradient, spreads=spreads)
        slopes = slopes.reshape(*shape, 3) if gradient else slopes
        return b.reshape(shape), slopes, sds.reshape(shape) if sd else sds

    def _check_outside(self, p: Array, outside: Outside) -> None:
        if outside not in ("nan", "clamp", "raise"):
            raise InputError(f'outside must be "nan", "clamp" or "raise", got {outside!r}')
        if outside != "raise":
            return
        off = ~(self.contains(p) | np.isnan(p).any(axis=-1))
        if off.any():
            x0, x1, y0, y1 = self.extent
            where = ", ".join(f"{c:.3f}" for c in p[off][0])
            raise InputError(
                f"{np.count_nonzero(off)} of {len(p)} points lie off the map {self.name!r} "
                f"(x {x0:g}..{x1:g}, y {y0:g}..{y1:g} m), the first at ({where}); "
                'keep inside, or ask for outside="clamp" or "nan"'
            )

    def _error_in_short(self) -> list[str]:
        if self.variance_nt2 is None or not self.known.nodes:
            return []
        return [f"sd {np.sqrt(np.median(self.variance_nt2[self.valid])):.3g} nT (median)"]

    def _summary(self) -> Summary:
        known, (x0, x1, y0, y1) = self.known, self.extent
        title = "no valid node"
        if known.nodes:
            title = f"{span(known.least_nt, known.greatest_nt, 'nT')}, mean {known.mean_nt:,.0f} nT"
        cell = f"{self.cell_m[0]:.3g} x {self.cell_m[1]:.3g} m"
        headings, rows, columns = self.grid.shape
        masked = headings * rows * columns - known.nodes
        degrees = listed([f"{d:.4g}" for d in np.degrees(self.headings_rad)], 40)
        about = [self.created or "day unknown"]
        about.append("height unknown" if self.height_m is None else f"sensor at {self.height_m:.3g} m")
        about += self._error_in_short()
        about += [self.licence] if self.licence else []
        return Summary(
            f"AnomalyMap {self.name or 'without a name'}: {title}",
            (
                ("nodes", f"{columns} x {rows}, {cell} apart, {rectangle(x0, x1, y0, y1)}"),
                ("headings", f"{headings}: {degrees} deg" + (f"; {masked:,} nodes masked" if masked else "")),
                ("known", ", ".join(about)),
                ("method", self.method or "unknown"),
                *((("made from", str(self.made_from)),) if self.made_from else ()),
                ("source", self.source),
                ("frame", self.frame),
                ("datum", self.datum),
            ),
        )


def amplitude(means_nt: Array, headings_rad: Array) -> Figure:
    """The figure of a + c cos(heading) + s sin(heading), least squares, through the headings' means."""
    waves = np.column_stack([np.ones_like(headings_rad), np.cos(headings_rad), np.sin(headings_rad)])
    _, c, s = np.linalg.lstsq(waves, means_nt, rcond=None)[0]
    return Figure("heading amplitude", round(float(np.hypot(c, s)), 1), "nT")


def _frozen(values: ArrayLike, kind: type) -> NDArray[Any]:
    """A read-only copy."""
    array: NDArray[Any] = np.array(values, kind)
    array.flags.writeable = False
    return array


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return np.array_equal(a, b, equal_nan=a.dtype != bool)
    return bool(a is b or (not isinstance(a, np.ndarray) and not isinstance(b, np.ndarray) and a == b))


def is_variance(array: NDArray) -> NDArray[np.bool_]:
    """Where numbers can be variances: not below 0, nor nan or infinite."""
    return np.asarray((array >= 0) & (array < np.inf))
