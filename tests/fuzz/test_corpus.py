"""Inputs that were faults once are read or refused in one line; every kind of file that is read is fuzzed."""

from functools import cache
from pathlib import Path

import pytest
from seeds import FORMATS, Seed, read, seed

from magtwin.errors import InputError

CORPUS = Path(__file__).with_name("corpus")


@cache
def beside(kind: str, folder: Path) -> Seed:
    return seed(kind, folder / kind / "results-seed")


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    return tmp_path_factory.mktemp("seeds")


@pytest.mark.filterwarnings("default")  # of numbers that overflow
@pytest.mark.parametrize(
    "file", sorted(CORPUS.glob("*/*")), ids=lambda file: f"{file.parent.name}-{file.name}"
)
def test_an_input_that_was_a_fault_is_read_or_refused_in_one_line(file, home, tmp_path):
    kind = file.parent.name
    refusal = ""
    try:
        read(kind, file.read_bytes(), beside(kind, home).beside, tmp_path / "x")
    except InputError as error:
        refusal = str(error)
    assert "\n" not in refusal
    assert len(refusal) < 2000


def test_every_kind_of_file_that_is_read_is_fuzzed():
    from magtwin.io.formats import FORMATS as RUNS
    from magtwin.io.info import NETWORKS
    from magtwin.kinds import _BY_SUFFIX
    from magtwin.urdf.meshes.mesh import SUFFIXES

    written = {
        ".py",
        ".html",
        ".md",
        ".svg",
        ".mp4",
        ".pt",
        ".jpeg",
        ".usd",
        *(".sdf", ".world", ".pgm", ".yml"),
        *(".zip", ".tar", ".tgz", ".gz", ".bz2", ".xz", ".zst", ".7z", ".rar"),
    }  # never read, or by another name
    fuzzed = {Path(chosen.file).suffix for chosen in FORMATS.values()}
    known = {*RUNS, *NETWORKS, *_BY_SUFFIX, *SUFFIXES, ".yaml", ".mat", ".mtl"}
    assert known - written <= fuzzed
