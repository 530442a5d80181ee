"""Maps in tiles: bytes of a map in memory, tiles read only where they are touched, damage that is seen."""

import pickle
import shutil
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from pxr import Sdf, Usd, Vt

from magtwin.errors import InputError
from magtwin.field.grid import Grid
from magtwin.field.maps import tiles as tiles_module
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.maps.statistics import map_metadata, statistics
from magtwin.field.maps.tiles import Tile, TiledMap, Tiling
from magtwin.twin import open_twin, simulate
from magtwin.usd import layers
from magtwin.usd.layers import layer_sha256
from magtwin.usd.maps.heat_map import HEAT_MAP, MAP
from magtwin.usd.maps.layer import checksums, load_epochs, load_map, save_map
from magtwin.usd.maps.tiled_layer import check_tiles, save_tiled_map, tile_faults
from magtwin.usd.scene import open_scene, use_map

SHAPE = (5, 41, 57)
CELLS = 8  # 5 x 7 tiles


def a_map(*, holes=True, planes=3, headings=(0.3, 1.0, 1.9, 3.0, 5.5)) -> AnomalyMap:
    rng = np.random.default_rng(3)
    shape = (len(headings), *SHAPE[1:])
    return AnomalyMap(
        values_nt=(45_000 + 2_000 * rng.standard_normal(shape)).astype("f4"),
        valid=rng.random(shape) > 0.03 if holes else None,
        variance_nt2=rng.random(shape).astype("f4") if planes else None,
        between_nt2=rng.random((2, *shape)).astype("f4") if planes == 3 else None,
        origin_m=(-1.3, 0.7),
        cell_m=(0.05, 0.07),
        headings_rad=headings,
        name="hall",
        created="2026-11-21",
        height_m=0.3,
        parameters={"seed": 3},
    )


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """One map in memory, and its file in tiles."""
    folder = tmp_path_factory.mktemp("tiled")
    save_map(a_map(), folder / "flat.usdc")
    save_map(a_map(), folder / "tiled.usdc", tile_cells=CELLS)
    return load_map(folder / "flat.usdc"), folder / "tiled.usdc"


