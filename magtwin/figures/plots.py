"""Plots of maps and runs as PNG or SVG files: the same input gives the same bytes.

Figures are drawn on Agg canvases of their own, so that no window system and no state of pyplot is
involved.
"""

import io
import os
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError, find
from magtwin.field.maps.difference import LISTED, MapDifference
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.maps.statistics import COLOUR_MAP, colour_limits
from magtwin.files import output

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

Array = NDArray[np.float64]

SUFFIXES = (".png", ".svg")
DPI = 110
MOST_NODES_A_SIDE = 600
"""Nodes of a map that are drawn along a side: a panel has no more pixels."""

MOST_PANELS = 8
"""Headings that are drawn unasked; of a map with more four are, evenly spaced where its own are."""

MOST_ASKED = 36
"""Headings that are drawn at most: a picture has no room for more."""

MOST_SHAPES = 10_000
"""Cells beyond which an SVG holds them as a picture: as shapes they would fill megabytes."""

BANDS = 20
"""About how many colours a map is drawn in."""

PATH_SEGMENTS = 3000
"""Pieces that a driven path is drawn in: more cannot be told apart."""

INK, MAP_INK, LIDAR_INK, PLAN_INK = "#1f2430", "#e08214", "#d9e6f2", "#d6336c"
VALID, MASKED, MASKED_INK, HATCH = "#8fb8a8", "0.85", "0.65", "////"


def plot_map(
    field: AnomalyMap,
    out: str | os.PathLike[str],
    *,
    what: str = "field",
    headings: Sequence[float] | None = None,
    force: bool = False,
) -> None:
    """Write the picture of a map that `draw_map` makes.

    Args:
        field: As for `draw_map`, and so `what` and `headings`.
        out: PNG or SVG to write.
        what: What of the map to draw.
        headings: Headings to show [rad].
        force: Whether a file that exists is replaced.

    Raises:
        InputError: As for `draw_map`; or `out` is no picture or exists.
    """
    save(draw_map(field, what=what, headings=headings), out, force)


def draw_map(field: AnomalyMap, *, what: str = "field", headings: Sequence[float] | None = None) -> "Figure":
    """Draw a map as filled contours, a panel a heading, all on one scale of colours.

    Where a node is masked its cell is hatched. The scale leaves out the outermost 0.5 % of the nodes at
    either end, which the pointed ends of its bar tell; that of the field is the scale of the layer's
    coloured floor. Of a map finer than 600 nodes a side every second node is drawn, or third, ...

    Args:
        field: The map.
        what: "field"; "gradient", the slope of the magnitude along the floor by central differences;
            "variance", its root, the standard deviation; "mask", which nodes hold field; "headings",
            each heading minus the mean over all of them.
        headings: Headings to show [rad], interpolated between layers; the map's own unless given, of more
            than eight four.

    Raises:
        InputError: No heading is to be shown, or nothing is known of what is to be.
    """
    from matplotlib.colors import ListedColormap

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
            _cells(ax, x, y, layer, (0.0, 1.0), ListedColormap([VALID]))
        legend.append(_patch("holds field", facecolor=VALID))
    else:
        scale = _Scale.of(layers, quantity)
        drawn = [scale.draw(ax, x, y, layer) for ax, layer in zip(axes, layers, strict=False)]
        bar = figure.colorbar(drawn[0], ax=axes.tolist(), ticks=scale.ticks(), shrink=0.9, pad=0.02)
        bar.set_label(quantity.label, fontsize=10)
        bar.ax.tick_params(labelsize=8)
    for ax, heading, count in zip(axes, shown, unknown, strict=False):
        masked = f", {count} masked" if what == "mask" else ""
        ax.set_title(f"heading {np.degrees(heading):.4g}°{masked}", fontsize=10)
    if np.isnan(layers).any():
        legend.append(_patch(quantity.unknown, facecolor=MASKED, hatch=HATCH, edgecolor=MASKED_INK))
    _legend(figure, legend)
    figure.suptitle(_summary(field, 112 if len(shown) > 1 else 52), fontsize=11)
    return figure


