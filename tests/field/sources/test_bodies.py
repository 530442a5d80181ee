"""Magnetised bodies: magpylib beside them, the laws of their field, and what the Earth makes of them."""

from dataclasses import replace

import magpylib
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.field.sources import bodies
from magtwin.field.sources.bodies import (
    MU_0,
    TOLERANCE,
    Bodies,
    Body,
    demagnetising,
    induced_magnetization,
)
from magtwin.field.sources.dipoles import dipole_field_nt
from magtwin.frames import quat_from_rpy, rotate

CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float) / 2
QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
SIDES = np.array([t for a, b, c, d in QUADS for t in ((a, b, c), (a, c, d))])
TURN = quat_from_rpy([0.3, -0.7, 1.9])
PLACE = np.array([1.0, -2.0, 0.5])


def body(shape="cuboid", size=(0.3, 0.2, 0.5), magnetization=(1e3, -2e3, 3e3), **given):
    parts = {"p_world": PLACE, "q_world_xyzw": TURN, **given}
    return Body(
        shape=shape, size_m=np.array(size, float), magnetization=np.array(magnetization, float), **parts
    )


def box_mesh(size=(0.3, 0.2, 0.5), **given):
    vertices = CUBE * size
    return body("mesh", size, vertices=vertices, faces=SIDES, **given)


ROUND = (0.3, 0.3, 0.5)
KINDS = {
    "cuboid": body(),
    "cylinder": body("cylinder", ROUND),
    "sphere": body("sphere", (0.3,) * 3),
    "mesh": box_mesh(),
}
every_kind = pytest.mark.parametrize("kind", KINDS)


def about(thing: Body, distance: float, count: int = 200, seed: int = 0):
    """Points at a distance from the box of a body: beside its faces, edges and corners."""
    rng = np.random.default_rng(seed)
    half = thing.size_m / 2
    p, away = rng.uniform(-half, half, (count, 3)), rng.normal(size=(count, 3))
    beyond = rng.integers(1, 8, count)[:, None] >> np.arange(3) & 1 == 1
    p = np.where(beyond, np.sign(away) * half, p)
    away = np.where(beyond, away, 0)
    p = p + distance * away / np.linalg.norm(away, axis=1, keepdims=True) + thing.middle
    return p @ thing.rotation.T + thing.p_world


def peer(thing: Body, p):
    """What magpylib says of a body, placed by itself."""
    from scipy.spatial.transform import Rotation

    same = {
        "polarization": MU_0 * thing.magnetization,
        "position": thing.p_world,
        "orientation": Rotation.from_quat(thing.q_world_xyzw),
    }
    magnet = {
        "cuboid": lambda: magpylib.magnet.Cuboid(dimension=thing.size_m, **same),
        "cylinder": lambda: magpylib.magnet.Cylinder(dimension=thing.size_m[[0, 2]], **same),
        "sphere": lambda: magpylib.magnet.Sphere(diameter=thing.size_m[0], **same),
        "mesh": lambda: magpylib.magnet.TriangularMesh(vertices=thing.vertices, faces=thing.faces, **same),
    }[thing.shape]()
    return magnet.getB(p) * 1e9


# Near and far


@every_kind
@pytest.mark.parametrize("part", [0.03, 0.3, 0.99])
def test_near_a_body_its_field_is_magpylibs_to_1e_9(kind, part):
    p = about(KINDS[kind], part * (bodies._Cut(KINDS[kind]).near or 0.1))
    want = peer(KINDS[kind], p)
    got = Bodies([KINDS[kind]]).field_nt(p)
    assert np.abs(got - want).max() < 1e-9 * np.linalg.norm(want, axis=1).max()


