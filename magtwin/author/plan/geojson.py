"""Drawings from GeoJSON: lines and polygons, in metres or in degrees about a local tangent plane."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from magtwin.author.plan.drawing import Drawing, Line
from magtwin.errors import InputError
from magtwin.files.file import read_text

A_M, E2 = 6378137.0, 0.00669437999014
"""Semi-major axis [m] and squared eccentricity of WGS 84."""

LARGEST_DEG = 0.05
"""A plan that is larger than this is not in degrees: 5 km [deg]."""


def read_geojson(path: Path) -> Drawing:
    """The lines of a GeoJSON.

    Coordinates are longitude and latitude [deg] if they can be those of a building, as RFC 7946 says; they
    are projected to the plane that touches WGS 84 in their middle. Others are metres.

    Raises:
        InputError: It is not GeoJSON.
    """
    try:
        table = json.loads(read_text(path, "floor plan", "JSON"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not GeoJSON: {error}") from error
    drawing = Drawing(metres=1.0)
    try:
        drawing.lines = list(_lines(table, ""))
    except (TypeError, ValueError, KeyError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: not GeoJSON: {error!r}; expected a FeatureCollection of lines") from error
    if not drawing.lines:
        return drawing
    p = np.vstack([line.p for line in drawing.lines])
    low, high = p.min(axis=0), p.max(axis=0)
    on_earth = np.all(np.abs([low, high]) <= [180, 90]) and (high - low).max() < LARGEST_DEG
    if not on_earth:
        drawing.stated = "its coordinates are in metres"
        return drawing
    longitude, latitude = (low + high) / 2
    sin, cos = np.sin(np.radians(latitude)), np.cos(np.radians(latitude))
    across = A_M / np.sqrt(1 - E2 * sin**2)
    along = across * (1 - E2) / (1 - E2 * sin**2)
    scale = np.radians([across * cos, along])
    middle = np.array([longitude, latitude])
    drawing.lines = [Line((each.p - middle) * scale, each.closed, each.layer) for each in drawing.lines]
    drawing.stated = f"its coordinates are degrees about {latitude:.6f} N, {longitude:.6f} E"
    drawing.notes.append(f"projected to the plane at {latitude:.6f} N, {longitude:.6f} E; y is true north")
    return drawing


def _lines(table: Any, layer: str) -> Iterator[Line]:
    """Lines of a GeoJSON object."""
    kind = table["type"]
    if kind == "FeatureCollection":
        for feature in table["features"]:
            yield from _lines(feature, layer)
    elif kind == "Feature":
        properties = table.get("properties") or {}
        words = " ".join(f"{key} {value}" for key, value in properties.items() if isinstance(value, str))
        if table.get("geometry"):
            yield from _lines(table["geometry"], words)
    elif kind == "GeometryCollection":
        for geometry in table["geometries"]:
            yield from _lines(geometry, layer)
    elif kind in ("LineString", "MultiLineString", "Polygon", "MultiPolygon"):
        several = {"LineString": [[table["coordinates"]]], "MultiPolygon": table["coordinates"]}
        for rings in several.get(kind, [table["coordinates"]]):
            for ring in rings:
                p = np.array([[float(x) for x in point[:2]] for point in ring]).reshape(-1, 2)
                closed = len(p) > 3 and bool(np.all(p[0] == p[-1]))
                if len(p) > 1:
                    yield Line(p[:-1] if closed else p, closed, layer)
