"""A map through its layer and back, and the coloured floor that goes with it."""

import datetime
import hashlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose, assert_array_equal
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade
from validators import assert_valid

from magtwin.errors import InputError
from magtwin.field.maps.made_from import MadeFrom
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.maps.statistics import colour_limits
from magtwin.field.sources.harmonic import HarmonicField
from magtwin.usd.maps.heat_map import HEAT_MAP, MAP, colour_index, heading_variants, viridis
from magtwin.usd.maps.layer import checksums, load_epochs, load_map, read_map, save_map, save_map_series
from magtwin.usd.schema import NOUNS, attribute_name

VALUES = "magtwin:anomalyMap:valuesNt"
HEIGHT = "magtwin:anomalyMap:heightM"
PARAMETERS = "magtwin:anomalyMap:parameters"
GRID = [f"magtwin:anomalyMap:{name}" for name in ("shape", "originM", "cellSizeM", "headingsDeg")]
HARMONIC = ("pWorldDipoleM", "mWorldAm2", "bUniformNt", "hardIronNt", "softIron", "pBaseSensorM")


def a_map(shape=(4, 3, 5), **changes) -> AnomalyMap:
    rng = np.random.default_rng(0)
    single = rng.normal(41_000, 3_000, shape).astype(np.float32)
    given = {
        "values_nt": single.astype(float),
        "origin_m": (-3.0, -1.75),
        "cell_m": (0.25, 0.5),
        "headings_rad": np.arange(shape[0]) * 2 * np.pi / shape[0],
        "name": "small",
        "method": "drawn",
        "source": "a test",
        "licence": "CC0-1.0",
        "created": "2026-01-02",
    }
    return AnomalyMap(**(given | changes))


def a_field(dipoles=3, seed=0) -> HarmonicField:
    rng = np.random.default_rng(seed)
    return HarmonicField(
        p_world_dipole=rng.normal(size=(dipoles, 3)),
        m_world=rng.normal(size=(dipoles, 3)),
        b_uniform_nt=rng.normal(2e4, 1e3, 3),
        hard_iron_nt=rng.normal(0, 300, 3),
        soft_iron=rng.normal(0, 0.01, (3, 3)),
        p_base_sensor=(0.01, 0.0, 0.35),
    )


def save_and_load(field, folder) -> AnomalyMap:
    save_map(field, folder / "m.usdc", force=True)
    return load_map(folder / "m.usdc")


def test_a_map_survives_its_layer(tmp_path):
    shape = (4, 3, 5)
    rng = np.random.default_rng(1)
    variance = rng.uniform(0, 100, shape).astype(np.float32).astype(float)
    field = a_map(valid=rng.random(shape) < 0.8, variance_nt2=variance)
    assert save_and_load(field, tmp_path) == field


@settings(deadline=None, max_examples=30)
@given(
    arrays(
        np.float32,
        st.tuples(st.integers(1, 3), st.integers(2, 4), st.integers(2, 4)),
        elements=st.floats(0, 1e5, width=32),
    ),
    st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)),
    st.tuples(st.floats(1e-3, 10), st.floats(1e-3, 10)),
)
def test_any_map_in_single_precision_survives_its_layer(tmp_path_factory, values, origin, cell):
    field = a_map(
        values.shape,
        values_nt=values.astype(float),
        origin_m=origin,
        cell_m=cell,
        headings_rad=np.arange(len(values)) * np.pi / 2,
    )
    assert save_and_load(field, tmp_path_factory.mktemp("map")) == field


numbers = st.floats(allow_nan=False, allow_infinity=False)
heights = st.floats(0, allow_infinity=False)
figures = st.dictionaries(
    st.text(),
    st.recursive(
        numbers | st.integers(-(2**63), 2**63) | st.text() | st.booleans(),
        lambda some: st.lists(some, max_size=3),
    ),
    max_size=4,
)
texts = st.text(st.characters(blacklist_categories=("Cs",), blacklist_characters="\x00"))


@settings(deadline=None, max_examples=30)
@given(texts, texts, st.none() | heights, figures)
def test_what_a_map_knows_of_itself_survives_its_layer(tmp_path_factory, frame, datum, height, parameters):
    field = a_map((1, 2, 2), frame=frame, datum=datum, height_m=height, parameters=parameters)
    assert save_and_load(field, tmp_path_factory.mktemp("map")) == field


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 4), st.randoms(use_true_random=False))
def test_a_harmonic_field_survives_the_layer_to_the_last_bit(tmp_path_factory, dipoles, random):
    field = a_map((1, 2, 2), harmonic=a_field(dipoles, random.randrange(2**32)))
    assert save_and_load(field, tmp_path_factory.mktemp("map")).harmonic == field.harmonic


