"""Placeholder: a box in the place of a mesh that is missing or unreadable, so that its link keeps a shape."""

import re
from collections.abc import Iterator
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from magtwin.urdf.description.description import Description, origin_of
from magtwin.urdf.description.model import Geometry, Link, Shape
from magtwin.urdf.meshes.mesh_layer import MeshLayer
from magtwin.urdf.source.package import MissingFileError

FOLDERS = re.compile(r"(?<!\S)/[^:]*/")
"""Folders of an absolute path, which a note leaves out: they differ between machines."""

EDGE_M = 0.05
"""Edge of the box of a link of which nothing is known [m]."""

THINNEST_M = 0.001
"""Least edge of a box [m]."""


def replace_failed(description: Description, meshes: MeshLayer) -> Description:
    """Replace every shape whose mesh failed by a box.

    The box of a link is that around its other shapes, or else a cube with edges of `EDGE_M`.

    Args:
        description: The description, which receives a repair for each shape.
        meshes: Its meshes, which receive the boxes.
    """
    for error in meshes.failed.values():
        if isinstance(error, MissingFileError) and error.supply:
            description.repairs.supplies[error.supply] = None
    links = dict(description.links)
    for name, link in description.links.items():
        shapes = {role: tuple(_kept(description, meshes, link, role)) for role in ("visual", "collision")}
        links[name] = replace(link, visuals=shapes["visual"], collisions=shapes["collision"])
    return replace(description, links=links) if meshes.failed else description


def _kept(description: Description, meshes: MeshLayer, link: Link, role: str) -> Iterator[Shape]:
    """The visuals or collisions of a link, with boxes in the place of failed meshes."""
    for shape in link.visuals if role == "visual" else link.collisions:
        file = shape.geometry.filename
        if shape.geometry.kind != "mesh" or file not in meshes.failed:
            yield shape
            continue
        error = meshes.failed[file]
        what = f"mesh {file!r} cannot be read ({FOLDERS.sub('', str(error))})"
        if isinstance(error, MissingFileError):
            what = f"mesh {file!r} is missing{error.near}"
        size, T = _box_of(link, meshes)
        box = Geometry("box", size)
        if role == "visual":
            meshes.primitive(box)
        edges = " x ".join(f"{edge:.3g}" for edge in size)
        text = f"link {link.name!r}: {role} {what}: a box of {edges} m stands for it"
        kind = "mesh-missing" if isinstance(error, MissingFileError) else "mesh-unreadable"
        description.repair(kind, text, description.mesh_element(file))
        yield replace(shape, geometry=box, origin=T)


def _box_of(link: Link, meshes: MeshLayer) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Edges [m], shape (3,), and pose in the link, shape (4, 4), of a box of the link's size."""
    corners = [_corners(shape, meshes) for shape in (*link.visuals, *link.collisions)]
    known = [points for points in corners if points is not None]
    size, T = np.full(3, EDGE_M), np.eye(4)
    if known:
        low, high = np.min(known, (0, 1)), np.max(known, (0, 1))
        size, T[:3, 3] = high - low, (low + high) / 2
    return np.maximum(np.round(size, 6), THINNEST_M), T


def _corners(shape: Shape, meshes: MeshLayer) -> NDArray[np.float64] | None:
    """Corners of the box around a shape, in its link's frame, shape (8, 3); None if its mesh failed."""
    form, T = shape.geometry, origin_of(shape)
    if form.kind == "mesh":
        if form.filename in meshes.failed:
            return None
        points = meshes.vertices(form)
        low, high = points.min(0), points.max(0)
    else:
        half = form.half_extents(np.eye(3))
        low, high = -half, half
    box = np.array(list(product(*zip(low, high, strict=True))))
    return np.asarray(box @ T[:3, :3].T + T[:3, 3], float)