def poses(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Poses on the map, off it, on nodes and on the borders of tiles; and two that are no poses."""
    rng = np.random.default_rng(5)
    p = rng.uniform((-1.6, 0.4), (1.8, 3.9), (n, 2))
    half = n // 2
    p[:half] = np.array([-1.3, 0.7]) + rng.integers(0, (57, 41), (half, 2)) * [0.05, 0.07]
    yaw = rng.uniform(-10, 10, n)
    p[-1], yaw[-2] = np.nan, np.inf
    return p, yaw


@pytest.mark.parametrize("holes", [False, True])
@pytest.mark.parametrize(("planes", "headings"), [(0, (0.0,)), (1, (0.0, np.pi)), (3, (0.3, 1.0, 5.5))])
def test_a_lookup_in_tiles_gives_the_bytes_of_the_map_in_memory(tmp_path, holes, planes, headings):
    field = a_map(holes=holes, planes=planes, headings=headings)
    save_map(field, tmp_path / "tiled.usdc", tile_cells=CELLS)
    tiled = load_map(tmp_path / "tiled.usdc")
    assert isinstance(tiled, TiledMap)
    for n in (7, 3_000):  # in plain Python and in numpy
        for outside in ("nan", "clamp"):
            p, yaw = poses(n)
            for ours, its in zip(
                tiled.lookup_with_gradient(p, yaw, outside=outside),
                field.lookup_with_gradient(p, yaw, outside=outside),
                strict=True,
            ):
                assert ours.tobytes() == its.tobytes()
            if planes:
                for ours, its in zip(tiled.lookup_all(p, yaw), field.lookup_all(p, yaw), strict=True):
                    assert ours.tobytes() == its.tobytes()
    assert tiled.at(0.11, 1.23, 4.0) == field.at(0.11, 1.23, 4.0) or not field.valid.all()
    assert tiled.turns == field.turns == (len(headings) > 1)
    with pytest.raises(InputError, match="lie off the map"):
        tiled.lookup([9.0, 9.0], 0.0, outside="raise")


def test_a_map_without_variance_refuses_a_standard_deviation_in_tiles_too(tmp_path):
    save_map(a_map(planes=0), tmp_path / "m.usdc", tile_cells=CELLS)
    with pytest.raises(InputError, match="has no variance"):
        load_map(tmp_path / "m.usdc").lookup_with_sd([0.0, 1.0], 0.0)


def test_a_run_reads_only_the_tiles_that_it_touches(both):
    field = load_map(both[1])
    assert len(field.tiling) == 35
    assert field.extent == both[0].extent
    assert field.is_constant is False
    assert "37," in repr(field)
    assert field.opened == set()  # so far the map's prim was enough
    x = np.linspace(-1.29, -1.25, 50)
    field.lookup(np.column_stack([x, np.full(50, 0.75)]), 0.0)
    assert field.opened == {0}
    field.lookup([[-1.0, 0.75], [50.0, 50.0]], 0.0)  # a point off the map reads none
    assert field.opened == {0, 0 * 7 + 0, int((0.3 / 0.05) // CELLS)}
    field.lookup([1.49, 3.49], 0.0)
    assert max(field.opened) == 34


def test_few_tiles_stay_in_memory(both, monkeypatch):
    monkeypatch.setattr(tiles_module, "CACHE_BYTES", 1)  # four are kept at least
    field = load_map(both[1])
    field.lookup(*poses(3_000))
    assert len(field._lookup._blocks) == 4
    assert_array_equal(field.lookup(*poses(3_000)), both[0].lookup(*poses(3_000)))


def test_a_tiled_map_is_the_map_in_every_other_respect(both, tmp_path):
    flat, tiled = both[0], load_map(both[1])
    assert tiled == flat
    assert flat == tiled
    assert load_epochs(both[1]) == (flat,)
    changed = replace(tiled, name="another")
    assert type(changed) is AnomalyMap
    assert changed == replace(flat, name="another")
    copy = pickle.loads(pickle.dumps(load_map(both[1])))
    assert copy.opened == set()
    assert_array_equal(copy.lookup(*poses(100)), flat.lookup(*poses(100)))
    save_map(tiled, tmp_path / "again.usdc")
    assert (tmp_path / "again.usdc").read_bytes() == both[1].read_bytes()
    save_map(tiled, tmp_path / "other.usdc", tile_cells=16)
    assert load_map(tmp_path / "other.usdc") == flat
    part = tiled.part((-0.5, 0.5), (1.0, 2.0))
    x, y = (
        np.flatnonzero((a >= lo - 1e-9) & (a <= hi + 1e-9))
        for a, lo, hi in ((flat.x_m, -0.5, 0.5), (flat.y_m, 1, 2))
    )
    assert_array_equal(part.values_nt, flat.values_nt[:, y[0] : y[-1] + 1, x[0] : x[-1] + 1])
    assert part.extent == pytest.approx((flat.x_m[x[0]], flat.x_m[x[-1]], flat.y_m[y[0]], flat.y_m[y[-1]]))


def test_its_statistics_are_those_of_the_map(both):
    flat, tiled = both[0], load_map(both[1])
    for ours, its in zip(map_metadata(tiled).figures, map_metadata(flat).figures, strict=True):
        assert (ours.name, ours.unit) == (its.name, its.unit)
        if "gradient" not in its.name:
            assert (ours.value, ours.spread) == (its.value, its.spread)
    known = np.where(flat.valid, flat.values_nt, np.nan)
    slope = np.hypot(*np.gradient(known, 0.07, 0.05, axis=(1, 2)))
    inside = slope[:, np.arange(41) % CELLS != 0][:, :, np.arange(57) % CELLS != 0]  # not on borders of tiles
    assert_array_equal(np.sort(tiled.sums.slopes_nt_m), np.sort(inside[np.isfinite(inside)]))
    row = statistics(flat, 2)
    assert tiled.sums.mean[2] == pytest.approx(row["mean_nt"], rel=1e-12)
    assert np.sqrt(tiled.sums.square / tiled.sums.count)[2] == pytest.approx(row["sd_nt"], rel=1e-9)


def test_the_coloured_floor_is_that_of_the_map(both):
    stages = [Usd.Stage.Open(str(both[1].with_name(name))) for name in ("flat.usdc", "tiled.usdc")]
    meshes = [stage.GetPrimAtPath(HEAT_MAP) for stage in stages]
    ours, its = ({a.GetName(): a.Get() for a in mesh.GetAttributes()} for mesh in meshes)
    assert len(its["points"]) == 41 * 57
    assert ours == its


def test_a_damaged_tile_is_refused_where_it_is_read_and_found_by_a_check(both, tmp_path):
    file = tmp_path / "damaged.usdc"
    layer = Sdf.Layer.OpenAsAnonymous(str(both[1]))
    attribute = layer.GetAttributeAtPath(f"{MAP}/Tiles/tile_2_3.magtwin:mapTile:valuesNt")
    values = np.array(attribute.default)
    values[7] += 0.01
    attribute.default = Vt.FloatArray.FromNumpy(values)
    del layer.GetPrimAtPath(f"{MAP}/Tiles").nameChildren["tile_4_6"]
    layer.Export(str(file))
    field = load_map(file)
    field.lookup([-1.29, 0.71], 0.0)  # far from it
    with pytest.raises(InputError, match=r"tile_2_3>: the tile's values do not match its checksum; make"):
        field.lookup([0.0, 2.0], 0.0)
    with pytest.raises(InputError, match=r"tile_4_6>: the map's tile is missing"):
        field.lookup([1.49, 3.49], 0.0)
    stage = Usd.Stage.Open(str(file))
    prim = stage.GetPrimAtPath(MAP)
    assert [str(path).rsplit("/", 1)[1] for path, _ in tile_faults(prim)] == ["tile_2_3", "tile_4_6"]
    with pytest.raises(InputError, match="tile_2_3"):
        check_tiles(prim)
    assert all(said == taken for said, taken in checksums(prim))  # the tree itself is sound


@pytest.mark.parametrize(
    ("name", "value"),
    [("originM", (9.0, 9.0)), ("tileCells", 4), ("shape", [5, 57, 41]), ("tileChecksums", ["0" * 64] * 35)],
)
def test_a_changed_grid_or_checksum_is_refused_when_the_map_is_opened(both, name, value):
    stage = Usd.Stage.Open(str(both[1]))
    prim = stage.GetPrimAtPath(MAP)
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        prim.GetAttribute(f"magtwin:anomalyMap:{name}").Set(value)
    from magtwin.usd.maps.layer import read_map

    with pytest.raises(InputError, match="do not match its checksum"):
        read_map(prim)


def test_a_shape_of_one_number_is_refused_though_the_checksum_fits(both, tmp_path):
    stage = Usd.Stage.Open(str(shutil.copy(both[1], tmp_path / "odd.usdc")))
    prim = stage.GetPrimAtPath(MAP)
    prim.GetAttribute("magtwin:anomalyMap:shape").Set(Vt.IntArray([5]))
    prim.GetAttribute("magtwin:anomalyMap:checksum").Set(checksums(prim)[0][1])
    stage.Save()
    with pytest.raises(InputError, match=r"shape \[5\] of 5 headings"):
        load_map(tmp_path / "odd.usdc")


def test_a_file_is_written_from_a_function_and_never_holds_two_kinds_of_tile(both, tmp_path):
    flat = both[0]
    grid = Grid(
        origin_m=flat.origin_m, cell_m=flat.cell_m, headings_rad=tuple(flat.headings_rad), rows=41, columns=57
    )

    def field_of(rows, columns):
        at = (..., rows, columns)
        return Tile(
            flat.values_nt[at].astype("f4"),
            flat.valid[at],
            flat.variance_nt2[at].astype("f4"),
            flat.between_nt2[at].astype("f4"),
        )

    about = {n: getattr(flat, n) for n in ("name", "created", "height_m", "parameters")}
    save_tiled_map(tmp_path / "m.usdc", grid, field_of, tile_cells=CELLS, **about)
    assert (tmp_path / "m.usdc").read_bytes() == both[1].read_bytes()
    for wrong in (
        lambda r, c: replace(field_of(r, c), between_nt2=None) if r.start else field_of(r, c),
        lambda r, c: replace(field_of(r, c), valid=np.ones((1, 1, 1), bool)),
    ):
        with pytest.raises(InputError, match=r"tile .* of map 'hall': arrays must be of shape"):
            save_tiled_map(tmp_path / "no.usdc", grid, wrong, tile_cells=CELLS, **about)
    with pytest.raises(InputError, match="variances must not be below 0"):
        save_tiled_map(
            tmp_path / "no.usdc",
            grid,
            lambda r, c: replace(field_of(r, c), variance_nt2=-field_of(r, c).variance_nt2),
        )
    assert not (tmp_path / "no.usdc").exists()


def test_size_decides_whether_a_map_is_tiled(tmp_path, monkeypatch):
    save_map(a_map(), tmp_path / "small.usdc")
    assert type(load_map(tmp_path / "small.usdc")) is AnomalyMap
    monkeypatch.setattr("magtwin.usd.maps.layer.TILED_FROM", np.prod(SHAPE))
    save_map(a_map(), tmp_path / "large.usdc")
    assert isinstance(load_map(tmp_path / "large.usdc"), TiledMap)
    single = replace(a_map(), recorded_yaw=np.zeros(SHAPE))
    save_map(single, tmp_path / "readings.usdc")  # they keep their precision
    assert load_map(tmp_path / "readings.usdc") == single


def test_what_needs_the_whole_of_a_map_too_large_is_refused_with_its_size(both, monkeypatch):
    monkeypatch.setattr(tiles_module, "MOST_NODES", 10_000)
    field = load_map(both[1])
    with pytest.raises(InputError, match=r"has 41 x 57 nodes in 5 headings, 0\.0 GB at once"):
        field.values_nt  # noqa: B018
    with pytest.raises(InputError, match=r"take a part of it \(`map\.part`\)"):
        field.tables()
    assert field.part((-1.3, 0.0), (0.7, 2.0)).values_nt.size <= 10_000
    with pytest.raises(InputError, match="take a smaller one"):
        field.part((-9, 9), (-9, 9))
    assert field.opened <= set(range(35))


def test_the_checksum_of_a_large_layer_reads_no_tile(both, tmp_path, monkeypatch):
    monkeypatch.setattr(layers, "TILED_BYTES", 1)
    whole = layer_sha256(both[1])
    layer = Sdf.Layer.OpenAsAnonymous(str(both[1]))
    del layer.GetPrimAtPath(f"{MAP}/Tiles").nameChildren["tile_4_6"]
    layer.Export(str(tmp_path / "same.usdc"))
    assert layer_sha256(tmp_path / "same.usdc") == whole  # the tile's own checksum is in the map's prim
    changed = a_map()
    save_map(replace(changed, height_m=0.4), tmp_path / "higher.usdc", tile_cells=CELLS)
    values = changed.values_nt.copy()
    values[0, 0, 0] += 0.01
    save_map(replace(changed, values_nt=values), tmp_path / "other.usdc", tile_cells=CELLS)
    assert len({whole, *(layer_sha256(tmp_path / f"{n}.usdc") for n in ("higher", "other"))}) == 3


def test_tiles_cover_every_node_once():
    grid = Grid(origin_m=(0, 0), cell_m=(1, 1), headings_rad=(0.0,), rows=17, columns=11)
    tiling = Tiling(grid, 4)
    assert tiling.shape == (4, 3)
    seen = np.zeros((17, 11), int)
    for tile in range(len(tiling)):
        rows, columns = tiling.nodes(tile)
        own = tiling.own(tile)
        seen[rows, columns][own] += 1
    assert (seen == 1).all()


def test_a_run_on_a_tiled_map_has_the_bytes_of_one_on_the_map_in_memory(lab_scene, tmp_path):
    scene, flat = tmp_path / lab_scene.name, open_twin(lab_scene, magnetometer="physical")
    save_map(flat.field, tmp_path / "tiled.usdc", tile_cells=CELLS)
    shutil.copytree(lab_scene.parent, tmp_path, dirs_exist_ok=True)
    use_map(open_scene(scene, check_network=False), tmp_path / "tiled.usdc")
    tiled = open_twin(scene, magnetometer="physical")
    assert tiled.field.opened == set()
    ours, its = (simulate(t, "figure8", duration_s=3, seed=1) for t in (tiled, flat))
    for name, values in its.items():
        assert np.asarray(values).tobytes() == np.asarray(ours[name]).tobytes(), name
    assert 0 < len(tiled.field.opened) < len(tiled.field.tiling) / 4
