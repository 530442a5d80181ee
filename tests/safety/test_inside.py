"""A stage names files in its own folder; others are refused, in every command, before they are opened."""

import os
import shutil
import zipfile
from contextlib import suppress
from pathlib import Path

import pytest

from magtwin import allow
from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.export.contents import bring_together
from magtwin.files.file import shipped
from magtwin.files.folders import ALLOW_DIR
from magtwin.usd.attributes import plain_value
from magtwin.usd.layers import layer_sha256, open_layer, open_stage, stage_sha256

LAYER = '#usda 1.0\n(defaultPrim = "X")\ndef Xform "X" {\n}\n'

ROOT = """#usda 1.0
(
    defaultPrim = "A"
    %(layer)s
)
def Xform "A" (
    %(prim)s
)
{
    %(inside)s
}
"""

CLIPS = """clips = {
    dictionary default = {
        %s
        double2[] active = [(0, 0)]
        double2[] times = [(0, 0)]
        string primPath = "/X"
    }
}"""

TEMPLATE = 'string templateAssetPath = "../out/l.#.usda"\n' + "\n".join(
    f"double template{name} = 1" for name in ("StartTime", "EndTime", "Stride")
)

ARCS = {
    "sublayer": ("layer", "subLayers = [@../out/l.usda@]", ""),
    "reference": ("prim", "prepend references = @../out/l.usda@", "/A"),
    "payload": ("prim", "payload = @../out/l.usda@</X>", "/A"),
    "absolute reference": ("prim", "references = @OUT/l.usda@", "/A"),
    "reference with arguments": ("prim", "references = @../out/l.usda:SDF_FORMAT_ARGS:target=usd@", "/A"),
    "variant that is not selected": (
        "prim",
        'variantSets = "v"\n)\n{\nvariantSet "v" = { "b" ( references = @../out/l.usda@ ) {\n} }\n}\n'
        'def "B" (',
        "/A{v=b}",
    ),
    "expression": ("both", ('string D = "out"', '@`"../${D}/l.usda"`@'), "/A"),
    "reference beside its removal": ("prim", "delete references = @../out/l.usda@", "/A"),
    "clips": ("prim", CLIPS % "asset[] assetPaths = [@../out/l.usda@]", "/A"),
    "clips by a template": ("prim", CLIPS % TEMPLATE, "/A"),
    "clips' manifest": ("prim", CLIPS % "asset manifestAssetPath = @../out/l.usda@", "/A"),
    "texture": ("inside", "asset inputs:file = @../out/t.png@", "/A.inputs:file"),
    "texture by its absolute name": ("inside", "asset inputs:file = @OUT/t.png@", "/A.inputs:file"),
    "texture by an unregistered scheme": ("inside", "asset a = @foo://../../out/t.png@", "/A.a"),
    "texture by https": ("inside", "asset a = @https://../../out/t.png@", "/A.a"),
    "texture in tiles by a scheme": ("inside", "asset a = @foo://../../out/t.<UDIM>.png@", "/A.a"),
    "texture like an anonymous layer": ("inside", "asset a = @anon:x/../../out/t.png@", "/A.a"),
    "layer by a scheme, as a value": ("inside", "asset a = @foo://../../out/l.usda@", "/A.a"),
    "clips by a scheme": ("prim", CLIPS % "asset[] assetPaths = [@bar://../../out/l.usda@]", "/A"),
    "texture in tiles": ("inside", "asset inputs:file = @../out/t.<UDIM>.png@", "/A.inputs:file"),
    "texture over time": ("inside", "asset inputs:file.timeSamples = { 1: @../out/t.png@ }", "/A.inputs"),
    "array": ("inside", "asset[] files = [@./in.png@, @../out/t.png@]", "/A.files"),
    "network": ("inside", "asset network = @../out/n.safetensors@", "/A.network"),
    "metadata of a layer": ("layer", "customLayerData = { asset a = @../out/t.png@ }", ""),
    "metadata of a prim": ("prim", "customData = { dictionary d = { asset a = @../out/t.png@ } }", "/A"),
    "identifier": ("prim", "assetInfo = { asset identifier = @../out/l.usda@ }", "/A"),
    "link": ("inside", "asset inputs:file = @./link.png@", "/A.inputs:file"),
    "layer below a linked folder": ("prim", "references = @./linked/l.usda@", "/A"),
    "file of the working folder": ("inside", "asset inputs:file = @cwd.png@", "/A.inputs:file"),
    "reference of a reference": ("prim", "references = @./chain.usda@", "/X"),
    "variable of the layer above": ("both", ('string W = "../out"', "@./late.usda@"), "/X"),
}


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder `in` for a stage, `out` beside it with files to name, and another working folder."""
    for name in ("in", "out", "cwd"):
        (tmp_path / name).mkdir()
    for name in ("l.usda", "l.1.usda"):
        (tmp_path / "out" / name).write_text(LAYER)
    for name in ("out/t.png", "out/t.1001.png", "out/n.safetensors", "in/in.png", "cwd/cwd.png"):
        (tmp_path / name).write_bytes(b"secret")
    (tmp_path / "in" / "link.png").symlink_to(tmp_path / "out" / "t.png")
    (tmp_path / "in" / "linked").symlink_to(tmp_path / "out")
    chain = LAYER.replace('"X" {', '"X" (references = @../out/l.usda@) {')
    (tmp_path / "in" / "chain.usda").write_text(chain)
    late = '(\ndefaultPrim = "X"\nexpressionVariables = { string W = "." }\n)'
    late = LAYER.replace('(defaultPrim = "X")', late).replace(
        '"X" {', '"X" (references = @`"${W}/l.usda"`@) {'
    )
    (tmp_path / "in" / "late.usda").write_text(late)
    monkeypatch.chdir(tmp_path / "cwd")
    monkeypatch.delenv(ALLOW_DIR, raising=False)
    return tmp_path / "in"


def stage_with(place, kind):
    """A stage that names a file outside in one way."""
    slot, text, _ = ARCS[kind]
    parts = {"layer": "", "prim": "", "inside": ""}
    if slot == "both":
        parts["layer"], parts["prim"] = f"expressionVariables = {{ {text[0]} }}", f"references = {text[1]}"
    else:
        parts[slot] = text.replace("OUT", str(place.parent / "out"))
    (place / "s.usda").write_text(ROOT % parts)
    return place / "s.usda"


@pytest.mark.parametrize("kind", ARCS)
def test_a_name_out_of_the_folder_is_refused_with_its_prim_until_it_is_allowed(kind, place):
    stage, where = stage_with(place, kind), ARCS[kind][2]
    with pytest.raises(InputError, match="outside the stage's folder") as refusal:
        open_stage(stage)
    text = str(refusal.value)
    folder = "cwd" if kind == "file of the working folder" else "out"
    assert f"<{where}" in text or not where
    assert f"`magtwin.allow({str(place.parent / folder)!r})`" in text
    assert "\n" not in text
    for read in (stage_sha256, lambda file: bring_together(file, place)):
        with pytest.raises(InputError, match="outside the stage's folder"):
            read(stage)
    with allow(place.parent / folder):
        open_stage(stage)
    with pytest.raises(InputError, match="outside the stage's folder"):
        open_stage(stage)
    assert open_layer(stage)  # alone: nothing that it names is read
    assert layer_sha256(stage)


def test_a_file_that_escaped_the_audit_is_refused_where_it_is_used(place, monkeypatch):
    """The second check, for names that OpenUSD resolves otherwise than the audit."""
    parts = {"layer": "subLayers = [@../out/l.usda@]", "prim": "", "inside": "asset a = @../out/t.png@"}
    (place / "s.usda").write_text(ROOT % parts)
    monkeypatch.setattr("magtwin.usd.layers.try_stage", lambda path, composed: None)
    folder = place.parent / "packed"
    folder.mkdir()
    stage = open_stage(place / "s.usda")  # held in a name: a prim does not keep its stage alive
    with pytest.raises(InputError, match="outside the stage's folder"):
        bring_together(place / "s.usda", folder)
    with pytest.raises(InputError, match=r"</A\.a> names .*t\.png, outside the stage's folder"):
        plain_value(stage.GetPrimAtPath("/A").GetAttribute("a"))
    assert not any(folder.iterdir())


@pytest.mark.parametrize("form", ["usdc", "usdz"])
@pytest.mark.parametrize("kind", ["reference", "texture by its absolute name", "metadata of a prim"])
def test_binary_layers_and_packages_are_held_to_it(form, kind, place):
    from pxr import Sdf, Usd

    text = stage_with(place, kind)
    if form == "usdz":
        text.write_text(text.read_text().replace("../out", str(place.parent / "out")))
        with zipfile.ZipFile(place / "s.usdz", "w", zipfile.ZIP_STORED) as package:
            package.writestr("top.usda", LAYER.replace('"X" {', '"X" (references = @./below/s.usda@) {'))
            package.write(text, "below/s.usda")
    else:
        Sdf.Layer.FindOrOpen(str(text)).Export(str(place / "s.usdc"))
    file = place / f"s.{form}"
    assert Usd.Stage.Open(str(file))  # OpenUSD itself follows the name
    with pytest.raises(InputError, match="outside the stage's folder"):
        open_stage(file)
    with allow(place.parent / "out"):
        open_stage(file)


def test_what_lies_inside_ships_with_magtwin_or_is_nowhere_is_no_refusal(place):
    (place / "below").mkdir()
    (place / "below" / "l.usda").write_text(LAYER.replace("{\n", "{\nasset a = @../in.png@\n"))
    shipped_robot = shipped("robots", "turtlebot4", "turtlebot4.usda")
    parts = {
        "layer": "subLayers = [@./below/l.usda@]",
        "prim": f"references = @{shipped_robot}@",
        "inside": "asset a = @/home/of/another/wood.png@\nasset b = @https://a.example/wood.png@\n"
        "asset c = @in.png@\nasset d = @OmniPBR.mdl@\nasset e = @../out@",
    }
    (place / "s.usda").write_text(ROOT % parts)
    stage = open_stage(place / "s.usda")
    assert any(layer.realPath == str(shipped_robot) for layer in stage.GetUsedLayers())
    assert open_stage(shipped("scenes", "lab", "lab.usda"))  # names ../../robots and ../../maps


def test_a_linked_stage_is_held_to_the_folder_in_which_it_lies(place):
    (place / "s.usda").write_text(ROOT % {"layer": "", "prim": "", "inside": "asset a = @./in.png@"})
    (place.parent / "other").mkdir()
    link = place.parent / "other" / "link.usda"
    link.symlink_to(place / "s.usda")
    open_stage(link)
    (link.parent / "in.png").write_bytes(b"found beside the link")
    with pytest.raises(InputError, match="outside the stage's folder"):
        open_stage(link)


@pytest.mark.parametrize("scheme", ["https", "omniverse", "file"])
def test_layers_are_not_fetched(scheme, place):
    parts = {"layer": "", "prim": f"references = @{scheme}://a.example/l.usda@", "inside": ""}
    (place / "s.usda").write_text(ROOT % parts)
    with pytest.raises(InputError, match=r"</A> names .*, an address; download the file"):
        open_stage(place / "s.usda")


def test_a_layer_that_changes_is_looked_at_again(place):
    part = place / "part.usda"
    part.write_text(LAYER)
    (place / "s.usda").write_text(ROOT % {"layer": "subLayers = [@./part.usda@]", "prim": "", "inside": ""})
    open_stage(place / "s.usda")
    part.write_text(LAYER.replace('"X" {', '"X" (references = @../out/l.usda@) {'))
    with pytest.raises(InputError, match=r"part\.usda </X> names"):
        open_stage(place / "s.usda")


COMMANDS = (
    "info S",
    "run S --out o",
    "drive S",
    "plot S --out o.png",
    "export S --out o",
    "validate S",
    "map survey S --out o.parquet",
    "map info S",
    "robot S --out o.urdf",
    "ros magnetometer S",
)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_refuses_what_is_outside(command, place, capsys):
    copied = place / "s.usda"
    shutil.copytree(shipped("scenes", "lab"), place, dirs_exist_ok=True)
    text = (place / "lab.usda").read_text()
    for name in ("maps", "robots", "weights"):
        text = text.replace(f"../../{name}", str(shipped(name)))
    assert "subLayers = [" in text
    copied.write_text(text.replace("subLayers = [", "subLayers = [@../out/l.usda@, "))
    before = copied.read_bytes()
    with suppress(SystemExit), suppress(BrokenPipeError):
        main([str(copied) if word == "S" else word for word in command.split()])
    error = capsys.readouterr().err
    assert "s.usda: names ../out/l.usda, outside the stage's folder" in error
    assert f"give --allow {place.parent / 'out'}" in error
    assert not list(Path.cwd().glob("o*"))
    assert copied.read_bytes() == before


@pytest.mark.parametrize("form", ["--allow DIR info S", "info S --allow=DIR", "info --allow DIR S", "env"])
def test_allow_is_an_option_of_every_command(form, place, capsys, monkeypatch):
    stage = stage_with(place, "reference")
    if form == "env":
        monkeypatch.setenv(ALLOW_DIR, os.pathsep.join(["~", "../out"]))
    words = ("info S" if form == "env" else form).replace("S", str(stage)).split()
    main([word.replace("DIR", "../out") for word in words])
    assert "s.usda" in "".join(capsys.readouterr().out.split())  # long paths are wrapped


@pytest.mark.parametrize(
    ("folder", "message"),
    [("none", "no such folder"), ("l.usda", "a file; give its folder"), ("", "wants a f")],
)
def test_a_folder_that_cannot_be_allowed_is_refused(folder, message, place, capsys, monkeypatch):
    monkeypatch.chdir(place.parent / "out")
    with pytest.raises(SystemExit):
        main(["info", str(stage_with(place, "reference")), "--allow", folder])
    error = capsys.readouterr().err
    assert "--allow" in error
    assert message in error
    assert ALLOW_DIR not in os.environ


def test_a_picture_of_a_layer_that_is_a_link_is_not_packed(place):
    """Isaac Sim keeps a layer's picture in `.thumbs`; it is exported with the layer."""
    (place / "s.usda").write_text(ROOT % {"layer": "", "prim": "", "inside": ""})
    (place / ".thumbs" / "256x256").mkdir(parents=True)
    (place / ".thumbs" / "256x256" / "s.usda.png").symlink_to(place.parent / "out" / "t.png")
    out = place.parent / "packed"
    out.mkdir()
    bring_together(place / "s.usda", out)
    assert not any(file.read_bytes() == b"secret" for file in out.rglob("*") if file.is_file())
