"""Kinds: what a file is, from its name and its first bytes, and which command takes it.

Readers call `expected` first. A file of another kind is then refused with the command that takes it, in place
of a fault of the parser. Kinds of USD files are told apart in `magtwin.usd`.
"""

import os
import re
from codecs import BOM_UTF8
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from magtwin.errors import InputError, find
from magtwin.files.file import existing, shipped

HEAD = 1 << 16
"""Bytes that are read at the beginning and at the end of a file."""


@dataclass(frozen=True)
class Kind:
    """A kind of file."""

    noun: str
    """What it is, with its article."""

    remedy: str
    """What to do with one; {file} stands for its name."""


SCENE_TOML = Kind("the TOML of a scene", "author its stage first: magtwin scene {file} --out FOLDER")
SUITE_TOML = Kind("the TOML of a suite", "magtwin bench {file} --out FOLDER runs it")
ROBOT_TOML = Kind("the settings of a robot", "magtwin robot URDF --settings {file} --out FOLDER takes it")
TRAIN_TOML = Kind("the settings of a training", "magtwin train SET --config {file} takes it")
TOML = Kind("a TOML", "give the file that is named there, or see --help for what takes a TOML")
URDF = Kind(
    "a robot description",
    "magtwin robot {file} --out FOLDER converts it; magtwin scene --urdf {file} --out FOLDER puts it "
    "into a room",
)
STAGE = Kind("a USD file", "magtwin info {file} describes it")
ROBOT_FOLDER = Kind("the folder of a robot", "name the stage inside")
SCENE_FOLDER = Kind("the folder of a scene", "magtwin run {file} drives in it; or name the stage inside")
RUN = Kind("a run", "magtwin info {file} describes it, and magtwin plot, report and localize take it")
SWEEP = Kind(
    "a folder of runs", "name one of its .parquet files; magtwin report and magtwin dataset build take all"
)
READINGS = Kind("a table of survey readings", "magtwin map fit {file} --out MAP.usdc fits a map to it")
SURVEY = Kind(
    "a survey, one CSV per heading", "magtwin map import {file} --out MAP.usdc makes a map layer of it"
)
DATASET = Kind(
    "a data set", "magtwin train {file} --out F.safetensors and magtwin dataset info {file} take it"
)
RESULTS = Kind("a folder of results", "magtwin bench report {file} takes it")
WEIGHTS = Kind(
    "a network",
    "magtwin info {file} describes it; magtwin evaluate and magtwin run SCENE --network {file} take it",
)
ONNX = Kind("a network as ONNX, which runs without magtwin", "give its .safetensors or .pth")
CHECKPOINT = Kind("a PyTorch checkpoint", "magtwin model convert {file} --out F.safetensors converts it")
PATH = Kind("a path", "magtwin run SCENE --path {file} drives it")
COMMANDS = Kind("a file of commands", "magtwin run SCENE --path {file} drives them")
MODEL = Kind("a Tolles-Lawson model", "magtwin model compensate apply RUN {file} --out F.parquet applies it")
JSON = Kind("a JSON", "give another file")
PICTURE = Kind("a picture or film", "give the file that it was drawn from")
PAGE = Kind("a page", "give the file that it was made from")
PYTHON = Kind("a Python file", "magtwin localize RUN --map MAP --method MODULE:CLASS takes a class in it")
YAML = Kind("a YAML", "--controllers of magtwin robot and magtwin scene takes one with a robot's controllers")
OCCUPANCY = Kind("an occupancy map of map_server", "give the scene that magtwin map occupancy made it from")
BAG_YAML = Kind("the description of a bag", "give the folder that it is in")
MESH = Kind("a mesh", "magtwin robot converts a URDF that names it")
GAZEBO = Kind("a world or model of Gazebo", "give the URDF or the stage that it was made from")
ARCHIVE = Kind("an archive", "unpack it, and give a file in it")
TABLE = Kind("a table", "give its columns to magtwin map import, or the file that it was made from")

USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")

ACCEPTED: dict[str, tuple[Kind, ...]] = {
    "run": (RUN, STAGE, JSON, TABLE),
    "scene": (STAGE,),
    "USD file": (STAGE,),
    "map": (STAGE, SURVEY),
    "source of readings": (RUN, SWEEP, READINGS, SURVEY, TABLE, COMMANDS, PATH, ARCHIVE),
    "robot description": (URDF,),
    "robot": (URDF, STAGE),
    "weights file": (WEIGHTS, CHECKPOINT),
    "data set": (DATASET,),
    "folder of results": (RESULTS,),
    "TOML of a scene": (SCENE_TOML, TOML),
    "suite": (SUITE_TOML, TOML),
    "settings of a robot": (ROBOT_TOML, TOML),
    "settings of a training": (TRAIN_TOML, TOML),
    "path file": (PATH, TABLE),
    "file of commands": (COMMANDS, TABLE),
    "Tolles-Lawson model": (MODEL, JSON),
}
"""Kinds that a reader of a noun reads. A table is let through where its columns decide."""

