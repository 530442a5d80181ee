"""A map through its layer and back, and the coloured floor that goes with it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose, assert_array_equal
from pxr import Gf, Sdf, Usd, UsdGeom
from validators import assert_valid

from magtwin.errors import InputError
from magtwin.field.maps.made_from import MadeFrom
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.maps.statistics import colour_limits
from magtwin.field.sources.harmonic import HarmonicField
from magtwin.usd.maps.heat_map import HEAT_MAP, MAP, colour_index, viridis
from magtwin.usd.maps.layer import _arrays, _checksum, load_map, read_map, save_map

DAYS = ("2026-01-01", "2026-02-01")
GRID = [f"magtwin:anomalyMap:{name}" for name in ("shape", "originM", "cellSizeM", "headingsDeg")]


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
    valid = values % 2 < 1
    field = a_map(
        values.shape,
        values_nt=np.where(valid, values, np.nan).astype(float),  # masked nodes may hold NaN
        valid=valid,
        variance_nt2=values.astype(float),
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
@given(texts, texts, st.none() | heights, figures, st.integers(0, 4))
def test_what_a_map_knows_of_itself_survives_its_layer_to_the_bit(
    tmp_path_factory, frame, datum, height, parameters, dipoles
):
    about = {"frame": frame, "datum": datum, "height_m": height, "parameters": parameters}
    origin = MadeFrom(
        earth_nt=(1.0, 2.5, -3.0),
        sensor_m=(0.1, 0.0, 0.4),
        platform="ab",
        bodies={"désk": "12", "pipe": "34"},
    )
    field = a_map((1, 2, 2), **about, harmonic=a_field(dipoles, dipoles), made_from=origin)
    again = save_and_load(field, tmp_path_factory.mktemp("map"))
    assert again == field
    assert (again.harmonic, again.made_from) == (field.harmonic, origin)


@pytest.mark.parametrize(
    "parameters", [{"a": np.nan}, {"a": np.zeros(2)}, {"a": {1, 2}}], ids=["nan", "array", "set"]
)
def test_figures_that_json_does_not_hold_are_refused_and_nothing_is_written(tmp_path, parameters):
    with pytest.raises(InputError, match="parameters of map 'small' must be finite numbers, texts"):
        save_map(a_map(parameters=parameters), tmp_path / "m.usdc")
    assert list(tmp_path.iterdir()) == []


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


def test_a_map_layer_passes_the_gates(tmp_path):
    save_map(a_map(), tmp_path / "m.usdc")
    assert_valid(tmp_path / "m.usdc", tmp_path)


def test_what_cannot_be_written_or_read_is_refused_by_file(tmp_path):
    save_map(a_map(), tmp_path / "m.usdc")
    before = (tmp_path / "m.usdc").read_bytes()
    with pytest.raises(InputError, match=r"m\.usdc: exists already; give `force=True`"):
        save_map(a_map(name="other"), tmp_path / "m.usdc")
    assert (tmp_path / "m.usdc").read_bytes() == before
    with pytest.raises(InputError, match=r"m\.csv: a map layer ends in"):
        save_map(a_map(), tmp_path / "m.csv")
    (tmp_path / "text.usdc").write_text("not USD")
    (tmp_path / "empty.usda").write_text('#usda 1.0\n(defaultPrim = "World")\ndef "World" {}\n')
    for name, words in (
        ("gone.usdc", r"gone\.usdc: no such USD file"),
        ("text.usdc", r"text\.usdc: cannot be opened as USD"),
        ("empty.usda", r"empty\.usda </>: needs one prim with MagtwinAnomalyMapAPI"),
    ):
        with pytest.raises(InputError, match=words):
            load_map(tmp_path / name)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["empty.usda", "m.usdc", "text.usdc"]


TAMPERED = [
    ("valuesNt", "float[]", [1.0] * 60, "checksum"),
    ("valuesNt", "float[]", [], "has no .*valuesNt; select the variant that has them"),
    ("valuesNt", "string", "many", r"must be a float\[\]"),
    ("valid", "bool[]", [False] * 60, "checksum"),
    ("originM", "double2", Gf.Vec2d(-3, -1), "checksum, which covers its grid"),
    ("cellSizeM", "double2", Gf.Vec2d(0.25, 0.25), "checksum, which covers its grid"),
    ("headingsDeg", "double[]", [0.0, 90.0, 180.0, 271.0], "checksum, which covers its grid"),
    ("shape", "int[]", [4, 3, 6], "does not fit 60 values"),
    ("shape", "int[]", [-1, -1, 60], "does not fit 60 values"),
    ("cellSizeM", "double2", Gf.Vec2d(0, 1), "cell_m of AnomalyMap must"),
    ("created", "string", "last May", "created .* a day YYYY-MM-DD, got 'last May'"),
    ("checksum", "string", "none", "a SHA-256, 64 digits 0-9a-f, got 'none'"),
    ("checksumVersion", "int", 3, "is of version 3, this magtwin reads 2"),
    ("headingsDeg", "double[]", [0.0, 180.0, 90.0, 270.0], r"ascend in \[0, 360\) deg, got \[0.0, 180.0"),
    ("headingsDeg", "double[]", [0.0, 90.0], r"headings_rad .* shape \(4,\), got \(2,\)"),
    ("headingsDeg", "double[]", [], r"must ascend in .* got \[\]"),
    ("parameters", "string", '{"a": 1', "parameters is not JSON"),
    ("parameters", "string", '{"a": NaN}', r"not JSON \(Out of range float"),
    ("parameters", "string", '{"a": 1e999}', "parameters is not JSON"),
    ("parameters", "string", "[" * 10_000, "parameters is not JSON"),
    ("parameters", "string", "[1]", "parameters must be a JSON object"),
    ("parameters", "double", 1.0, "parameters must be a string"),
    ("heightM", "double", np.nan, r"heightM must be a length \[m\], got nan"),
    ("heightM", "string", "high", r"heightM must be a length \[m\], got 'high'"),
    *(("madeFrom", "string", text, "madeFrom: ") for text in ("{", "[]", '{"earth_nt": null}', '{"a": 1}')),
    ("harmonic:hardIronNt", "double3", Gf.Vec3d(0, 0, 1), "checksum"),
    ("harmonic:mWorldAm2", "float3[]", [Gf.Vec3f(1)], r"must be a double3\[\]"),
    ("harmonic:softIron", None, None, "its harmonic field has no magtwin:harmonic:softIron"),
]


@pytest.mark.parametrize(("name", "kind", "value", "words"), TAMPERED)
def test_a_tampered_map_is_refused_by_file_and_prim(tmp_path, name, kind, value, words):
    save_map(a_map(height_m=0.35, harmonic=a_field()), tmp_path / "m.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "m.usdc"))
    layer, attribute = (
        stage.GetRootLayer(),
        f"magtwin:{name}" if ":" in name else f"magtwin:anomalyMap:{name}",
    )
    prim = layer.GetPrimAtPath(MAP)
    spec = prim.attributes.get(attribute)
    if spec is not None and (kind is None or spec.typeName != Sdf.ValueTypeNames.Find(kind)):
        prim.RemoveProperty(spec)
        spec = None
    if kind is not None:
        spec = spec or Sdf.AttributeSpec(prim, attribute, Sdf.ValueTypeNames.Find(kind))
        spec.default = value
    if attribute in GRID and value and "checksum" not in words:  # a checksum that fits
        prim.attributes["magtwin:anomalyMap:checksum"].default = _checksum(*_arrays(stage.GetPrimAtPath(MAP)))
    layer.Save()
    with pytest.raises(InputError, match=rf"m\.usdc </World/AnomalyMap>: .*{words}"):
        load_map(tmp_path / "m.usdc")


def test_a_map_with_variants_is_read_as_the_stage_selects(tmp_path):
    """So are the epochs that an earlier magtwin wrote: USD composes them."""
    maps = {day: a_map(created=day, values_nt=a_map().values_nt + k) for k, day in enumerate(DAYS)}
    save_map(maps[DAYS[0]], tmp_path / "m.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "m.usdc"))
    prim = stage.GetPrimAtPath(MAP)
    epochs = prim.GetVariantSets().AddVariantSet("epoch")
    for name in ("valuesNt", "checksum", "created"):
        prim.RemoveProperty(f"magtwin:anomalyMap:{name}")
    for day, field in maps.items():
        save_map(field, tmp_path / f"{day}.usdc")
        layer = Sdf.Layer.FindOrOpen(str(tmp_path / f"{day}.usdc"))
        source = layer.GetPrimAtPath(MAP)
        epochs.AddVariant(day)
        epochs.SetVariantSelection(day)
        with epochs.GetVariantEditContext():
            for name in ("valuesNt", "checksum", "created"):
                prim.GetAttribute(f"magtwin:anomalyMap:{name}").Set(
                    source.attributes[f"magtwin:anomalyMap:{name}"].default
                )
    for day, field in maps.items():
        epochs.SetVariantSelection(day)
        assert read_map(prim) == field