def test_a_layer_from_before_frame_height_and_figures_still_loads(tmp_path):
    save_map(a_map(), tmp_path / "m.usdc")
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "m.usdc"))
    prim = layer.GetPrimAtPath(MAP)
    for name in ("frame", "datum", "parameters"):
        prim.RemoveProperty(prim.attributes[f"magtwin:anomalyMap:{name}"])
    for name in ("name", "method", "source", "licence", "created", "checksum"):  # which never varied
        attribute = prim.attributes[f"magtwin:anomalyMap:{name}"]
        value = attribute.default
        prim.RemoveProperty(attribute)
        Sdf.AttributeSpec(
            prim, attribute_name("anomalyMap", name), Sdf.ValueTypeNames.String, Sdf.VariabilityUniform
        ).default = value
    layer.Save()
    assert load_map(tmp_path / "m.usdc") == a_map()


@pytest.mark.parametrize(
    "parameters", [{"a": np.nan}, {"a": np.zeros(2)}, {"a": {1, 2}}], ids=["nan", "array", "set"]
)
def test_figures_that_json_does_not_hold_are_refused_and_nothing_is_written(tmp_path, parameters):
    with pytest.raises(InputError, match="parameters of map 'small' must be finite numbers, texts"):
        save_map(a_map(parameters=parameters), tmp_path / "m.usdc")
    assert list(tmp_path.iterdir()) == []


def epochs() -> list[AnomalyMap]:
    """Three surveys of one floor, of which the second has a harmonic field and the third no variance."""
    base, rng = a_map(), np.random.default_rng(5)
    maps = []
    for k, day in enumerate(("2025-12-31", "2026-01-10", "2026-02-01")):
        values = base.values_nt + np.round(rng.normal(0, 50, base.values_nt.shape))
        maps.append(
            a_map(
                values_nt=values.astype(np.float32).astype(float),
                valid=rng.random(values.shape) < 0.9,
                variance_nt2=None if k == 2 else np.full(values.shape, 4.0 + 4 * k),
                name=f"survey {k}",
                source=f"file {k}",
                created=day,
                height_m=0.35,
                parameters={"k": k},
                harmonic=a_field() if k == 1 else None,
            )
        )
    return maps


def test_every_epoch_comes_back_from_a_series_and_the_latest_without_a_date(tmp_path):
    first, second, third = maps = epochs()
    save_map_series([third, first, second], tmp_path / "m.usdc")
    assert load_epochs(tmp_path / "m.usdc") == tuple(maps)
    for field in maps:
        assert load_map(tmp_path / "m.usdc", field.created) == field
        assert load_map(tmp_path / "m.usdc", datetime.date.fromisoformat(field.created)) == field
    assert load_map(tmp_path / "m.usdc") == third


def test_between_two_epochs_the_field_is_linear_in_time_and_surer_than_each(tmp_path):
    maps = epochs()
    save_map_series(maps, tmp_path / "m.usdc")
    field = load_map(tmp_path / "m.usdc", "2026-01-05")  # half the ten days
    before, after = maps[:2]
    assert_allclose(field.values_nt, (before.values_nt + after.values_nt) / 2)
    assert_allclose(field.variance_nt2, (4.0 + 8.0) / 4)
    assert_array_equal(field.valid, before.valid & after.valid)
    assert field.created == "2026-01-05"
    assert field.source == "file 0; file 1"
    assert field.harmonic is None
    assert load_map(tmp_path / "m.usdc", "2026-01-20").variance_nt2 is None


