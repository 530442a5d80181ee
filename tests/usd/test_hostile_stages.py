"""Small stages that cost much, crash USD, or hold values of other types are refused in one line."""

# ruff: noqa: E501
import numpy as np
import pytest
from pxr import Sdf, Vt

from magtwin.errors import InputError
from magtwin.export.package import export_scene
from magtwin.usd.animation import read_animation
from magtwin.usd.geometry import read_colour_scale, read_links, read_shapes
from magtwin.usd.info import info_of_stage
from magtwin.usd.layers import open_layer, open_stage, stage_sha256
from magtwin.usd.trial import VALUES

HEAD = '#usda 1.0\n(\n    defaultPrim = "World"\n    metersPerUnit = 1\n    upAxis = "Z"\n)\n'


def stage(folder, text, name="s.usda"):
    file = folder / name
    file.write_text(HEAD + text)
    return file


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


@pytest.mark.parametrize(
    ("wrong", "right"),
    [
        ('string xformOp:translate = "x"', "float3 xformOp:translate = (1, 2, 3)"),
        ("double xformOp:rotateXYZ:first = 1", "half3 xformOp:rotateXYZ:first = (1, 2, 3)"),
        ("double3 xformOp:rotateX = (1, 2, 3)", "float xformOp:rotateX = 1"),
        ("quatf[] xformOp:orient = [(1, 0, 0, 0)]", "quatf xformOp:orient = (1, 0, 0, 0)"),
        ("matrix3d xformOp:transform:b:c = ((1, 0, 0), (0, 1, 0), (0, 0, 1))", ""),
    ],
)
def test_a_transform_of_another_type_is_refused(wrong, right, tmp_path):
    for name, text in (("wrong", wrong), ("right", right)):
        order = f'uniform token[] xformOpOrder = ["{wrong.split()[1]}"]\n' if text else ""
        text = f'def Xform "World"\n{{\n    {text}\n    {order}\n}}\n'
        file = stage(tmp_path, text, f"{name}.usda")
        if name == "right":
            open_stage(file)
        else:
            with pytest.raises(InputError, match=r"</World> has xformOp:\S+ as .*; correct it"):
                open_stage(file)


def test_an_instancer_of_itself_is_refused(tmp_path):
    text = """def PointInstancer "World"
{
    rel prototypes = </World>
    int[] protoIndices = [0]
    point3f[] positions = [(0, 0, 0)]
}
"""
    with pytest.raises(InputError, match="USD crashes on it"):
        info_of_stage(stage(tmp_path, text))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('def Mesh "World"\n{\n    string[] points = ["a"]\n}\n', "points as string"),
        ('def Cube "World"\n{\n    string[] primvars:displayColor = ["a"]\n}\n', "displayColor as string"),
        (
            'def Cube "World" (\n    apiSchemas = ["PhysicsMassAPI"]\n)\n{\n    string physics:mass = "a"\n}\n',
            "mass as",
        ),
        (
            'def PhysicsRevoluteJoint "World" (\n    apiSchemas = ["PhysicsDriveAPI:angular"]\n)\n'
            '{\n    string drive:angular:physics:damping = "a"\n}\n',
            "damping as string",
        ),
    ],
)
def test_a_value_of_another_type_than_the_schema_is_refused_by_name(text, said, tmp_path):
    with pytest.raises(InputError, match=f"</World> has .*{said}.*correct it"):
        open_stage(stage(tmp_path, text))


def test_other_precisions_and_other_attributes_of_the_same_name_are_read(tmp_path):
    text = 'def Sphere "World"\n{\n    float radius = 2\n}\ndef Scope "s"\n{\n    custom string radius = "large"\n}\n'
    assert read_shapes(open_stage(stage(tmp_path, text)))


def test_a_face_with_a_negative_number_of_corners_is_refused(tmp_path):
    text = """def Mesh "World"
{
    int[] faceVertexCounts = [300000000, -299999997]
    int[] faceVertexIndices = [0, 1, 2]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
}
"""
    with pytest.raises(InputError, match="has -299999997 corners"):
        read_shapes(open_stage(stage(tmp_path, text)))


@pytest.mark.parametrize(
    "scale", ['string colourMap = "viridis"', 'string colourMap = "a"\nstring least = "b"']
)
def test_a_damaged_colour_scale_is_refused(scale, tmp_path):
    text = f'def Cube "World" (\n    customData = {{\n        dictionary magtwin = {{\n{scale}\n        }}\n    }}\n)\n{{\n}}\n'
    with pytest.raises(InputError, match="colour scale"):
        read_colour_scale(open_stage(stage(tmp_path, text)))


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


def diamond(folder, levels):
    """Layers of which each names the next two in a variant that is not selected."""
    for i in range(levels, -1, -1):
        names = ", ".join(f"@./a{k}.usda@" for k in (i + 1, i + 2) if k <= levels)
        variant = f'    variantSet "v" = {{\n        "x" (\n            references = [{names}]\n        ) {{\n        }}\n    }}\n'
        stage(
            folder,
            f'def "World" (\n    variantSets = "v"\n)\n{{\n{variant if names else ""}}}\n',
            f"a{i}.usda",
        )
    return folder / "a0.usda"


def test_layers_that_share_layers_are_summed_once(tmp_path):
    assert len(stage_sha256(diamond(tmp_path, 40))) == 64
    (tmp_path / "long").mkdir()
    with pytest.raises(InputError, match="files that name each other"):
        stage_sha256(diamond(tmp_path / "long", 300))


def test_facts_that_nest_deep_are_a_damaged_run(tmp_path):
    text = HEAD.replace(
        "(\n", '(\n    customLayerData = {\n        string magtwinFacts = "' + "[" * 100_000 + '"\n    }\n'
    )
    (tmp_path / "r.usda").write_text(text + 'def Xform "World"\n{\n    custom double[] run:t = [0, 1]\n}\n')
    with pytest.raises(InputError):
        read_animation(tmp_path / "r.usda")


def test_metadata_of_other_kinds_and_tiles_in_folders_are_packed(tmp_path):
    (tmp_path / "<UDIM>").mkdir()
    (tmp_path / "<UDIM>" / "x.png").write_bytes(b"x")
    text = HEAD.replace(
        "(\n", '(\n    customLayerData = {\n        string SimReady_Metadata = "none"\n    }\n'
    )
    text += 'def Cube "World"\n{\n    custom asset a = @./<UDIM>/x.png@\n}\n'
    (tmp_path / "s.usda").write_text(text)
    export_scene(tmp_path / "s.usda", tmp_path / "out")
    assert (tmp_path / "out").is_dir()
