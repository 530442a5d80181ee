"""Executables for `ros2 run magtwin_ros NODE ...`: `magtwin ros NODE ...` with ROS arguments."""

import os
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import yaml

FIRST = {
    "sim": "scene",
    "magnetometer": "scene",
    "localize": "scene",
    "follow": "path",
    "record": "out",
    "replay": "run",
}
"""Executables, and the parameter of each that is the positional argument of its command."""

NETWORK = ("discovery", "backend", "domain")
"""Parameters of every node that are options; an empty one is not set."""

OPTIONS = {
    "magnetometer": ("network", "online", "measured", "duration_s", "frame_prefix", *NETWORK),
    "localize": (
        *("method", "option", "map", "sensor", "odometry", "map_length_m", "seed", "duration_s"),
        *("frame_prefix", *NETWORK),
    ),
}
"""Parameters of these nodes that are options; their other parameters are settings, name:=value."""

IGNORED = ("--log-level", "--log-config-file", "-e", "--enclave")
"""ROS arguments for logging and security, each with a value, that are ignored."""


class WrongArgument(ValueError):  # noqa: N818
    """A ROS argument that cannot be used."""


def arguments(node: str, given: list[str]) -> list[str]:
    """The magtwin command line for ROS arguments such as `--ros-args -r a:=b -r __ns:=/c -p name:=value`.

    Namespace, node name and remaps become options. Parameters become settings or options. Of a parameter
    file, the sections `/**` and those that name the node count. Parameters on the command line override it.

    Args:
        node: The executable.
        given: Its command-line arguments.

    Raises:
        WrongArgument: An argument is unknown, or a parameter file cannot be read.
    """
    own: list[str] = []
    first: list[str] = []
    options: dict[str, str] = {}
    remaps: list[str] = []
    explicit: dict[str, str] = {}
    files: list[str] = []
    for flag, value in _split(given, own):
        if flag in IGNORED:
            continue
        if flag == "--params-file":
            files.append(value)
            continue
        left, sign, right = value.partition(":=")
        if not sign:
            raise WrongArgument(f"{flag} takes name:=value, got {value!r}")
        left = left.rpartition(":")[2]  # drop the node name of NODE:name; there is one node
        if flag in ("-p", "--param"):
            explicit[left] = right
        elif left in ("__ns", "__node", "__name"):
            options["namespace" if left == "__ns" else "node-name"] = right.strip("/")
        else:
            remaps += ["--remap", f"{left}:={right}"]
    whole = f"{options.get('namespace', 'robot')}/{options.get('node-name', f'magtwin_{node}')}".strip("/")
    parameters = {name: value for file in files for name, value in _read(file, whole).items()} | explicit
    for name, value in parameters.items():
        if name in NETWORK and not value:
            continue
        if name == FIRST[node]:
            first = [value]
        elif node in OPTIONS and name not in OPTIONS[node]:
            own.append(f"{name}:={value}")
        elif name != "use_sim_time":
            own.append(f"--{name.replace('_', '-')}={value}")
        elif node not in ("sim", "replay"):  # which publish the time
            own.append(f"--sim-time={value}")
    named = [f"--{name}={value}" for name, value in options.items()]
    return ["ros", node, *first, *own, *named, *remaps]


def _split(given: list[str], own: list[str]) -> Iterator[tuple[str, str]]:
    """ROS arguments with their values; the others are appended to `own`."""
    words, inside = iter(given), False
    for word in words:
        if word in ("--ros-args", "--"):
            inside = word == "--ros-args"
        elif not inside:
            own.append(word)
        elif word in ("-r", "--remap", "-p", "--param", "--params-file", *IGNORED):
            value = next(words, None)
            if value is None:
                raise WrongArgument(f"{word} takes a value")
            yield word, value
        elif ":=" in word:  # the old form of a remap
            yield "-r", word
        elif not word.startswith(("--enable-", "--disable-")):
            raise WrongArgument(f"ROS has no argument {word!r}")


def _read(file: str, node: str) -> dict[str, str]:
    """The parameters of a node in a parameter file."""
    try:
        content = yaml.safe_load(Path(file).read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise WrongArgument(f"{file}: not a parameter file ({' '.join(str(error).split())})") from None
    parameters: dict[str, str] = {}
    for section, values in (content if isinstance(content, dict) else {}).items():
        entries = values.get("ros__parameters") if isinstance(values, dict) else None
        if not isinstance(entries, dict):
            raise WrongArgument(f"{file}: section {section!r} has no ros__parameters")
        if section == "/**" or str(section).strip("/") in (node, node.rpartition("/")[2]):
            parameters |= {str(name): _text(value) for name, value in entries.items()}
    return parameters


def _text(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def start(node: str) -> None:
    """Run a node with the magtwin of this Python, else with the magtwin command on the PATH."""
    try:
        command = arguments(node, sys.argv[1:])
    except WrongArgument as error:
        sys.exit(f"magtwin_ros {node}: {error}")
    try:
        from magtwin.cli import main
    except ModuleNotFoundError:
        if (command_file := shutil.which("magtwin")) is None:
            sys.exit(
                "magtwin is neither in this Python nor on the PATH: pip install 'magtwin[ros]' in an "
                "environment, and add its bin folder to the PATH"
            )
        os.execv(command_file, [command_file, *command])
    main(command)


def _starter(node: str) -> Callable[[], None]:
    return lambda: start(node)


sim, magnetometer, localize, follow, record, replay = map(_starter, FIRST)