def test_a_program_that_knows_usd_alone_selects_an_epoch_and_finds_no_time_codes(tmp_path):
    maps = epochs()
    save_map_series(maps, tmp_path / "m.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "m.usdc"))
    prim = stage.GetPrimAtPath(MAP)
    variants = prim.GetVariantSet("epoch")
    assert variants.GetVariantNames() == ["2025-12-31", "2026-01-10", "2026-02-01"]
    assert variants.GetVariantSelection() == "2026-02-01"
    assert not stage.HasAuthoredTimeCodeRange()
    for field in maps:
        variants.SetVariantSelection(field.created)
        assert_array_equal(prim.GetAttribute(VALUES).Get(), field.values_nt.ravel().astype(np.float32))
        assert prim.GetAttribute("magtwin:anomalyMap:source").Get() == field.source
        assert not any(a.ValueMightBeTimeVarying() for p in stage.Traverse() for a in p.GetAttributes())


def test_a_stage_that_references_the_map_selects_its_epoch(tmp_path):
    """In a stronger layer, at another frame rate, below another prim, twice."""
    maps = epochs()
    save_map_series(maps, tmp_path / "m.usdc")
    stage = Usd.Stage.CreateNew(str(tmp_path / "scene.usda"))
    stage.SetTimeCodesPerSecond(30.0)
    for name, day in (("Before", "2025-12-31"), ("After", "2026-01-10")):
        prim = stage.DefinePrim(f"/Site/{name}")
        prim.GetReferences().AddReference("./m.usdc", MAP)
        prim.GetVariantSets().SetSelection("epoch", day)
    stage.Save()
    before, after = (stage.GetPrimAtPath(f"/Site/{name}") for name in ("Before", "After"))
    assert (read_map(before), read_map(after)) == (maps[0], maps[1])
    stage.RemovePrim("/Site/Before")
    stage.Save()
    assert load_map(tmp_path / "scene.usda") == maps[1]
    assert load_epochs(tmp_path / "scene.usda") == tuple(maps)


@pytest.mark.parametrize(
    ("epoch", "said"),
    [("", "no epoch is selected; select one of 2025-12-31, "), ("2026-03-01", "the epoch '2026-03-01' is")],
)
def test_a_selection_that_is_no_epoch_is_refused_with_the_epochs(tmp_path, epoch, said):
    save_map_series(epochs(), tmp_path / "m.usdc")
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "m.usdc"))
    layer.GetPrimAtPath(MAP).variantSelections["epoch"] = epoch
    layer.Save()
    with pytest.raises(InputError, match=f"m.usdc </World/AnomalyMap>: {said}"):
        load_map(tmp_path / "m.usdc")
    assert load_map(tmp_path / "m.usdc", "2026-01-10") == epochs()[1]


def test_only_the_selected_epoch_is_read(tmp_path):
    """The bytes of another epoch's arrays may be damaged: nobody asks for them."""
    wide = a_map((4, 60, 80), created="2026-01-01")
    days = [wide, replace(wide, values_nt=wide.values_nt + 0.5, created="2026-02-01")]
    save_map_series(days, tmp_path / "m.usdc")
    data = (tmp_path / "m.usdc").read_bytes()
    piece = days[0].values_nt.astype("<f4").ravel()[1000:1016].tobytes()
    assert data.count(piece) == 1
    (tmp_path / "m.usdc").write_bytes(data.replace(piece, bytes(64)))
    assert load_map(tmp_path / "m.usdc") == days[1]
    with pytest.raises(InputError, match="do not match its checksum"):
        load_map(tmp_path / "m.usdc", "2026-01-01")


