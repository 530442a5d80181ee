"""Inputs that were faults once are read or refused in one line; every kind of file that is read is fuzzed."""

from functools import cache
from pathlib import Path

import pytest
from seeds import FORMATS, Seed, read, seed

from magtwin.errors import InputError

CORPUS = Path(__file__).with_name("corpus")

OTHERS = {
    **{kind: (kind,) for kind in ("dataset", "glb", "npz", "ply", "usdz", "xacro")},
    "usda.glb": ("usda", "robot"),
    "usda.info": ("usda", "robot"),
    "usda.magnetics": ("scene-magnetics", "usda"),
    "usda.robot": ("robot", "usda"),
    "usda.scene": ("scene", "usda"),
    "usda.tourdf": ("robot", "usda"),
    "usda.validate": ("scene", "usda"),
    "usdc.map": ("map", "usdc"),
    "usdc.robot": ("usdc",),
}
"""Formats as which others' files are read, by the first part of their names."""


@cache
def beside(kind: str, folder: Path) -> Seed:
    return seed(kind, folder / kind / "results-seed")


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    return tmp_path_factory.mktemp("seeds")


def refusal(kind, data, home, folder):
    """What is said of a file of a format; "" if it is read."""
    try:
        read(kind, data, beside(kind, home).beside, folder)
    except InputError as error:
        return str(error)
    return ""


@pytest.mark.filterwarnings("default")  # of numbers that overflow
@pytest.mark.parametrize(
    "file", sorted(CORPUS.glob("*/*")), ids=lambda file: f"{file.parent.name}-{file.name}"
)
def test_an_input_that_was_a_fault_is_read_or_refused_in_one_line(file, home, tmp_path):
    said = refusal(file.parent.name, file.read_bytes(), home, tmp_path / "x")
    assert "\n" not in said
    assert len(said) < 2000


@pytest.mark.filterwarnings("default")
def test_faults_that_others_found_are_read_or_refused_in_one_line(real_data, home, tmp_path):
    files = sorted((real_data / "fuzz").iterdir())
    assert len(files) == 26
    for number, file in enumerate(files):
        name = file.name.partition("-")[0]
        for kind in OTHERS[name]:
            said = refusal(kind, file.read_bytes(), home, tmp_path / f"{number}{kind}")
            assert "\n" not in said
            assert len(said) < 2000


def test_every_kind_of_file_that_is_read_is_fuzzed():
    from magtwin.files.kinds import _BY_SUFFIX
    from magtwin.io.formats import FORMATS as RUNS
    from magtwin.io.info import NETWORKS
    from magtwin.urdf.meshes.mesh import READERS

    written = {
        *(".py", ".html", ".md", ".svg", ".mp4", ".pt", ".jpeg", ".usd"),
        *(".bag", ".sdf", ".world", ".pgm", ".yml"),
        *(".zip", ".tar", ".tgz", ".gz", ".bz2", ".xz", ".zst", ".7z", ".rar"),
    }  # never read, or by another name
    fuzzed = {Path(chosen.file).suffix for chosen in FORMATS.values()}
    known = {*RUNS, *NETWORKS, *_BY_SUFFIX, *READERS, ".yaml", ".mat", ".mtl"}
    assert known - written <= fuzzed
