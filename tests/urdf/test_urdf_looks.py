"""Looks of mesh files as UsdPreviewSurface, and what is lost of them."""

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose
from PIL import Image
from pxr import Gf, UsdShade
from test_urdf_geometry import SQUARES, dae, meshes_of, notes_of, picture, robot, surface_of, visual
from validators import assert_valid

from magtwin.urdf.meshes.mesh import read_mesh
from magtwin.usd.geometry import linear_from_srgb

UP = (128, 128, 255)
"""A texel of a normal map that points straight up."""


def blue(tmp_path, lines, **options):
    """The stage of an OBJ whose material `blue` has these statements, and that material's surface."""
    (tmp_path / "squares.obj").write_text(SQUARES)
    (tmp_path / "paint.mtl").write_text(f"newmtl red\nKd 1 0 0\nnewmtl blue\n{lines}\n")
    stage = robot(tmp_path, visual("squares.obj"), **options)
    (mesh,) = meshes_of(stage)
    return stage, surface_of(mesh.GetPrim().GetChild("blue"))


def values(surface):
    """Inputs of a surface that no texture gives."""
    return {i.GetBaseName(): i.Get() for i in surface.GetInputs() if not i.HasConnectedSource()}


def textures(surface):
    """By input of a surface: file name, output, colour space, scale and bias of its texture."""
    found = {}
    for given in surface.GetInputs():
        if given.HasConnectedSource():
            source = given.GetConnectedSources()[0][0]
            shader = UsdShade.Shader(source.source.GetPrim())
            get = {i.GetBaseName(): i.Get() for i in shader.GetInputs()}
            found[given.GetBaseName()] = (
                get["file"].path.rpartition("/")[2],
                source.sourceName,
                get["sourceColorSpace"],
                get.get("scale", Gf.Vec4f(1)),
                get.get("bias", Gf.Vec4f(0)),
            )
    return found


def test_a_wavefront_material_arrives_with_all_of_its_pbr_statements(tmp_path):
    for i, name in enumerate(("kd", "ke", "pr", "pm", "d")):  # images are shared by content
        picture(tmp_path / f"{name}.png", [(i, i, i)])
    picture(tmp_path / "n.png", [UP])
    stage, surface = blue(
        tmp_path,
        "Kd 0.5 1 1\nKe 1 0.5 0\nPr 0.25\nPm 0.75\nNi 1.33\nd 0.5\nmap_Kd kd.png\nmap_Ke ke.png\n"
        "map_Pr pr.png\nmap_Pm -s 1 1 1 pm.png\nmap_d d.png\nnorm n.png",
    )
    seen = values(surface)
    assert_allclose(seen["ior"], 1.33, atol=1e-4)
    assert "useSpecularWorkflow" not in seen
    assert_allclose(read_mesh(tmp_path / "squares.obj").paints[1].emissive, linear_from_srgb([1, 0.5, 0]))
    maps = textures(surface)
    assert maps.keys() == {"diffuseColor", "emissiveColor", "roughness", "metallic", "opacity", "normal"}
    assert [maps[n][:3] for n in ("diffuseColor", "emissiveColor", "roughness", "normal")] == [
        ("kd.png", "rgb", "sRGB"),
        ("ke.png", "rgb", "sRGB"),
        ("pr.png", "r", "raw"),
        ("n.png", "rgb", "raw"),
    ]
    assert_allclose(maps["diffuseColor"][3], [*linear_from_srgb([0.5, 1, 1]), 0.5], atol=1e-5)
    assert_allclose(maps["emissiveColor"][3], [*linear_from_srgb([1, 0.5, 0]), 1], atol=1e-5)
    assert_allclose(maps["opacity"][3], [0.5] * 4)
    assert_allclose(maps["normal"][3:], [[2, 2, 2, 1], [-1, -1, -1, 0]])
    assert not [note for note in notes_of(stage) if "squares.obj" in note]
    assert_valid(stage.GetRootLayer().realPath, tmp_path)


@pytest.mark.parametrize("exponent", [0, 10, 250])
def test_a_phong_highlight_keeps_its_width_and_its_height(tmp_path, exponent):
    """GGX of width a = roughness^2 peaks at F / 4 a^2, and is as wide as an exponent of 2 / a^2 - 2."""
    _, surface = blue(tmp_path, f"Kd 0.5 0.5 0.5\nKs 0.2 0.1 0\nNs {exponent}\nNi 1.5")
    seen = values(surface)
    assert seen["useSpecularWorkflow"] == 1
    squared = seen["roughness"] ** 4
    assert_allclose(2 / squared - 2, exponent, atol=0.02 * exponent + 1e-3)
    height = np.array(seen["specularColor"]) / (4 * squared)
    assert_allclose(height, linear_from_srgb([0.2, 0.1, 0]), rtol=0.02, atol=1e-5)