def test_the_coloured_floor_shows_the_epoch_and_the_heading_that_are_selected(tmp_path):
    maps = epochs()
    save_map_series(maps, tmp_path / "m.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "m.usdc"))
    prim = stage.GetPrimAtPath(HEAT_MAP)
    legend, primvar = prim.GetCustomDataByKey("magtwin"), UsdGeom.Mesh(prim).GetDisplayColorPrimvar()
    for field in maps:
        stage.GetPrimAtPath(MAP).GetVariantSet("epoch").SetVariantSelection(field.created)
        for h, heading in ((0, "0"), (2, "180")):
            prim.GetVariantSet("heading").SetVariantSelection(heading)
            index = colour_index(field.values_nt[h], field.valid[h], legend["least"], legend["greatest"])
            assert_array_equal(np.array(primvar.ComputeFlattened()), viridis()[index.ravel()])


@pytest.mark.parametrize("date", ["2025-12-30", "2026-02-02"])
def test_a_date_outside_the_span_is_refused_with_the_span(tmp_path, date):
    save_map_series(epochs(), tmp_path / "m.usdc")
    with pytest.raises(InputError, match=f"{date} lies beyond .* reaches from 2025-12-31 to 2026-02-01"):
        load_map(tmp_path / "m.usdc", date)


def test_a_date_of_a_map_of_one_day_is_that_day_or_refused(tmp_path):
    save_map(a_map(), tmp_path / "m.usdc")
    assert load_map(tmp_path / "m.usdc", "2026-01-02") == a_map()
    with pytest.raises(InputError, match="is of 2026-01-02 only"):
        load_map(tmp_path / "m.usdc", "2026-01-03")
    save_map(a_map(created=""), tmp_path / "m.usdc", force=True)
    with pytest.raises(InputError, match=r"map 'small' has no day; .*--created"):
        load_map(tmp_path / "m.usdc", "2026-01-02")


@pytest.mark.parametrize("date", ["soon", "20260102", "2026-W01-5", "2026-02-30"])
def test_a_date_that_is_no_day_is_refused(tmp_path, date):
    save_map(a_map(), tmp_path / "m.usdc")
    with pytest.raises(InputError, match=f"date must be a day YYYY-MM-DD, got '{date}'"):
        load_map(tmp_path / "m.usdc", date)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"created": ""}, "map 'small' has no day"),
        ({"created": "2026-01-02"}, "are both of 2026-01-02"),
        ({"origin_m": (0.0, 0.0)}, r"origin_m is \(-3.0, -1.75\) on 2026-01-02 and \(0.0, 0.0\)"),
        ({"height_m": 0.5}, "height_m is None on 2026-01-02 and 0.5 on"),
        ({"frame": "map"}, "frame is '' on 2026-01-02 and 'map' on"),
        ({"headings_rad": [0.0, 1.0, 2.0, 3.0]}, "headings_rad is"),
    ],
)
def test_maps_that_are_no_epochs_of_one_are_refused(tmp_path, change, said):
    with pytest.raises(InputError, match=said):
        save_map_series([a_map(), a_map(**({"created": "2026-01-03"} | change))], tmp_path / "m.usdc")
    assert list(tmp_path.iterdir()) == []


def test_grids_of_other_size_and_a_single_map_are_no_series(tmp_path):
    with pytest.raises(InputError, match=r"\(4, 3, 5\) nodes on 2026-01-02 and \(4, 3, 6\)"):
        save_map_series([a_map(), a_map((4, 3, 6), created="2026-01-03")], tmp_path / "m.usdc")
    with pytest.raises(InputError, match="two at least, got 1"):
        save_map_series([a_map()], tmp_path / "m.usdc")


def of_epoch(layer: Sdf.Layer, day: str, name: str) -> Sdf.AttributeSpec:
    return layer.GetAttributeAtPath(MAP.AppendVariantSelection("epoch", day).AppendProperty(name))


def test_an_epoch_that_was_tampered_with_is_refused_when_it_is_asked_for(tmp_path):
    maps = epochs()
    save_map_series(maps, tmp_path / "m.usdc")
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "m.usdc"))
    of_epoch(layer, "2026-01-10", VALUES).default = [4e4] * 60
    layer.Save()
    assert load_map(tmp_path / "m.usdc") == maps[2]
    with pytest.raises(InputError, match="do not match its checksum"):
        load_map(tmp_path / "m.usdc", "2026-01-10")
    stage = Usd.Stage.Open(layer)
    assert [said == taken for said, taken in checksums(stage.GetPrimAtPath(MAP))] == [True, False, True]


@pytest.mark.parametrize(
    ("day", "said"),
    [
        (
            "2026-01-11",
            "its epoch 2026-01-10 must be of that day, got magtwin:anomalyMap:created 2026-01-11;",
        ),
        ("soon", "epoch 2026-01-10: created of AnomalyMap must be a day YYYY-MM-DD, got 'soon'"),
        ("", "epoch 2026-01-10: map 'survey 1' has no day"),
    ],
)
def test_an_epoch_whose_day_is_not_that_of_its_variant_is_refused_with_its_prim(tmp_path, day, said):
    save_map_series(epochs(), tmp_path / "m.usdc")
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "m.usdc"))
    of_epoch(layer, "2026-01-10", "magtwin:anomalyMap:created").default = day
    layer.Save()
    with pytest.raises(InputError, match=f"m.usdc </World/AnomalyMap>: {said}"):
        load_epochs(tmp_path / "m.usdc")


