"""Small stages that cost much, crash USD, or hold values of other types are refused in one line."""

# ruff: noqa: E501
import numpy as np
import pytest
from pxr import Sdf, Vt

from magtwin.errors import InputError
from magtwin.usd.geometry import read_colour_scale, read_links, read_shapes
from magtwin.usd.info import info_of_stage
from magtwin.usd.layers import open_layer, open_stage
from magtwin.usd.trial import VALUES

HEAD = '#usda 1.0\n(\n    defaultPrim = "World"\n    metersPerUnit = 1\n    upAxis = "Z"\n)\n'


def stage(folder, text, name="s.usda"):
    file = folder / name
    file.write_text(HEAD + text)
    return file


def scale_of(file):
    return read_colour_scale(open_stage(file))


def twice(levels):
    """Instances of two instances each, some levels deep."""
    text = 'def Xform "World" (\n    instanceable = true\n    references = </P0>\n)\n{\n}\n'
    for i in range(levels):
        halves = "".join(
            f'    def "{n}" (\n        instanceable = true\n        references = </P{i + 1}>\n    )\n    {{\n    }}\n'
            for n in "ab"
        )
        text += f'def Xform "P{i}"\n{{\n{halves}}}\n'
    return text + f'def Xform "P{levels}"\n{{\n    def Cube "c"\n    {{\n    }}\n}}\n'


@pytest.mark.parametrize(("levels", "reason"), [(30, "prims with those of instances"), (140, "levels deep")])
def test_instances_of_instances_are_counted_before_they_are_visited(levels, reason, tmp_path):
    with pytest.raises(InputError, match=reason):
        open_stage(stage(tmp_path, twice(levels)))
    assert len(read_shapes(open_stage(stage(tmp_path, twice(3), "few.usda")))) == 8 + 8 + 4 + 2 + 1


def test_shapes_of_instances_are_counted_before_they_are_read(tmp_path, monkeypatch):
    with pytest.raises(InputError, match="has 196,607 shapes with those of instances"):
        read_shapes(stage(tmp_path, twice(16)))
    monkeypatch.setattr("magtwin.usd.geometry.CORNERS", 100)
    with pytest.raises(InputError, match="has 828 corners of faces with those of instances"):
        read_shapes(stage(tmp_path, twice(3), "few.usda"))


def test_prims_that_nest_too_deep_for_usd_are_refused(tmp_path):
    layer = Sdf.Layer.CreateNew(str(tmp_path / "deep.usdc"))
    prim = Sdf.PrimSpec(layer, "World", Sdf.SpecifierDef, "Xform")
    layer.defaultPrim = "World"
    for _ in range(300):
        prim = Sdf.PrimSpec(prim, "a", Sdf.SpecifierDef, "Xform")
    layer.Save()
    with pytest.raises(InputError, match="over 128 levels deep"):
        info_of_stage(tmp_path / "deep.usdc")


def with_(attribute):
    """A stage whose root has one attribute of a transform."""
    order = f'uniform token[] xformOpOrder = ["{attribute.split()[1]}"]'
    return f'def Xform "World"\n{{\n    {attribute}\n    {order}\n}}\n'


def prim(kind, text, apis=""):
    return f'def {kind} "World" (\n    {apis}\n)\n{{\n{text}\n}}\n'


MASS, DRIVE = 'apiSchemas = ["PhysicsMassAPI"]', 'apiSchemas = ["PhysicsDriveAPI:angular"]'
SCALE = "customData = {{\n        dictionary magtwin = {{\n{}\n        }}\n    }}"
ITSELF = "rel prototypes = </World>\nint[] protoIndices = [0]\npoint3f[] positions = [(0, 0, 0)]"
FACES = (
    "int[] faceVertexCounts = [300000000, -299999997]\nint[] faceVertexIndices = [0, 1, 2]\n"
    "point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]"
)

REFUSED = [
    (with_('string xformOp:translate = "x"'), open_stage, r"</World> has xformOp:\S+ as .*; correct it"),
    (with_("double xformOp:rotateXYZ:first = 1"), open_stage, r"</World> has xformOp:\S+ as .*; correct it"),
    (with_("double3 xformOp:rotateX = (1, 2, 3)"), open_stage, r"</World> has xformOp:\S+ as .*; correct it"),
    (with_("quatf[] xformOp:orient = [(1, 0, 0, 0)]"), open_stage, "has xformOp"),
    (with_("matrix3d xformOp:transform:b:c = ((1, 0, 0), (0, 1, 0), (0, 0, 1))"), open_stage, "has xformOp"),
    (prim("Mesh", 'string[] points = ["a"]'), open_stage, "</World> has .*points as string"),
    (prim("Cube", 'string[] primvars:displayColor = ["a"]'), open_stage, "displayColor as string"),
    (prim("Cube", 'string physics:mass = "a"', MASS), open_stage, "mass as"),
    (
        prim("PhysicsRevoluteJoint", 'string drive:angular:physics:damping = "a"', DRIVE),
        open_stage,
        "damping as string",
    ),
    (prim("PointInstancer", ITSELF), info_of_stage, "USD crashes on it"),
    (prim("Mesh", FACES), read_shapes, "has -299999997 corners"),
    (prim("Cube", "", SCALE.format('string colourMap = "viridis"')), scale_of, "colour scale"),
    (prim("Cube", "", SCALE.format('string colourMap = "a"\nstring least = "b"')), scale_of, "colour scale"),
]


