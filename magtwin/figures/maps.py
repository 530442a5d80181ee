"""Maps: plots of an anomaly map, and of the difference between two surveys."""

import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, Colormap, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from magtwin.errors import InputError, find
from magtwin.field.maps.difference import LISTED, MapDifference
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.maps.statistics import COLOUR_MAP, colour_limits
from magtwin.figures.canvas import INK, Array, colour_bar, label, new_figure

MOST_NODES_A_SIDE = 600
"""Nodes drawn along a side of a map. A panel has no more pixels."""

MOST_PANELS = 8
"""Headings drawn by default. Of a map with more headings, about four are drawn, evenly spaced."""

MOST_ASKED = 36
"""Most headings that can be asked for."""

MOST_SHAPES = 10_000
"""Cells above which an SVG holds them as a bitmap, as shapes would take megabytes."""

BANDS = 20
"""Approximate number of colours of a map."""

VALID, MASKED, MASKED_INK, HATCH = "#8fb8a8", "0.85", "0.65", "////"


def draw_map(field: AnomalyMap, *, what: str = "field", headings: Sequence[float] | None = None) -> Figure:
    """Draw a map as filled contours, one panel per heading, all on one colour scale.

    The cells of masked nodes are hatched. The scale leaves out the outermost 0.5 % of the nodes at each end,
    shown by the pointed ends of its bar; the scale of the field is that of the layer's coloured floor. A map
    with more than 600 nodes along a side is drawn at every second node, or third, and so on.

    Args:
        field: The map.
        what: "field"; "gradient", the slope of the magnitude along the floor by central differences;
            "variance", drawn as its root, the standard deviation; "mask", which nodes hold field; or
            "headings", each heading minus the mean over all of them.
        headings: Headings to show [rad], interpolated between layers. Default: the map's own, or about four
            of more than eight.

    Returns:
        A matplotlib figure.

    Raises:
        InputError: There is no heading to show, or the map does not know the quantity.
    """
    quantity = find("quantity", what, QUANTITIES)
    if headings is not None and len(headings) == 0:
        raise InputError("headings must name one heading at least, got none")
    if headings is not None and len(headings) > MOST_ASKED:
        raise InputError(f"headings to show are {MOST_ASKED} at most, a panel each, got {len(headings)}")
    if what != "mask" and not field.valid.any():
        raise InputError(f"map {field.name!r} has no valid node to draw")
    layers = quantity.layers(field)
    if headings is None:
        every = -(-len(layers) // 4) if len(layers) > MOST_PANELS else 1
        shown, layers = field.headings_rad[::every], layers[::every]
    else:
        shown = np.asarray(headings, float)
        layers = _between_headings(field, layers, shown)
    if what != "mask" and not np.isfinite(layers).any():
        raise InputError(f"map {field.name!r} has no node whose {what} is known")
    unknown = np.isnan(layers).sum(axis=(1, 2))
    every = -(-max(layers.shape[1:]) // MOST_NODES_A_SIDE)
    j, i = (np.unique(np.append(np.arange(0, n, every), n - 1)) for n in layers.shape[1:])
    x, y, layers = field.x_m[i], field.y_m[j], layers[:, j][:, :, i]
    figure, axes = _panels(field.extent, len(shown))
    legend = []
    if what == "mask":
        for ax, layer in zip(axes, layers, strict=False):
            draw_cells(ax, x, y, layer, ListedColormap([VALID]))
        legend.append(Patch(label="holds field", facecolor=VALID))
    else:
        scale = _Scale.of(layers, quantity)
        drawn = [scale.draw(ax, x, y, layer) for ax, layer in zip(axes, layers, strict=False)]
        ticks = scale.levels[:: max(1, len(scale.levels) // 10)]
        colour_bar(figure, drawn[0], axes.tolist(), quantity.label, ticks=ticks)
    for ax, heading, count in zip(axes, shown, unknown, strict=False):
        masked = f", {count} masked" if what == "mask" else ""
        ax.set_title(f"heading {np.degrees(heading):.4g}°{masked}", fontsize=10)
    if np.isnan(layers).any():
        legend.append(_hatched(quantity.unknown))
    _legend(figure, legend)
    figure.suptitle(_summary(field, 112 if len(shown) > 1 else 52), fontsize=11)
    return figure


def draw_difference(difference: MapDifference) -> Figure:
    """Draw what changed between two surveys and how certain it is; regions have the numbers of the report."""
    grid, count = difference.grid, np.isfinite(difference.z).sum(axis=0)
    local = np.where(count, np.nansum(difference.local_nt, axis=0) / np.maximum(count, 1), np.nan)
    most = np.nanargmax(np.where(np.isfinite(difference.z), np.abs(difference.z), -1.0), axis=0)
    z = np.take_along_axis(difference.z, most[None], axis=0)[0]
    figure, axes = _panels(grid.extent, 2)
    several = ", mean over headings" if len(difference.z) > 1 else ""
    for ax, layer, title in (
        (axes[0], local, f"local change{several} [nT]"),
        (axes[1], z, "z, of the heading where it is greatest" if several else "z"),
    ):
        reach = max(map(abs, colour_limits(layer, 0))) or 1.0  # all values: the peaks matter here
        cells = draw_cells(ax, grid.x_m, grid.y_m, layer, "RdBu_r", vmin=-reach, vmax=reach)
        colour_bar(figure, cells, ax, title)
        _draw_regions(ax, difference)
    names = [" ".join(t for t in pair if t) for pair in zip(difference.names, difference.days, strict=True)]
    changed, regions = int(difference.changed.any(axis=0).sum()), len(difference.regions)
    words = [
        f"common bias {difference.bias_nt.mean():+.3g} nT",
        f"{changed} of {np.count_nonzero(count)} nodes changed, in {regions} region{'s' * (regions != 1)}",
        f"|z| from {difference.threshold_z:.2f}",
    ]
    if not difference.from_variance:
        words.append("no variance is known: z by the robust spread")
    lines = [f"{names[0]} to {names[1]}", *textwrap.wrap(", ".join(words), 112)]
    figure.suptitle("\n".join(lines), fontsize=11)
    legend = [Patch(label="changed region", facecolor="none", edgecolor=INK)] if regions else []
    _legend(figure, legend + ([] if count.all() else [_hatched("not known to both surveys")]))
    return figure


def draw_cells(
    ax: Axes, x_m: Array, y_m: Array, layer: Array, colours: str | Colormap, **look: Any
) -> ScalarMappable:
    """Draw one layer of a map, one cell per node, over hatched grey that shows where it is unknown.

    Args:
        ax: Where to draw.
        x_m: Nodes along x [m], shape (X,).
        y_m: Nodes along y [m], shape (Y,).
        layer: Values, nan where unknown, shape (Y, X).
        colours: The colour scale, or its name.
        look: Further options of `pcolormesh`, such as `vmin` and `vmax`.
    """
    ax.set_facecolor(MASKED)
    ax.patch.set(hatch=HATCH, edgecolor=MASKED_INK)
    ax.set_aspect("equal")
    ax.tick_params(labelsize=8)
    look = {"rasterized": layer.size > MOST_SHAPES, **look}
    return ax.pcolormesh(x_m, y_m, np.ma.masked_invalid(layer), shading="nearest", cmap=colours, **look)


def mean_field_ut(field: AnomalyMap) -> Array:
    """Mean of a map over its headings [µT], nan where a heading is masked, shape (Y, X)."""
    return np.where(field.valid.all(axis=0), field.values_nt.mean(axis=0), np.nan) / 1000


def _hatched(name: str) -> Patch:
    return Patch(label=name, facecolor=MASKED, hatch=HATCH, edgecolor=MASKED_INK)


def _panels(extent: tuple[float, float, float, float], count: int) -> tuple[Figure, NDArray[Any]]:
    """A figure with `count` panels of one floor, two per row, and its axes."""
    columns = min(count, 2)
    rows = -(-count // columns)
    x0, x1, y0, y1 = extent
    tall = float(np.clip((y1 - y0) / (x1 - x0), 0.3, 2))
    figure = new_figure(4.9 * columns + 1.3, (4.4 * tall + 0.55) * rows + 1.3)
    figure.set_layout_engine("constrained", h_pad=0.08)  # keeps titles off the panels above
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for k, ax in enumerate(axes[:count]):
        bottom = k + columns >= count
        label(ax, "x [m]" if bottom else "", "" if k % columns else "y [m]")
        if bottom:
            ax.tick_params(labelbottom=True)  # above an empty panel too
    for ax in axes[count:]:
        ax.set_axis_off()
    return figure, axes


def _legend(figure: Figure, handles: list[Patch]) -> None:
    if handles:
        figure.legend(handles=handles, loc="outside lower right", fontsize=9, frameon=False, ncols=2)


def _field_ut(field: AnomalyMap) -> Array:
    return np.where(field.valid, field.values_nt, np.nan) / 1000


def _sd_nt(field: AnomalyMap) -> Array:
    if field.variance_nt2 is None:
        raise InputError(f"map {field.name!r} has no variance; fit it from its readings to get one")
    return np.sqrt(np.where(field.valid, field.variance_nt2, np.nan))


def _heading_difference_nt(field: AnomalyMap) -> Array:
    if len(field.headings_rad) < 2:
        raise InputError(f"map {field.name!r} has one heading only, so there is none to compare it with")
    known = np.where(field.valid.all(axis=0), field.values_nt, np.nan)
    return known - known.mean(axis=0)


@dataclass(frozen=True)
class _Quantity:
    """A quantity of a map that can be drawn."""

    layers: Callable[[AnomalyMap], Array]
    """Its values at the nodes, nan where unknown, shape (H, Y, X)."""

    label: str
    """Its name and unit."""

    colours: str = COLOUR_MAP
    """Name of its colour scale."""

    about_zero: bool = False
    """Whether the scale is symmetric about zero."""

    unknown: str = "masked: no field is known there"
    """Meaning of hatched nodes."""


QUANTITIES = {
    "field": _Quantity(_field_ut, "total field [µT]"),
    "gradient": _Quantity(
        lambda field: np.hypot(*np.gradient(_field_ut(field), *field.cell_m[::-1], axis=(1, 2))),
        "gradient along the floor [µT/m]",
        "magma",
        unknown="masked, or beside a masked node",
    ),
    "variance": _Quantity(_sd_nt, "standard deviation [nT]", "cividis"),
    "mask": _Quantity(lambda field: np.where(field.valid, 1.0, np.nan), "holds field"),
    "headings": _Quantity(
        _heading_difference_nt,
        "difference from the mean over headings [nT]",
        "RdBu_r",
        about_zero=True,
        unknown="masked in some heading",
    ),
}
"""Quantities of a map that can be drawn, by name."""


@dataclass(frozen=True)
class _Scale:
    """Bands of values, one colour each."""

    levels: Array
    limits: tuple[float, float]
    colours: Colormap
    extend: str
    """Ends of the colour bar that are pointed, as values lie beyond them."""

    @classmethod
    def of(cls, layers: Array, quantity: _Quantity) -> "_Scale":
        """Bands over the known values of all panels."""
        low, high = colour_limits(layers)
        if quantity.about_zero:
            low, high = -max(-low, high), max(-low, high)
        if not high - low > 1e-6 * abs(high):  # one value everywhere
            low, high = (low - 0.1 * abs(low), high + 0.1 * abs(high)) if high else (-1.0, 1.0)
        levels = np.asarray(MaxNLocator(BANDS, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high))
        known = layers[np.isfinite(layers)]
        beyond = (bool((known < levels[0]).any()), bool((known > levels[-1]).any()))
        extend = {(True, True): "both", (True, False): "min", (False, True): "max"}.get(beyond, "neither")
        return cls(levels, (low, high), colormaps[quantity.colours], extend)

    def draw(self, ax: Axes, x: Array, y: Array, layer: Array) -> ScalarMappable:
        """Filled contours of one layer over its cells, which show beside unknown nodes."""
        middle = np.convolve(self.levels, (0.5, 0.5), "valid")
        low, high = self.limits
        bands = self.colours(np.clip((middle - low) / (high - low), 0, 1))
        colours = ListedColormap(bands).with_extremes(under=bands[0], over=bands[-1])
        norm = BoundaryNorm(self.levels, len(bands))
        draw_cells(ax, x, y, layer, colours, norm=norm, zorder=0.5, rasterized=True)
        look: dict[str, Any] = {"cmap": colours, "norm": norm, "extend": self.extend, "zorder": 0.6}
        drawn = ax.contourf(x, y, np.ma.masked_invalid(layer), self.levels, **look)
        ax.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
        return drawn


def _between_headings(field: AnomalyMap, layers: Array, headings: Array) -> Array:
    """Layers at other headings, interpolated as a map lookup does."""
    parts: dict[str, Any] = {
        "variance_nt2": None,
        "between_nt2": None,
        "harmonic": None,
        "recorded_yaw": None,
    }
    x, y = np.meshgrid(field.x_m, field.y_m)
    values = replace(field, values_nt=layers, valid=np.isfinite(layers), **parts)
    return values.lookup(np.stack([x, y], axis=-1)[None], headings[:, None, None])


def _draw_regions(ax: Axes, difference: MapDifference) -> None:
    """A numbered box around each region that the report lists."""
    dx, dy = difference.grid.cell_m
    for number, region in enumerate(difference.regions[:LISTED], 1):
        x0, x1, y0, y1 = region.extent_m
        corner = (x0 - dx / 2, y0 - dy / 2)
        ax.add_patch(Rectangle(corner, x1 - x0 + dx, y1 - y0 + dy, fill=False, ec=INK, lw=1.2))
        ax.annotate(
            str(number),
            (x0 - dx / 2, y1 + dy / 2),
            xytext=(2, -2),
            textcoords="offset points",
            va="top",
            fontsize=8,
            color=INK,
            bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.8},
        )


def _summary(field: AnomalyMap, width: int) -> str:
    """The map's name, and its figures in lines of at most `width` characters."""
    figures = {f.name: f for f in field.report().figures}
    mean = figures["mean"]
    words = [f"mean {float(mean.value) / 1000:.2f} µT", f"sd {(mean.spread or 0) / 1000:.2f} µT"]
    if "median gradient" in figures:
        words.append(f"median gradient {float(figures['median gradient'].value):.1f} µT/m")
    if "heading amplitude" in figures:
        words.append(f"heading amplitude {float(figures['heading amplitude'].value):.0f} nT")
    if field.height_m is not None:
        words.append(f"sensor at {field.height_m:.4g} m")
    if field.created:
        words.append(field.created)
    if masked := int(figures["masked nodes"].value):
        words.append(f"{masked} nodes masked")
    return "\n".join([field.name or "map", *textwrap.wrap(", ".join(words), width)])