def plot_difference(found: MapDifference, out: str | os.PathLike[str], *, force: bool = False) -> None:
    """Draw what changed between two surveys, and how sure that is, the regions numbered as in its report.

    Args:
        found: The difference.
        out: PNG or SVG to write.
        force: Whether a file that exists is replaced.

    Raises:
        InputError: `out` is no picture or exists.
    """
    grid = found.grid
    count = np.isfinite(found.z).sum(axis=0)
    local = np.where(count, np.nansum(found.local_nt, axis=0) / np.maximum(count, 1), np.nan)
    most = np.nanargmax(np.where(np.isfinite(found.z), np.abs(found.z), -1.0), axis=0)
    z = np.take_along_axis(found.z, most[None], axis=0)[0]
    figure, axes = _panels(grid.extent, 2)
    several = ", mean over headings" if len(found.z) > 1 else ""
    for ax, layer, label in (
        (axes[0], local, f"local change{several} [nT]"),
        (axes[1], z, "z, of the heading where it is greatest" if several else "z"),
    ):
        reach = max(map(abs, colour_limits(layer, 0))) or 1.0  # peaks are what it is about
        bar = figure.colorbar(
            _cells(ax, grid.x_m, grid.y_m, layer, (-reach, reach), "RdBu_r"), ax=ax, shrink=0.9, pad=0.02
        )
        bar.set_label(label, fontsize=9)
        bar.ax.tick_params(labelsize=8)
        _draw_regions(ax, found)
    names = [" ".join(t for t in pair if t) for pair in zip(found.names, found.days, strict=True)]
    changed = int(found.changed.any(axis=0).sum())
    words = [
        f"common bias {found.bias_nt.mean():+.3g} nT",
        f"{changed} of {np.count_nonzero(count)} nodes changed, in {_count(len(found.regions), 'region')}",
        f"|z| from {found.threshold_z:.2f}",
    ]
    if not found.from_variance:
        words.append("no variance is known: z by the robust spread")
    figure.suptitle(
        "\n".join([f"{names[0]} to {names[1]}", *textwrap.wrap(", ".join(words), 112)]), fontsize=11
    )
    legend = [_patch("changed region", facecolor="none", edgecolor=INK)] if found.regions else []
    if not count.all():
        legend.append(
            _patch("not known to both surveys", facecolor=MASKED, hatch=HATCH, edgecolor=MASKED_INK)
        )
    _legend(figure, legend)
    save(figure, out, force)


def draw_path(
    ax: "Axes", p_xy: Array, total: Array, field: AnomalyMap | None, planned: ArrayLike | None
) -> None:
    """The path over the map, coloured by the field along it."""
    from matplotlib.collections import LineCollection
    from matplotlib.colors import LinearSegmentedColormap

    if field is not None:
        known = np.where(field.valid.all(axis=0), field.values_nt.mean(axis=0), np.nan) / 1000
        paper = LinearSegmentedColormap.from_list("paper", ["white", "0.4"])  # below any colour of the path
        mesh = _cells(ax, field.x_m, field.y_m, known, colour_limits(known), paper)
        _flat_bar(ax, mesh, "map, mean over headings [µT]")
    keep = np.unique(np.linspace(0, len(p_xy) - 1, PATH_SEGMENTS + 1).astype(int))
    points, colour = p_xy[keep], total[keep]
    for colour_of_edge, width in ((INK, 5.4), ("white", 4.5)):  # one of the two differs from the map
        ax.plot(*points.T, color=colour_of_edge, lw=width, solid_capstyle="round")
    low, high = colour_limits(total, 0)
    driven = LineCollection(
        list(np.stack([points[:-1], points[1:]], axis=1)),
        array=np.ma.masked_invalid((colour[:-1] + colour[1:]) / 2),
        cmap="viridis",
        clim=(low, high),
        lw=3,
        capstyle="round",
        zorder=3,
    )
    ax.add_collection(driven)
    if planned is not None:
        way = np.asarray(planned, float)
        ax.plot(way[:, 0], way[:, 1], color=PLAN_INK, lw=0.8, ls=(0, (4, 3)), zorder=4, label="planned")
    ax.plot(*p_xy[0], marker="o", ms=7, mfc="white", mec=INK, ls="", zorder=5, label="start")
    _flat_bar(ax, driven, "total field along the path [µT]")
    ax.set_aspect("equal")
    ax.set_xlabel("x [m]", fontsize=9)
    ax.set_ylabel("y [m]", fontsize=9)
    ax.tick_params(labelsize=8)
    ax.legend(loc="upper right", fontsize=8, framealpha=0.85)


