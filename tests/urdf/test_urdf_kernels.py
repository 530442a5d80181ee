"""Numpy in place of a library that takes longer to import: it agrees with the library."""

import numpy as np
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial import ConvexHull

from magtwin.urdf.meshes.collider import hull_faces
from magtwin.urdf.meshes.mesh import distinct
from magtwin.urdf.physics.inertia import is_closed
from magtwin.usd.solids import capsule

SEEDS = st.integers(0, 2**32 - 1)


def cloud(rng, kind):
    """Points: a cloud, a lattice with planes of many points, a flat cloud, or a sphere; shape (N, 3)."""
    points = rng.normal(size=(rng.integers(4, 80), 3)) * rng.uniform(0.1, 1, 3)
    if kind == 1:
        return np.round(2 * points)
    if kind == 2:
        points[:, 2] = 0.25
    if kind == 3:
        points /= np.linalg.norm(points, axis=1, keepdims=True)
    return points


@settings(max_examples=40, deadline=None)
@given(seed=SEEDS, kind=st.sampled_from([0, 1, 3]))
def test_a_hull_is_scipys(seed, kind):
    points = cloud(np.random.default_rng(seed), kind)
    points = points[distinct(points)[0]].astype(np.float32).astype(float)
    faces = hull_faces(points)
    if np.linalg.matrix_rank(points - points.mean(axis=0), tol=1e-6) < 3:
        assert faces is None
        return
    peer = ConvexHull(points)
    a, b, c = (points[faces[:, i]] for i in range(3))
    assert_allclose(np.sum(a * np.cross(b, c)) / 6, peer.volume, rtol=1e-6)
    outwards = np.cross(b - a, c - a)
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    assert ((points @ outwards.T - np.sum(a * outwards, axis=1)) < 1e-6).all()
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()  # closed


def test_a_plane_has_no_hull():
    assert hull_faces(cloud(np.random.default_rng(0), 2)) is None


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), fault=st.sampled_from(["none", "apart", "hole", "turned", "twice"]))
def test_a_mesh_is_closed_where_trimesh_finds_a_volume(seed, fault):
    points, faces = capsule(0.1, 0.3)
    some = int(np.random.default_rng(seed).integers(len(faces)))
    if fault == "apart":  # corners of their own for each triangle
        points, faces = points[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)
    elif fault == "hole":
        faces = np.delete(faces, some, axis=0)
    elif fault == "turned":
        faces = np.vstack([np.delete(faces, some, axis=0), faces[some, ::-1]])
    elif fault == "twice":
        faces = np.vstack([faces, faces[some]])
    peer = trimesh.Trimesh(points, faces)
    assert is_closed(points, faces) == (peer.is_watertight and peer.is_winding_consistent)
    assert is_closed(points, faces) == (fault in ("none", "apart"))
