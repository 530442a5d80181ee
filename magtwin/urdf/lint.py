"""Lint: what is doubtful in a description, though it can be converted."""

from collections.abc import Callable, Iterable, Iterator
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.urdf.description.description import Description, origin_of
from magtwin.urdf.description.model import Geometry, Mesh, Shape
from magtwin.urdf.meshes.mesh import bounds

Array = NDArray[np.float64]

Vertices = Callable[[Mesh], Array]
"""Vertices of a URDF `<mesh>`, scaled [m], shape (V, 3)."""

OUTSIDE = 0.1
"""How far outside of the body's box a frame is doubtful, as part of the box's diagonal."""

ASIDE = 0.01
"""Distance from the middle plane from which a frame counts as left or right [m]."""

DENSEST = 9_000.0
"""Density above which a body is doubtful [kg/m3]; copper has 8,960."""

LIGHT = 10.0
"""How many times less than an evenly filled box of its size a body may resist turning."""

MASS_OFF = 0.05
"""Part of a data sheet's mass by which the links' sum may be off."""


def lint(
    description: Description, *, mass: float | None = None, vertices: Vertices | None = None
) -> tuple[str, ...]:
    """Doubts about a description, one line each, in the order of the checks below.

    Args:
        description: What was read.
        mass: Mass on the robot's data sheet [kg].
        vertices: Reads a mesh; without it, or where it refuses, meshes count for nothing.
    """
    shapes = {
        name: [points for part in (*link.visuals, *link.collisions) for points in _box_of(part, vertices)]
        for name, link in description.links.items()
    }
    return (
        *_dummies(description),
        *_weightless(description),
        *_frames_outside(description, shapes),
        *_swapped_sides(description),
        *_stuck_joints(description),
        *_inertias(description, shapes),
        *_densities(description, vertices),
        *_mass(description, mass),
    )


def _dummies(description: Description) -> Iterator[str]:
    """Frames that were given a mass, though nothing is there."""
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


def _weightless(description: Description) -> Iterator[str]:
    """Bodies without mass, or without a tensor."""
    links = description.links.values()
    bare = [link.name for link in links if (link.visuals or link.collisions) and link.inertial is None]
    if bare:
        yield f"no <inertial>, though there is a shape: {', '.join(bare)}"
    partial = [link.name for link in links if link.inertial is not None and link.inertial.inertia is None]
    if partial:
        yield f"no <inertia> in <inertial>: {', '.join(partial)}"


def _frames_outside(description: Description, shapes: dict[str, list[Array]]) -> Iterator[str]:
    """Frames without a shape that stand far off all shapes."""
    poses = description.poses()
    placed = [_moved(poses[name], points) for name, boxes in shapes.items() for points in boxes]
    if not placed:
        return
    low, high = np.vstack(placed).min(0), np.vstack(placed).max(0)
    margin = OUTSIDE * float(np.linalg.norm(high - low))
    for name in description.links:
        p = poses[name][:3, 3]
        off = float(np.linalg.norm(p - np.clip(p, low, high)))
        if not shapes[name] and off > margin:
            yield f"link {name!r} at ({_say(p)}) m lies {off:.3g} m outside of the body"


def _swapped_sides(description: Description) -> Iterator[str]:
    """Pairs called left and right that stand the other way round: left is +y (REP-103)."""
    poses = description.poses()
    for name in description.links:
        twin = _twin(name)
        if twin is None or twin not in description.links or not _is_rigid(description, name, twin):
            continue
        left, right = float(poses[name][1, 3]), float(poses[twin][1, 3])
        if left < -ASIDE and right > ASIDE:
            yield (
                f"link {name!r} is at y = {left:.4g} m and {twin!r} at {right:.4g} m: "
                "swapped? left is +y (REP-103)"
            )


def _twin(name: str) -> str | None:
    """What the link opposite of a left one would be called."""
    for left, right in (("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT")):
        if left in name:
            return name.replace(left, right)
    return None


def _is_rigid(description: Description, *names: str) -> bool:
    """Whether links hang from the root by fixed joints, save their own."""
    for name in names:
        while name in description.joints:
            name = description.joints[name].parent
            if name in description.joints and description.joints[name].type != "fixed":
                return False
    return True


