"""Magnetised things and the Earth's field through the stage and back; moved, instanced, broken."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from pxr import Gf, Usd, UsdGeom, UsdPhysics, UsdShade

from magtwin.errors import InputError
from magtwin.field.sources.earth import earth_field_nt
from magtwin.field.sources.magnets import body_of
from magtwin.frames import rotate
from magtwin.spec.furniture import KINDS, FurnitureSpec, parts_of
from magtwin.spec.magnetics import EarthFieldSpec, SourceSpec
from magtwin.usd.lab.earth import checked, define_earth, read_earth
from magtwin.usd.lab.furniture import FURNITURE, define_furniture, read_magnets
from magtwin.usd.lab.sources import SOURCES, define_source, define_sources, read_source
from magtwin.usd.schema import apply_api, attribute_name

unhurried = settings(deadline=None, max_examples=50)

number = st.floats(-1e6, 1e6)
vec3 = st.tuples(number, number, number)
side = st.floats(1e-3, 1e3)
turns = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)
unit = turns.map(lambda q: tuple((np.array(q) / np.linalg.norm(q)).tolist()))
name = st.from_regex(r"[A-Za-z_][A-Za-z0-9_]{0,12}", fullmatch=True)
sizes = {
    "cuboid": st.tuples(side, side, side),
    "cylinder": st.tuples(side, side).map(lambda s: (s[0], *s)),
    "sphere": side.map(lambda s: (s,) * 3),
}
TETRAHEDRON = ((0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, 0.0, 0.5))
SIDES = ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2))
WEDGE = SourceSpec(
    name="wedge",
    p_world=(1.0, 2.0, 3.0),
    shape="mesh",
    vertices_m=TETRAHEDRON,
    faces=SIDES,
    magnetization=(1e3, 0, 0),
)
BAR = SourceSpec(
    name="bar",
    p_world=(1.0, 0.0, 0.5),
    shape="cylinder",
    size_m=(0.02, 0.02, 0.8),
    magnetization=(0.0, 0.0, 2e3),
)
DESK = FurnitureSpec(
    name="desk", kind="desk", p_world=(0.0, 2.2, 0.0), magnetization=(1e3, -2e3, 500.0, 4e3, -1.5e3, 3e3)
)
EARTH = EarthFieldSpec(
    b_world_nt=(0.0, 2e4, -4e4), latitude_deg=29.65, longitude_deg=-82.35, height_m=50.0, date="2026-11-21"
)


def world() -> Usd.Stage:
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.Xform.Define(stage, "/World")
    return stage


def stage_of(*sources: SourceSpec) -> Usd.Stage:
    stage = world()
    define_sources(stage, sources)
    return stage


def the_source(stage: Usd.Stage, of: SourceSpec = BAR) -> Usd.Prim:
    return stage.GetPrimAtPath(SOURCES.AppendChild(of.name))


# There and back


@unhurried
@given(st.sampled_from(sorted(sizes)), st.data())
def test_a_body_survives_the_stage_to_the_bit(shape, data):
    spec = SourceSpec(
        name=data.draw(name.filter(lambda n: n != "Looks")),
        p_world=data.draw(vec3),
        q_world_xyzw=data.draw(unit),
        shape=shape,
        size_m=data.draw(sizes[shape]),
        magnetization=data.draw(vec3),
        susceptibility=data.draw(st.floats(0, 1e4)),
    )
    assert read_magnets(stage_of(spec)) == ((spec,), ())


@unhurried
@given(st.lists(vec3, min_size=4, max_size=4), unit, vec3)
def test_a_mesh_survives_the_stage_to_the_bit(corners, turn, magnetization):
    try:
        spec = replace(WEDGE, vertices_m=tuple(corners), q_world_xyzw=turn, magnetization=magnetization)
    except InputError:  # flat or inside out
        return
    assert read_magnets(stage_of(spec)) == ((spec,), ())


# Where things stand


def test_moving_turning_and_nesting_a_prim_moves_and_turns_the_source():
    stage = stage_of(BAR)
    UsdGeom.Xformable(stage.GetPrimAtPath(SOURCES)).AddTranslateOp().Set(Gf.Vec3d(0, 0, 1))
    UsdGeom.Xformable(stage.GetPrimAtPath(SOURCES)).AddRotateXYZOp().Set(Gf.Vec3f(90, 0, 0))
    (read,), _ = read_magnets(stage)
    assert_allclose(read.p_world, (1.0, -0.5, 1.0), atol=1e-12)
    assert_allclose(rotate(read.q_world_xyzw, read.magnetization), (0, -2e3, 0), atol=1e-9)
    assert_allclose(read.size_m, BAR.size_m, rtol=1e-12)


def test_furniture_of_which_a_part_was_changed_comes_back_as_the_sources_that_it_consists_of():
    stage = world()
    define_furniture(stage, (DESK,))
    leg = stage.GetPrimAtPath(FURNITURE.AppendPath("desk/leg_1"))
    leg.GetAttribute("xformOp:translate").Set(Gf.Vec3d(0.2, 0.2, 0.4))
    sources, furniture = read_magnets(stage)
    assert furniture == ()
    assert [s.name for s in sources] == [
        f"Furniture_desk_{part.name}" for part in parts_of("desk") if part.steel
    ]
    unmoved = {s.name: s for s in DESK.sources()}
    for source in sources:
        want = unmoved[source.name.removeprefix("Furniture_")]
        if source.name.endswith("leg_1"):
            assert_allclose(source.p_world, (0.2, 2.4, 0.4), rtol=1e-12)
        else:
            assert_allclose(source.p_world, want.p_world, rtol=1e-12, atol=1e-12)
        assert source.magnetization == want.magnetization


def test_a_desk_from_another_file_counts_and_so_do_instances_and_what_is_invisible(tmp_path):
    asset = Usd.Stage.CreateNew(str(tmp_path / "desk.usda"))
    UsdGeom.Xform.Define(asset, "/World")
    define_furniture(asset, (replace(DESK, p_world=(0.0, 0.0, 0.0)),))
    asset.SetDefaultPrim(asset.GetPrimAtPath("/World"))
    asset.Save()
    stage = world()
    for k, instanceable in enumerate((False, True)):
        there = UsdGeom.Xform.Define(stage, f"/World/annex_{k}")
        there.AddTranslateOp().Set(Gf.Vec3d(5.0 * k, 0, 0))
        there.GetPrim().GetReferences().AddReference(str(tmp_path / "desk.usda"))
        there.GetPrim().SetInstanceable(instanceable)
        there.MakeInvisible()
    sources, furniture = read_magnets(stage)
    assert sources == ()
    assert [piece.p_world for piece in furniture] == [(0.0, 0.0, 0.0), (5.0, 0.0, 0.0)]
    stage.GetPrimAtPath("/World/annex_0").SetActive(False)
    assert len(read_magnets(stage)[1]) == 1


@pytest.mark.parametrize("axis", ["X", "Y", "Z"])
def test_a_cylinders_axis_and_scale_are_its_shape_and_leave_its_magnetization(axis):
    stage = world()
    cylinder = UsdGeom.Cylinder.Define(stage, "/World/pipe")
    cylinder.CreateAxisAttr(axis)
    cylinder.CreateRadiusAttr(0.5)
    cylinder.CreateHeightAttr(2.0)
    scale = [0.1, 0.1, 0.1]
    scale["XYZ".index(axis)] = 3.0
    cylinder.AddScaleOp().Set(Gf.Vec3f(*scale))
    apply_api(cylinder.GetPrim(), "source").GetAttribute("magtwin:source:magnetizationAPerM").Set(
        (1.0, 2.0, 3.0)
    )
    read = read_source(cylinder.GetPrim())
    assert_allclose(read.size_m, (0.1, 0.1, 6.0), rtol=1e-6)
    assert_allclose(rotate(read.q_world_xyzw, (0, 0, 1)), np.eye(3)["XYZ".index(axis)], atol=1e-12)
    assert_allclose(rotate(read.q_world_xyzw, read.magnetization), (1, 2, 3), rtol=1e-12)


def test_a_mesh_with_doubled_vertices_polygons_and_faces_turned_inwards_is_the_same_body():
    stage = world()
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    mesh = UsdGeom.Mesh.Define(stage, "/World/box")
    mesh.CreatePointsAttr([Gf.Vec3f(*map(float, corners[k])) for quad in quads for k in quad[::-1]])
    mesh.CreateFaceVertexCountsAttr([4] * 6)
    mesh.CreateFaceVertexIndicesAttr(list(range(24)))
    apply_api(mesh.GetPrim(), "source").GetAttribute("magtwin:source:magnetizationAPerM").Set((0, 0, 1e3))
    body = body_of(read_source(mesh.GetPrim()))
    assert body.vertices.shape == (8, 3)
    assert body.volume_m3 == pytest.approx(1.0)


# Refusals


def ops(prim: Usd.Prim) -> UsdGeom.Xformable:
    return UsdGeom.Xformable(prim)


def put(prim: Usd.Prim, attribute: str, value) -> None:
    prim.GetAttribute(attribute_name("source", attribute)).Set(value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p: put(p, "magnetization", (0, 0, float("nan"))), "magnetization .* finite"),
        (lambda p: put(p, "susceptibility", -1.0), "susceptibility .* not be below 0"),
        (lambda p: put(p, "moment", (1, 0, 0)), "both a moment and a magnetization"),
        (lambda p: ops(p).AddScaleOp().Set((1, 2, 1)), "scale across its axis must be the same"),
        (lambda p: ops(p).AddScaleOp().Set((-1, 1, 1)), "mirrored by a negative scale"),
        (lambda p: ops(p).AddScaleOp().Set((0, 0, 0)), "flattens it or is not finite"),
        (
            lambda p: (ops(p.GetParent()).AddScaleOp().Set((1, 1, 3)), ops(p).AddRotateXOp().Set(30)),
            "it is sheared",
        ),
        (lambda p: UsdGeom.Cylinder(p).GetRadiusAttr().Set(0.0), "size_m .* above 0 m"),
        (lambda p: p.SetTypeName("Cone"), "a Cone cannot be a magnetic source; put .* on Xform, Cube"),
        (lambda p: p.SetTypeName("Xform"), "an Xform has no volume"),
        (lambda p: p.GetParent().SetTypeName("PointInstancer"), "PointInstancer has no single place"),
        (lambda p: apply_api(p.GetParent(), "robot"), "on the robot /World/Sources, which moves"),
    ],
)
def test_what_cannot_be_a_source_is_refused_by_prim(change, words):
    stage = stage_of(BAR)
    change(the_source(stage))
    with pytest.raises(InputError, match=rf"</World/Sources/bar>: .*{words}"):
        read_magnets(stage)


@pytest.mark.parametrize(
    ("attribute", "value", "words"),
    [
        ("faceVertexIndices", [0, 2, 1, 0, 1, 3, 1, 2, 3, 0, 3, 1], "not a closed mesh: the edge from"),
        ("faceVertexIndices", [0, 2, 1, 0, 1, 3, 1, 2, 3, 0, 3, 9], "12 indices and 4 points do not fit"),
        ("faceVertexCounts", [3, 3, 3], "9 corners, 12 indices and 4 points do not fit"),
        ("points", [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)], "encloses no volume"),
        ("points", [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, float("nan"))], "finite vertices"),
    ],
)
def test_a_mesh_that_encloses_nothing_is_refused_by_prim(attribute, value, words):
    stage = stage_of(WEDGE)
    the_source(stage, WEDGE).GetAttribute(attribute).Set(value)
    with pytest.raises(InputError, match=rf"</World/Sources/wedge>: .*{words}"):
        read_magnets(stage)


TETRA = {"shape": "mesh", "vertices_m": TETRAHEDRON}


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"shape": "cubiod"}, "did you mean 'cuboid'"),
        ({"size_m": (0.0, 1.0, 1.0)}, "size_m .* above 0 m each way"),
        ({"shape": "cylinder", "size_m": (1.0, 2.0, 1.0)}, "equal in x and y for a cylinder"),
        ({"shape": "sphere", "size_m": (1.0, 1.0, 2.0)}, "equal each way"),
        ({"shape": "point"}, "size_m .* left out for a point"),
        ({"m_world": (0, 0, 1.0)}, "m_world .* left out for a cuboid"),
        ({"vertices_m": TETRAHEDRON}, "vertices_m .* mesh only"),
        ({"q_world_xyzw": (0.0, 0.0, 0.0, 2.0)}, "unit quaternion"),
        ({**TETRA, "faces": SIDES[:3]}, "'crate' is not a closed mesh"),
        ({**TETRA, "faces": ((0, 1, 2),) * 4}, "'crate' is not a closed"),
        ({**TETRA, "faces": tuple(f[::-1] for f in SIDES)}, "'crate' encloses no volume: -0.02.* outwards"),
    ],
)
def test_a_source_that_makes_no_sense_is_refused(given, words):
    crate = {"name": "crate", "p_world": (0.0, 0.0, 0.0), "shape": "cuboid", "size_m": (1.0, 1.0, 1.0)}
    with pytest.raises(InputError, match=words):
        SourceSpec(**{**crate, **given})


def test_names_that_are_none_are_refused_by_the_near_one_and_steel_is_counted():
    with pytest.raises(InputError, match="source 'steel beam' cannot name a prim"):
        define_source(world(), "/World", SourceSpec(name="steel beam", p_world=(0, 0, 0), m_world=(0, 0, 1)))
    with pytest.raises(InputError, match="no furniture 'dsek'; did you mean 'desk'"):
        FurnitureSpec(name="a", kind="dsek", p_world=(0, 0, 0))
    with pytest.raises(InputError, match="one number for each of leg_0, leg_1"):
        FurnitureSpec(name="a", kind="desk", p_world=(0, 0, 0), magnetization=(1e3,))


# Furniture is to be seen


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_every_part_wears_a_material_collides_and_stands_within_the_piece(kind):
    stage = world()
    define_furniture(stage, (FurnitureSpec(name="piece", kind=kind, p_world=(0, 0, 0)),))
    gprims = [p for p in stage.Traverse() if p.IsA(UsdGeom.Gprim)]
    solid = [p for p in gprims if p.HasAPI(UsdPhysics.CollisionAPI)]
    shown = [p for p in gprims if UsdGeom.Imageable(p).ComputePurpose() == "default"]
    names = [part.name for part in parts_of(kind)]
    assert ([p.GetName() for p in solid], [p.GetName() for p in shown]) == (names, names)
    assert len(gprims) == 2 * len(names)
    for prim in gprims:
        assert UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0], prim
    box = (
        UsdGeom.BBoxCache(0, ["default"])
        .ComputeWorldBound(stage.GetPrimAtPath("/World"))
        .ComputeAlignedRange()
    )
    assert box.GetMin()[2] == pytest.approx(0, abs=1e-6)  # it stands on the floor


# The Earth


def test_a_place_day_or_north_changed_on_the_stage_gives_the_field_there_and_then():
    stage = world()
    prim = define_earth(stage, "/World/Earth", checked(replace(EARTH, b_world_nt=(0.0, 0.0, 0.0))))
    before = read_earth(prim)
    prim.GetAttribute("magtwin:earth:date").Set("1990-06-01")
    prim.GetAttribute("magtwin:earth:northDeg").Set(30.0)
    after = read_earth(prim)
    want = earth_field_nt(
        EARTH.latitude_deg, EARTH.longitude_deg, EARTH.height_m, "1990-06-01", north_deg=30.0
    )
    assert after.b_world_nt == pytest.approx(want, abs=0.051)
    assert np.linalg.norm(np.subtract(after.b_world_nt, before.b_world_nt)) > 3000
    prim.GetAttribute("magtwin:earth:measured").Set(True)
    assert read_earth(prim).b_world_nt == before.b_world_nt, "what was measured stays as it was written"


def test_a_field_that_is_not_the_models_is_refused_unless_it_was_measured():
    with pytest.raises(InputError, match=r"b_world_nt \[0.0, 20000.0, -40000.0\] is not the IGRF-14's field"):
        checked(EARTH)
    assert checked(replace(EARTH, measured=True)) == replace(EARTH, measured=True)
    model = checked(replace(EARTH, b_world_nt=(0.0, 0.0, 0.0)))
    assert checked(model) == model


@pytest.mark.parametrize(
    ("attribute", "value", "said"),
    [
        ("date", "soon", "date .* YYYY-MM-DD"),
        ("date", "2031-01-01", "date .* the IGRF-14's span, 1900-01-01 to 2030-01-01"),
        ("latitudeDeg", 90.5, r"latitude_deg .* -90\.\.90, got 90\.5"),
        ("northDeg", 361.0, r"north_deg .* -360\.\.360, got 361"),
        ("heightM", 5e6, "height must lie in"),
    ],
)
def test_an_earth_that_makes_no_sense_is_refused_by_prim(attribute, value, said):
    stage = world()
    prim = define_earth(stage, "/World/Earth", EARTH)
    prim.GetAttribute(f"magtwin:earth:{attribute}").Set(value)
    with pytest.raises(InputError, match=f"</World/Earth>: {said}"):
        read_earth(prim)
