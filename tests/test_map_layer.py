"""A map through its layer and back, and the coloured floor that goes with it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose, assert_array_equal
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade
from validators import assert_valid

from magtwin.field.map import AnomalyMap
from magtwin.names import RefusedError
from magtwin.usd.maps import HEAT_MAP, MAP, colour_index, heading_variants, load_map, save_map, viridis

VALUES = "magtwin:anomalyMap:values"


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
    from magtwin.field.survey import import_survey

    field = import_survey(real_data / "aprilab" / "maps", name="aprilab", licence="MIT")
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
    assert (legend["least"], legend["greatest"]) == (field.values_nt.min(), field.values_nt.max())
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
    with pytest.raises(RefusedError, match=r"m\.usdc: exists already; give --force"):
        save_map(a_map(name="other"), tmp_path / "m.usdc")
    assert (tmp_path / "m.usdc").read_bytes() == before


def test_a_map_as_text_is_refused(tmp_path):
    with pytest.raises(RefusedError, match=r"m\.usda: a map layer ends in \.usdc or \.usd"):
        save_map(a_map(), tmp_path / "m.usda")
    assert list(tmp_path.iterdir()) == []


def test_a_missing_layer_is_refused(tmp_path):
    with pytest.raises(RefusedError, match=r"gone\.usdc: no such USD file"):
        load_map(tmp_path / "gone.usdc")


def test_a_file_that_is_not_usd_is_refused(tmp_path):
    (tmp_path / "m.usdc").write_text("not USD")
    with pytest.raises(RefusedError, match=r"m\.usdc: cannot be opened as USD"):
        load_map(tmp_path / "m.usdc")


def test_a_stage_without_a_map_is_refused(tmp_path):
    stage = Usd.Stage.CreateNew(str(tmp_path / "empty.usda"))
    UsdGeom.Xform.Define(stage, "/World")
    stage.Save()
    with pytest.raises(RefusedError, match=r"empty\.usda </>: needs one prim with MagtwinAnomalyMapAPI"):
        load_map(tmp_path / "empty.usda")


@pytest.mark.parametrize(
    ("attribute", "kind", "value", "said"),
    [
        (VALUES, Sdf.ValueTypeNames.FloatArray, [1.0] * 60, "not those that its checksum was taken of"),
        (
            "magtwin:anomalyMap:valid",
            Sdf.ValueTypeNames.BoolArray,
            [False] * 60,
            "not those that its checksum",
        ),
        ("magtwin:anomalyMap:shape", Sdf.ValueTypeNames.IntArray, [4, 3, 6], "does not fit 60 values"),
        (
            "magtwin:anomalyMap:cellSize",
            Sdf.ValueTypeNames.Double2,
            Gf.Vec2d(0, 1),
            "cell_m of AnomalyMap must",
        ),
        ("magtwin:anomalyMap:unit", Sdf.ValueTypeNames.Token, "uT", "the map is in 'uT', magtwin reads nT"),
        (VALUES, Sdf.ValueTypeNames.String, "many", r"values must be a float\[\]"),
    ],
)
def test_a_tampered_map_is_refused_by_file_and_prim(tmp_path, attribute, kind, value, said):
    save_map(a_map(), tmp_path / "m.usdc")
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "m.usdc"))
    prim = layer.GetPrimAtPath(MAP)
    if prim.attributes[attribute].typeName != kind:
        prim.RemoveProperty(prim.attributes[attribute])
        Sdf.AttributeSpec(prim, attribute, kind)
    prim.attributes[attribute].default = value
    layer.Save()
    with pytest.raises(RefusedError, match=rf"m\.usdc </World/AnomalyMap>: .*{said}"):
        load_map(tmp_path / "m.usdc")
