"""Stages of other versions of the schema, and with names that it lacks; and the library without magtwin."""

import json
import os
import re
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
from magtwin.files.file import shipped
from magtwin.usd.maps.layer import load_map, save_map
from magtwin.usd.schema import FILES, FOLDER, NOUNS
from magtwin.usd.schema.versions import TEXT


def heard(call, *args):
    """What a call gives, and what it warns of."""
    with warnings.catch_warnings(record=True) as got:
        warnings.simplefilter("always", MismatchWarning)
        result = call(*args)
    return result, [str(w.message) for w in got if issubclass(w.category, MismatchWarning)]


def edited(folder: Path, text: str) -> Path:
    """The shipped scene, below an edit of its robot."""
    edit = folder / "edit.usda"
    edit.write_text(
        f'#usda 1.0\n(\n    defaultPrim = "World"\n    metersPerUnit = 1\n    upAxis = "Z"\n'
        f'    subLayers = [@{shipped("scenes", "lab", "lab.usda")}@]\n)\nover "World" {{\n'
        f'  over "turtlebot4" {{\n    {text}\n  }}\n}}\n'
    )
    return edit


@pytest.mark.usefixtures("allow_neighbours")
@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "double magtwin:drive:vMax = 0.1",
            "magtwin:drive:vMax, not in the schema and ignored; did you mean magtwin:drive:vMaxMPerS",
        ),
        ("custom double magtwin:drive:vMaxMperS = 1", "vMaxMperS, .*; did you mean magtwin:drive:vMaxMPerS"),
        ("rel magtwin:drive:leftWheelJoin = </World>", "did you mean magtwin:drive:leftWheelJoint"),
        ("double magtwin:zzz = 1\ndouble magtwin:qqq = 1", "and 1 more such names, .*docs/schema.md has the"),
    ],
)
def test_a_name_that_the_schema_lacks_is_told_once_with_its_prim_and_the_nearest_name(tmp_path, text, said):
    edit = edited(tmp_path, text)
    twin, texts = heard(lambda: magtwin.open_twin(edit, network="none"))
    assert twin.scene.robot.drive == magtwin.open_twin("lab", network="none").scene.robot.drive
    (told,) = texts
    assert re.search(f"edit.usda: </World/turtlebot4> has .*{said}", told), told
    assert heard(lambda: magtwin.open_twin(edit, network="none"))[1] == []


@pytest.mark.parametrize(
    ("version", "words"),
    [
        ("2.0", "is of schema 2.0, this magtwin knows 1.0"),
        ("one", "must be a version such as '1.0', got 'one'"),
    ],
)
def test_a_later_or_wrong_version_is_refused_and_a_later_second_number_read_and_told(
    tmp_path, version, words
):
    with pytest.raises(InputError, match=f"m.usda: .*{words}") as refused:
        load_map(of_version(tmp_path, version))
    assert "\n" not in str(refused.value)
    (tmp_path / "later").mkdir()
    field, (said,) = heard(load_map, of_version(tmp_path / "later", "1.7"))
    assert field == a_map()
    assert "of a schema later than 1.0" in said


def of_version(folder: Path, version: str) -> Path:
    """A map of another version of the schema."""
    file = folder / "m.usda"
    save_map(a_map(), folder / "m.usdc")
    Sdf.Layer.FindOrOpen(str(folder / "m.usdc")).Export(str(file))
    file.write_text(file.read_text().replace('SchemaVersion = "1.0"', f'SchemaVersion = "{version}"'))
    return file


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
    **dict.fromkeys(("frame", "datum", "name", "method", "source", "licence", "created"), "same"),
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
    main(["schema", "--out", str(tmp_path / "schema")])
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