def _stuck_joints(description: Description) -> Iterator[str]:
    """Joints that move by their type and not by their limits."""
    for joint in description.joints.values():
        limit = joint.limit
        if limit is None or joint.type == "fixed":
            continue
        zeros = [f"{what} of 0" for what in ("effort", "velocity") if getattr(limit, what) == 0]
        if zeros:
            limits = " and ".join(zeros)
            yield f"joint {joint.name!r} ({joint.type}) has an {limits}: it cannot be driven"
        if joint.type != "continuous" and limit.lower is not None and limit.lower == limit.upper:
            yield f"joint {joint.name!r} ({joint.type}) has both limits at {limit.lower:g}: it cannot move"


def _inertias(description: Description, shapes: dict[str, list[Array]]) -> Iterator[str]:
    """Tensors that no body of that mass and size can have, or none that is filled evenly.

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


def _densities(description: Description, vertices: Vertices | None) -> Iterator[str]:
    """Bodies that weigh more than their shapes can hold."""
    for name, link in description.links.items():
        volume = max(_volume(link.collisions, vertices), _volume(link.visuals, vertices))
        mass = 0.0 if link.inertial is None else float(link.inertial.mass or 0.0)
        if volume > 0 and mass / volume > DENSEST:
            yield (
                f"link {name!r} weighs {mass:g} kg in {volume * 1e6:.3g} cm3 or less: "
                f"{mass / volume:.0f} kg/m3, above copper"
            )


def _mass(description: Description, mass: float | None) -> Iterator[str]:
    """The sum of the links against the data sheet."""
    if mass is None:
        return
    links = description.links.values()
    total = sum(float(link.inertial.mass or 0.0) for link in links if link.inertial is not None)
    if abs(total - mass) > MASS_OFF * mass:
        more = total / mass - 1
        yield f"the links weigh {total:.6g} kg in all, the data sheet says {mass:g} kg ({more:+.0%})"


def _box_of(part: Shape, vertices: Vertices | None) -> list[Array]:
    """Corners of a box around a visual or collision in its link's frame, shape (8, 3); [] for none."""
    geometry = part.geometry
    if geometry.mesh is not None:
        points = _read(geometry.mesh, vertices)
        if points is None:
            return []
        low, high = bounds(points)
    else:
        high = _half(geometry)
        low = -high
    corners = np.array(list(product(*zip(low, high, strict=True))))
    return [_moved(origin_of(part), corners)]


def _half(geometry: Geometry) -> Array:
    """Half the edges of the box around a primitive at its origin [m], shape (3,)."""
    if geometry.box is not None:
        return np.asarray(geometry.box.size, float) / 2
    if geometry.sphere is not None:
        return np.full(3, float(geometry.sphere.radius))
    round_one = geometry.cylinder or geometry.capsule
    assert round_one is not None  # a geometry is one of these
    radius, half = float(round_one.radius), float(round_one.length) / 2
    return np.array([radius, radius, half + (radius if geometry.capsule else 0.0)])


def _volume(parts: Iterable[Shape], vertices: Vertices | None) -> float:
    """What shapes hold at most [m3]: primitives exactly, meshes by their boxes; inf where one is unknown."""
    total = 0.0
    for part in parts:
        geometry = part.geometry
        if geometry.mesh is not None:
            points = _read(geometry.mesh, vertices)
            if points is None:
                return np.inf
            low, high = bounds(points)
            total += float(np.prod(high - low))
        elif geometry.box is not None:
            total += float(np.prod(geometry.box.size))
        elif geometry.sphere is not None:
            total += 4 / 3 * np.pi * float(geometry.sphere.radius) ** 3
        else:
            round_one = geometry.cylinder or geometry.capsule
            assert round_one is not None
            radius, length = float(round_one.radius), float(round_one.length)
            total += np.pi * radius**2 * (length + (4 / 3 * radius if geometry.capsule else 0.0))
    return total


def _read(mesh: Mesh, vertices: Vertices | None) -> Array | None:
    """Vertices of a mesh, none where it cannot be read."""
    if vertices is None:
        return None
    try:
        return vertices(mesh)
    except (InputError, KeyError):
        return None  # the conversion says so itself


def _moved(T: ArrayLike, points: Array) -> Array:
    """Points (N, 3) after a transform (4, 4)."""
    T = np.asarray(T, float)
    return points @ T[:3, :3].T + T[:3, 3]


def _say(p: Array) -> str:
    return ", ".join(f"{round(float(v), 4) + 0.0:g}" for v in p)
