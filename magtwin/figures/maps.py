"""Maps: plots of anomaly maps, of the difference between two surveys, and of what stands on the floor."""

import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, Colormap, LinearSegmentedColormap, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Polygon, Rectangle
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from magtwin.errors import InputError, find
from magtwin.field.maps.difference import LISTED, MapDifference
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.maps.statistics import apart, colour_limits
from magtwin.figures import style
from magtwin.figures.canvas import WIDTH_IN, Array, Chart, colour_bar, label, new_figure
from magtwin.frames import rotate
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.scene import Scene

MOST_NODES_A_SIDE = 600
"""Nodes drawn along a side of a map. A panel has no more pixels."""

MOST_PANELS = 8
"""Headings drawn by default. Of a map with more headings, about four are drawn, evenly spaced."""

MOST_ASKED = 36
"""Most headings that can be asked for."""

MOST_MAPS = 4
"""Most maps side by side."""

BANDS = 20
"""Approximate number of colours of a map."""

OVERVIEW = {
    "mean": "mean over headings",
    "heading effect": "heading effect: greatest less least",
    "sd": "standard deviation, RMS over headings",
    "gradient": "gradient of the mean along the floor",
}
"""What a map is drawn by, if nothing else is asked for."""

HATCH = "////"

EXTEND = {(False, False): "neither", (True, True): "both", (True, False): "min", (False, True): "max"}
"""Ends of a colour bar that are pointed, by whether values lie below and above its scale."""


@style.styled
def draw_map(
    field: AnomalyMap | Sequence[AnomalyMap],
    *,
    what: str = "overview",
    headings: Sequence[float] | None = None,
    plan: "FloorPlan | None" = None,
) -> Figure:
    """Draw a map as filled contours, or several maps side by side; each quantity has one colour scale.

    The cells of masked nodes are hatched. A scale leaves out the outermost 0.5 % of the nodes at each end,
    shown by the pointed ends of its bar; the scale of the field is that of the layer's coloured floor. A map
    with more than 600 nodes along a side is drawn at every second node, or third, and so on.

    Args:
        field: The map, or up to `MOST_MAPS`; of several, each is drawn by its mean over headings.
        what: "overview": the mean over headings, the difference that the heading makes, the standard
            deviation and the gradient, as far as they are known. Or one quantity with a panel per heading:
            "field"; "gradient", the slope of the magnitude along the floor by central differences;
            "variance", drawn as its root, the standard deviation; "mask", which nodes hold field; or
            "headings", each heading minus the mean over all of them.
        headings: Headings to show [rad], interpolated between layers. Default: the map's own, or about four
            of more than eight. Ignored by the overview.
        plan: Walls, furniture and doors, drawn over each panel.

    Raises:
        InputError: There is no map or no heading to show, or the map does not know the quantity.
    """
    fields = [field] if isinstance(field, AnomalyMap) else list(field)
    if not 1 <= len(fields) <= MOST_MAPS:
        raise InputError(f"one to {MOST_MAPS} maps are drawn side by side, got {len(fields)}")
    names = {"overview", *QUANTITIES} - {"mean", "heading effect", "sd"}
    find("quantity", what, dict.fromkeys(sorted(names)))
    if headings is not None and len(headings) == 0:
        raise InputError("headings must name one heading at least, got none")
    if headings is not None and len(headings) > MOST_ASKED:
        raise InputError(f"headings to show are {MOST_ASKED} at most, a panel each, got {len(headings)}")
    for one in fields:
        if what != "mask" and not one.valid.any():
            raise InputError(f"map {one.name!r} has no valid node to draw")
    several = len(fields) > 1
    panels: list[_Panel | None]
    if what == "overview":
        panels, columns = _overviews(fields), len(fields) if several else 2
    else:
        panels = [panel for one in fields for panel in _by_heading(what, one, headings, several=several)]
        columns = min(len(panels), 2)
    figure, axes = _panels(fields[0].extent, len(panels), columns)
    legend: dict[str, Patch] = {}
    for quantity, mine in _by_quantity(panels).items():
        scale = _Scale.of(mine.values(), QUANTITIES[quantity])
        for k, panel in mine.items():
            drawn, keys = panel.draw(axes[k], scale, plan)
            axes[k].set_title(panel.title)
            legend |= keys
        if quantity != "mask":
            beside = [axes[k] for k in mine]
            colour_bar(figure, drawn, beside, QUANTITIES[quantity].label, ticks=scale.ticks())
    for ax, shown in zip(axes, panels, strict=False):
        ax.set_visible(shown is not None)
    if legend:
        figure.legend(legend.values(), legend.keys(), loc="outside lower right", ncols=3)
    if not several:
        figure.suptitle(_summary(fields[0], 125 if len(panels) > 1 else 46), x=0.01, ha="left")
    return figure


