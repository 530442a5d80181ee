"""Style: the look that figures and pages share: colours for light and dark, lines, text, and one style sheet.

A drawing is made in the light colours. On a page, each of them becomes a variable of `CSS`, which follows the
reader's choice of light or dark. Data of different series differ in colour and in dashes.
"""

import functools
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from matplotlib import rc_context
from matplotlib.rcsetup import cycler

P = ParamSpec("P")
R = TypeVar("R")

PALETTE: Mapping[str, tuple[str, str]] = {
    "ink": ("#1f2430", "#e6e9ee"),
    "soft": ("#5c6470", "#a3abb7"),
    "faint": ("#9aa3ae", "#717a86"),
    "line": ("#d9dee5", "#3a414c"),
    "paper": ("#fdfdfe", "#16191f"),
    "bar": ("#ffffff", "#1f242c"),
    "panel": ("#f6f8fa", "#1e232b"),
    "link": ("#0b5cad", "#7cb7f5"),
    "data": ("#0b66c3", "#5aa9f5"),
    "model": ("#d9730d", "#f0a35a"),
    "green": ("#12805c", "#54c79b"),
    "violet": ("#7b3fb5", "#c49bf0"),
    "red": ("#c2255c", "#f783ac"),
    "teal": ("#0c7c93", "#5cc8de"),
    "brown": ("#7a5c12", "#d3b15e"),
    "lidar": ("#e9edf3", "#2b323d"),
    "lost": ("#f3d9fa", "#4a2b55"),
    "masked": ("#d0d5db", "#4b525d"),
    "glass": ("rgba(255, 255, 255, .86)", "rgba(22, 25, 31, .84)"),
}
"""Colours by name, for light and for dark. Those of data are told apart by the colour-blind too."""

INK, SOFT, FAINT, LINE, PAPER = (PALETTE[name][0] for name in ("ink", "soft", "faint", "line", "bar"))
DATA, MODEL, BOUND, OTHER = (PALETTE[name][0] for name in ("data", "model", "green", "violet"))
LIDAR, LOST, MASKED = (PALETTE[name][0] for name in ("lidar", "lost", "masked"))
"""What is measured, what a model says of it, the best that is possible, another model."""

FIELD_COLOURS, SIGNED_COLOURS, SPREAD_COLOURS, SLOPE_COLOURS = "viridis", "RdBu_r", "cividis", "magma"
"""Colour scales: of a field, of differences about zero, of standard deviations, and of slopes."""

SERIES = tuple(
    {"color": PALETTE[name][0], "ls": ("-", (0, (5, 1.5)), (0, (1.5, 1.2)))[k % 3]}
    for k, name in enumerate(3 * ("data", "model", "green", "violet", "red", "teal", "brown"))
)
"""Looks of lines that are compared, by their index: no two alike in colour and dashes."""

TEXT = 10
"""Size of text [points]. A figure of `canvas.WIDTH_IN` on a phone shows it at 11 pixels or more."""

RC: Mapping[str, Any] = {
    "axes.axisbelow": True,
    "axes.edgecolor": FAINT,
    "axes.grid": False,
    "axes.labelcolor": INK,
    "axes.labelsize": TEXT,
    "axes.linewidth": 0.7,
    "axes.prop_cycle": cycler(color=[look["color"] for look in SERIES[:7]]),
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlecolor": INK,
    "axes.titlelocation": "left",
    "axes.titlesize": TEXT,
    "figure.facecolor": PAPER,
    "figure.titlesize": TEXT + 1,
    "font.size": TEXT,
    "grid.color": LINE,
    "grid.linewidth": 0.7,
    "hatch.linewidth": 0.7,
    "legend.borderaxespad": 0.2,
    "legend.columnspacing": 1.4,
    "legend.fontsize": TEXT,
    "legend.frameon": False,
    "lines.linewidth": 1.3,
    "svg.fonttype": "none",
    "svg.hashsalt": "magtwin",
    "text.color": INK,
    "text.parse_math": False,
    "xtick.color": FAINT,
    "xtick.labelcolor": SOFT,
    "xtick.labelsize": TEXT,
    "ytick.color": FAINT,
    "ytick.labelcolor": SOFT,
    "ytick.labelsize": TEXT,
}
"""Settings of matplotlib. Text stays text in an SVG, and names of files are no formulas."""

VARIABLES = "".join(f" --{name}: light-dark({light}, {dark});" for name, (light, dark) in PALETTE.items())
CSS = f":root {{ color-scheme: light dark;{VARIABLES} }}\n" + (
    Path(__file__).with_name("style.css").read_text(encoding="utf-8")
)
"""The style sheet of all pages."""

_NAMES = {light: name for name, (light, _) in PALETTE.items()}


def styled(draw: Callable[P, R]) -> Callable[P, R]:
    """Have a function draw with `RC`, and leave matplotlib's settings of the program as they are."""

    @functools.wraps(draw)
    def drawn(*args: P.args, **options: P.kwargs) -> R:
        with rc_context(dict(RC)):
            return draw(*args, **options)

    return drawn


def inline_svg(svg: bytes, prefix: str) -> str:
    """An SVG of `canvas.render` for a page: with variables as colours, and names with a prefix of its own."""
    text = svg.decode("utf-8")
    text = re.sub(r"^.*?(?=<svg)|<metadata>.*?</metadata>|<style.*?</style>|<!--.*?-->", "", text, flags=re.S)
    text = re.sub(r' xmlns(:\w+)?="[^"]*"| version="1\.1"|(?<=<svg) width="[^"]*" height="[^"]*"', "", text)
    used = set(re.findall(r'(?:url\(|href=")#([^)"]+)', text))
    text = re.sub(r' id="([^"]*)"', lambda m: f' id="{prefix}{m[1]}"' if m[1] in used else "", text)
    text = re.sub(r'(url\(|href=")#', rf"\1#{prefix}", text).replace("xlink:href", "href")
    return re.sub("#[0-9a-f]{6}", lambda m: f"var(--{_NAMES[m[0]]})" if m[0] in _NAMES else m[0], text)