def _flat_bar(ax: "Axes", mappable: "ScalarMappable", label: str) -> None:
    bar = ax.figure.colorbar(mappable, ax=ax, orientation="horizontal", pad=0.02, aspect=40, shrink=0.9)
    bar.set_label(label, fontsize=9)
    bar.ax.tick_params(labelsize=8)


def _cells(
    ax: "Axes",
    x_m: Array,
    y_m: Array,
    layer: Array,
    limits: tuple[float, float],
    colours: "str | Colormap",
) -> "ScalarMappable":
    """One layer, a cell a node, on hatched grey that shows where nothing is known."""
    _unknown_ground(ax)
    low, high = limits
    known = np.ma.masked_invalid(layer)
    return ax.pcolormesh(
        x_m,
        y_m,
        known,
        shading="nearest",
        cmap=colours,
        vmin=low,
        vmax=high,
        rasterized=known.size > MOST_SHAPES,
    )


def _unknown_ground(ax: "Axes") -> None:
    """Hatched grey, which shows where nothing is drawn over it."""
    ax.set_facecolor(MASKED)
    ax.patch.set(hatch=HATCH, edgecolor=MASKED_INK)
    ax.set_aspect("equal")
    ax.tick_params(labelsize=8)


def _patch(label: str, **look: Any) -> "Patch":
    """A legend's entry for an area."""
    from matplotlib.patches import Patch

    return Patch(label=label, **look)