_REMEDIES = {
    ("robot description", STAGE): "magtwin robot {file} --out F.urdf writes the URDF of a stage",
    (
        "TOML of a scene",
        STAGE,
    ): "magtwin run {file} drives in it if magtwin scene made it; for another room, magtwin new room.toml "
    "writes a TOML; its furniture may be meshes (glTF, OBJ, STL), and your stage may reference the finished "
    "room (docs/scenes.md)",
    ("TOML of a scene", URDF): "magtwin scene --urdf {file} --out FOLDER puts it into a room",
    (
        "source of readings",
        STAGE,
    ): "give the survey that the map was made of, or survey a scene: magtwin map survey",
    ("data set", SWEEP): "build one first: magtwin dataset build {file} --map MAP --out SET",
    ("scene", RUN): "give the scene; magtwin run SCENE --path {file} repeats a run in it",
    ("USD file", RUN): "magtwin convert {file} F.usda makes one of it; if a scene is meant, give that",
}
"""Better remedies for single pairs of what is needed and what was given."""

_TOMLS = (
    (SUITE_TOML, re.compile(rb"^\s*\[\[\s*(scenario|localizer)\s*\]\]", re.M)),
    (
        SCENE_TOML,
        re.compile(
            rb"^\s*(\[\s*(lab|robot|earth|survey)[\].]|\[\[\s*(furniture|source|robots?)\s*\]\]|map\s*=)",
            re.M,
        ),
    ),
    (
        ROBOT_TOML,
        re.compile(
            rb"^\s*(\[\s*(drive|battery|platform|magnetometer|imu|lidar|conversion|mocap)\s*\]|footprint_radius_m\s*=)",
            re.M,
        ),
    ),
    (
        TRAIN_TOML,
        re.compile(rb"^\s*(model|layers|features|epochs|batch|lr|dropout|penalty|weighting|split)\s*=", re.M),
    ),
)
"""Kinds of TOML by a line that each has, the most particular first."""


def expected(path: str | os.PathLike[str], noun: str) -> Path:
    """`path` if it may be the file of a noun in `ACCEPTED`; a file of an unknown kind may be.

    Raises:
        InputError: As for `magtwin.files.existing`; or it is empty, or of another kind, and the text names
            the command that takes it.
    """
    path = existing(path, noun)
    if path.is_file() and path.stat().st_size == 0:
        raise InputError(f"{path}: is empty (0 bytes); make or copy the {noun} again")
    kind = kind_of(path)
    if kind is not None and kind not in ACCEPTED[noun]:
        raise refused(path, kind, noun)
    return path


def scene_file(scene: str | Path) -> Path:
    """The file of a stage, of a folder that `author_scene` wrote, or of a shipped scene's name such as "lab".

    A folder goes before a shipped scene of its name only if it holds a scene.

    Raises:
        InputError: The file is missing, there is no scene of that name, or it is a TOML.
    """
    file = Path(scene)
    if file.suffix.lower() == ".toml" and kind_of(file) in (None, TOML, SCENE_TOML):
        author = f"magtwin scene {scene} --out {file.with_suffix('')} (in Python, mt.scene_from_toml)"
        raise InputError(
            f"{scene}: describes a scene; author it first: {author}; then give its folder, "
            f"as in magtwin run {file.with_suffix('')}"
        )
    if (inside := stage_in(file)).is_file():
        return inside
    stages = _shipped_stages()
    if str(scene) in stages and not file.is_file():
        return stages[str(scene)]
    if file.suffix or file.exists() or len(file.parts) > 1:
        return expected(file, "scene")
    if shipped("scenes").joinpath(f"{scene}.toml").is_file():
        author = f"magtwin scene {scene} --map MAP.usdc --out {scene}"
        raise InputError(f"{scene}: ships as a TOML without its map; author it first: {author}")
    if file.with_suffix(".toml").is_file():
        return scene_file(file.with_suffix(".toml"))
    return find("scene", str(scene), stages)


def stage_in(folder: Path) -> Path:
    """The stage of a folder: the one of its name, or with its own layer, or whose parts are its sublayers.

    A scene NAME is NAME.usda beside NAME_layer.usda; a robot is the only stage of its folder.
    """
    inside = folder / f"{folder.resolve().name}.usda"
    stages = [s for s in folder.glob("*.usda") if s.name != "edits.usda"] if folder.is_dir() else []
    whole = [stage for stage in stages if stage.with_name(f"{stage.stem}_layer.usda").is_file()]
    whole = whole or [stage for stage in stages if b"@./magnetics" in _head(stage)]
    whole = whole or (stages if (folder / "payloads").is_dir() else [])  # of a robot
    return whole[0] if len(whole) == 1 and inside not in whole else inside


