"""Stages of other versions of the schema: read, upgraded or refused; and the library without magtwin."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd

import magtwin
from magtwin.cli import main
from magtwin.errors import InputError, MismatchWarning
from magtwin.field.maps.map import AnomalyMap
from magtwin.files import shipped
from magtwin.usd.layers import layer_sha256, open_stage
from magtwin.usd.maps.layer import load_map, save_map
from magtwin.usd.schema import FILES, FOLDER, NOUNS, attribute_name, publish
from magtwin.usd.schema.names import REMOVED, RENAMED
from magtwin.usd.schema.versions import TEXT, older_properties, version_of
from magtwin.usd.upgrade import upgrade

LAB = "lab"
PARTS = ("maps/lab", "robots/turtlebot4", "scenes/lab")
OLDER = {name: older for older, name in RENAMED.items()}

OLD_MAP = """#usda 1.0
(
    customLayerData = { string creator = "magtwin" }
    defaultPrim = "World"
    metersPerUnit = 1
    upAxis = "Z"
)
def Xform "World"
{
    def Xform "AnomalyMap" (prepend apiSchemas = ["MagtwinAnomalyMapAPI"])
    {
        double2 magtwin:anomalyMap:cellSize = (0.5, 0.25)
        string magtwin:anomalyMap:checksum = "%s"
        double[] magtwin:anomalyMap:headings = [0, 90]
        double2 magtwin:anomalyMap:origin = (-1, 2)
        int[] magtwin:anomalyMap:shape = [2, 2, 2]
        uniform token magtwin:anomalyMap:unit = "nT"
        bool[] magtwin:anomalyMap:valid = [1, 1, 1, 1, 1, 1, 1, 0]
        float[] magtwin:anomalyMap:values = [1, 2, 3, 4, 5, 6, 7, 8]
        float[] magtwin:anomalyMap:variance = [9, 9, 9, 9, 9, 9, 9, 9]
    }
}
"""
"""A map of magtwin 0.1, by hand: the checksum covers the arrays."""


def old_map(folder: Path, text: str = OLD_MAP) -> Path:
    digest = hashlib.sha256(np.arange(1, 9, dtype="<f4").tobytes())
    digest.update(bytes([1] * 7 + [0]) + np.full(8, 9, "<f4").tobytes())
    file = folder / "old.usda"
    file.write_text(text % digest.hexdigest())
    return file


def heard(call, *args):
    """What a call gives, and what it warns of."""
    with warnings.catch_warnings(record=True) as got:
        warnings.simplefilter("always", MismatchWarning)
        result = call(*args)
    return result, [str(w.message) for w in got if issubclass(w.category, MismatchWarning)]


def made_older(file: Path) -> None:
    """Give a layer the names of 0.x, and no version."""
    layer = Sdf.Layer.FindOrOpen(str(file))
    found: list[Sdf.Path] = []
    layer.Traverse("/", found.append)
    for path in found:
        if path.IsPropertyPath() and path.name in OLDER:
            layer.GetPropertyAtPath(path).name = OLDER[path.name]
    data = dict(layer.customLayerData)
    layer.customLayerData = {k: v for k, v in data.items() if k != "magtwin"}
    layer.Save()


@pytest.fixture(scope="module")
def copied(tmp_path_factory) -> Path:
    """The shipped scene with its files, to be changed."""
    folder = tmp_path_factory.mktemp("copied")
    for part in PARTS:
        shutil.copytree(shipped(*part.split("/")), folder / part)
    return folder / "scenes" / LAB / "lab.usda"


@pytest.fixture
def old_scene(copied, tmp_path) -> Path:
    """The shipped scene as magtwin 0.2 would have it."""
    root = copied.parents[2]
    shutil.copytree(root, tmp_path / "old")
    map_file = tmp_path / "old" / "maps" / "lab" / "lab.usdc"
    before = layer_sha256(map_file)
    for file in sorted((tmp_path / "old").rglob("*.usd[ac]")):
        made_older(file)
    scene = tmp_path / "old" / "scenes" / LAB / "lab.usda"
    text = scene.read_text()
    assert before in text
    scene.write_text(text.replace(before, layer_sha256(map_file)))
    return scene


def drive(file: Path) -> np.ndarray:
    twin = magtwin.open_twin(file, network="none")
    return magtwin.simulate(twin, "sine", seed=3, session="survey", duration_s=2.0)["b_measured_nt"]


def test_an_old_map_is_read_as_it_was_with_one_warning(tmp_path):
    file = old_map(tmp_path)
    bytes_before = file.read_bytes()
    field, said = heard(load_map, file)
    assert said == [
        f"{file}: old.usda has attributes of schema 0.x, read as those of {TEXT}; `magtwin upgrade {file}` "
        "rewrites the files"
    ]
    np.testing.assert_array_equal(field.values_nt.ravel()[:7], np.arange(1.0, 8))
    assert not field.valid.ravel()[7]
    assert (field.origin_m, field.cell_m) == ((-1.0, 2.0), (0.5, 0.25))
    np.testing.assert_allclose(field.headings_rad, [0, np.pi / 2])
    assert (field.variance_nt2 == 9).all()
    assert heard(load_map, file) == (field, [])  # told once
    assert file.read_bytes() == bytes_before
    assert upgrade(file) == [file]
    assert heard(load_map, file) == (field, [])
    assert version_of(Sdf.Layer.FindOrOpen(str(file))) == (1, 0)
    assert upgrade(file) == []


@pytest.mark.usefixtures("allow_neighbours")
def test_an_old_scene_runs_to_the_same_readings_and_warns_once(copied, old_scene):
    wanted, none = heard(drive, copied)
    assert none == []
    got, said = heard(drive, old_scene)
    assert len(said) == 1
    assert f"`magtwin upgrade {old_scene}`" in said[0]
    np.testing.assert_array_equal(got, wanted)
    assert len(upgrade(old_scene)) >= 4
    upgraded, none = heard(drive, old_scene)
    assert none == []
    np.testing.assert_array_equal(upgraded, wanted)
    for file in old_scene.parents[2].rglob("*.usd[ac]"):
        assert older_properties(Sdf.Layer.OpenAsAnonymous(str(file))) == []


@pytest.mark.usefixtures("allow_neighbours")
def test_an_edit_with_an_older_name_counts_and_is_told(copied, tmp_path):
    edit = tmp_path / "edit.usda"
    edit.write_text(
        f'#usda 1.0\n(\n    defaultPrim = "World"\n    metersPerUnit = 1\n    upAxis = "Z"\n'
        f'    subLayers = [@{copied}@]\n)\nover "World" {{\n  over "turtlebot4" {{\n'
        "    double magtwin:drive:vMax = 0.123\n  }\n}\n"
    )
    twin, said = heard(lambda: magtwin.open_twin(edit, network="none"))
    assert twin.scene.robot.drive.v_max == 0.123
    assert len(said) == 1
    assert "edit.usda has attributes of schema 0.x" in said[0]


def test_a_stage_that_another_one_holds_is_opened_again_and_other_edits_are_refused(tmp_path):
    file = old_map(tmp_path)
    stage = open_stage(file)
    prim = stage.GetPrimAtPath("/World/AnomalyMap")
    assert load_map(file) == load_map(file)
    assert prim.GetAttribute(attribute_name("anomalyMap", "origin")).Get() == (-1, 2)
    file.write_text(file.read_text().replace("(-1, 2)", "(-3, 2)"))  # changed on disk, under the stage
    os.utime(file, ns=(1, 1))
    with pytest.raises(InputError, match="not saved"):
        load_map(file)
    del stage, prim
    assert load_map(file).origin_m == (-3.0, 2.0)
    other = tmp_path / "new.usdc"
    save_map(a_map(), other)
    stage = Usd.Stage.Open(str(other))
    stage.GetPrimAtPath("/World/AnomalyMap").GetAttribute("magtwin:anomalyMap:name").Set("x")
    with pytest.raises(InputError, match="not saved"):
        load_map(other)


@pytest.mark.parametrize(
    ("version", "said"),
    [
        ("2.0", "is of schema 2.0, this magtwin knows 1.0; read it with a later magtwin"),
        ("one", "magtwinSchemaVersion must be a version such as '1.0', got 'one'"),
    ],
)
def test_a_later_or_wrong_version_is_refused_in_one_line(tmp_path, version, said):
    file = old_map(tmp_path, with_version(version))
    for call in (load_map, upgrade):
        with pytest.raises(InputError, match=f"old.usda: .*{said}") as refused:
            call(file)
        assert "\n" not in str(refused.value)


def test_a_later_second_number_is_read_and_told(tmp_path):
    file = tmp_path / "m.usda"
    save_map(a_map(), tmp_path / "m.usdc")
    Sdf.Layer.FindOrOpen(str(tmp_path / "m.usdc")).Export(str(file))
    file.write_text(file.read_text().replace('SchemaVersion = "1.0"', 'SchemaVersion = "1.7"'))
    field, said = heard(load_map, file)
    assert field == a_map()
    assert len(said) == 1
    assert "of a schema later than 1.0" in said[0]


def with_version(version: str) -> str:
    return OLD_MAP.replace('string creator = "magtwin" }', f'string magtwinSchemaVersion = "{version}" }}')


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('unit = "nT"', 'unit = "uT"', "magtwin:anomalyMap:unit is 'uT', magtwin reads nT"),
        (
            "int[] magtwin:anomalyMap:shape",
            "double2 magtwin:anomalyMap:originM = (0, 0)\n        int[] magtwin:anomalyMap:shape",
            "has magtwin:anomalyMap:origin and its later name magtwin:anomalyMap:originM; remove one",
        ),
    ],
)
def test_what_has_two_meanings_is_refused(tmp_path, old, new, said):
    file = old_map(tmp_path, OLD_MAP.replace(old, new))
    before = file.read_bytes()
    for call in (load_map, upgrade):
        with pytest.raises(InputError, match=f"old.usda </World/AnomalyMap>: {said}"):
            call(file)
    assert file.read_bytes() == before


def a_map() -> AnomalyMap:
    values = np.linspace(4e4, 5e4, 12).astype("f4").astype(float).reshape(2, 2, 3)
    return AnomalyMap(
        values_nt=values,
        origin_m=(0.5, 0.0),
        cell_m=(0.5, 0.4),
        headings_rad=np.array([0, np.pi]),
        variance_nt2=np.ones((2, 2, 3)),
    )


MEANT = {
    **dict.fromkeys(("valuesNt", "valid", "shape", "headingsDeg", "checksum", "originM", "cellSizeM"), ""),
    "varianceNt2": "",  # the checksum covers it
    "checksumVersion": "",
    **dict.fromkeys(("recordedNt", "recordedYawRad", "parameters", "madeFrom", "heightM"), "same"),
    **dict.fromkeys(("tileCells", "tileChecksums", "tileFigures", "frame", "datum"), "same"),
    **dict.fromkeys(("name", "method", "source", "licence", "created"), "same"),
}
"""A map without one of its attributes: "" if it is refused, "same" if the fallback is that of AnomalyMap."""


def test_a_map_without_an_attribute_is_refused_or_has_the_default(tmp_path):
    known = Usd.SchemaRegistry().FindAppliedAPIPrimDefinition(NOUNS["anomalyMap"]).GetPropertyNames()
    assert {name.rsplit(":", 1)[1] for name in known} == set(MEANT)
    for name, meant in MEANT.items():
        file = tmp_path / f"{name}.usdc"
        save_map(a_map(), file)
        layer = Sdf.Layer.FindOrOpen(str(file))
        prim = layer.GetPrimAtPath("/World/AnomalyMap")
        if attribute := prim.attributes.get(f"magtwin:anomalyMap:{name}"):
            prim.RemoveProperty(attribute)
            layer.Save()
        if meant:
            assert load_map(file) == a_map()
        else:
            with pytest.raises(InputError):
                load_map(file)


READER = """
import json, sys
sys.modules["magtwin"] = None  # not importable
from pxr import Sdf, Usd
registry, found = Usd.SchemaRegistry(), {}
for name in json.loads(sys.argv[1]):
    known = registry.FindAppliedAPIPrimDefinition(name)
    stage = Usd.Stage.CreateInMemory()
    prim = stage.DefinePrim("/thing", "Xform")
    assert prim.ApplyAPI(name), name
    for prop in prim.GetProperties():
        if not prop.GetName().startswith("magtwin:"):
            continue
        value = str(prop.Get()) if isinstance(prop, Usd.Attribute) else "rel"
        kind = str(prop.GetVariability()) if isinstance(prop, Usd.Attribute) else "rel"
        text = known.GetPropertyDocumentation(prop.GetName())
        found[prop.GetName()] = [value, prop.GetDisplayName(), prop.GetDisplayGroup(), kind, text]
