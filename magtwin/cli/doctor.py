"""`magtwin doctor`: what is installed, and what each missing extra would add; and `magtwin completion`."""

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from magtwin.cli.app import app
from magtwin.cli.terminal import Done
from magtwin.report.report import key

ADDS = {
    "cluster": ("distributed", "work on a dask cluster (magtwin bench --dask, magtwin sweep --dask)"),
    "gym": ("gymnasium", "a Gymnasium environment (magtwin.gym)"),
    "onnx": ("onnxruntime", "networks as ONNX (magtwin model export, magtwin export)"),
    "pandas": ("pandas", "runs as pandas tables (Run.to_pandas)"),
    "physics": ("newton", "driving in Newton (magtwin run --engine newton)"),
    "ros": ("cyclonedds", "ROS 2 nodes on a machine without ROS (magtwin ros)"),
    "simready": ("simready-validate", "NVIDIA's SimReady profiles (magtwin validate --against simready)"),
    "validate": ("usd-validation-nvidia", "NVIDIA's asset validator (magtwin validate --against nvidia)"),
    "view": ("pyvista", "pictures and films of stages (magtwin plot)"),
}
"""The main package of each extra, and what it is for."""

PACKAGES = ("usd-core", "rerun-sdk", "torch", "numpy", "scipy", "numba", "pyarrow", "rosbags", "cyclopts")
"""Packages whose version matters in a report of a fault."""

DRIVERS = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d", "/usr/local/share/vulkan/icd.d")
"""Folders in which Vulkan drivers are listed."""


@app.command
def doctor() -> Done:
    """List what is installed, what each missing extra would add, and how to install it."""
    found = diagnose()
    extras = found["extras"]
    missing = {name: extra for name, extra in extras.items() if not extra["installed"]}
    others = [f"{name}: {text}" for name, text in found["tools"].items() if text.startswith("not found; ")]
    lines = [
        f"magtwin {found['magtwin']}, Python {found['python']}: "
        f"{len(extras) - len(missing)} of {len(extras)} extras are installed",
        ", ".join(f"{name} {version}" for name, version in found["packages"].items()),
        *(f"missing  {name}: {extra['adds']}; {extra['install']}" for name, extra in missing.items()),
        *(f"missing  {text.replace('not found; ', '')}" for text in others if "magtwin[" not in text),
    ]
    tools = {key(name): text for name, text in found["tools"].items()}
    return Done(lines=lines, data=found | {"tools": tools})


def diagnose() -> dict[str, Any]:
    """Versions, tools and extras of this installation, as a table for JSON."""
    from ctypes.util import find_library

    drivers = [file.stem for folder in DRIVERS for file in sorted(Path(folder).glob("*.json"))]
    vulkan = ", ".join(drivers) if find_library("vulkan") else ""
    tools = (
        ("Rerun viewer", find_spec("rerun_cli") and "installed", "pip install rerun-sdk"),
        ("Vulkan", vulkan, "apt install mesa-vulkan-drivers libvulkan1; pictures of recordings need it"),
        ("Newton", _version("newton"), "pip install 'magtwin[physics]'"),
        ("ROS 2, rclpy", find_spec("rclpy") and "installed", "source a ROS 2 installation"),
        ("ROS 2, cyclonedds", _version("cyclonedds"), "pip install 'magtwin[ros]'"),
        ("NVIDIA validator", _version("usd-validation-nvidia"), "pip install 'magtwin[validate]'"),
        ("SimReady validator", _version("simready-validate"), "make simready, in a checkout"),
    )
    extras = {
        name: {
            "installed": bool(_version(package)),
            "adds": adds,
            "install": f"pip install 'magtwin[{name}]'",
        }
        for name, (package, adds) in ADDS.items()
    }
    from magtwin.version import __version__

    return {
        "magtwin": __version__,
        "python": sys.version.split()[0],
        "packages": {name: _version(name) or "not installed" for name in PACKAGES},
        "tools": {name: found or f"not found; {remedy}" for name, found, remedy in tools},
        "extras": extras,
    }


def _version(package: str) -> str:
    """Version of an installed package, "" if it is not installed."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(package)
    except PackageNotFoundError:
        return ""


@app.command
def completion(shell: Literal["bash", "zsh", "fish"]) -> Done:
    """Print a script that completes magtwin's commands and options in a shell.

    bash: magtwin completion bash > ~/.local/share/bash-completion/completions/magtwin
    zsh: magtwin completion zsh > a folder of $fpath, as _magtwin
    fish: magtwin completion fish > ~/.config/fish/completions/magtwin.fish

    Parameters
    ----------
    shell
        Shell that will read the script.
    """
    script = app.generate_completion(shell=shell)
    return Done(text=script.rstrip("\n"), data={"shell": shell, "script": script})