def map_charts(fields: Sequence[AnomalyMap], plan: "FloorPlan | None" = None) -> list[Chart]:
    """The overview of maps as charts of a page; each quantity has one scale for all of them."""
    charts = []
    for quantity, mine in _by_quantity(_overviews(fields)).items():
        scale = _Scale.of(mine.values(), QUANTITIES[quantity])
        for panel in mine.values():
            x0, x1, y0, y1 = panel.field.extent if plan is None else plan.extent(panel.field.extent)
            tall = float(np.clip((WIDTH_IN - 0.8) * (y1 - y0) / (x1 - x0), 1.4, 6.0))
            draw = partial(_draw_alone, panel=panel, scale=scale, plan=plan)
            file = f"{quantity}_{panel.field.name}".replace(" ", "_")
            charts.append(Chart(panel.title, draw, tall + 1.1, file))
    return charts


def _draw_alone(ax: Axes, panel: "_Panel", scale: "_Scale", plan: "FloorPlan | None") -> None:
    """A panel with its own bar."""
    drawn, _ = panel.draw(ax, scale, plan)
    colour_bar(ax.figure, drawn, ax, QUANTITIES[panel.quantity].label, below=True, ticks=scale.ticks(5))
    label(ax, "x [m]", "y [m]")


@style.styled
def draw_difference(difference: MapDifference) -> Figure:
    """Draw what changed between two surveys and how certain it is; regions have the numbers of the report."""
    grid, count = difference.grid, np.isfinite(difference.z).sum(axis=0)
    local = np.where(count, np.nansum(difference.local_nt, axis=0) / np.maximum(count, 1), np.nan)
    most = np.nanargmax(np.where(np.isfinite(difference.z), np.abs(difference.z), -1.0), axis=0)
    z = np.take_along_axis(difference.z, most[None], axis=0)[0]
    figure, axes = _panels(grid.extent, 2, 2)
    several = ", mean over headings" if len(difference.z) > 1 else ""
    for ax, layer, title in (
        (axes[0], local, f"local change{several} [nT]"),
        (axes[1], z, "z, of the heading where it is greatest" if several else "z"),
    ):
        reach = max(map(abs, colour_limits(layer, 0))) or 1.0  # all values: the peaks matter here
        cells = draw_cells(ax, grid.x_m, grid.y_m, layer, style.SIGNED_COLOURS, vmin=-reach, vmax=reach)
        colour_bar(figure, cells, ax, title, below=True)
        dx, dy = grid.cell_m
        for number, region in enumerate(difference.regions[:LISTED], 1):
            x0, x1, y0, y1 = np.add(region.extent_m, np.array([-dx, dx, -dy, dy]) / 2)
            ax.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, ec=style.INK, lw=1.2))
            box = {"boxstyle": "round,pad=0.15", "fc": style.PAPER, "ec": "none", "alpha": 0.8}
            place: dict[str, Any] = {"textcoords": "offset points", "va": "top"}
            ax.annotate(str(number), (x0, y1), (2, -2), bbox=box, **place)
    names = [" ".join(t for t in pair if t) for pair in zip(difference.names, difference.days, strict=True)]
    changed, regions = int(difference.changed.any(axis=0).sum()), len(difference.regions)
    words = [
        f"common bias {difference.bias_nt.mean():+.3g} nT",
        f"{changed} of {np.count_nonzero(count)} nodes changed, in {regions} region{'s' * (regions != 1)}",
        f"|z| from {difference.threshold_z:.2f}",
        *([] if difference.from_variance else ["no variance is known: z by the robust spread"]),
    ]
    lines = [f"{names[0]} to {names[1]}", *textwrap.wrap(", ".join(words), 100)]
    figure.suptitle("\n".join(lines))
    legend = {"changed region": Patch(facecolor="none", edgecolor=style.INK)} if regions else {}
    legend |= {} if count.all() else {"not known to both surveys": _hatched()}
    if legend:
        figure.legend(legend.values(), legend.keys(), loc="outside lower right", ncols=2)
    return figure