def test_epochs_that_an_older_version_wrote_as_time_codes_are_read_with_a_warning(tmp_path):
    """Each value of an epoch is a time sample, in days since 2000-01-01; a missing one is blocked."""
    maps = epochs()
    save_map(maps[2], tmp_path / "old.usdc")
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "old.usdc"))
    prim = layer.GetPrimAtPath(MAP)
    schemas = [NOUNS["anomalyMap"], NOUNS["harmonic"]]
    prim.SetInfo("apiSchemas", Sdf.TokenListOp.Create(prependedItems=schemas))
    for k, (field, code) in enumerate(zip(maps, (9496.0, 9506.0, 9528.0), strict=True)):
        save_map(field, tmp_path / f"{k}.usdc")
        single = Sdf.Layer.FindOrOpen(str(tmp_path / f"{k}.usdc"))
        own = single.GetPrimAtPath(MAP)
        shared = ("shape", "origin", "cellSize", "headings", "unit", "checksumVersion")
        for spec in own.attributes:
            if spec.name.rpartition(":")[2] not in shared:
                if spec.name not in prim.attributes:
                    Sdf.AttributeSpec(prim, spec.name, spec.typeName, spec.variability)
                layer.SetTimeSample(MAP.AppendProperty(spec.name), code, spec.default)
    layer.Save()
    with pytest.warns(UserWarning, match=r"old.usdc .*time codes, .*: magtwin map epochs OLD.usdc --out NEW"):
        assert load_map(tmp_path / "old.usdc") == maps[2]
    with pytest.warns(UserWarning, match="time codes"):
        old = load_epochs(tmp_path / "old.usdc")
    assert old == tuple(maps)
    with pytest.warns(UserWarning, match="time codes"):
        assert load_map(tmp_path / "old.usdc", "2026-01-10") == maps[1]
    save_map_series(old, tmp_path / "new.usdc")
    assert load_epochs(tmp_path / "new.usdc") == tuple(maps)