@settings(deadline=None, max_examples=60)
@given(
    shape=st.sampled_from(["cuboid", "cylinder"]),
    size=st.tuples(*[st.floats(-2.5, 0.3)] * 3).map(lambda e: 10 ** np.array(e)),
    like=st.sampled_from(["none", "rod", "cube"]),
    rungs=st.integers(0, 14),
    seed=st.integers(0, 99),
)
def test_the_dipoles_that_stand_for_a_body_err_by_less_than_is_stated(shape, size, like, rungs, seed):
    if shape == "cylinder" or like == "rod":
        size[1] = size[0]
    if like == "cube":
        size[:] = size[0]
    direction = np.random.default_rng(seed).normal(size=3)
    thing = body(shape, size, 1e3 * direction, p_world=np.zeros(3), q_world_xyzw=np.array([0, 0, 0, 1.0]))
    cut = bodies._Cut(thing)
    distance = cut.near * bodies.LADDER**rungs
    p = about(thing, distance, 100, seed)
    moment = thing.volume_m3 * thing.magnetization

    def field(places, shares):
        return dipole_field_nt(p, places, shares[:, None] * moment)

    # a rule of 1e-9: magpylib's cylinder loses digits with the cube of the distance
    kept = bodies.TOLERANCE, bodies.FOURTH
    bodies.TOLERANCE, bodies.FOURTH = 1e-9, 1e9
    try:
        exact = field(*bodies._dipoles_of(thing, distance))
    finally:
        bodies.TOLERANCE, bodies.FOURTH = kept
    off = np.linalg.norm(field(*bodies._dipoles_of(thing, distance)) - exact, axis=1).max()
    assert off < 2 * TOLERANCE * np.linalg.norm(exact, axis=1).max()


@pytest.mark.parametrize("sizes", [1.0, 3.0, 10.0])
def test_that_fine_rule_is_magpylibs_field_where_magpylib_has_its_digits(sizes, monkeypatch):
    thing = body("cuboid", (0.02, 0.3, 0.7))
    monkeypatch.setattr(bodies, "TOLERANCE", 1e-9)
    monkeypatch.setattr(bodies, "FOURTH", 1e9)
    p = about(thing, 0.7 * sizes)
    places, shares = bodies._dipoles_of(thing, 0.7 * sizes)
    moments = shares[:, None] * thing.volume_m3 * (thing.rotation @ thing.magnetization)
    got = dipole_field_nt(p, thing.p_world + places @ thing.rotation.T, moments)
    want = peer(thing, p)
    assert np.abs(got - want).max() < 3e-8 * np.linalg.norm(want, axis=1).max()


def test_a_mesh_beyond_three_sizes_is_four_dipoles_within_two_in_a_thousand():
    rng = np.random.default_rng(5)
    from scipy.spatial import ConvexHull

    for _ in range(5):
        points = rng.normal(size=(15, 3)) * rng.uniform(0.03, 0.3, 3)
        hull = ConvexHull(points)
        faces = np.array(
            [
                f if np.dot(np.cross(*(points[f[1:]] - points[f[0]])), n[:3]) > 0 else f[::-1]
                for f, n in zip(hull.simplices, hull.equations, strict=True)
            ]
        )
        used, index = np.unique(faces, return_inverse=True)
        thing = body("mesh", np.ptp(points, axis=0), vertices=points[used], faces=index.reshape(-1, 3))
        p = about(thing, 3.001 * thing.size_m.max() + bodies.CELL_M)
        want = thing.exact_field_nt(p)
        off = np.linalg.norm(Bodies([thing]).field_nt(p) - want, axis=1).max()
        assert 0 < off < 2e-3 * np.linalg.norm(want, axis=1).max()


def test_a_sphere_is_its_dipole_outside_and_two_thirds_of_its_magnetization_within():
    ball = KINDS["sphere"]
    p = about(ball, 0.001)
    moment = ball.volume_m3 * rotate(TURN, ball.magnetization)
    assert_allclose(Bodies([ball]).field_nt(p), dipole_field_nt(p, [PLACE], [moment]), rtol=1e-9, atol=1e-6)
    within = Bodies([ball]).field_nt(PLACE + np.array([0.01, 0.02, -0.03]))
    assert_allclose(within, 1e9 * 2 / 3 * MU_0 * rotate(TURN, ball.magnetization), rtol=1e-9)