def draw_cells(
    ax: Axes, x_m: Array, y_m: Array, layer: Array, colours: str | Colormap, **look: Any
) -> ScalarMappable:
    """Draw a layer (Y, X) of a map, one cell per node, over hatched grey that shows where it is nan.

    The nodes x_m (X,) and y_m (Y,) are in metres; `look` has further options of `pcolormesh`.
    """
    if np.isnan(layer).any():
        ax.set_facecolor(style.MASKED)
        ax.patch.set(hatch=HATCH, edgecolor=style.FAINT)
    ax.set_aspect("equal")
    look = {"rasterized": True, **look}
    return ax.pcolormesh(x_m, y_m, np.ma.masked_invalid(layer), shading="nearest", cmap=colours, **look)


def mean_field_nt(field: AnomalyMap) -> Array:
    """Mean of a map over its headings [nT], nan where a heading is masked, shape (Y, X)."""
    return np.where(field.valid.all(axis=0), field.values_nt.mean(axis=0), np.nan)


def draw_mean(ax: Axes, field: AnomalyMap) -> tuple[float, float]:
    """Draw a map's mean over headings pale, with its bar; returns the ends of the scale [nT]."""
    known = mean_field_nt(field)
    ends = colour_limits(known)
    low, high = apart(*ends)
    pale = 0.5 * colormaps[style.FIELD_COLOURS](np.linspace(0, 1, 64)) + 0.5
    flat = ends != (low, high)  # its value is then the middle of a colour
    colours = LinearSegmentedColormap.from_list("pale", np.minimum(pale, 1.0), 255 if flat else 256)
    mesh = draw_cells(ax, field.x_m, field.y_m, known, colours, vmin=low, vmax=high)
    one = {"ticks": [(low + high) / 2]} if flat else {}
    colour_bar(ax.figure, mesh, ax, "map, mean over headings [nT]", below=True, **one)
    return low, high