def test_the_coloured_floor_of_a_fine_map_stays_light_and_reaches_its_border(tmp_path):
    field = a_map((1, 301, 402))
    save_map(field, tmp_path / "m.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "m.usdc"))
    prim = stage.GetPrimAtPath(HEAT_MAP)
    mesh, legend = UsdGeom.Mesh(prim), prim.GetCustomDataByKey("magtwin")
    assert legend["everyNode"] == 2
    assert 25_000 < len(mesh.GetFaceVertexCountsAttr().Get()) <= 60_000
    points = np.array(mesh.GetPointsAttr().Get())
    x0, x1, y0, y1 = field.extent
    assert_allclose([*points.min(axis=0)[:2], *points.max(axis=0)[:2]], [x0, y0, x1, y1], rtol=1e-6)
    colours = np.array(mesh.GetDisplayColorPrimvar().ComputeFlattened())
    at = np.rint((points[:, :2] - field.origin_m) / field.cell_m).astype(int)
    values = field.values_nt[0][at[:, 1], at[:, 0]]
    index = colour_index(values, values > 0, legend["least"], legend["greatest"])
    assert_array_equal(colours, viridis()[index])


def test_masked_nodes_may_hold_nan(tmp_path):
    values = np.full((1, 2, 2), 40_000.0)
    values[0, 1, 1] = np.nan
    field = a_map((1, 2, 2), values_nt=values, valid=np.isfinite(values))
    assert save_and_load(field, tmp_path) == field


def test_headings_come_back_to_the_last_bit_or_the_one_before(tmp_path):
    headings = np.sort(np.random.default_rng(2).uniform(0, 2 * np.pi, 50))
    field = a_map((50, 2, 2), headings_rad=headings)
    assert_allclose(save_and_load(field, tmp_path).headings_rad, headings, rtol=4e-16, atol=0)


def test_the_real_survey_survives_its_layer_to_half_a_step_of_single_precision(tmp_path, real_data):
    from magtwin.field.survey.folder import read_survey

    field = read_survey(real_data / "aprilab" / "maps", name="aprilab", licence="MIT")[0]
    back = save_and_load(field, tmp_path)
    assert_allclose(back.values_nt, field.values_nt, rtol=2**-24, atol=0)
    assert_array_equal(back.valid, field.valid)
    assert_array_equal(back.headings_rad, field.headings_rad)
    assert (back.origin_m, back.cell_m, back.name, back.licence) == (
        field.origin_m,
        field.cell_m,
        field.name,
        field.licence,
    )


def test_one_map_gives_the_same_bytes_every_time(tmp_path):
    for name in ("a.usdc", "b.usdc"):
        save_map(a_map(), tmp_path / name)
    assert (tmp_path / "a.usdc").read_bytes() == (tmp_path / "b.usdc").read_bytes()


def test_the_heat_map_stands_at_the_nodes_and_is_coloured_by_heading(tmp_path):
    field = a_map()
    save_map(field, tmp_path / "m.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "m.usdc"))
    prim = stage.GetPrimAtPath(HEAT_MAP)
    mesh, variants = UsdGeom.Mesh(prim), prim.GetVariantSet("heading")
    points = np.array(mesh.GetPointsAttr().Get()).reshape(3, 5, 3)
    assert_allclose(points[..., 0], np.broadcast_to(field.x_m, (3, 5)))
    assert_allclose(points[..., 1], np.broadcast_to(field.y_m[:, None], (3, 5)))
    assert UsdGeom.Mesh.ValidateTopology(
        mesh.GetFaceVertexIndicesAttr().Get(), mesh.GetFaceVertexCountsAttr().Get(), points.size // 3
    )
    assert variants.GetVariantNames() == sorted(["0", "90", "180", "270"])
    assert variants.GetVariantSelection() == "0"
    legend = prim.GetCustomDataByKey("magtwin")
    for heading, values in zip(("0", "90", "180", "270"), field.values_nt, strict=True):
        variants.SetVariantSelection(heading)
        colours = np.array(mesh.GetDisplayColorPrimvar().ComputeFlattened())
        index = colour_index(values, values > 0, legend["least"], legend["greatest"])
        assert_array_equal(colours, viridis()[index.ravel()])
    assert (legend["least"], legend["greatest"]) == colour_limits(field.values_nt)
    assert legend["unit"] == "nT"


def test_viridis_runs_from_dark_violet_to_yellow_in_linear_light():
    dark, bright = viridis()[0], viridis()[255]
    # The ends are #440154 and #fde725, here through IEC 61966-2-1; half a step of 8 bits is 0.0045 of light.
    assert_allclose(dark, [0.0578, 0.0003, 0.0887], atol=0.0045)
    assert_allclose(bright, [0.9823, 0.7991, 0.0185], atol=0.0045)


def test_colours_spread_evenly_over_the_values_and_a_node_without_one_is_grey():
    values = np.array([0.0, 0.5, 1.0, np.nan])
    index = colour_index(values, np.isfinite(values), 0.0, 1.0)
    assert index.tolist() == [0, 128, 255, 256]
    assert len(set(viridis()[256])) == 1


def test_headings_with_fractions_name_their_variants():
    assert heading_variants(np.deg2rad([0.0, 22.5, 45.0])) == ["0", "22_5", "45"]


def test_the_heat_map_shows_its_colours_through_its_material(tmp_path):
    save_map(a_map(), tmp_path / "m.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "m.usdc"))
    material, _ = UsdShade.MaterialBindingAPI(stage.GetPrimAtPath(HEAT_MAP)).ComputeBoundMaterial()
    surface, _, _ = material.ComputeSurfaceSource()
    reader = surface.GetInput("diffuseColor").GetConnectedSources()[0][0].source
    assert UsdShade.Shader(reader.GetPrim()).GetInput("varname").Get() == "displayColor"


def test_a_map_layer_passes_the_gates(tmp_path):
    save_map(a_map(), tmp_path / "m.usdc")
    assert_valid(tmp_path / "m.usdc", tmp_path)


def test_a_map_comes_along_with_a_stage_that_sublayers_it(tmp_path):
    save_map(a_map(), tmp_path / "m.usdc")
    stage = Usd.Stage.CreateNew(str(tmp_path / "scene.usda"))
    stage.GetRootLayer().subLayerPaths.append("./m.usdc")
    stage.Save()
    assert load_map(tmp_path / "scene.usda") == a_map()


def test_an_output_that_exists_is_refused_and_kept(tmp_path):
    save_map(a_map(), tmp_path / "m.usdc")
    before = (tmp_path / "m.usdc").read_bytes()
    with pytest.raises(InputError, match=r"m\.usdc: exists already; give `force=True`"):
        save_map(a_map(name="other"), tmp_path / "m.usdc")
    assert (tmp_path / "m.usdc").read_bytes() == before


def test_a_map_as_text_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"m\.usda: a map layer ends in \.usdc or \.usd"):
        save_map(a_map(), tmp_path / "m.usda")
    assert list(tmp_path.iterdir()) == []


def test_a_missing_layer_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"gone\.usdc: no such USD file"):
        load_map(tmp_path / "gone.usdc")


def test_a_file_that_is_not_usd_is_refused(tmp_path):
    (tmp_path / "m.usdc").write_text("not USD")
    with pytest.raises(InputError, match=r"m\.usdc: cannot be opened as USD"):
        load_map(tmp_path / "m.usdc")


def test_a_stage_without_a_map_is_refused(tmp_path):
    stage = Usd.Stage.CreateNew(str(tmp_path / "empty.usda"))
    UsdGeom.Xform.Define(stage, "/World")
    stage.Save()
    with pytest.raises(InputError, match=r"empty\.usda </>: needs one prim with MagtwinAnomalyMapAPI"):
        load_map(tmp_path / "empty.usda")


@pytest.mark.parametrize(
    ("attribute", "kind", "value", "said"),
    [
        (VALUES, Sdf.ValueTypeNames.FloatArray, [1.0] * 60, "do not match its checksum"),
        (
            "magtwin:anomalyMap:valid",
            Sdf.ValueTypeNames.BoolArray,
            [False] * 60,
            "do not match its checksum",
        ),
        ("magtwin:anomalyMap:shape", Sdf.ValueTypeNames.IntArray, [4, 3, 6], "does not fit 60 values"),
        ("magtwin:anomalyMap:shape", Sdf.ValueTypeNames.IntArray, [-1, -1, 60], "does not fit 60 values"),
        (
            "magtwin:anomalyMap:cellSizeM",
            Sdf.ValueTypeNames.Double2,
            Gf.Vec2d(0, 1),
            "cell_m of AnomalyMap must",
        ),
        (
            "magtwin:anomalyMap:created",
            Sdf.ValueTypeNames.String,
            "last May",
            "created of AnomalyMap must be a day YYYY-MM-DD, got 'last May'",
        ),
        (
            "magtwin:anomalyMap:checksum",
            Sdf.ValueTypeNames.String,
            "none",
            "must be a SHA-256, 64 digits 0-9a-f, got 'none'",
        ),
        (
            "magtwin:anomalyMap:headingsDeg",
            Sdf.ValueTypeNames.DoubleArray,
            [0.0, 180.0, 90.0, 270.0],
            r"headingsDeg must ascend in \[0, 360\) deg, got \[0.0, 180.0",
        ),
        (
            "magtwin:anomalyMap:headingsDeg",
            Sdf.ValueTypeNames.DoubleArray,
            [0.0, 90.0],
            r"headings_rad of AnomalyMap must have shape \(4,\), got \(2,\)",
        ),
        (
            "magtwin:anomalyMap:headingsDeg",
            Sdf.ValueTypeNames.DoubleArray,
            [],
            "must ascend in .* got \\[\\]",
        ),
        (VALUES, Sdf.ValueTypeNames.String, "many", r"valuesNt must be a float\[\]"),
        (PARAMETERS, Sdf.ValueTypeNames.String, '{"a": 1', "parameters is not JSON"),
        (PARAMETERS, Sdf.ValueTypeNames.String, '{"a": NaN}', r"not JSON \(Out of range float"),
        (PARAMETERS, Sdf.ValueTypeNames.String, '{"a": 1e999}', "parameters is not JSON"),
        (PARAMETERS, Sdf.ValueTypeNames.String, "[" * 10_000, "parameters is not JSON"),
        (PARAMETERS, Sdf.ValueTypeNames.String, "[1]", "parameters must be a JSON object"),
        (PARAMETERS, Sdf.ValueTypeNames.Double, 1.0, "parameters must be a string"),
        (HEIGHT, Sdf.ValueTypeNames.Double, np.nan, r"heightM must be a length \[m\], got nan"),
        (HEIGHT, Sdf.ValueTypeNames.String, "high", r"heightM must be a length \[m\], got 'high'"),
        (
            "magtwin:harmonic:hardIronNt",
            Sdf.ValueTypeNames.Double3,
            Gf.Vec3d(0, 0, 1),
            "do not match its checksum",
        ),
        (
            "magtwin:harmonic:mWorldAm2",
            Sdf.ValueTypeNames.Float3Array,
            [Gf.Vec3f(1)],
            r"must be a double3\[\]",
        ),
    ],
)
def test_a_tampered_map_is_refused_by_file_and_prim(tmp_path, attribute, kind, value, said):
    save_map(a_map(height_m=0.35, harmonic=a_field()), tmp_path / "m.usdc")
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "m.usdc"))
    prim = layer.GetPrimAtPath(MAP)
    if prim.attributes[attribute].typeName != kind:
        prim.RemoveProperty(prim.attributes[attribute])
        Sdf.AttributeSpec(prim, attribute, kind)
    prim.attributes[attribute].default = value
    if attribute in GRID and value:  # an old map; the checksum of a new one has its grid
        with_old_checksum(prim)
    layer.Save()
    with pytest.raises(InputError, match=rf"m\.usdc </World/AnomalyMap>: .*{said}"):
        load_map(tmp_path / "m.usdc")