def _panels(extent: tuple[float, float, float, float], count: int) -> "tuple[Figure, NDArray[Any]]":
    """A figure with so many panels of one floor, two a row, and its axes."""
    columns = min(count, 2)
    rows = -(-count // columns)
    x0, x1, y0, y1 = extent
    tall = float(np.clip((y1 - y0) / (x1 - x0), 0.3, 2))
    figure = new_figure(4.9 * columns + 1.3, (4.4 * tall + 0.55) * rows + 1.3)
    figure.set_layout_engine("constrained", h_pad=0.08)  # so that no title touches the one above
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for k, ax in enumerate(axes[:count]):
        if k + columns >= count:
            ax.set_xlabel("x [m]", fontsize=9)
            ax.tick_params(labelbottom=True)  # above an empty panel too
        if k % columns == 0:
            ax.set_ylabel("y [m]", fontsize=9)
    for ax in axes[count:]:
        ax.set_axis_off()
    return figure, axes


def _legend(figure: "Figure", handles: "list[Patch]") -> None:
    if handles:
        figure.legend(handles=handles, loc="outside lower right", fontsize=9, frameon=False, ncols=2)


def _field_ut(field: AnomalyMap) -> Array:
    return np.where(field.valid, field.values_nt, np.nan) / 1000


def _gradient_ut_m(field: AnomalyMap) -> Array:
    along = np.gradient(_field_ut(field), *field.cell_m[::-1], axis=(1, 2))
    return np.asarray(np.hypot(*along))


def _deviation_nt(field: AnomalyMap) -> Array:
    if field.variance_nt2 is None:
        raise InputError(
            f"nothing is known of the variance of map {field.name!r}; fit it from its readings to know it"
        )
    return np.sqrt(np.where(field.valid, field.variance_nt2, np.nan))


def _mask(field: AnomalyMap) -> Array:
    return np.where(field.valid, 1.0, np.nan)


def _heading_difference_nt(field: AnomalyMap) -> Array:
    if len(field.headings_rad) < 2:
        raise InputError(f"map {field.name!r} has one heading only, so none to compare it with")
    known = np.where(field.valid.all(axis=0), field.values_nt, np.nan)
    return known - known.mean(axis=0)


@dataclass(frozen=True)
class _Quantity:
    """Something of a map that can be drawn."""

    layers: Callable[[AnomalyMap], Array]
    """It at the nodes, nan where unknown, shape (H, Y, X)."""

    label: str
    """What it is, with its unit."""

    colours: str = COLOUR_MAP
    """Name of its scale of colours."""

    about_zero: bool = False
    """Whether the scale reaches as far below zero as above."""

    unknown: str = "masked: no field is known there"
    """What hatched nodes are."""


QUANTITIES = {
    "field": _Quantity(_field_ut, "total field [µT]"),
    "gradient": _Quantity(
        _gradient_ut_m, "gradient along the floor [µT/m]", "magma", unknown="masked, or beside a masked node"
    ),
    "variance": _Quantity(_deviation_nt, "standard deviation [nT]", "cividis"),
    "mask": _Quantity(_mask, "holds field"),
    "headings": _Quantity(
        _heading_difference_nt,
        "difference from the mean over headings [nT]",
        "RdBu_r",
        about_zero=True,
        unknown="masked in some heading",
    ),
}
"""What of a map can be drawn, by name."""


@dataclass(frozen=True)
class _Scale:
    """Bands of values, each a colour."""

    levels: Array
    below: bool
    """Whether some values lie below the lowest level; then they have its colour and the bar a point."""

    above: bool
    colours: "Colormap"
    limits: tuple[float, float]

    @classmethod
    def of(cls, layers: Array, quantity: _Quantity) -> "_Scale":
        """Bands over what is known of all panels."""
        from matplotlib import colormaps
        from matplotlib.ticker import MaxNLocator

        low, high = colour_limits(layers)
        if quantity.about_zero:
            low, high = -max(-low, high), max(-low, high)
        if not high - low > 1e-6 * abs(high):  # one value everywhere
            low, high = (low - 0.1 * abs(low), high + 0.1 * abs(high)) if high else (-1.0, 1.0)
        levels = np.asarray(MaxNLocator(BANDS, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high))
        known = layers[np.isfinite(layers)]
        least, greatest = (known.min(), known.max()) if known.size else (low, high)
        return cls(
            levels,
            bool(least < levels[0]),
            bool(greatest > levels[-1]),
            colormaps[quantity.colours],
            (low, high),
        )

    def ticks(self) -> Array:
        """Levels that the bar is labelled at."""
        return self.levels[:: max(1, len(self.levels) // 10)]

    def draw(self, ax: "Axes", x: Array, y: Array, layer: Array) -> "ScalarMappable":
        """Filled contours of one layer; a known node beside an unknown one fills its cell."""
        from matplotlib.collections import PolyCollection
        from matplotlib.colors import BoundaryNorm, ListedColormap

        _unknown_ground(ax)
        known = np.isfinite(layer)
        extend = ("both" if self.above else "min") if self.below else ("max" if self.above else "neither")
        middle = np.convolve(self.levels, (0.5, 0.5), "valid")
        low, high = self.limits
        bands = self.colours(np.clip((middle - low) / (high - low), 0, 1))
        colours = ListedColormap(bands).with_extremes(under=bands[0], over=bands[-1])
        norm = BoundaryNorm(self.levels, len(bands))
        j, i = np.nonzero(known & _grown(~known))
        across, up = _edges(x), _edges(y)
        left, right, below, above = across[i], across[i + 1], up[j], up[j + 1]
        corners = np.stack([left, below, right, below, right, above, left, above], axis=-1).reshape(-1, 4, 2)
        cells = PolyCollection(
            list(corners), array=layer[j, i], cmap=colours, norm=norm, ec="face", lw=0.3, zorder=0.5
        )
        ax.add_collection(cells)
        drawn = ax.contourf(
            x, y, np.ma.masked_invalid(layer), self.levels, cmap=colours, norm=norm, extend=extend, zorder=0.6
        )
        ax.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
        return drawn


def _edges(nodes: Array) -> Array:
    """Borders of the cells about ascending nodes, shape (N,) -> (N + 1,)."""
    middle = (nodes[:-1] + nodes[1:]) / 2
    return np.concatenate([[2 * nodes[0] - middle[0]], middle, [2 * nodes[-1] - middle[-1]]])


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _grown(flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Flags, and their neighbours at sides and corners."""
    wide = np.pad(flags, 1)
    rows, columns = flags.shape
    around = [wide[j : j + rows, i : i + columns] for j in range(3) for i in range(3)]
    return np.logical_or.reduce(around)


def _between_headings(field: AnomalyMap, layers: Array, headings: Array) -> Array:
    """Layers of other headings, as a map is looked up."""
    known = np.isfinite(layers)
    values = replace(
        field, values_nt=layers, valid=known, variance_nt2=None, harmonic=None, recorded_yaw=None
    )
    x, y = np.meshgrid(field.x_m, field.y_m)
    return values.lookup(np.stack([x, y], axis=-1)[None], headings[:, None, None])


def _draw_regions(ax: "Axes", found: MapDifference) -> None:
    """A box about each region that the report tells of, with its number."""
    from matplotlib.patches import Rectangle

    dx, dy = found.grid.cell_m
    for number, region in enumerate(found.regions[:LISTED], 1):
        x0, x1, y0, y1 = region.extent_m
        box = Rectangle((x0 - dx / 2, y0 - dy / 2), x1 - x0 + dx, y1 - y0 + dy, fill=False, ec=INK, lw=1.2)
        ax.add_patch(box)
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
    masked = int(figures["masked nodes"].value)
    if masked:
        words.append(f"{masked} nodes masked")
    return "\n".join([field.name or "map", *textwrap.wrap(", ".join(words), width)])


def shade(ax: "Axes", t: Array, on: NDArray[np.bool_]) -> None:
    """Mark the spans of time in which a flag is set."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]]).astype(int)))
    for first, last in edges.reshape(-1, 2):
        ax.axvspan(t[first], t[min(last, len(t) - 1)], color=LIDAR_INK, lw=0, zorder=-1)


def new_figure(width_in: float, height_in: float) -> "Figure":
    """An empty figure on a canvas of its own."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), dpi=DPI, layout="constrained", facecolor="white")


def save(figure: "Figure", out: str | os.PathLike[str], force: bool) -> None:
    """Write a figure as its name ends."""
    suffix = Path(out).suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"{out}: a picture ends in {' or '.join(SUFFIXES)}")
    picture = drawn(figure, suffix)
    with output(out, force=force) as path:
        path.write_bytes(picture)


def drawn(figure: "Figure", suffix: str) -> bytes:
    """A figure as the bytes of a .png or .svg file."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.text import Text

    picture = io.BytesIO()
    for text in figure.findobj(Text):
        text.set_parse_math(False)  # type: ignore[attr-defined]  # a name may hold dollars; none is a formula
    if suffix == ".png":
        FigureCanvasAgg(figure).print_png(picture, metadata={"Software": None})  # no version, no date
    else:  # names of its parts; text as text
        with rc_context({"svg.hashsalt": "magtwin", "svg.fonttype": "none"}):
            FigureCanvasSVG(figure).print_svg(picture, metadata={"Date": None, "Creator": None})
    return picture.getvalue()
