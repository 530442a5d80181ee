"""Lookup: numpy, plain Python and compiled code agree to the byte; gradients are how the field changes."""

import copy
import math
import pickle
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from magtwin import compiled
from magtwin.errors import InputError
from magtwin.field.maps import lookup
from magtwin.field.maps.lookup import LOOPS, warm_up
from magtwin.field.maps.map import AnomalyMap

QUARTERS = (0.0, 90.0, 180.0, 270.0)


@pytest.fixture(autouse=True)
def _closed(monkeypatch):
    """Each test begins as a program does, without compiled code."""
    monkeypatch.setattr(LOOPS, "code", None)
    monkeypatch.setattr(LOOPS, "pays", math.inf)


def field_map(*, degrees=QUARTERS, shape=(6, 9), seed=0, masked=0.0, cell=(0.25, 0.1)):
    rng = np.random.default_rng(seed)
    values = 41_000 + 3_000 * rng.standard_normal((len(degrees), *shape))
    valid = rng.random(values.shape) >= masked
    return AnomalyMap(
        values_nt=np.where(valid, values, np.nan),
        valid=valid,
        origin_m=(-1.0, 0.5),
        cell_m=cell,
        headings_rad=np.radians(degrees),
        name="lab",
    )


def poses(field, count, seed=1):
    """Poses in and about the map, among them ones on nodes, on borders, on headings, and none at all."""
    rng = np.random.default_rng(seed)
    x0, x1, y0, y1 = field.extent
    p = rng.uniform((x0 - 0.2, y0 - 0.1), (x1 + 0.2, y1 + 0.1), (count, 2))
    yaw = rng.uniform(-20, 20, count)
    part = rng.integers(0, 4, count)
    p[part == 1] = np.round((p[part == 1] - field.origin_m) / field.cell_m) * field.cell_m + field.origin_m
    yaw[part >= 2] = rng.choice(field.headings_rad, np.count_nonzero(part >= 2))
    odd = [np.nan, np.inf, -np.inf, 1e300, -1e-17, 0.0]
    for n, value in enumerate(odd[: count // 20]):
        p[3 * n, 0], p[3 * n + 1, 1], yaw[3 * n + 2] = value, value, value
    return p, yaw


def by_each_way(field, p, yaw, outside):
    """Field and gradient by numpy, plain Python and compiled code, and the compiled fields alone."""
    in_numpy = field.lookup_with_gradient(p, yaw, outside=outside)
    rows = list(zip(p[:, 0].tolist(), p[:, 1].tolist(), yaw.tolist(), strict=True))
    python = np.array([field.at_with_gradient(*row, outside=outside) for row in rows])
    alone = np.array([field.at(*row, outside=outside) for row in rows])
    warm_up()
    many = field.lookup_with_gradient(p, yaw, outside=outside)
    compiled_alone = np.array([field.at(*row, outside=outside) for row in rows])
    compiled_one = np.array([field.at_with_gradient(*row, outside=outside) for row in rows])
    fields = [in_numpy[0], python[:, 0], alone, many[0], compiled_alone, compiled_one[:, 0]]
    fields.append(field.lookup(p, yaw, outside=outside))
    return fields, [in_numpy[1], python[:, 1:], many[1], compiled_one[:, 1:]]


maps = st.builds(
    field_map,
    degrees=st.sampled_from(
        [QUARTERS, (0.0,), (33.0,), (0.0, 180.0), (15.0, 100.0, 110.0, 300.0), (0.0, 359.0)]
    ),
    shape=st.tuples(st.integers(2, 7), st.integers(2, 7)),
    seed=st.integers(0, 99),
    masked=st.sampled_from([0.0, 0.05, 0.5]),
    cell=st.sampled_from([(0.25, 0.1), (0.1, 0.3), (1 / 3, 1 / 7)]),
)


@given(field=maps, seed=st.integers(0, 99), outside=st.sampled_from(["nan", "clamp"]))
@settings(max_examples=80, deadline=None)
def test_numpy_plain_python_and_compiled_code_give_the_same_bytes(field, seed, outside):
    LOOPS.code = None
    fields, gradients = by_each_way(field, *poses(field, 150, seed), outside)
    for other in fields[1:]:
        assert_array_equal(other, fields[0])
    for other in gradients[1:]:
        assert_array_equal(other, gradients[0])


@pytest.mark.parametrize("masked", [0.0, 0.05])
def test_the_number_of_threads_changes_no_byte(monkeypatch, masked):
    field = field_map(masked=masked)
    p, yaw = poses(field, 20_011)
    warm_up()
    alone = field.lookup_with_gradient(p, yaw)
    monkeypatch.setattr(lookup, "SHARE", 1_000)
    for got, want in zip(field.lookup_with_gradient(p, yaw), alone, strict=True):
        assert_array_equal(got, want)


def test_poses_in_numpy_and_one_by_one_open_the_compiled_code_once_it_pays(monkeypatch):
    monkeypatch.setattr(LOOPS, "pays", 1_000 * compiled.NUMBA_SHARE)
    field = field_map()
    p, yaw = poses(field, 400)
    for count in (0, 400, 800):
        monkeypatch.setattr(LOOPS, "done", count)
        field.lookup(p, yaw)
        assert (LOOPS.code is not None) == (count == 800)
    monkeypatch.setattr(LOOPS, "code", None)
    monkeypatch.setattr(LOOPS, "done", 1_000 - lookup.AS_MANY)
    assert field.at(0.0, 0.7, 1.0) == field.at(0.0, 0.7, 1.0)
    assert LOOPS.code is not None


def test_lookup_loads_no_numba_of_its_own_accord():
    script = (
        "import sys, numpy as np\n"
        "from magtwin.field.maps.map import AnomalyMap\n"
        "field = AnomalyMap(values_nt=np.ones((1, 3, 3)), origin_m=(0, 0), cell_m=(1, 1), headings_rad=[0])\n"
        "field.lookup(np.ones((100_000, 2)), 0.0), field.at(1, 1, 0), field.gradient((1, 1), 0)\n"
        "sys.exit('numba' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", script], check=True)


@given(
    st.floats(-1, 1), st.floats(0.5, 1), st.floats(-7, 7), st.sampled_from([QUARTERS, (15.0, 100.0, 300.0)])
)
@settings(max_examples=60, deadline=None)
def test_within_a_cell_the_gradient_is_the_difference_over_a_small_step(x, y, yaw, degrees):
    field = field_map(degrees=degrees)
    step = 1e-6
    pose = np.array([x, y, yaw])
    difference = []
    for axis in range(3):
        to = step * np.eye(3)[axis]
        pair = [field.at(*(pose + s * to), outside="clamp") for s in (-1, 1)]
        difference.append((pair[1] - pair[0]) / (2 * step))
    got = field.gradient(pose[:2], yaw)
    cells = (pose[:2] - field.origin_m) / field.cell_m
    knots = (yaw - field.headings_rad) / (2 * np.pi)
    near = [abs(c - round(c)) * d < 2 * step for c, d in zip(cells, field.cell_m, strict=True)]
    near.append(bool(np.any(np.abs(knots - np.round(knots)) < 2 * step)))
    for axis in range(3):
        if not near[
            axis
        ]:  # values of 1e5 nT carry 1e-11 nT of rounding: 1e-5 nT over the step, a weight's more
            assert difference[axis] == pytest.approx(got[axis], abs=1e-3)


def test_the_gradient_of_a_plane_is_its_slope_and_of_a_heading_ramp_its_rate():
    x, y = np.meshgrid(np.arange(7) * 0.1 - 0.3, np.arange(5) * 0.2 + 1.0)
    layers = np.stack([40_000 + 300 * x - 200 * y + 50 * h for h in range(4)])
    field = AnomalyMap(
        values_nt=layers, origin_m=(-0.3, 1.0), cell_m=(0.1, 0.2), headings_rad=np.radians(QUARTERS)
    )
    rate = 50 / (np.pi / 2)
    p = [(0.0, 1.1), (-0.3, 1.0), (0.3, 1.8), (0.11, 1.43)]  # inside, and at two corners of the map
    assert_allclose(field.gradient(p, 1.0), [(300, -200, rate)] * 4, rtol=0, atol=1e-7)
    assert_allclose(field.gradient(p, -0.5), [(300, -200, -3 * rate)] * 4, rtol=0, atol=1e-7)


def test_across_the_border_a_clamped_field_does_not_change():
    field = field_map()
    _, x1, y0, _ = field.extent
    beyond, beside = field.gradient([(x1 + 1, 0.7), (0.1, y0 - 1)], 0.3, outside="clamp")
    border = field.gradient([(x1, 0.7), (0.1, y0)], 0.3)
    assert_array_equal(beyond, border[0] * (0, 1, 1))
    assert_array_equal(beside, border[1] * (1, 0, 1))


def test_a_derivative_in_which_a_masked_node_has_a_part_is_nan_and_the_others_are_not():
    valid = np.ones((4, 6, 9), bool)
    valid[1, 2, 3] = False
    field = field_map()
    field = AnomalyMap(
        values_nt=field.values_nt,
        valid=valid,
        origin_m=field.origin_m,
        cell_m=field.cell_m,
        headings_rad=field.headings_rad,
    )
    x, y = float(field.x_m[2]), float(field.y_m[2])  # the node left of the masked one
    nan = np.isnan
    assert nan(field.gradient((x, y), np.pi / 2)).tolist() == [True, False, False]
    assert nan(field.gradient((x, y + 0.05), np.pi / 2)).tolist() == [True, False, False]
    assert nan(field.gradient((float(field.x_m[3]), y + 0.05), 0.0)).tolist() == [False, False, True]
    assert nan(field.gradient((x + 0.1, y), np.pi / 2)).all()
    assert not nan(field.gradient((x - 0.1, y), np.pi / 2)).any()


def test_one_pose_is_refused_outside_as_many_are():
    field = field_map()
    for look in (field.at, field.at_with_gradient):
        with pytest.raises(InputError, match=r"^1 of 1 points lie off the map 'lab'.*\(9\.000, 0\.700\)"):
            look(9.0, 0.7, 0.0, outside="raise")
        with pytest.raises(InputError, match="outside must be"):
            look(0.0, 0.7, 0.0, outside="zero")
    with pytest.raises(InputError, match="outside must be"):
        field.gradient((0.0, 0.7), 0.0, outside="zero")
    assert field.at(0.0, 0.7, 0.0, outside="raise") == field.at(0.0, 0.7, 0.0)
    assert math.isnan(field.at(9.0, 0.7, 0.0))


def test_read_only_strided_and_single_precision_poses_are_looked_up_when_compiled():
    field = field_map()
    p, yaw = poses(field, 300)
    wide = np.concatenate([p, p], axis=1)[:, 1:3][:, ::-1]
    locked = p.copy()
    locked.flags.writeable = False
    odd = np.frombuffer(b"." + yaw.tobytes(), offset=1)  # not aligned
    warm_up()
    want = field.lookup(p, yaw)
    assert_array_equal(field.lookup(wide, odd), want)
    assert_array_equal(field.lookup(locked, yaw), want)
    assert field.lookup(np.zeros((30, 2), np.float32), yaw[:30]).dtype == np.float64


def test_a_map_that_was_looked_up_is_copied_and_pickled_without_what_lookup_keeps():
    field = field_map(masked=0.1)
    p, yaw = poses(field, 300)
    before = len(pickle.dumps(field))
    want = field.lookup(p, yaw)
    for same in (pickle.loads(pickle.dumps(field)), copy.deepcopy(field)):
        assert same == field
        assert_array_equal(same.lookup(p, yaw), want)
    assert len(pickle.dumps(field)) == before


def test_the_sd_is_the_root_of_the_interpolated_variance():
    field = field_map(masked=0.05)
    variance = np.random.default_rng(3).uniform(1, 9, field.values_nt.shape)
    known = replace(field, variance_nt2=variance)
    p, yaw = poses(field, 200)
    mean, sd = known.lookup_with_sd(p.reshape(20, 10, 2), yaw.reshape(20, 10))
    assert mean.shape == sd.shape == (20, 10)
    assert_array_equal(mean.ravel(), field.lookup(p, yaw))
    assert_allclose(sd.ravel() ** 2, replace(field, values_nt=variance).lookup(p, yaw), rtol=1e-12)
    with pytest.raises(InputError, match=r"map 'lab' has no variance; fit one"):
        field.lookup_with_sd(p, yaw)