@pytest.mark.parametrize(
    ("attribute", "value"),
    [
        ("originM", Gf.Vec2d(-3, -1)),
        ("cellSizeM", Gf.Vec2d(0.25, 0.25)),
        ("headingsDeg", [0.0, 90.0, 180.0, 271.0]),
    ],
)
def test_the_checksum_covers_the_grid(tmp_path, attribute, value):
    save_map(a_map(harmonic=a_field()), tmp_path / "m.usdc")
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "m.usdc"))
    prim = layer.GetPrimAtPath(MAP)
    prim.attributes[f"magtwin:anomalyMap:{attribute}"].default = value
    layer.Save()
    with pytest.raises(InputError, match="do not match its checksum, which covers its grid too"):
        load_map(tmp_path / "m.usdc")
    with_old_checksum(prim)  # which does not see it
    layer.Save()
    load_map(tmp_path / "m.usdc")


def test_a_map_with_the_old_checksum_opens(tmp_path):
    field = a_map(variance_nt2=np.ones((4, 3, 5)), harmonic=a_field())
    save_map(field, tmp_path / "m.usdc")
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "m.usdc"))
    with_old_checksum(layer.GetPrimAtPath(MAP))
    layer.Save()
    assert load_map(tmp_path / "m.usdc") == field


def test_a_checksum_of_a_later_version_is_refused(tmp_path):
    save_map(a_map(), tmp_path / "m.usdc")
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "m.usdc"))
    layer.GetPrimAtPath(MAP).attributes["magtwin:anomalyMap:checksumVersion"].default = 3
    layer.Save()
    with pytest.raises(InputError, match="checksum is of version 3, this magtwin knows 1 to 2"):
        load_map(tmp_path / "m.usdc")


