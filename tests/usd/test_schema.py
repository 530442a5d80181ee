"""The schema library: what is committed is what the source gives, and each schema holds its promises."""

import json
import re
from dataclasses import MISSING, fields

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdUtils, Vt

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.sources.harmonic import HarmonicField
from magtwin.spec.base import ZERO3
from magtwin.spec.drive import DriveSpec
from magtwin.spec.furniture import FurnitureSpec
from magtwin.spec.lab import LabSpec
from magtwin.spec.magnetics import EarthFieldSpec, PlatformFieldSpec, SourceSpec
from magtwin.spec.plant import PlantSpec
from magtwin.spec.robot import PlacedRobot, RobotSpec
from magtwin.spec.scene import Scene
from magtwin.spec.sensors import BatterySpec, ImuSpec, LidarSpec, MagnetometerSpec, MocapSpec
from magtwin.spec.walls import Door, Wall, Window
from magtwin.usd import schema
from magtwin.usd.attributes import plain_value, write_pose
from magtwin.usd.schema import attribute_name, generate

SPECS = {
    "magnetometer": MagnetometerSpec,
    "imu": ImuSpec,
    "lidar": LidarSpec,
    "source": SourceSpec,
    "earth": EarthFieldSpec,
    "battery": BatterySpec,
    "mocap": MocapSpec,
    "drive": DriveSpec,
    "plant": PlantSpec,
    "platform": PlatformFieldSpec,
    "lab": LabSpec,
    "harmonic": HarmonicField,
    "wall": Wall,
    "door": Door,
    "window": Window,
}
"""The spec whose figures each noun's attributes hold."""


every_noun = pytest.mark.parametrize("noun", schema.NOUNS)


def stage_with(noun: str) -> tuple[Usd.Stage, Usd.Prim]:
    stage = Usd.Stage.CreateInMemory()
    prim = UsdGeom.Xform.Define(stage, "/thing").GetPrim()
    stage.SetDefaultPrim(prim)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    write_pose(prim, (1.0, 2.0, 3.0))
    return stage, schema.apply_api(prim, noun)


def attributes(noun: str) -> list[str]:
    definition = Usd.SchemaRegistry().FindAppliedAPIPrimDefinition(schema.NOUNS[noun])
    return [n for n in definition.GetPropertyNames() if definition.GetAttributeDefinition(n)]


def other_value(attribute: Usd.Attribute):
    """A value that is not the fallback."""
    value = attribute.Get()
    if isinstance(value, bool):
        return not value
    if isinstance(value, float):
        return value + 1.0
    if isinstance(value, str):
        allowed = attribute.GetMetadata("allowedTokens")
        return allowed[0] if allowed else "some text"
    if isinstance(value, Gf.Matrix3d):
        return Gf.Matrix3d(*range(9))
    if isinstance(value, Gf.Vec3d | Gf.Vec2d):
        return value + type(value)(1.0)
    if isinstance(value, Sdf.AssetPath):
        return Sdf.AssetPath("./somewhere.bin")
    return {
        "string[]": Vt.StringArray(["a", "b"]),
        "int[]": Vt.IntArray([1, 2]),
        "bool[]": Vt.BoolArray([True, False]),
        "float[]": Vt.FloatArray([1.5]),
        "double[]": Vt.DoubleArray([1.5]),
        "double2[]": Vt.Vec2dArray([Gf.Vec2d(1, 2)]),
        "double3[]": Vt.Vec3dArray([Gf.Vec3d(1, 2, 3)]),
        "double4[]": Vt.Vec4dArray([Gf.Vec4d(1, 2, 3, 4)]),
        "int": 7,
        "double": 1.5,  # one without a fallback: unknown unless authored
    }[str(attribute.GetTypeName())]


def test_a_fresh_generation_equals_what_is_committed(tmp_path):
    generate.generate(tmp_path)
    for name in generate.GENERATED:
        assert (tmp_path / name).read_text() == (schema.FOLDER / name).read_text(), (
            f"run `make schema`: {name}"
        )