@dataclass(frozen=True)
class FloorPlan:
    """What stands on a floor, seen from above: outlines in world [m], each of shape (K, 2)."""

    solids: tuple[Array, ...]
    """What a robot runs into, walls among it."""

    pieces: tuple[Array, ...] = ()
    """Furniture, as wide as it is anywhere."""

    doors: tuple[Array, ...] = ()

    floor: Array | None = None
    """Corners of a floor that is no rectangle, shape (K, 2): a map is drawn on it alone."""

    @classmethod
    def of(cls, scene: Scene, obstacles: Obstacles) -> "FloorPlan":
        """The plan of a scene."""
        found: dict[bool, list[Array]] = {False: [], True: []}
        for piece in scene.furniture:
            corners = [
                rotate(piece.q_world_xyzw, np.array(part.p) + np.array(part.size_m) * _ENDS / 2)[:, :2]
                for part in piece.parts
            ]
            hull = Obstacles((piece.name,), (np.vstack(corners) + piece.p_world[:2],))
            found[piece.kind.startswith("door")].append(hull.outlines[0])
        floor = np.array(scene.lab.corners) if scene.lab.floor else None
        return cls(obstacles.outlines, tuple(found[False]), tuple(found[True]), floor)

    def draw(self, ax: Axes) -> None:
        """Draw the outlines over a map, which is cut to the floor, and widen the view to hold them."""
        if self.floor is not None:
            for drawn in ax.collections:
                drawn.set_clip_path(Polygon(self.floor, transform=ax.transData))
        looks: tuple[tuple[tuple[Array, ...], dict[str, Any]], ...] = (
            (self.pieces, {"fc": style.FAINT, "ec": style.SOFT, "alpha": 0.45, "lw": 0.8}),
            (self.solids, {"fc": style.SOFT, "ec": style.SOFT, "lw": 0.6}),
            (self.doors, {"fc": "none", "ec": style.BOUND, "lw": 1.6}),
        )
        for outlines, look in looks:
            for outline in outlines:
                ax.add_patch(Polygon(outline, **{"zorder": 2.5, **look}))
        x0, x1, y0, y1 = self.extent((*ax.get_xlim(), *ax.get_ylim()))
        ax.set(xlim=(x0, x1), ylim=(y0, y1))

    def extent(self, least: Sequence[float]) -> tuple[float, float, float, float]:
        """Ends along x and along y that hold the outlines and these ends [m]."""
        ends = np.reshape(least, (2, 2)).T
        outlines = [o + s for o in (*self.solids, *self.pieces, *self.doors) for s in (-0.1, 0.1)]
        (x0, y0), (x1, y1) = (f(np.vstack([ends, *outlines]), axis=0).tolist() for f in (np.min, np.max))
        return x0, x1, y0, y1

    def keys(self) -> dict[str, Patch]:
        """Entries of a legend."""
        looks = (
            ("solid near the floor", self.solids, Patch(fc=style.SOFT)),
            ("furniture", self.pieces, Patch(fc=style.FAINT, ec=style.SOFT, alpha=0.45)),
            ("door", self.doors, Patch(fc="none", ec=style.BOUND)),
        )
        return {name: patch for name, outlines, patch in looks if outlines}


_ENDS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


def _hatched() -> Patch:
    return Patch(facecolor=style.MASKED, hatch=HATCH, edgecolor=style.FAINT)


