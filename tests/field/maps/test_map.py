import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.interpolate import RegularGridInterpolator

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap

FOUR = np.radians([0.0, 90.0, 180.0, 270.0])
SCIPY_NT = 1e-9
"""Two roundings of 8 products of 41,000 nT lie below 1e-10 nT; FACTS' bound on ours is 1e-9 nT."""


def field_map(*, headings=FOUR, shape=(15, 25), seed=0, **more):
    rng = np.random.default_rng(seed)
    values = 41_000 + 3_000 * rng.standard_normal((len(headings), *shape))
    return AnomalyMap(
        values_nt=values, origin_m=(-3.0, -1.75), cell_m=(0.25, 0.25), headings_rad=headings, **more
    )


def poses(field, count, seed=1):
    rng = np.random.default_rng(seed)
    x0, x1, y0, y1 = field.extent
    return rng.uniform((x0, y0), (x1, y1), (count, 2)), rng.uniform(-20, 20, count)


def by_scipy(field, p, yaw):
    """The heading axis closed by a copy of the first layer 360 degrees on, then scipy's interpolator."""
    first = field.headings_rad[0]
    axes = (np.append(field.headings_rad, first + 2 * np.pi), field.y_m, field.x_m)
    values = np.concatenate([field.values_nt, field.values_nt[:1]])
    turned = first + np.mod(yaw - first, 2 * np.pi)
    return RegularGridInterpolator(axes, values)(np.column_stack([turned, p[:, 1], p[:, 0]]))


@pytest.mark.parametrize("degrees", [(0, 90, 180, 270), (15, 100, 110, 300), (0, 180), (0, 45, 350)])
def test_lookup_equals_scipys_interpolator_with_the_heading_axis_closed(degrees):
    field = field_map(headings=np.radians(degrees))
    p, yaw = poses(field, 20_000)  # more than two blocks
    assert_allclose(field.lookup(p, yaw), by_scipy(field, p, yaw), rtol=0, atol=SCIPY_NT)


def test_outside_the_map_gives_nan_the_border_or_a_refusal():
    field = field_map(name="lab")
    p = np.array([[3.2, 0.0], [0.0, -9.0], [1.0, 1.0]])
    assert_array_equal(np.isnan(field.lookup(p, 0.0)), [True, True, False])
    border = field.lookup([[3.0, 0.0], [0.0, -1.75], [1.0, 1.0]], 0.0)
    assert_array_equal(field.lookup(p, 0.0, outside="clamp"), border)
    with pytest.raises(
        InputError, match=r"^2 of 3 points lie off the map 'lab' \(x -3\.\.3, y -1\.75\.\.1\.75"
    ):
        field.lookup(p, 0.0, outside="raise")
    with pytest.raises(InputError, match="outside must be"):
        field.lookup(p, 0.0, outside="zero")


def test_the_border_belongs_to_the_map_and_rounding_does_not_lose_it():
    field = field_map()
    corners = np.array([[-3, -1.75], [3, -1.75], [3, 1.75], [-3, 1.75]])
    assert field.contains(corners).all()
    assert field.contains(corners * (1 + 1e-16)).all()
    assert not field.contains(corners * 1.001).any()
    assert not field.contains([np.nan, 0.0])
    tenths = AnomalyMap(
        values_nt=np.ones((1, 4, 4)), origin_m=(0.0, 0.0), cell_m=(0.1, 0.1), headings_rad=[0.0]
    )
    assert tenths.contains([0.3, 0.3])  # 0.1 * 3 = 0.30000000000000004
    assert tenths.lookup([0.3, 0.3], 0.0) == 1.0


def test_a_masked_node_gives_nan_where_it_has_weight_and_only_there():
    valid = np.ones((4, 15, 25), bool)
    valid[1, 7, 12] = False  # x = 0, y = 0, heading 90
    field = field_map(valid=valid)
    unknown = np.array([[0.0, 0.0], [0.1, 0.1], [-0.2, 0.24]])
    known = np.array([[0.25, 0.0], [0.25, 0.25], [-0.25, -0.1], [0.3, 0.0]])
    assert np.isnan(field.lookup(unknown, np.pi / 2)).all()
    assert np.isnan(field.lookup(unknown, 0.1)).all()
    assert_array_equal(field.lookup(unknown, 0.0), field_map().lookup(unknown, 0.0))
    assert np.isnan(field.lookup(unknown, np.pi - 1e-3)).all()
    assert np.isfinite(field.lookup(known, np.pi / 2)).all()
    assert field.contains(unknown).all()