def shaded(tmp_path, shader, extra="", images=""):
    """The stage of a COLLADA tetrahedron with this shader, and its surface."""
    path = dae(tmp_path / "n.dae", "<node>{mesh}</node>", images=images)
    text = path.read_text()
    first, last = text.index("<lambert>"), text.index("</lambert>") + len("</lambert>")
    path.write_text(text[:first] + shader + extra + text[last:])
    stage = robot(tmp_path, visual("n.dae"))
    (mesh,) = meshes_of(stage)
    return stage, surface_of(mesh.GetPrim())


def test_collada_emission_and_highlights_arrive(tmp_path):
    _, surface = shaded(
        tmp_path,
        "<phong><emission><color>0.5 0 0 1</color></emission><diffuse><color>1 1 1 1</color></diffuse>"
        "<specular><color>0.2 0.2 0.2 1</color></specular><shininess><float>30</float></shininess></phong>",
    )
    seen = values(surface)
    assert_allclose(seen["emissiveColor"], linear_from_srgb([0.5, 0, 0]), atol=1e-5)
    assert_allclose(seen["roughness"], (2 / 32) ** 0.25, atol=1e-4)
    assert_allclose(seen["specularColor"], 4 * 2 / 32 * linear_from_srgb([0.2] * 3), atol=1e-5)


def test_collada_normal_maps_cut_outs_and_glowing_textures_arrive(tmp_path):
    Image.new("RGBA", (2, 2), (255, 255, 255, 0)).save(tmp_path / "leaf.png")
    picture(tmp_path / "n.png", [UP])
    image = '<image id="{0}"><init_from>{0}.png</init_from></image>'
    stage, surface = shaded(
        tmp_path,
        '<lambert><emission><texture texture="leaf" texcoord="U"/></emission><diffuse><texture '
        'texture="leaf" texcoord="U"/></diffuse>'
        '<transparent><texture texture="leaf" texcoord="U"/></transparent></lambert>',
        extra='<extra><technique profile="FCOLLADA"><bump bumptype="NORMALMAP"><texture texture="n" texcoord='
        '"U"/></bump></technique></extra>',
        images=image.format("leaf") + image.format("n"),
    )
    maps = textures(surface)
    assert {name: each[:2] for name, each in maps.items()} == {
        "diffuseColor": ("leaf.png", "rgb"),
        "opacity": ("leaf.png", "a"),
        "emissiveColor": ("leaf.png", "rgb"),
        "normal": ("n.png", "rgb"),
    }
    assert not [note for note in notes_of(stage) if "n.dae" in note]


def test_all_of_gltfs_core_material_arrives_from_a_file_of_trimesh(tmp_path):
    one = Image.new("RGB", (2, 2), (10, 20, 30))
    material = trimesh.visual.material.PBRMaterial(
        name="skin",
        baseColorFactor=[128, 255, 255, 255],
        baseColorTexture=Image.new("RGBA", (2, 2), (200, 100, 50, 255)),
        metallicFactor=0.5,
        roughnessFactor=0.25,
        metallicRoughnessTexture=one,
        normalTexture=Image.new("RGB", (2, 2), UP),
        occlusionTexture=Image.new("RGB", (2, 2), (90, 0, 0)),
        emissiveTexture=Image.new("RGB", (2, 2), (0, 90, 0)),
        emissiveFactor=[1.0, 0.5, 0.0],
        alphaMode="MASK",
        alphaCutoff=0.25,
    )
    box = trimesh.creation.box()
    box.visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)
    box.export(tmp_path / "t.glb")
    stage = robot(tmp_path, visual("t.glb"))
    (mesh,) = meshes_of(stage)
    surface = surface_of(mesh.GetPrim())
    maps = textures(surface)
    assert {name: each[1:3] for name, each in maps.items()} == {
        "diffuseColor": ("rgb", "sRGB"),
        "opacity": ("a", "sRGB"),
        "roughness": ("g", "raw"),
        "metallic": ("b", "raw"),
        "normal": ("rgb", "raw"),
        "occlusion": ("r", "raw"),
        "emissiveColor": ("rgb", "sRGB"),
    }
    assert maps["roughness"][0] == maps["metallic"][0]
    assert_allclose(maps["roughness"][3], [0.25] * 4)
    assert_allclose(maps["metallic"][3], [0.5] * 4)
    assert_allclose(maps["emissiveColor"][3], [1, 0.5, 0, 1])
    assert_allclose(maps["diffuseColor"][3][0], 128 / 255, atol=1e-3)
    assert_allclose(values(surface)["opacityThreshold"], 0.25)
    assert not [note for note in notes_of(stage) if "t.glb" in note]
    assert_valid(stage.GetRootLayer().realPath, tmp_path)