def _panels(
    extent: tuple[float, float, float, float], count: int, columns: int
) -> tuple[Figure, NDArray[Any]]:
    """A figure with `count` panels of one floor, and its axes."""
    rows = -(-count // columns)
    x0, x1, y0, y1 = extent
    tall = float(np.clip((y1 - y0) / (x1 - x0), 0.3, 2))
    figure = new_figure(5.4 * columns + 0.6, (4.4 * tall + 0.7) * rows + 1.2)
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


def _known_nt(field: AnomalyMap) -> Array:
    return np.where(field.valid, field.values_nt, np.nan)


def _slope(values: Array, field: AnomalyMap) -> Array:
    """Size of the gradient along the floor [nT/m], of the last two axes."""
    return np.hypot(*np.gradient(values, *field.cell_m[::-1], axis=(-2, -1)))


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

    colours: str = style.FIELD_COLOURS
    """Name of its colour scale."""

    about_zero: bool = False
    """Whether the scale is symmetric about zero."""

    unknown: str = "masked: no field is known there"
    """Meaning of hatched nodes."""


QUANTITIES: Mapping[str, _Quantity] = {
    "field": _Quantity(_known_nt, "total field [nT]"),
    "gradient": _Quantity(
        lambda field: _slope(_known_nt(field), field),
        "gradient [nT/m]",
        style.SLOPE_COLOURS,
        unknown="masked, or beside a masked node",
    ),
    "variance": _Quantity(_sd_nt, "standard deviation [nT]", style.SPREAD_COLOURS),
    "mask": _Quantity(lambda field: np.where(field.valid, 1.0, np.nan), "holds field"),
    "headings": _Quantity(
        _heading_difference_nt,
        "difference from the mean over headings [nT]",
        style.SIGNED_COLOURS,
        about_zero=True,
        unknown="masked in some heading",
    ),
    "mean": _Quantity(lambda field: mean_field_nt(field)[None], "[nT]"),
    "heading effect": _Quantity(
        lambda field: np.ptp(_heading_difference_nt(field), axis=0)[None],
        "[nT]",
        "plasma",
        unknown="masked in some heading",
    ),
    "sd": _Quantity(
        lambda field: np.sqrt(np.mean(_sd_nt(field) ** 2, axis=0))[None], "[nT]", style.SPREAD_COLOURS
    ),
}
"""Quantities of a map that can be drawn, by name."""


@dataclass(frozen=True)
class _Panel:
    """One layer of a map, to be drawn by the scale of its quantity."""

    title: str
    quantity: str
    field: AnomalyMap
    layer: Array

    def draw(
        self, ax: Axes, scale: "_Scale", plan: "FloorPlan | None"
    ) -> tuple[ScalarMappable, dict[str, Patch]]:
        """Draw the layer and what stands there; returns what a colour bar needs, and a legend's entries."""
        every = -(-max(self.layer.shape) // MOST_NODES_A_SIDE)
        j, i = (np.unique(np.append(np.arange(0, n, every), n - 1)) for n in self.layer.shape)
        x, y, layer = self.field.x_m[i], self.field.y_m[j], self.layer[j][:, i]
        keys = {} if plan is None else plan.keys()
        if self.quantity == "mask":
            drawn = draw_cells(ax, x, y, layer, ListedColormap([style.PALETTE["teal"][0]]), alpha=0.5)
            keys["holds field"] = Patch(facecolor=style.PALETTE["teal"][0], alpha=0.5)
        else:
            drawn = scale.draw(ax, x, y, layer)
        if plan is not None:
            plan.draw(ax)
        if np.isnan(layer).any():
            keys[QUANTITIES[self.quantity].unknown] = _hatched()
        return drawn, keys


def _by_quantity(panels: Sequence[_Panel | None]) -> dict[str, dict[int, _Panel]]:
    """Panels by their index, for each quantity."""
    found: dict[str, dict[int, _Panel]] = {}
    for k, panel in enumerate(panels):
        if panel is not None:
            found.setdefault(panel.quantity, {})[k] = panel
    return found


def _overviews(fields: Sequence[AnomalyMap]) -> list[_Panel | None]:
    """The quantities of the overview that a map knows, of each map; None where only another one does."""
    rows = [[_overview(name, field, several=len(fields) > 1) for field in fields] for name in OVERVIEW]
    return [panel for row in rows if any(row) for panel in row]


def _overview(name: str, field: AnomalyMap, *, several: bool) -> _Panel | None:
    """A quantity of the overview; None if the map does not know it."""
    unknown = {"heading effect": len(field.headings_rad) < 2, "sd": field.variance_nt2 is None}
    if unknown.get(name):
        return None
    layer = _slope(mean_field_nt(field), field) if name == "gradient" else QUANTITIES[name].layers(field)[0]
    title = f"{field.name}, " * several + OVERVIEW[name]
    return _Panel(title, name, field, layer) if np.isfinite(layer).any() else None


def _by_heading(
    what: str, field: AnomalyMap, headings: Sequence[float] | None, *, several: bool
) -> list[_Panel]:
    """A quantity of a map, one panel per heading."""
    layers = QUANTITIES[what].layers(field)
    if headings is None:
        every = -(-len(layers) // 4) if len(layers) > MOST_PANELS else 1
        shown, layers = field.headings_rad[::every], layers[::every]
    else:
        shown = np.asarray(headings, float)
        parts: dict[str, Any] = dict.fromkeys(("variance_nt2", "between_nt2", "harmonic", "recorded_yaw"))
        values = replace(field, values_nt=layers, valid=np.isfinite(layers), **parts)
        p_xy = np.stack(np.meshgrid(field.x_m, field.y_m), axis=-1)
        layers = values.lookup(p_xy[None], shown[:, None, None])  # interpolated as a map is
    if what != "mask" and not np.isfinite(layers).any():
        raise InputError(f"map {field.name!r} has no node whose {what} is known")
    panels = []
    for heading, layer in zip(shown, layers, strict=True):
        masked = f", {np.isnan(layer).sum()} masked" if what == "mask" else ""
        title = f"{field.name}, " * several + f"heading {np.degrees(heading):.4g}°{masked}"
        panels.append(_Panel(title, what, field, layer))
    return panels


@dataclass(frozen=True)
class _Scale:
    """Bands of values, one colour each."""

    levels: Array
    limits: tuple[float, float]
    colours: Colormap
    extend: str
    """Ends of the colour bar that are pointed, as values lie beyond them."""

    @classmethod
    def of(cls, panels: Iterable["_Panel"], quantity: _Quantity) -> "_Scale":
        """Bands over the known values of all panels."""
        known = np.concatenate([panel.layer[np.isfinite(panel.layer)] for panel in panels])
        low, high = colour_limits(known)
        if quantity.about_zero:
            low, high = -max(-low, high), max(-low, high)
        wide = apart(low, high)
        if wide == (low, high):
            levels = np.asarray(MaxNLocator(BANDS, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high))
        else:
            low, high = wide
            levels = np.array([low, high])
        beyond = (bool((known < levels[0]).any()), bool((known > levels[-1]).any()))
        return cls(levels, (low, high), colormaps[quantity.colours], EXTEND[beyond])

    def ticks(self, every: int = 0) -> Array:
        """Values beside the colour bar, by default about 8; of one value everywhere, that alone."""
        if len(self.levels) == 2:
            return np.array([round(float(self.levels.mean()), 6)])
        return self.levels[:: every or max(1, len(self.levels) // 8)]

    def draw(self, ax: Axes, x: Array, y: Array, layer: Array) -> ScalarMappable:
        """Filled contours of one layer over its cells, which show beside unknown nodes."""
        middle = np.convolve(self.levels, (0.5, 0.5), "valid")
        low, high = self.limits
        bands = self.colours(np.clip((middle - low) / (high - low), 0, 1))
        colours = ListedColormap(bands).with_extremes(under=bands[0], over=bands[-1])
        norm = BoundaryNorm(self.levels, len(bands))
        draw_cells(ax, x, y, layer, colours, norm=norm, zorder=0.5)
        look: dict[str, Any] = {"cmap": colours, "norm": norm, "extend": self.extend, "zorder": 0.6}
        drawn = ax.contourf(x, y, np.ma.masked_invalid(layer), self.levels, **look)
        drawn.set_rasterized(True)
        ax.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
        return drawn


def _summary(field: AnomalyMap, width: int) -> str:
    """The map's name, and its figures in lines of at most `width` characters."""
    figures = {f.name: f for f in field.report().figures}
    mean = figures["mean"]
    words = [f"mean {float(mean.value):,.0f} nT", f"sd {mean.spread or 0:,.0f} nT"]
    if "median gradient" in figures:
        words.append(f"median gradient {1000 * float(figures['median gradient'].value):,.0f} nT/m")
    if "heading amplitude" in figures:
        words.append(f"heading amplitude {float(figures['heading amplitude'].value):.0f} nT")
    if field.height_m is not None:
        words.append(f"sensor at {field.height_m:.4g} m")
    if field.created:
        words.append(field.created)
    if masked := int(figures["masked nodes"].value):
        words.append(f"{masked} nodes masked")
    return "\n".join([field.name or "map", *textwrap.wrap(", ".join(words), width)])
