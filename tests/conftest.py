"""What tests share: the real data beside the checkout, and the default lab, authored once."""

import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

# The same examples on every run; `pytest --hypothesis-profile=default` draws new ones.
settings.register_profile("fixed", derandomize=True, deadline=None, database=None)
settings.load_profile("fixed")

os.environ.pop("COLUMNS", None)  # what is printed has the same lines on any terminal
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where a shell began this in the background

REAL = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The real survey, network, paths and robot; a test that needs them is skipped where they are absent."""
    if not REAL.is_dir():
        pytest.skip(f"the real data are not at {REAL}; `magtwin fetch` gets them for use by hand")
    return REAL


@pytest.fixture
def isaac_rules(real_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The copy of Isaac Sim's published rules that `magtwin fetch isaac-rules` makes, for the test."""
    from magtwin.fetch import SOURCES, default_folder

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = default_folder("isaac-rules")
    for name, _, path in SOURCES["isaac-rules"][0].files():
        file = real_data / "isaacsim-6.0.1" / path.removeprefix("source/extensions/")
        if not file.is_file():
            pytest.skip(f"Isaac Sim's rules are not at {file}; `magtwin fetch isaac-rules` gets them")
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, folder / name)
    return folder


@pytest.fixture
def allow_neighbours(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Lets stages name files in the folders of other tests, such as the lab that is authored once."""
    from magtwin.files.folders import allow

    with allow(tmp_path_factory.getbasetemp()):
        yield


@pytest.fixture(scope="session")
def lab_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Root layer of the default lab, authored once into a folder of its own; not to be changed."""
    from magtwin.author.scene import author_scene
    from magtwin.files.file import shipped
    from magtwin.twin import scene_from_toml

    return author_scene(
        scene_from_toml(shipped("scenes", "lab.toml")), tmp_path_factory.mktemp("lab") / "lab"
    )
