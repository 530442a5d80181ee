"""What a command loads: a library that it does not need stays out of its process."""

import subprocess
import sys

import pytest

CHILD = """
import sys
from magtwin.cli import main
main(sys.argv[2:])
with open(sys.argv[1], "w") as file:
    file.write("\\n".join(sys.modules))
"""

SCIPY_PARTS = "scipy.signal scipy.stats scipy.interpolate"
PICTURES = "rerun matplotlib sympy"


def loaded(folder, command):
    """Names of the modules in the process of a command, which runs in `folder`."""
    child = [sys.executable, "-c", CHILD, "modules", *command.split()]
    subprocess.run(child, cwd=folder, capture_output=True, check=True)
    return set((folder / "modules").read_text().split())


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with x.parquet, a run of the shipped lab by its network."""
    folder = tmp_path_factory.mktemp("startup")
    subprocess.run(
        [sys.executable, "-m", "magtwin", "run", "lab", "--duration-s", "2", "--out", "x.parquet"],
        cwd=folder,
        capture_output=True,
        check=True,
    )
    return folder


@pytest.mark.parametrize(
    ("command", "refused"),
    [
        ("run lab --duration-s 2 --out y.parquet", f"torch numba pandas {SCIPY_PARTS} {PICTURES}"),
        ("sweep lab --count 2 --duration-s 2 --out sweep", f"torch numba pandas {SCIPY_PARTS} {PICTURES}"),
        ("scene lab --out scene", f"torch numba {SCIPY_PARTS} {PICTURES}"),
        ("info x.parquet", f"torch numba pxr scipy pandas {PICTURES}"),
        ("convert x.parquet --out x.csv", f"torch numba pxr scipy pandas {PICTURES}"),
        ("reproduce x.parquet", f"torch numba scipy pandas {PICTURES}"),
        ("report x.parquet --out report.html", "torch numba scipy pandas rerun sympy"),
        ("run lab --duration-s 2 --out run", f"torch numba pandas {SCIPY_PARTS} sympy"),
        ("localize x.parquet --map lab --out localized", f"torch pandas sympy {SCIPY_PARTS}"),
    ],
)
def test_a_command_loads_no_library_that_it_does_not_need(folder, command, refused):
    assert loaded(folder, command) & set(refused.split()) == set()