def test_masked_nodes_may_hold_anything():
    values = np.full((1, 3, 3), 40_000.0)
    values[0, 0, 0] = np.nan
    field = AnomalyMap(
        values_nt=values,
        origin_m=(0.0, 0.0),
        cell_m=(1.0, 1.0),
        headings_rad=[0.0],
        valid=np.isfinite(values),
    )
    assert field.lookup((1.5, 1.5), 0.0) == 40_000
    assert field == field


def test_maps_are_equal_when_every_field_is():
    field = field_map(variance_nt2=np.ones((4, 15, 25)), name="lab")
    assert field == field_map(variance_nt2=np.ones((4, 15, 25)), name="lab")
    assert field != field_map(name="lab")
    assert field != field_map(variance_nt2=np.ones((4, 15, 25)), name="hall")
    assert field != field_map(seed=1, variance_nt2=np.ones((4, 15, 25)), name="lab")
    assert field != "lab"


def test_a_map_keeps_its_own_arrays_and_nobody_writes_to_them():
    values = np.full((1, 3, 3), 40_000.0)
    field = AnomalyMap(values_nt=values, origin_m=(0.0, 0.0), cell_m=(1.0, 1.0), headings_rad=[0.0])
    values[:] = 0
    assert field.lookup((1.0, 1.0), 0.0) == 40_000
    with pytest.raises(ValueError, match="read-only"):
        field.values_nt[0, 0, 0] = 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"values_nt": np.ones((3, 3))}, r"shape \(H, Y, X\).*got \(3, 3\)"),
        ({"values_nt": np.ones((1, 1, 3))}, "2 x 2 nodes"),
        ({"headings_rad": [0.0, 1.0]}, r"headings_rad of AnomalyMap must have shape \(1,\), got \(2,\)"),
        ({"headings_rad": [7.0]}, r"ascend in \[0, 2 pi\), got \[7.0\]"),
        ({"headings_rad": [-0.1]}, "ascend"),
        ({"cell_m": (0.25, 0.0)}, "cell_m of AnomalyMap must be two lengths above 0"),
        ({"origin_m": (0.0, np.nan)}, "origin_m of AnomalyMap must be two lengths"),
        ({"origin_m": (1e300, 0.0)}, r"origin_m of AnomalyMap must be from -1e\+08 to 1e\+08 m"),
        ({"cell_m": (1e300, 1.0)}, r"cell_m of AnomalyMap must be from 1e-06 to 1e\+08 m"),
        ({"cell_m": (1e-300, 1e-300)}, "cell_m of AnomalyMap must be from 1e-06"),
        ({"valid": np.ones((1, 3, 4), bool)}, "valid of AnomalyMap must have shape"),
        ({"variance_nt2": -np.ones((1, 3, 3))}, "variance_nt2 of AnomalyMap must not be below 0"),
        ({"variance_nt2": np.full((1, 3, 3), np.inf)}, "variance_nt2 of AnomalyMap must not be .* infinite"),
        ({"values_nt": np.full((1, 3, 3), np.nan)}, "finite at valid nodes.*heading 0, row 0, column 0"),
    ],
)
def test_a_map_is_checked_at_birth(change, message):
    good = {
        "values_nt": np.full((1, 3, 3), 4e4),
        "origin_m": (0.0, 0.0),
        "cell_m": (1.0, 1.0),
        "headings_rad": [0.0],
    }
    AnomalyMap(**good)
    with pytest.raises(InputError, match=message):
        AnomalyMap(**{**good, **change})


def test_the_figures_of_a_known_field_are_its_slope_and_its_heading_wave():
    x, y = np.meshgrid(np.arange(6) * 0.25, np.arange(5) * 0.25)
    wave = 300 * np.cos(FOUR) - 400 * np.sin(FOUR) + 70 * np.cos(2 * FOUR)
    values = 41_000 + 3_000 * x + 4_000 * y + wave[:, None, None]
    valid = np.ones(values.shape, bool)
    valid[2, 4, 5] = False
    values[2, 4, 5] = np.nan
    field = AnomalyMap(
        values_nt=values, origin_m=(0.0, 0.0), cell_m=(0.25, 0.25), headings_rad=FOUR, valid=valid
    )
    got = {f.name: f.value for f in field.report().figures}
    assert got["masked nodes"] == 1
    for name in ("median gradient", "mean gradient", "greatest gradient"):
        assert got[name] == pytest.approx(5, abs=1e-3)
    assert got["heading amplitude"] == pytest.approx(500, abs=0.1)
    assert got["greatest"] == pytest.approx(np.nanmax(values), abs=0.1)