def test_the_reference_for_people_says_what_the_source_says():
    assert generate.REFERENCE.read_text() == generate.reference(), "run `make schema`"


def test_the_library_holds_the_schemas_that_the_table_names_and_no_other():
    plugin = json.loads((schema.FOLDER / "plugInfo.json").read_text())["Plugins"][0]
    assert set(plugin["Info"]["Types"]) == set(schema.NOUNS.values())


def test_a_schema_refuses_what_is_no_xform_and_a_source_what_has_no_volume():
    stage = Usd.Stage.CreateInMemory()
    for noun in sorted(schema.NOUNS.keys() - {"source"}):
        for kind in ("Cube", "Scope", ""):
            prim = stage.DefinePrim(f"/{noun}{kind}", kind)
            with pytest.raises(InputError, match=rf"{schema.NOUNS[noun]} goes on an Xform only"):
                schema.apply_api(prim, noun)
            assert prim.GetAppliedSchemas() == []
    for kind in ("Xform", "Cube", "Cylinder", "Sphere", "Mesh"):
        assert schema.apply_api(stage.DefinePrim(f"/{kind}", kind), "source").HasAPI(schema.NOUNS["source"])
    with pytest.raises(InputError, match=r"goes on an Xform, Cube, .* or Mesh only, not on a Cone"):
        schema.apply_api(stage.DefinePrim("/Cone", "Cone"), "source")


def suffix_of(unit: str) -> str:
    """The end of a name by the rule of names.py: nT/(N m)^2 is NtPerNm2."""
    spelled = unit.replace("(N m)", "Nm").replace("A m2", "Am2").replace("^", "")
    spelled = re.sub(r"sqrt\((\w+)\)", r"root \1", spelled)
    factors = [[word for word in part.split() if word != "1"] for part in spelled.split("/")]
    return "Per".join("".join(word[0].upper() + word[1:].lower() for word in part) for part in factors)


@every_noun
def test_every_name_ends_in_the_unit_that_usdview_shows(noun):
    definition = Usd.SchemaRegistry().FindAppliedAPIPrimDefinition(schema.NOUNS[noun])
    assert definition.GetPropertyNames()
    for name in definition.GetPropertyNames():
        assert re.fullmatch(rf"magtwin:{noun}:[a-z][A-Za-z0-9]*", name)
        shown = definition.GetPropertyMetadata(name, "displayName")
        unit = re.search(r" \[(.+)\]$", shown)
        text = definition.GetPropertyDocumentation(name)
        assert definition.GetPropertyMetadata(name, "displayGroup"), name
        if unit:
            assert name.endswith(suffix_of(unit[1])), name
            assert f"[{unit[1]}]" in text, name
        elif named := re.search(r"\[([^\]\d=]+)\]", text):  # a ratio, or several units
            assert named[1] == "nT per nT" or name.endswith(("madeFrom", "pathFile")), name
        assert "[" not in shown.removesuffix(unit[0] if unit else "")
    for name in attributes(noun):
        attribute = definition.GetAttributeDefinition(name)
        assert attribute.GetVariability() == Sdf.VariabilityUniform, name
        if str(attribute.GetTypeName()).startswith(("double", "matrix")) and noun in {*SPECS, "robot"}:
            assert re.search(r"\[[^\]]+\]", definition.GetPropertyDocumentation(name)), name


