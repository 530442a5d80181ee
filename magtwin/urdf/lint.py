"""Lint: doubtful values in a description that can still be converted."""

from collections.abc import Callable, Iterable, Iterator
from itertools import product

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.urdf.description.description import Description, origin_of
from magtwin.urdf.description.model import Geometry, Shape
from magtwin.urdf.meshes.mesh import bounds

Array = NDArray[np.float64]

Vertices = Callable[[Geometry], Array]
"""Vertices of a URDF `<mesh>`, scaled [m], shape (V, 3)."""

OUTSIDE = 0.1
"""Doubtful distance of a frame from the body's box, relative to the box's diagonal."""

ASIDE = 0.01
"""Distance from the middle plane from which a frame counts as left or right [m]."""

DENSEST = 9_000.0
"""Density above which a body is doubtful [kg/m3]; copper has 8,960."""

LIGHT = 10.0
"""Factor by which an inertia may be below that of an evenly filled box of its size."""

MASS_OFF = 0.05
"""Relative error of the total mass against the data sheet that is doubtful."""

HUGE_M = 30.0
"""Size of a robot above which it is doubtful [m]."""

SIDES = (("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT"))


def lint(
    description: Description, *, mass: float | None = None, vertices: Vertices | None = None
) -> tuple[str, ...]:
    """Doubts about a description, one line each, in the order of the checks below.

    Args:
        description: The description.
        mass: Mass on the robot's data sheet [kg].
        vertices: Reads a mesh; without it, or if it fails, meshes are ignored.
    """
    shapes = {
        name: [_corners(p, box) for p in (*link.visuals, *link.collisions) if (box := _box(p, vertices))]
        for name, link in description.links.items()
    }
    return (
        *_size(description, shapes),
        *_masses(description),
        *_frames_outside(description, shapes),
        *_swapped_sides(description),
        *_stuck_joints(description),
        *_inertias(description, shapes),
        *_densities(description, vertices, mass),
    )


def _size(description: Description, shapes: dict[str, list[Array]]) -> Iterator[str]:
    """A robot that is too large, as one whose meshes are in millimetres."""
    poses = description.poses()
    placed = [_transformed(poses[name], points) for name, boxes in shapes.items() for points in boxes]
    size = np.ptp(np.vstack(placed), axis=0) if placed else np.zeros(3)
    if size.max() > HUGE_M:
        yield (
            f"the robot is {' x '.join(f'{side:.4g}' for side in size)} m large; are its meshes in mm? then "
            '<mesh scale="0.001 0.001 0.001" .../>'
        )


def _masses(description: Description) -> Iterator[str]:
    """Frames with a mass but no shape."""
    dummies: dict[float, list[str]] = {}
    for name, link in description.links.items():
        fixed = name in description.joints and description.joints[name].type == "fixed"
        if fixed and not link.visuals and not link.collisions and link.inertial and link.inertial.mass:
            dummies.setdefault(float(link.inertial.mass), []).append(name)
    for mass, names in dummies.items():
        yield (
            f"frames with a mass of {mass:g} kg and no shape, {len(names) * mass:g} kg in all "
            f"({len(names)}): {', '.join(names)}"
        )


def _frames_outside(description: Description, shapes: dict[str, list[Array]]) -> Iterator[str]:
    """Frames without a shape that are far from all shapes."""
    poses = description.poses()
    placed = [_transformed(poses[name], points) for name, boxes in shapes.items() for points in boxes]
    if not placed:
        return
    low, high = np.vstack(placed).min(0), np.vstack(placed).max(0)
    margin = OUTSIDE * float(np.linalg.norm(high - low))
    for name in description.links:
        p = poses[name][:3, 3]
        off = float(np.linalg.norm(p - np.clip(p, low, high)))
        if not shapes[name] and off > margin:
            at = ", ".join(f"{round(float(v), 4) + 0.0:g}" for v in p)
            yield f"link {name!r} at ({at}) m lies {off:.3g} m outside of the body"


def _swapped_sides(description: Description) -> Iterator[str]:
    """Pairs called left and right that are swapped: left is +y (REP-103)."""
    poses, joints = description.poses(), description.joints

    def is_rigid(name: str) -> bool:
        """Whether fixed joints connect a link to the root, apart from its own joint."""
        while name in joints:
            name = joints[name].parent
            if name in joints and joints[name].type != "fixed":
                return False
        return True

    for name in description.links:
        twin = next((name.replace(left, right) for left, right in SIDES if left in name), "")
        if twin not in description.links or not (is_rigid(name) and is_rigid(twin)):
            continue
        left, right = float(poses[name][1, 3]), float(poses[twin][1, 3])
        if left < -ASIDE and right > ASIDE:
            yield (
                f"link {name!r} is at y = {left:.4g} m and {twin!r} at {right:.4g} m: "
                "swapped? left is +y (REP-103)"
            )