def test_a_map_keeps_what_it_was_made_from(tmp_path):
    origin = MadeFrom(
        earth_nt=(1.0, 2.5, -3.0),
        sensor_m=(0.1, 0.0, 0.4),
        platform="ab",
        bodies={"désk": "12", "pipe": "34"},
    )
    save_map(a_map(made_from=origin), tmp_path / "m.usdc")
    assert load_map(tmp_path / "m.usdc").made_from == origin


@pytest.mark.parametrize("text", ["{", "[]", '{"earth_nt": null}', '{"a": 1}'])
def test_a_damaged_record_of_what_a_map_was_made_from_is_refused(tmp_path, text):
    save_map(a_map(), tmp_path / "m.usdc")
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "m.usdc"))
    layer.GetPrimAtPath(MAP).attributes["magtwin:anomalyMap:madeFrom"].default = text
    layer.Save()
    with pytest.raises(InputError, match=r"m\.usdc </World/AnomalyMap>: magtwin:anomalyMap:madeFrom: "):
        load_map(tmp_path / "m.usdc")


def with_old_checksum(prim: Sdf.PrimSpec) -> None:
    """Give a map's prim the checksum of version 1, as docs/schema.md defines it."""
    digest = hashlib.sha256()
    kinds = {"anomalyMap:valuesNt": "<f4", "anomalyMap:valid": "u1", "anomalyMap:varianceNt2": "<f4"}
    kinds |= {f"harmonic:{name}": "<f8" for name in HARMONIC}
    for name, kind in kinds.items():
        if attribute := prim.attributes.get(f"magtwin:{name}"):
            digest.update(np.array(attribute.default).astype(kind).tobytes())
    prim.attributes["magtwin:anomalyMap:checksum"].default = digest.hexdigest()
    prim.RemoveProperty(prim.attributes["magtwin:anomalyMap:checksumVersion"])


def test_a_harmonic_field_that_lost_a_part_is_refused(tmp_path):
    save_map(a_map(harmonic=a_field()), tmp_path / "m.usdc")
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "m.usdc"))
    prim = layer.GetPrimAtPath(MAP)
    prim.RemoveProperty(prim.attributes["magtwin:harmonic:softIron"])
    layer.Save()
    with pytest.raises(InputError, match="its harmonic field has no magtwin:harmonic:softIron"):
        load_map(tmp_path / "m.usdc")