UNAUTHORED = {
    "magtwin:anomalyMap:checksumVersion": (1, 1),  # the first maps have none, and are refused
    "magtwin:earth:derivedFrom": ("", ""),  # computed anew
    "magtwin:furniture:kind": ("desk", "desk"),
    "magtwin:magnetometer:mapSha256": ("", Scene.__dataclass_fields__["map_sha256"].default),
    "magtwin:robot:footprintRadiusM": (0.171, RobotSpec.__dataclass_fields__["footprint_radius_m"].default),
    "magtwin:robot:path": ("", PlacedRobot.__dataclass_fields__["path"].default),
    "magtwin:robot:pathFile": (None, None),
    "magtwin:source:momentAm2": (ZERO3, SourceSpec.__dataclass_fields__["m_world"].default),
    "magtwin:wall:startM": ((0.0, 0.0), (0.0, 0.0)),
    "magtwin:wall:endM": ((1.0, 0.0), (1.0, 0.0)),
    "magtwin:door:atM": (0.5, 0.5),
    "magtwin:window:atM": (0.5, 0.5),
    **{
        f"magtwin:{noun}:{name}": (0.0, 0.0)
        for noun in ("wall", "door")
        for name in ("magnetizationAPerM", "susceptibility")
    },
    **{
        attribute_name("furniture", name): (default, FurnitureSpec.__dataclass_fields__[name].default)
        for name, default in (("material", ""), ("size_m", ZERO3))
    },
    **{
        attribute_name("anomalyMap", name): ("", AnomalyMap.__dataclass_fields__[name].default)
        for name in ("name", "method", "source", "licence", "created", "frame", "datum")
    },
}
"""Fallbacks beside the specs' fields, and what the reader assumes."""

EMPTY = {
    "anomalyMap": "valuesNt valid varianceNt2 recordedNt recordedYawRad shape headingsDeg checksum "
    "parameters madeFrom heightM originM cellSizeM"
}
"""Attributes of maps: unknown if empty, or refused, as test_schema_versions.py shows."""


def test_every_fallback_is_what_the_reader_assumes():
    checked = {f"magtwin:{noun}:{name}" for noun, names in EMPTY.items() for name in names.split()}
    for noun in schema.NOUNS:
        _, prim = stage_with(noun)
        spec = {f.name: f.default for f in fields(SPECS[noun])} if noun in SPECS else {}
        known = {attribute_name(noun, field): default for field, default in spec.items()}
        for name in attributes(noun):
            got = plain_value(prim.GetAttribute(name)) if name not in checked else None
            if name in UNAUTHORED:
                assert (got, got) == UNAUTHORED[name]
            elif name not in checked:
                default = known[name]
                assert got == default or (default is MISSING and not np.any(got)), name
            checked.add(name)
    assert not UNAUTHORED.keys() - checked


@every_noun
def test_values_survive_flattening_and_usdz(noun, tmp_path):
    stage, prim = stage_with(noun)
    wanted = {}
    for name in attributes(noun):
        attribute = prim.GetAttribute(name)
        wanted[name] = other_value(attribute)
        if isinstance(wanted[name], Sdf.AssetPath):  # a package holds the file itself
            (tmp_path / "somewhere.bin").write_bytes(b"weights")
        attribute.Set(wanted[name])
    stage.Export(str(tmp_path / "s.usdc"))
    flat = Usd.Stage.Open(str(tmp_path / "s.usdc")).Flatten()
    assert UsdUtils.CreateNewUsdzPackage(str(tmp_path / "s.usdc"), str(tmp_path / "s.usdz"))
    for again in (Usd.Stage.Open(flat), Usd.Stage.Open(str(tmp_path / "s.usdz"))):
        read = again.GetPrimAtPath("/thing")
        assert read.HasAPI(schema.NOUNS[noun])
        for name, value in wanted.items():
            got = read.GetAttribute(name).Get()
            if isinstance(value, Sdf.AssetPath):
                assert got.path.endswith("somewhere.bin")
            else:
                assert got == value


def test_a_prim_without_the_schema_is_refused():
    stage, _ = stage_with("lab")
    with pytest.raises(InputError, match=r"</thing>: has no MagtwinImuAPI"):
        schema.require_api(stage.GetPrimAtPath("/thing"), "imu")
    with pytest.raises(InputError, match=r"</thing>: needs one prim with MagtwinImuAPI below it, found none"):
        schema.only_prim_with(stage.GetPrimAtPath("/thing"), "imu")