print(json.dumps(found))
"""


def test_bare_usd_shows_the_published_folder_with_its_names_groups_texts_and_fallbacks(tmp_path):
    publish(tmp_path / "schema")
    assert sorted(p.name for p in (tmp_path / "schema").iterdir()) == sorted(FILES)
    assert json.loads((FOLDER / "plugInfo.json").read_text())["Plugins"][0]["Info"]["schemaVersion"] == TEXT
    done = subprocess.run(
        [sys.executable, "-I", "-c", READER, json.dumps(list(NOUNS.values()))],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        env=os.environ | {"PXR_PLUGINPATH_NAME": str(tmp_path / "schema")},
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    source = Sdf.Layer.OpenAsAnonymous(str(FOLDER / "schema.usda"))
    wanted = {}
    for prim in source.rootPrims:
        for prop in prim.properties:
            shown = [prop.GetInfo("displayName"), prop.GetInfo("displayGroup")]
            text = " ".join(prop.documentation.split())
            if isinstance(prop, Sdf.AttributeSpec):
                wanted[prop.name] = [str(prop.default), *shown, "Sdf.VariabilityUniform", text]
            else:
                wanted[prop.name] = ["rel", *shown, "rel", text]
    assert json.loads(done.stdout) == wanted
    assert len(wanted) > 190


@pytest.mark.parametrize("first", ["", "from pxr import Plug; Plug.Registry().GetAllPlugins(); "])
def test_an_older_library_on_the_path_is_not_used(tmp_path, first):
    publish(tmp_path / "schema")
    info = tmp_path / "schema" / "plugInfo.json"
    info.write_text(info.read_text().replace('"schemaVersion": "1.0"', '"schemaVersion": "0.9"'))
    where = "from pxr import Plug; print(Plug.Registry().GetPluginWithName('magtwin').resourcePath)"
    done = subprocess.run(
        [sys.executable, "-c", f"{first}import magtwin.usd; {where}"],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PXR_PLUGINPATH_NAME": str(tmp_path / "schema")},
    )
    if first:
        assert "InputError: USD loads version 0.9 of magtwin's schemas from" in done.stderr
    else:
        assert done.stdout.strip() == str(FOLDER)


def test_no_name_is_used_twice_and_every_new_one_is_in_the_schema():
    known = {
        name
        for api in NOUNS.values()
        for name in Usd.SchemaRegistry().FindAppliedAPIPrimDefinition(api).GetPropertyNames()
    }
    assert set(RENAMED.values()) <= known
    assert not (RENAMED.keys() | REMOVED.keys()) & known
    assert len(set(RENAMED.values())) == len(RENAMED)


def test_the_commands_copy_the_library_and_rewrite_a_map(tmp_path, capsys):
    main(["schema"])
    assert capsys.readouterr().out.strip() == str(FOLDER)
    main(["schema", "--out", str(tmp_path / "library")])
    assert sorted(p.name for p in (tmp_path / "library").iterdir()) == sorted(FILES)
    capsys.readouterr()
    file = old_map(tmp_path)
    main(["map", "info", str(file)])
    assert capsys.readouterr().err.count("magtwin upgrade") == 1
    main(["upgrade", str(file), "--json"])
    assert json.loads(capsys.readouterr().out) == {"wrote": [str(file)]}
    main(["map", "info", str(file)])
    assert "upgrade" not in capsys.readouterr().err
    main(["upgrade", str(file)])
    assert "Nothing to do" in capsys.readouterr().out


def test_an_export_of_an_old_map_is_of_this_version(tmp_path):
    file = old_map(tmp_path)
    done, _ = heard(magtwin.export_scene, file, tmp_path / "out")
    assert any("were of schema 0.x" in note for note in done.notes)
    layer = Sdf.Layer.OpenAsAnonymous(str(done.root))
    assert older_properties(layer) == []
    assert version_of(layer) == (1, 0)
    assert older_properties(Sdf.Layer.OpenAsAnonymous(str(file)))
    assert heard(load_map, done.root) == (load_map(file), [])
