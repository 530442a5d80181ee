"""Exports of what others made: refused with what to do and nothing written, or converted point by point."""

import shutil
import signal
import struct
import subprocess
import zipfile
from pathlib import Path

import pytest
from pxr import Sdf

from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.export.package import export_scene
from magtwin.export.usdz import pack, unpack
from magtwin.files.file import sha256, shipped
from magtwin.files.folders import allow

LAB = shipped("scenes", "lab", "lab.usda")
HEAD = '#usda 1.0\n(\n    defaultPrim = "World"\n    metersPerUnit = 1\n    upAxis = "Z"\n)\n'
CUBE = 'def Xform "World"\n{\n    def Cube "box"\n    {\n    }\n}\n'


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of the default lab, to be copied and spoiled."""
    out = tmp_path_factory.mktemp("lab") / "lab"
    export_scene(LAB, out, trusted=True)
    return out


NAMES = 'def Xform "World"\n{{\n    asset file = @{}@\n}}\n'


def refuse(text: str, stage: Path, tmp_path: Path, out: str = "out", **options) -> None:
    """The export is refused with a text, one line of it, and leaves nothing behind."""
    place = tmp_path / "place"
    place.mkdir(exist_ok=True)
    with pytest.raises(InputError, match=text) as refused:
        export_scene(stage, place / out, **{"trusted": True, **options})
    assert "\n" not in str(refused.value)
    assert "/tmp/tmp" not in str(refused.value)  # a folder that is gone helps nobody
    assert not list(place.iterdir())


def write(tmp_path: Path, text: str) -> Path:
    (tmp_path / "stage.usda").write_text(text)
    return tmp_path / "stage.usda"


# What is missing, spoiled or dangerous


def append(file: Path, data: bytes = b"x") -> None:
    file.write_bytes(file.read_bytes() + data)


def spoil_room(own: Path) -> None:
    room = own / "room.usda"
    room.write_bytes(room.read_bytes().replace(b"Looks", b"L\xffoks"))


def spoil_map(own: Path) -> None:
    layer = Sdf.Layer.FindOrOpen(str(own / "lab" / "lab.usdc"))
    values = layer.GetAttributeAtPath("/World/AnomalyMap.magtwin:anomalyMap:valuesNt")
    values.default = type(values.default)([v + 1 for v in values.default])
    layer.Save()


def weights(own: Path) -> Path:
    return next((own / "weights").glob("*.safetensors"))


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda own: (own / "room.usda").unlink(), r"lab\.usda: .*room\.usda"),
        (spoil_room, r"lab\.usda: .*room\.usda"),  # no UTF-8
        (lambda own: weights(own).unlink(), r"<\S*/magnetometer\S*network>: names .*does not exist"),
        (lambda own: append(weights(own)), r"lab/lab\.usda <\S*/magnetometer>: its network .* SHA-256"),
        (spoil_map, r"<.*AnomalyMap>: .*checksum"),
    ],
)
def test_a_lab_with_a_part_that_is_missing_or_another_is_refused(spoil, words, lab, tmp_path):
    own = shutil.copytree(lab, tmp_path / "lab")
    spoil(own)
    refuse(words, own / "lab.usda", tmp_path)


VARIANT = (
    'def Xform "World" (variants = {string v = "a"}\nprepend variantSets = "v")\n{\n'
    'variantSet "v" = {\n"a" {\n}\n"b" (references = @./gone.usda@) {\n}\n}\n}\n'
)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (HEAD + VARIANT, r"stage\.usda: names .*gone\.usda, which does not exist"),  # in any variant
        (HEAD + NAMES.format("./wood.png"), r"</World\.file>: names .*wood\.png, which does not exist"),
        (HEAD + NAMES.format("/etc/passwd"), r"</World\.file> names /etc/passwd, outside"),
        (
            '#usda 1.0\n(metersPerUnit = 0.01; upAxis = "Y")\n' + CUBE,
            r"stage\.usda: has 0\.01 m .*Y up; .*convert",
        ),
        ("#usda 1.0\n" + CUBE, "0.01 m a unit and Y up, the defaults of USD"),
    ],
)
def test_a_stage_that_cannot_be_handed_on_is_refused(text, words, tmp_path):
    refuse(words, write(tmp_path, text), tmp_path)


def test_a_file_that_is_nothing_a_stage_needs_is_not_handed_on_and_a_material_of_omniverse_may_be_named(
    tmp_path,
):
    stage = write(tmp_path, HEAD + NAMES.format("/etc/passwd"))
    with allow("/etc"):
        refuse(r"</World\.file>: names /etc/passwd, .* not exported", stage, tmp_path)
    made = export_scene(write(tmp_path, HEAD + NAMES.format("OmniPBR.mdl")), tmp_path / "out", trusted=True)
    assert "@OmniPBR.mdl@" in made.root.read_text()


@pytest.mark.parametrize(
    "name", ["../evil.usda", "/tmp/evil.usda", "a/../../evil.usda", "..\\evil.usda", "c:evil.usda"]
)
def test_an_entry_that_climbs_out_of_its_package_is_refused_before_anything_is_written(name, tmp_path):
    with zipfile.ZipFile(tmp_path / "slip.usdz", "w") as archive:
        archive.writestr("a.usda", HEAD + CUBE)
        archive.writestr(name, "#usda 1.0\n")
    refuse(r"slip\.usdz: its entry .*evil.* would be written outside", tmp_path / "slip.usdz", tmp_path)
    assert not list(tmp_path.rglob("evil*"))


def test_a_package_that_names_a_layer_outside_of_itself_is_refused(tmp_path):
    secret = write(tmp_path, HEAD + CUBE)
    with zipfile.ZipFile(tmp_path / "a.usdz", "w") as archive:
        text = HEAD.replace("    upAxis", f"    subLayers = [@{secret}@]\n    upAxis")
        archive.writestr("a.usda", text + CUBE)
    package = tmp_path / "a.usdz"
    refuse(r"a\.usdz/a\.usda: names .*stage\.usda, outside the stage's folder", package, tmp_path)
    with allow(tmp_path):
        refuse(r"a\.usdz/a\.usda: names .*stage\.usda, outside its package", package, tmp_path)


@pytest.mark.parametrize(
    "damage", ["cut", "flipped", "empty", "text", "compressed", "twice", "program", "no layer"]
)
def test_a_damaged_package_or_one_against_the_format_is_refused(damage, tmp_path):
    package = tmp_path / "lab.usdz"
    write(tmp_path, HEAD + CUBE)
    folder = tmp_path / "stage"
    folder.mkdir()
    shutil.move(tmp_path / "stage.usda", folder)
    pack(folder / "stage.usda", package)
    data = bytearray(package.read_bytes())
    if damage == "cut":
        data = data[:-100]
    elif damage == "flipped":
        data[100] ^= 1
    elif damage == "empty":
        data = bytearray()
    elif damage == "text":
        data = bytearray(b"not a package")
    package.write_bytes(data)
    if damage in ("compressed", "twice", "program", "no layer"):
        how = zipfile.ZIP_DEFLATED if damage == "compressed" else zipfile.ZIP_STORED
        with zipfile.ZipFile(package, "w", how) as archive:
            archive.writestr("a.png" if damage == "no layer" else "a.usda", HEAD + CUBE)
            archive.writestr({"twice": "A.usda", "program": "run.py"}.get(damage, "b.usda"), HEAD)
    refuse(r"lab\.usdz: ", package, tmp_path)


def test_a_package_that_is_packed_and_unpacked_is_the_same_files(lab, tmp_path):
    shutil.copytree(
        lab, tmp_path / "lab", ignore=shutil.ignore_patterns("weights", "plugin", "*.md", ".thumbs")
    )
    pack(tmp_path / "lab" / "lab.usda", tmp_path / "lab.usdz")
    (tmp_path / "back").mkdir()
    assert unpack(tmp_path / "lab.usdz", tmp_path / "back") == tmp_path / "back" / "lab.usda"
    files = {f.relative_to(tmp_path / "lab") for f in (tmp_path / "lab").rglob("*") if f.is_file()}
    assert files == {f.relative_to(tmp_path / "back") for f in (tmp_path / "back").rglob("*") if f.is_file()}
    assert all(sha256(tmp_path / "lab" / f) == sha256(tmp_path / "back" / f) for f in files)


def test_a_layer_that_ends_its_reader_is_refused_in_one_line(lab, tmp_path, monkeypatch):
    own = shutil.copytree(lab, tmp_path / "lab")
    seen = {}

    def killed(module, job, limit_s, *flags):
        seen["module"] = module
        return None, subprocess.CompletedProcess([module], -signal.SIGSEGV, "", "")

    monkeypatch.setattr("magtwin.export.validation.inspection.answer_of", killed)
    refuse(r"lab\.usda: damaged: USD crashes on it", own / "lab.usda", tmp_path, trusted=False)
    assert seen["module"] == "magtwin.export.validation.inspection"


@pytest.mark.parametrize(
    ("out", "options", "text"),
    [
        ("lab.obj", {}, r"an export is a folder \(no suffix\), or ends in \.usdz, \.usd, \.usdc or \.glb"),
        ("lab.glb", {"profile": "isaac"}, r"\.glb is for viewers; give a folder or a \.usdz"),
        ("lab", {"profile": "ominverse"}, r"did you mean 'omniverse'"),
        ("lab", {"profile": "isaac"}, "has no lab, robot and magnetometer, .* use `profile='omniverse'`"),
    ],
)
def test_what_cannot_be_made_is_refused(out, options, text, tmp_path):
    refuse(text, write(tmp_path, HEAD + CUBE), tmp_path, out, **options)


def test_a_folder_is_refused_with_the_stage_that_is_meant(lab, tmp_path):
    own = shutil.copytree(lab, tmp_path / "lab")
    refuse(r"lab: a folder; give a USD file in it, such as \S*lab/lab\.usda", own, tmp_path)


def test_what_exists_is_replaced_only_when_asked(lab, tmp_path):
    stage = write(tmp_path, HEAD + CUBE)
    for name in ("a", "a.usdz", "a.glb", "a.usd"):
        export_scene(stage, tmp_path / name, trusted=True)
        before = (tmp_path / name).stat().st_mtime_ns
        with pytest.raises(InputError, match="exists already; give `force=True`"):
            export_scene(stage, tmp_path / name, trusted=True)
        assert (tmp_path / name).stat().st_mtime_ns == before
        export_scene(stage, tmp_path / name, trusted=True, force=True)
    assert not list(tmp_path.glob(".*"))


def test_an_export_does_not_take_the_place_of_the_stage_that_it_is_made_from(lab, tmp_path):
    own = shutil.copytree(lab, tmp_path / "lab")
    for out in (own, own.parent):
        with pytest.raises(InputError, match="contains the exported stage; give another output"):
            export_scene(own / "lab.usda", out, trusted=True, force=True)
    assert (own / "room.usda").is_file()


# Structure


# The command


def test_the_command_exports_a_scene_by_its_name_and_says_what_it_made_as_json(tmp_path, capsys):
    main(["export", "lab", "--out", str(tmp_path / "lab.glb"), "--json"])
    said = capsys.readouterr().out
    assert '"profile"' in said
    assert struct.unpack("<4s", (tmp_path / "lab.glb").read_bytes()[:4]) == (b"glTF",)


@pytest.mark.parametrize(
    ("scene", "text"), [("lap", "did you mean 'lab'"), ("lab.toml", "magtwin scene lab.toml --out lab")]
)
def test_the_command_refuses_what_is_no_stage_with_status_1(scene, text, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["export", scene, "--out", str(tmp_path / "lab")])
    assert ended.value.code == 1
    assert text in capsys.readouterr().err