@pytest.mark.parametrize(("text", "read", "words"), REFUSED)
def test_a_value_that_is_none_is_refused_in_one_line(text, read, words, tmp_path):
    with pytest.raises(InputError, match=words) as refused:
        read(stage(tmp_path, text))
    assert "\n" not in str(refused.value)


def test_bodies_in_a_long_chain_have_one_base(tmp_path):
    count = 300
    text = "".join(
        f'    def Xform "b{i}" (\n        apiSchemas = ["PhysicsRigidBodyAPI"]\n    )\n    {{\n    }}\n'
        for i in range(count)
    ) + "".join(
        f'    def PhysicsFixedJoint "j{i}"\n    {{\n        rel physics:body0 = </World/b{i}>\n'
        f"        rel physics:body1 = </World/b{i + 1}>\n    }}\n"
        for i in range(count - 1)
    )
    links = read_links(open_stage(stage(tmp_path, f'def Xform "World"\n{{\n{text}}}\n')))
    assert {link.base for link in links.values()} == {"b0"}


@pytest.mark.parametrize("read", [open_layer, open_stage])
def test_values_of_a_layer_of_any_size_are_tried(read, tmp_path):
    """One index of a table of repeated floats is out of the table, in a layer of 17 MB."""
    layer = Sdf.Layer.CreateNew(str(tmp_path / "s.usdc"))
    prim = Sdf.CreatePrimInLayer(layer, "/World")
    layer.defaultPrim = "World"
    noise = np.random.default_rng(0).normal(size=VALUES // 4 + 250_000).astype(np.float32)
    few = np.arange(150_000, dtype=np.float32) % 5 * np.float32(0.1)
    for name, values in (("noise", noise), ("few", few)):
        kind = Sdf.ValueTypeNames.FloatArray
        Sdf.AttributeSpec(prim, name, kind).default = Vt.FloatArray.FromNumpy(values)
    layer.Save()
    data = bytearray((tmp_path / "s.usdc").read_bytes())
    table = data.index(few[:5].tobytes())
    indices = table + 20 + 8  # after the 5 floats and the size of the compressed indices
    data[indices : indices + 64] = b"\x7f" * 64
    (tmp_path / "damaged.usdc").write_bytes(data)
    with pytest.raises(InputError, match=r"damaged|cannot be opened as USD"):
        read(tmp_path / "damaged.usdc")


def test_chains_of_connections_and_relationships_end_the_trial_not_magtwin(tmp_path):
    """USD follows each by recursion. A chain of 100 is no fault."""

    def bound(material, text):
        cube = f'    def Cube "C" (\n        apiSchemas = ["MaterialBindingAPI"]\n    )\n    {{\n        rel material:binding = {material}\n    }}\n'
        return f'def Xform "World"\n{{\n{cube}{text}}}\n'

    def nodes(count):
        graphs = [
            f'        def NodeGraph "N{i}"\n        {{\n            token outputs:o.connect = </World/M/N{i + 1}.outputs:o>\n        }}\n'
            for i in range(count)
        ]
        surface = f"        token outputs:surface.connect = </World/M/N0.outputs:o>\n{''.join(graphs)}"
        shader = f'        def Shader "N{count}"\n        {{\n            token info:id = "UsdPreviewSurface"\n            color3f inputs:diffuseColor = (1, 0, 0)\n            token outputs:o\n        }}\n'
        return bound("</World/M>", f'    def Material "M"\n    {{\n{surface}{shader}    }}\n')

    def relationships(count):
        rels = "".join(f"        rel r{i} = </World/R.r{i + 1}>\n" for i in range(count))
        return bound(
            "</World/R.r0>",
            f'    def Scope "R"\n    {{\n{rels}        rel r{count} = </World/M>\n    }}\n    def Material "M"\n    {{\n    }}\n',
        )

    for chain in (nodes, relationships):
        assert len(read_shapes(open_stage(stage(tmp_path, chain(100), f"{chain.__name__}.usda")))) == 1
        with pytest.raises(InputError, match=r"USD crashes on it|does not open it in"):
            open_stage(stage(tmp_path, chain(20_000), f"long_{chain.__name__}.usda"))