def test_bodies_add_and_turn_with_their_magnetization():
    things = list(KINDS.values())
    p = np.random.default_rng(3).uniform(-3, 3, (100, 3))
    parts = sum(Bodies([thing]).field_nt(p) for thing in things)
    assert_allclose(Bodies(things).field_nt(p), parts, rtol=1e-9, atol=1e-9)
    turned = [replace(thing, magnetization=-thing.magnetization) for thing in things]
    assert_allclose(Bodies(turned).field_nt(p), -parts, rtol=1e-9, atol=1e-9)
    assert_array_equal(Bodies([replace(things[0], magnetization=np.zeros(3))]).field_nt(p), 0 * p)


# Laws


def slopes(some: Bodies, p, step):
    """dB_j / dp_i by central differences of fourth order [nT/m], shape (N, i, j)."""
    move = step * np.eye(3)[:, None, :]
    near = some.field_nt(p + move) - some.field_nt(p - move)
    far = some.field_nt(p + 2 * move) - some.field_nt(p - 2 * move)
    return np.moveaxis((8 * near - far) / (12 * step), 0, 1)


@every_kind
@pytest.mark.parametrize("distance", [0.05, 3.1])
def test_the_rate_at_a_moving_point_is_the_gradient_along_its_velocity(kind, distance):
    p = np.floor(about(KINDS[kind], distance) / bodies.CELL_M) * bodies.CELL_M + bodies.CELL_M / 2
    p = p[KINDS[kind].clearance(p) > 0.03]
    v = np.random.default_rng(3).normal(size=p.shape)
    v[0] = 0
    some = Bodies([KINDS[kind]])
    field, rate = some.field_and_rate_nt(p, v)
    assert_array_equal(field, some.field_nt(p))
    want = np.einsum("ni,nij->nj", v, slopes(some, p, 1e-3))
    assert_allclose(rate, want, rtol=0, atol=3e-6 * np.abs(want).max())
    assert_array_equal(rate[0], 0)


# In the Earth's field


def test_demagnetising_factors_sum_to_one_and_are_those_of_the_tables():
    assert_allclose(np.diag(demagnetising(body(size=(2, 2, 2)))), 1 / 3, rtol=1e-9)
    # Aharoni 1998: a square bar twice as long as wide has 0.1983 along it
    assert demagnetising(body(size=(1, 1, 2)))[2, 2] == pytest.approx(0.1983, abs=1e-4)
    assert demagnetising(body(size=(1, 1, 1e-3)))[2, 2] == pytest.approx(1, abs=0.01)
    # Chen, Brug and Goldfarb 1991: a cylinder as long as wide has 0.3116 along it
    round_one = demagnetising(body("cylinder", (1, 1, 1)))
    assert round_one[2, 2] == pytest.approx(0.3116, rel=0.02)
    for thing in KINDS.values():
        assert np.trace(demagnetising(thing)) == pytest.approx(1, rel=1e-9)
    assert_allclose(demagnetising(box_mesh()), demagnetising(body()), atol=1e-9)


def test_a_sphere_in_the_earths_field_is_magnetised_as_the_closed_form_says():
    b = np.array([-2_745.6, 24_067.1, -38_418.4])
    got = rotate(TURN, induced_magnetization(KINDS["sphere"], 1e6, b))
    assert_allclose(got, 3 * b * 1e-9 / MU_0, rtol=1e-5)  # 3 H for a sphere of great susceptibility
    weak = rotate(TURN, induced_magnetization(KINDS["mesh"], 1e-6, b))
    assert_allclose(weak, 1e-6 * b * 1e-9 / MU_0, rtol=1e-5)


# Meshes