def shipped_or(file: str | Path) -> Path:
    """The stage of a shipped scene's name such as "lab" or in the folder of a scene or robot; else the path.

    A file goes before a shipped scene of its name, and so does a folder of a known kind.
    """
    path, stage = Path(file), _shipped_stages().get(str(file))
    kind = kind_of(path) if stage is not None or not path.suffix else None
    if kind in (SCENE_FOLDER, ROBOT_FOLDER):
        return stage_in(path)
    return path if stage is None or path.is_file() or kind else stage


def _shipped_stages() -> dict[str, Path]:
    """Stages that ship with magtwin, by name."""
    stages = shipped("scenes").glob("*/*.usda")
    return {stage.stem: stage for stage in stages if stage.stem == stage.parent.name}


def refused(path: str | os.PathLike[str], kind: Kind, noun: str) -> InputError:
    """The refusal of a file of a kind where a noun is needed."""
    remedy = _REMEDIES.get((noun, kind), kind.remedy)
    wanted = noun if noun.startswith("settings") else f"a {noun}"
    return InputError(f"{path}: is {kind.noun}, not {wanted}; {remedy.format(file=path)}")


def kind_of(path: Path) -> Kind | None:
    """The kind of a file or folder; None if it is not known, or cannot be read."""
    try:
        reader = _kind_of_folder if path.is_dir() else _BY_SUFFIX.get(path.suffix.lower())
        return reader and reader(path)
    except OSError:
        return None


def _is(kind: Kind) -> Callable[[Path], Kind]:
    return lambda path: kind


def _kind_of_folder(folder: Path) -> Kind | None:
    robot = (folder / "payloads").is_dir() and not (folder / "robots").is_dir()  # layers, and no map
    for name, kind in (
        ("dataset.json", DATASET),
        ("suite.json", RESULTS),
        ("metadata.yaml", RUN),
        ("run.parquet", RUN),
        ("runs.csv", SWEEP),
        (stage_in(folder).name, ROBOT_FOLDER if robot else SCENE_FOLDER),
    ):
        if (folder / name).is_file():
            return kind
    return SURVEY if next(folder.glob("*_map.csv"), None) else None


def _kind_of_yaml(path: Path) -> Kind:
    head = _head(path)
    if b"rosbag2_bagfile_information" in head:
        return BAG_YAML
    return OCCUPANCY if re.search(rb"^image\s*:", head, re.M) else YAML


def _kind_of_toml(path: Path) -> Kind:
    head = _head(path)
    return next((kind for kind, line in _TOMLS if line.search(head)), TOML)


def _kind_of_csv(path: Path) -> Kind:
    lines = [line.strip() for line in _head(path).decode("utf-8", "replace").splitlines()]
    if lines and lines[0].startswith("# magtwin run"):
        return RUN
    words = next((line for line in lines if line and not line.startswith("#")), "")
    names = [word.strip().strip('"').lower() for word in words.split(",")]
    return PATH if names == ["x", "y"] else COMMANDS if names == ["t", "v", "w"] else TABLE


def _kind_of_parquet(path: Path) -> Kind:
    """By the metadata at the end of the file, which are plain text."""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 4 * HEAD))
        tail = file.read()
    return READINGS if b"magtwin_readings" in tail else RUN if b"magtwin_facts" in tail else TABLE


def _kind_of_json(path: Path) -> Kind:
    head = _head(path)
    return MODEL if b'"coefficients"' in head and b'"terms"' in head else JSON


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(HEAD).removeprefix(BOM_UTF8)


_BY_SUFFIX: dict[str, Callable[[Path], Kind | None]] = {
    ".toml": _kind_of_toml,
    ".csv": _kind_of_csv,
    ".json": _kind_of_json,
    ".parquet": _kind_of_parquet,
    ".safetensors": _is(WEIGHTS),
    ".onnx": _is(ONNX),
    ".py": _is(PYTHON),
    **dict.fromkeys((".urdf", ".xacro"), _is(URDF)),
    **dict.fromkeys(USD_SUFFIXES, _is(STAGE)),
    **dict.fromkeys((".npz", ".rrd", ".mcap", ".db3", ".bag"), _is(RUN)),
    **dict.fromkeys((".pth", ".pt"), _is(CHECKPOINT)),
    **dict.fromkeys((".png", ".jpg", ".jpeg", ".svg", ".gif", ".mp4", ".pgm"), _is(PICTURE)),
    **dict.fromkeys((".html", ".md"), _is(PAGE)),
    **dict.fromkeys((".yaml", ".yml"), _kind_of_yaml),
    **dict.fromkeys((".stl", ".obj", ".dae", ".glb", ".gltf", ".ply"), _is(MESH)),
    **dict.fromkeys((".sdf", ".world"), _is(GAZEBO)),
    **dict.fromkeys((".zip", ".gz", ".tgz", ".tar", ".xz", ".bz2", ".7z", ".zst"), _is(ARCHIVE)),
}
