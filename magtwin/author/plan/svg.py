"""Drawings from SVG: lines, polylines, polygons, rectangles and paths, with transforms and units."""

import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from magtwin.author.plan.drawing import Array, Drawing, Line
from magtwin.errors import InputError
from magtwin.urdf.source.markup import read_markup

NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
PIXELS = {
    "": 1.0,
    "px": 1.0,
    "mm": 96 / 25.4,
    "cm": 96 / 2.54,
    "in": 96.0,
    "pt": 96 / 72,
    "pc": 16.0,
    "m": 96 / 0.0254,
}
PHYSICAL = ("mm", "cm", "in", "pt", "pc", "m")
HIDDEN = (
    "defs",
    "symbol",
    "clipPath",
    "mask",
    "pattern",
    "marker",
    "text",
    "metadata",
    "title",
    "desc",
    "style",
)
TAKES = {"M": 2, "L": 2, "H": 1, "V": 1, "C": 6, "S": 4, "Q": 4, "T": 2, "A": 7, "Z": 0}
"""Numbers that each command of a path takes."""

LINK = "xlink:href"
DEEPEST = 8
"""Most levels of elements that refer to others."""


def read_svg(path: Path) -> Drawing:
    """The lines of an SVG.

    Its unit is that of the viewBox. If width and height are in mm or another physical unit, the drawing is
    taken at its size on paper.

    Raises:
        InputError: It is not SVG, or a number of it is none; the text has the line.
    """
    markup = read_markup(path, "floor plan")
    root = markup.root
    if _tag(root) != "svg":
        raise InputError(f"{path}: not an SVG: its first element is {_tag(root)!r}")
    named = {name: e for e in markup.lines if (name := e.get("id"))}
    drawing, view = Drawing(), [float(n) for n in re.findall(NUMBER, root.get("viewBox", ""))]
    width, unit = _length(root.get("width", ""))
    if unit in PHYSICAL and width:
        across = view[2] if len(view) == 4 and view[2] > 0 else width
        drawing.metres = width * 0.0254 / 96 / across
        drawing.stated = f"its width is {root.get('width')}"
    else:
        drawing.stated = "its width is not in mm, cm, in or m"
    flip, curved = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, 1]]), set[str]()

    def walk(element: Element, to_page: Array, layer: str, style: Mapping[str, str], depth: int) -> None:
        tag = _tag(element)
        style = {**style, **_style(element)}
        if tag in HIDDEN or style.get("display") == "none" or style.get("visibility") == "hidden":
            return
        where = f"{path}:{markup.lines[element]}"
        to_page = to_page @ _transform(element.get("transform", ""), where)
        naming = ("id", "class", "data-name")
        names = [v for k, v in element.items() if k in naming or k.endswith(":label")]
        layer = " ".join([layer, *names])
        used = named.get((element.get("href") or element.get(LINK) or "").removeprefix("#"))
        if tag == "use" and used is not None and depth < DEEPEST:
            moved = to_page @ _moved(_number(element, "x", where), _number(element, "y", where))
            for child in [used] if _tag(used) != "symbol" else used:
                walk(child, moved, layer, style, depth + 1)
        for p, closed in _shapes(element, tag, where, curved):
            stroked = style.get("stroke", "none") != "none"
            page = 0.99 * np.array(view[2:] if len(view) == 4 else [np.inf, np.inf])
            if tag == "rect" and not stroked and np.all(np.ptp(p, axis=0) >= page):
                continue  # the page's background
            on_page = np.column_stack([p, np.ones(len(p))]) @ (flip @ to_page).T
            stroke = _length(style.get("stroke-width", ""))[0] if stroked else 0.0
            wide = stroke * math.sqrt(abs(np.linalg.det(to_page[:2, :2])))
            drawing.lines.append(Line(on_page[:, :2], closed, layer, wide))
        for child in element:
            walk(child, to_page, layer, style, depth)

    walk(root, np.eye(3), "", {}, 0)
    if curved:
        drawing.notes.append(f"curves are straight between their ends: {', '.join(sorted(curved))}")
    return drawing


def _tag(element: Element) -> str:
    return str(element.tag).rpartition("}")[2].rpartition(":")[2]


def _style(element: Element) -> dict[str, str]:
    """Properties of an element, as attributes or in its style."""
    names = ("display", "visibility", "stroke", "stroke-width", "fill")
    own = {name: value for name in names if (value := element.get(name)) is not None}
    for part in element.get("style", "").split(";"):
        name, _, value = part.partition(":")
        if name.strip() in names:
            own[name.strip()] = value.strip()
    return own


