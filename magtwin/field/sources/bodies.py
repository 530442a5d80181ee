"""Magnetised bodies: boxes, cylinders, spheres, closed meshes; near, far, and in the Earth's field."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import compress
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.field.sources.dipoles import MU_0_OVER_4_PI, NT_PER_T, dipole_block, in_blocks, in_two_threads
from magtwin.field.sources.moments import mesh_moments
from magtwin.frames import matrix_from_quat

Array = NDArray[np.float64]
Triangles = NDArray[np.intp]
Rows = NDArray[np.intp]

MU_0 = 4 * math.pi * MU_0_OVER_4_PI  # Magnetic constant [T m/A]
# Target error of the dipoles that replace a box or a cylinder, relative to its largest field at that distance
# from its box. One in a hundred random bodies exceeds it, none reaches twice as much.
TOLERANCE = 1e-4
# That of walls and doors of solid steel, boxes at least so thick [m], and this many times as wide as thick:
# strong, and passed at arm's length. They stay within 0.01 nT.
PLATE_TOLERANCE, PLATE_M, PLATE_WIDE = 1e-6, 0.01, 4.0
# Distance up to which a mesh's field is exact, in its longest side; beyond, four dipoles replace it, within
# 0.2 % for nearly convex meshes
MESH_SIZES = 3.0
# Most dipoles that replace a box or a cylinder; nearer than they suffice, its field is exact
MOST_DIPOLES, MOST_OF_A_PLATE = 512, 128
# Ratio of the distances at which a body gets a new set of dipoles, and their number: up to 45,000 times as
# far
LADDER, RUNGS = 1.25, 48
CELL_M = 0.25  # Side of the cells of space that share one set of dipoles [m]
FARTHEST_CELL = 1 << 19  # Cells beyond this one, 130 km from the origin, use its dipoles
# Step of the differences for the rate of change near a body [m]. 1 cm from an edge of a box the error is
# (1e-5 / 1e-2)^2 / 6, 2e-7 of it.
STEP_M = 1e-5


@dataclass(frozen=True, kw_only=True, eq=False)
class Body:
    """A uniformly magnetised body in world."""

    shape: str  # One of `magtwin.spec.magnetics.SHAPES`
    size_m: Array  # Sides of its bounding box along its own axes [m], shape (3,); a cylinder's axis is z
    p_world: Array  # Origin of its own axes [m], shape (3,): the centre, except for a mesh
    q_world_xyzw: Array  # Rotation of its axes in world, shape (4,)
    magnetization: Array  # Magnetization in its own axes [A/m], shape (3,)
    vertices: Array | None = None  # Vertices of a mesh in its own axes [m], shape (V, 3)
    # Vertices of its triangles, counter-clockwise seen from outside, shape (F, 3)
    faces: Triangles | None = None

    @property
    def volume_m3(self) -> float:
        """Volume [m3]."""
        if self.vertices is not None and self.faces is not None:
            return mesh_moments(self.vertices, self.faces)[0]
        share = {"cuboid": 1, "cylinder": np.pi / 4, "sphere": np.pi / 6}[self.shape]
        return float(np.prod(self.size_m)) * share

    @property
    def is_plate(self) -> bool:
        """Whether it is a box like a wall or a door of solid steel."""
        thin, wide, _ = np.sort(self.size_m)
        return self.shape == "cuboid" and bool(thin >= PLATE_M and wide >= PLATE_WIDE * thin)

    @property
    def tolerance(self) -> float:
        """Target error of the dipoles that replace it, see `TOLERANCE`."""
        return PLATE_TOLERANCE if self.is_plate else TOLERANCE

    @cached_property
    def rotation(self) -> Array:
        """Matrix from its axes to world, shape (3, 3)."""
        return matrix_from_quat(self.q_world_xyzw)

    @cached_property
    def middle(self) -> Array:
        """Centre of its bounding box in its own axes [m], shape (3,)."""
        if self.vertices is None:
            return np.zeros(3)
        return np.asarray((self.vertices.min(axis=0) + self.vertices.max(axis=0)) / 2)

    def exact_field_nt(self, p_world: ArrayLike) -> Array:
        """Its exact field, also inside, by magpylib (Ortner and Coliado Bandeira 2020).

        Points [m] and field in world axes [nT] have shape (N, 3).
        """
        import magpylib  # its scipy takes 0.3 s

        p = (np.asarray(p_world, float) - self.p_world) @ self.rotation
        polarization, magnet, size = MU_0 * self.magnetization, magpylib.magnet, self.size_m
        body: Any
        if self.shape == "cuboid":
            body = magnet.Cuboid(dimension=size, polarization=polarization)
        elif self.shape == "cylinder":
            body = magnet.Cylinder(dimension=size[[0, 2]], polarization=polarization)
        elif self.shape == "sphere":
            body = magnet.Sphere(diameter=size[0], polarization=polarization)
        else:
            body = magnet.TriangularMesh(
                vertices=self.vertices,
                faces=self.faces,
                polarization=polarization,
                check_open="ignore",  # spec.mesh.check_mesh did
                check_disconnected="ignore",
                check_selfintersecting="skip",
                reorient_faces="skip",
            )
        return np.asarray(NT_PER_T * body.getB(p).reshape(p.shape) @ self.rotation.T)

    def clearance(self, p_world: Array) -> Array:
        """Distance of points from its bounding box [m], 0 inside, shape (N, 3) -> (N,)."""
        beyond = np.abs((p_world - self.p_world) @ self.rotation - self.middle) - self.size_m / 2
        return np.asarray(np.sqrt(np.square(np.maximum(beyond, 0)).sum(axis=1)))


# Bodies in the Earth's field


def induced_magnetization(body: Body, susceptibility: float, b_world_nt: ArrayLike) -> Array:
    """Magnetization that the Earth's field induces in a body.

    M = chi (1 + chi N)^-1 H, H = B / mu_0, with N the demagnetising tensor of the shape. This is exact for a
    sphere. For a box N is the mean over its volume (Aharoni 1998, J. Appl. Phys. 83, 3432), for a cylinder
    Sato and Ishii's fit of it (1989, J. Appl. Phys. 66, 983), for a mesh that of the box with its second
    moments. The fields of other bodies are neglected.

    The body's magnetization is ignored. The Earth's field is in world axes [nT], the result in the body's
    [A/m].
    """
    h = np.asarray(b_world_nt, float) @ body.rotation / (NT_PER_T * MU_0)
    return np.asarray(susceptibility * np.linalg.solve(np.eye(3) + susceptibility * demagnetising(body), h))


def demagnetising(body: Body) -> Array:
    """Demagnetising tensor of a body in its own axes [1], of trace 1, shape (3, 3)."""
    if body.shape == "sphere":
        return np.eye(3) / 3
    if body.shape == "cylinder":
        slender = body.size_m[2] / body.size_m[0]
        along = 1 / (4 * slender / math.sqrt(math.pi) + 1)
        return np.diag([(1 - along) / 2, (1 - along) / 2, along])
    if body.vertices is None or body.faces is None:
        return np.diag(_of_a_box(body.size_m))
    second, axes = np.linalg.eigh(mesh_moments(body.vertices, body.faces)[2])
    return np.asarray(axes @ np.diag(_of_a_box(np.sqrt(12 * second))) @ axes.T)


def _of_a_box(size: Array) -> Array:
    """Demagnetising factors of a box from its sides (Aharoni 1998, eq. 1), shape (3,) -> (3,)."""
    along = np.array([_along_c(*np.roll(size, -k - 1)) for k in range(3)])
    return along / along.sum()  # the factors sum to 1 but for rounding, which thin plates magnify


def _along_c(a: float, b: float, c: float) -> float:
    """Demagnetising factor along side c of a box with sides a, b, c."""
    a, b, c = (float(side) / max(a, b, c) for side in (a, b, c))
    ab, bc, ca, abc = math.hypot(a, b), math.hypot(b, c), math.hypot(a, c), math.hypot(a, b, c)
    total = (b * b - c * c) / (2 * b * c) * math.log((abc - a) / (abc + a))
    total += (a * a - c * c) / (2 * a * c) * math.log((abc - b) / (abc + b))
    total += b / (2 * c) * math.log((ab + a) / (ab - a)) + a / (2 * c) * math.log((ab + b) / (ab - b))
    total += c / (2 * a) * math.log((bc - b) / (bc + b)) + c / (2 * b) * math.log((ca - a) / (ca + a))
    total += 2 * math.atan2(a * b, c * abc) + (a**3 + b**3 - 2 * c**3) / (3 * a * b * c)
    total += (a * a + b * b - 2 * c * c) / (3 * a * b * c) * abc
    total += c / (a * b) * (ca + bc) - (ab**3 + bc**3 + ca**3) / (3 * a * b * c)
    return total / math.pi


# Bodies seen as dipoles


@cache
def _gauss(count: int) -> tuple[Array, Array, Array]:
    """Gauss-Legendre nodes in -1..1, weights of sum 1, and weights that give (f'(1) - f'(-1)) / 2.

    The latter are slopes of the polynomial through the nodes, sum_k (2k + 1) / 2 <f, P_k> P_k.
    """
    nodes, weights = np.polynomial.legendre.leggauss(count)
    even = np.arange(0, count, 2)
    rises = np.zeros(count)
    rises[even] = (2 * even + 1) / 2 * even * (even + 1) / 2  # P_k'(1) = k (k + 1) / 2
    return nodes, weights / 2, weights * np.polynomial.legendre.legval(nodes, rises)


def _count(half: float, distance: float, tolerance: float) -> int:
    """Nodes that a rule over -half..half needs for a field point at distance `distance` aside.

    One is enough if the neglected second moment is small. The error of n nodes falls as rho^-2n, with rho = d
    / a + sqrt(1 + (d / a)^2) the Bernstein ellipse through the nearest singularity (Trefethen 2013,
    Approximation Theory and Practice, theorem 19.3), and grows as n^3/2, since a dipole's field is steep.
    """
    if SECOND * (half / distance) ** 2 <= tolerance:
        return 1
    count, rate = 2, 2 * math.asinh(distance / half)
    while AMPLIFIED * (2 * count) ** 1.5 * math.exp(-rate * count) > tolerance:
        count += 1
    return count


# Bounds of the errors over (a / d)^2, (2 n)^3/2 rho^-2n and (b / d)^4, above the measured ones; a test checks
# them
SECOND, AMPLIFIED, FOURTH = 4.0, 60.0, 80.0


def _line(half: float, thin: float, distance: float, tolerance: float) -> tuple[Array, Array]:
    """Nodes and weights for the mean of f - thin^2 / 6 f'' over -half..half."""
    count = _count(math.sqrt(max(half**2 - thin**2, 0.0)), distance, tolerance)
    nodes, weights, slopes = _gauss(count)
    if count == 2:
        return math.sqrt((half**2 - thin**2) / 3) * np.array([-1.0, 1.0]), weights
    return half * nodes, weights - thin**2 / (6 * half**2) * slopes


def _dipoles_of(body: Body, distance: float) -> tuple[Array, Array]:
    """Positions in the body's axes (K, 3) and shares (K,) of dipoles that replace it from `distance` on.

    The field's Laplacian is 0, so the second derivative across the thinnest side, c, is minus the sum of
    those along the others. These take over its mean, c^2 / 6 times it, and one node is enough across. A cube
    is one dipole, a rod a row, a plate a sheet, all correct to fourth order in c.
    """
    half, tolerance = body.size_m / 2, body.tolerance
    if body.shape == "sphere":  # exactly a dipole
        return np.zeros((1, 3)), np.ones(1)
    if body.shape == "cylinder":
        return _of_a_cylinder(half[0], half[2], distance, tolerance)
    if body.vertices is not None and body.faces is not None:  # two on each of the two longer principal axes
        _, centroid, second = mesh_moments(body.vertices, body.faces)
        spread, axes = np.linalg.eigh(second)
        arms = [math.sqrt(2 * max(spread[k] - spread[0], 0.0)) * axes[:, k] for k in (1, 2)]
        return centroid + np.array([sign * arm for arm in arms for sign in (-1, 1)]), np.full(4, 0.25)
    thin = float(half.min()) if _is_thin(half.min(), distance, tolerance) else 0.0
    rules = [_line(h, thin, distance, tolerance) for h in half]
    nodes = np.stack(np.meshgrid(*[x for x, _ in rules], indexing="ij"), -1)
    shares = np.einsum("i,j,k->ijk", *[w for _, w in rules])
    return nodes.reshape(-1, 3), shares.ravel()


def _how_many(body: Body, distance: float) -> int:
    """Number of dipoles from `_dipoles_of` for a box or a cylinder, or slightly more."""
    sides, tolerance = body.size_m / 2, body.tolerance
    counts = [_count(half, distance, tolerance) for half in sides]
    if body.shape == "cylinder":
        rings = 1 if _is_thin(sides[0], distance, tolerance) else counts[0]
        return counts[2] * (1 if rings == 1 else rings * (2 * rings + 2))
    if _is_thin(sides.min(), distance, tolerance):
        counts[int(sides.argmin())] = 1
    return math.prod(counts)


def _is_thin(half: float, distance: float, tolerance: float) -> bool:
    """Whether one node is enough across a side, with its second moment moved to the others."""
    return FOURTH * (half / distance) ** 4 <= tolerance


def _of_a_cylinder(radius: float, half: float, distance: float, tolerance: float) -> tuple[Array, Array]:
    """A rule along the axis, times one in the squared radius with evenly spaced angles."""
    disc, part = np.zeros((1, 2)), np.ones(1)
    if (
        _is_thin(radius, distance, tolerance) and half > radius
    ):  # second moments are half^2 / 3 and radius^2 / 4
        along, share = _line(half, math.sqrt(0.75) * radius, distance, tolerance)
    else:
        along, share = _line(half, 0.0, distance, tolerance)
        if (rings := _count(radius, distance, tolerance)) > 1:
            square, weight, _ = _gauss(rings)
            spokes = 2 * rings + 2
            angle = 2 * np.pi * np.arange(spokes) / spokes
            r = radius * np.sqrt((1 + square) / 2)
            disc = (r[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], -1)).reshape(-1, 2)
            part = np.repeat(weight / spokes, spokes)
    places = np.column_stack([np.tile(disc, (len(along), 1)), np.repeat(along, len(disc))])
    return places, np.outer(share, part).ravel()


class _Cut:
    """A body and the dipoles that replace it, finer at shorter distances."""

    def __init__(self, body: Body) -> None:
        self.body = body
        self._moment = body.volume_m3 * body.rotation @ body.magnetization
        self._sets: dict[int, tuple[Array, Array]] = {}
        self.near = 0.0  # a sphere's dipole is exact outside of it
        if body.shape == "mesh":
            self.near = MESH_SIZES * float(body.size_m.max())
        elif body.shape != "sphere":
            distance = float(body.size_m.max()) * LADDER**16
            most = MOST_OF_A_PLATE if body.is_plate else MOST_DIPOLES
            while _how_many(body, distance) <= most:
                self.near, distance = distance, distance / LADDER

    def dipoles(self, rung: int) -> tuple[Array, Array]:
        """Positions [m] and moments [A m2] in world that replace it from near * LADDER^rung of its box on."""
        if rung not in self._sets:
            places, shares = _dipoles_of(self.body, self.near * LADDER**rung)
            at = self.body.p_world + places @ self.body.rotation.T
            self._sets[rung] = (at, shares[:, None] * self._moment)
        return self._sets[rung]


class Bodies:
    """Magnetised bodies and dipoles, prepared for field computations.

    Near a body its field is exact. Farther away, dipoles replace it, as many as `TOLERANCE` requires at that
    distance, chosen per cell of space. The result at a point depends on its position only, up to rounding.
    """

    def __init__(
        self, bodies: Sequence[Body] = (), p_world_dipole: ArrayLike = (), m_world: ArrayLike = ()
    ) -> None:
        """Take bodies, and dipoles as positions [m] and moments [A m2] in world, each of shape (D, 3)."""
        self.bodies = tuple(bodies)
        self.solid = [body for body in self.bodies if np.any(body.magnetization)]
        """Those that are magnetised."""

        self._cuts = [_Cut(body) for body in self.solid]
        place, moment = (np.asarray(part, float).reshape(-1, 3) for part in (p_world_dipole, m_world))
        self._dipoles = (place, moment)
        self._near = np.array([cut.near for cut in self._cuts])
        self._laddered = np.array([b.shape in ("cuboid", "cylinder") for b in self.solid], bool)
        self._rotation = np.array([b.rotation for b in self.solid]).reshape(-1, 3, 3)
        self._half = np.array([b.size_m / 2 for b in self.solid]).reshape(-1, 3)
        self._middle = np.array([b.p_world + b.rotation @ b.middle for b in self.solid]).reshape(-1, 3)

    def field_nt(self, p_world: ArrayLike) -> Array:
        """Their field.

        Points [m] and field in world axes [nT] have shape (..., 3); not finite at a dipole or if a point is
        not.
        """
        p = np.asarray(p_world, float)
        if p.ndim == 0 or p.shape[-1] != 3:
            raise InputError(f"p_world must have shape (..., 3), got {p.shape}")
        return self._evaluate(p.reshape(-1, 3), None)[0].reshape(p.shape)

    def field_and_rate_nt(self, p_world: ArrayLike, v_world: ArrayLike) -> tuple[Array, Array]:
        """Their field at moving points, and its rate of change, (v . grad) B.

        The rate is analytic for dipoles; for exact fields it is a difference over 20 um along the motion.

        Points [m], velocities [m/s], field [nT] and rate [nT/s], in world axes, have shape (..., 3).
        """
        p, v = np.asarray(p_world, float), np.asarray(v_world, float)
        if p.ndim == 0 or p.shape[-1] != 3 or v.shape != p.shape:
            raise InputError(f"p_world and v_world must have one shape (..., 3), got {p.shape} and {v.shape}")
        field, rate = self._evaluate(p.reshape(-1, 3), v.reshape(-1, 3))
        return field.reshape(p.shape), rate.reshape(p.shape)

    def _evaluate(self, p: Array, v: Array | None) -> tuple[Array, Array]:
        field, rate = np.zeros(p.shape), np.zeros(p.shape)
        known = np.isfinite(p).all(axis=1)
        field[~known], rate[~known] = np.nan, np.nan
        exact: list[list[Rows]] = [[] for _ in self._cuts]
        works = [self._work(p, rows, centre, exact) for rows, centre in _cells(p, np.flatnonzero(known))]

        def add(work: list[tuple[Rows, Array, Array]]) -> None:
            for rows, places, moments in work:
                for some in in_blocks(len(rows), len(places)):
                    k = rows[some]
                    b, change = dipole_block(p[k], None if v is None else v[k], places, moments)
                    field[k] += b
                    if v is not None:
                        rate[k] += change

        in_two_threads(add, works, pairs=sum(len(r) * len(d) for work in works for r, d, _ in work))
        for cut, parts in zip(self._cuts, exact, strict=True):
            if parts:
                k = np.concatenate(parts)
                field[k] += cut.body.exact_field_nt(p[k])
                if v is not None:  # by central differences along the motion
                    speed = np.sqrt(np.square(v[k]).sum(axis=1, keepdims=True))
                    ahead = STEP_M * np.divide(v[k], speed, out=np.zeros_like(v[k]), where=speed > 0)
                    change = cut.body.exact_field_nt(p[k] + ahead) - cut.body.exact_field_nt(p[k] - ahead)
                    rate[k] += change / (2 * STEP_M) * speed
        return field, rate

    def seen_from(self, centre: Array) -> tuple[Array, Array, list[int]]:
        """What the field in the cell of space about `centre` [m] is made of.

        Returns:
            Places [m] and moments [A m2] in world, each of shape (D, 3), of all dipoles and of those that
            replace the magnetised bodies that are far enough; and the indices of those that are not.
        """
        turned = np.einsum("bij,bi->bj", self._rotation, centre - self._middle)
        beyond = np.maximum(np.abs(turned) - self._half, 0)
        apart = np.sqrt(np.square(beyond).sum(axis=1)) - math.sqrt(0.75) * CELL_M
        far = (apart >= self._near) & (apart > 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            rungs = np.log(apart / self._near) / math.log(LADDER)
        rungs = np.where(self._laddered & far, np.clip(rungs, 0, RUNGS), 0).astype(int)
        rung = zip(compress(self._cuts, far), rungs[far].tolist(), strict=True)
        whole = [*(cut.dipoles(k) for cut, k in rung), self._dipoles]
        places, moments = (np.concatenate(part) for part in zip(*whole, strict=True))
        return places, moments, np.flatnonzero(~far).tolist()

    def _work(
        self, p: Array, rows: Rows, centre: Array, exact: list[list[Rows]]
    ) -> list[tuple[Rows, Array, Array]]:
        """The dipoles to sum for the points of a cell; adds rows near a body to `exact`."""
        places, moments, close = self.seen_from(centre)
        work = []
        for k in close:
            cut = self._cuts[k]
            clearance = cut.body.clearance(p[rows])
            near = clearance < cut.near if cut.near else clearance == 0
            if near.any():
                exact[k].append(rows[near])
            if not near.all():
                work.append((rows[~near], *cut.dipoles(0)))
        return [(rows, places, moments), *work]


def _cells(p: Array, known: Rows) -> Iterator[tuple[Rows, Array]]:
    """The rows of `known` grouped by cell of space, with the cell's centre [m]."""
    cell = np.clip(np.floor(p[known] / CELL_M), -FARTHEST_CELL, FARTHEST_CELL - 1).astype(np.int64)
    x, y, z = (cell + FARTHEST_CELL).T
    key = (x << 40) + (y << 20) + z
    order = np.argsort(key, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(key[order])) + 1):
        if len(rows):
            yield known[rows], CELL_M * (cell[rows[0]] + 0.5)