def _stuck_joints(description: Description) -> Iterator[str]:
    """Joints whose type allows a motion that their limits forbid."""
    for joint in description.joints.values():
        limit = joint.limit
        if limit is None or joint.type == "fixed":
            continue
        zeros = " and ".join(f"{what} of 0" for what in ("effort", "velocity") if getattr(limit, what) == 0)
        if zeros:
            yield f"joint {joint.name!r} ({joint.type}) has an {zeros}: it cannot be driven"
        if joint.type != "continuous" and limit.lower is not None and limit.lower == limit.upper:
            yield f"joint {joint.name!r} ({joint.type}) has both limits at {limit.lower:g}: it cannot move"


def _inertias(description: Description, shapes: dict[str, list[Array]]) -> Iterator[str]:
    """Inertias that are impossible or implausible for a body of that mass and size.

    A moment of inertia is the mass times a mean of squared distances from its axis, so none exceeds
    m R^2, with R the distance from the centre of mass to the shape's farthest corner.
    """
    for name, link in description.links.items():
        inertial = link.inertial
        if inertial is None or inertial.inertia is None or not inertial.mass or not shapes[name]:
            continue
        corners = np.vstack(shapes[name])
        low, high = corners.min(0), corners.max(0)
        centre = origin_of(inertial)[:3, 3]
        largest = float(np.linalg.eigvalsh(inertial.inertia).max())
        mass = float(inertial.mass)
        bound = mass * float(np.sum((corners - centre) ** 2, axis=1).max())
        edges = np.sort(high - low)[1:]
        even = mass / 12 * float(np.sum(edges**2))
        if largest > bound * (1 + 1e-6):
            yield (
                f"link {name!r} has a moment of inertia of {largest:.3g} kg m2; no {mass:g} kg within its "
                f"shapes can have above {bound:.3g}"
            )
        elif largest * LIGHT < even:
            yield (
                f"link {name!r} has a largest moment of inertia of {largest:.3g} kg m2; {mass:g} kg spread "
                f"over its shapes would have about {even:.3g}"
            )
        off = float(np.linalg.norm(centre - np.clip(centre, low, high)))
        if off > OUTSIDE * float(np.linalg.norm(high - low)):
            yield f"link {name!r} has its centre of mass {off:.3g} m outside of its shapes"


def _densities(
    description: Description, vertices: Vertices | None, data_sheet: float | None
) -> Iterator[str]:
    """Bodies that are too heavy for their shapes, and the total mass against the data sheet."""
    total = 0.0
    for name, link in description.links.items():
        volume = max(_volume(link.collisions, vertices), _volume(link.visuals, vertices))
        mass = 0.0 if link.inertial is None else float(link.inertial.mass or 0.0)
        total += mass
        if volume > 0 and mass / volume > DENSEST:
            yield (
                f"link {name!r} weighs {mass:g} kg in {volume * 1e6:.3g} cm3 or less: "
                f"{mass / volume:.0f} kg/m3, above copper"
            )
    if data_sheet is not None and abs(total - data_sheet) > MASS_OFF * data_sheet:
        more = total / data_sheet - 1
        yield f"the links weigh {total:.6g} kg in all, the data sheet says {data_sheet:g} kg ({more:+.0%})"


def _box(part: Shape, vertices: Vertices | None) -> tuple[Array, Array] | None:
    """Lower and upper corner of a box around a shape in its own frame; None if it cannot be read."""
    if part.geometry.kind != "mesh":
        half = part.geometry.half_extents(np.eye(3))
        return -half, half
    try:
        return None if vertices is None else bounds(vertices(part.geometry))
    except (InputError, KeyError):
        return None  # the conversion reports it


def _corners(part: Shape, box: tuple[Array, Array]) -> Array:
    """Corners of a shape's box in its link's frame, shape (8, 3)."""
    return _transformed(origin_of(part), np.array(list(product(*zip(*box, strict=True)))))


def _volume(parts: Iterable[Shape], vertices: Vertices | None) -> float:
    """Upper limit of the volume of shapes [m3], with boxes for meshes; inf if one is unknown."""
    total = 0.0
    for part in parts:
        box = _box(part, vertices)
        if box is None:
            return np.inf
        total += float(np.prod(box[1] - box[0])) if part.geometry.kind == "mesh" else part.geometry.volume
    return total


def _transformed(T: Array, points: Array) -> Array:
    """Points (N, 3) after a transform (4, 4)."""
    return points @ T[:3, :3].T + T[:3, 3]