def _length(text: str) -> tuple[float, str]:
    """A length in pixels, and its unit; 0 if it is none."""
    match = re.fullmatch(rf"\s*({NUMBER})\s*([a-z]*)\s*", text)
    if match is None or match[2] not in PIXELS:
        return 0.0, ""
    return float(match[1]) * PIXELS[match[2]], match[2]


def _number(element: Element, name: str, where: str) -> float:
    text = element.get(name, "0")
    value, _ = _length(text)
    if not value and not re.fullmatch(rf"\s*{NUMBER}\s*[a-z]*\s*", text):
        raise InputError(f"{where}: {name} of <{_tag(element)}> must be a length, got {text!r:.40}")
    return value


def _moved(x: float, y: float) -> Array:
    return np.array([[1.0, 0, x], [0, 1, y], [0, 0, 1]])


def _transform(text: str, where: str) -> Array:
    """A matrix (3, 3) from an attribute `transform`."""
    matrix = np.eye(3)
    for name, inside in re.findall(r"(\w+)\s*\(([^)]*)\)", text):
        n = [float(x) for x in re.findall(NUMBER, inside)]
        try:
            if name == "matrix":
                step = np.array([[n[0], n[2], n[4]], [n[1], n[3], n[5]], [0, 0, 1]])
            elif name == "translate":
                step = _moved(n[0], n[1] if len(n) > 1 else 0.0)
            elif name == "scale":
                step = np.diag([n[0], n[1] if len(n) > 1 else n[0], 1.0])
            elif name == "rotate":
                c, s = math.cos(math.radians(n[0])), math.sin(math.radians(n[0]))
                turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
                step = _moved(n[1], n[2]) @ turn @ _moved(-n[1], -n[2]) if len(n) > 2 else turn
            else:
                step = np.eye(3)
                step[{"skewX": (0, 1), "skewY": (1, 0)}[name]] = math.tan(math.radians(n[0]))
        except (IndexError, KeyError) as error:
            text = f"{where}: transform {name}({inside})"[:120]
            raise InputError(f"{text} is none of SVG; correct it") from error
        matrix = matrix @ step
    return matrix


def _shapes(element: Element, tag: str, where: str, curved: set[str]) -> Iterator[tuple[Array, bool]]:
    """Polylines (N, 2) of an element, and whether each is closed."""
    if tag == "line":
        ends = [_number(element, name, where) for name in ("x1", "y1", "x2", "y2")]
        yield np.reshape(ends, (2, 2)), False
    elif tag in ("polyline", "polygon"):
        numbers = [float(n) for n in re.findall(NUMBER, element.get("points", ""))]
        if len(numbers) % 2:
            raise InputError(f"{where}: points of <{tag}> must be pairs, got {len(numbers)} numbers")
        if len(numbers) >= 4:
            yield np.reshape(numbers, (-1, 2)), tag == "polygon"
    elif tag == "rect":
        x, y, w, h = (_number(element, name, where) for name in ("x", "y", "width", "height"))
        if w > 0 and h > 0:
            yield np.array([[x, y], [x + w, y], [x + w, y + h], [x, y + h]]), True
    elif tag == "path":
        yield from _path(element.get("d", ""), where, curved)


def _path(text: str, where: str, curved: set[str]) -> Iterator[tuple[Array, bool]]:
    """Polylines of a path's data; curves are straight."""
    points, at, start = list[Array](), np.zeros(2), np.zeros(2)
    for letter, inside in re.findall(r"([MmLlHhVvCcSsQqTtAaZz])([^MmLlHhVvCcSsQqTtAaZz]*)", text):
        name, near, n = letter.upper(), letter.islower(), [float(x) for x in re.findall(NUMBER, inside)]
        count = TAKES[name]
        if count and (not n or len(n) % count):
            raise InputError(f"{where}: command {letter} of a path takes {count} numbers each, got {len(n)}")
        if name in "CSQTA":
            curved.add({"A": "arcs"}.get(name, "Bezier curves"))
        for k in range(0, max(len(n), 1), max(count, 1)):
            if name == "Z":
                if len(points) > 1:
                    yield np.array(points), True
                points, at = [start], start
                continue
            if name in "HV":
                axis = name == "V"
                at = at.copy()
                at[int(axis)] = n[k] + near * at[int(axis)]
            else:
                at = np.array(n[k + count - 2 : k + count]) + near * at
            if name == "M" and k == 0:
                if len(points) > 1:
                    yield np.array(points), False
                points, start = [], at
            points.append(at)
    if len(points) > 1:
        yield np.array(points), False
