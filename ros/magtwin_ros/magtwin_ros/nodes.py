"""`ros2 run magtwin_ros NODE ...` is `magtwin ros NODE ...`, with the arguments of ROS read too."""

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
    "follow": "path",
    "record": "out",
    "replay": "run",
    "teleop": "",
}
"""Executables, and the parameter of each that its command takes without a name."""

OPTIONS = {"magnetometer": ("network", "duration_s")}
"""Parameters that are options of a node whose others are settings, name:=value."""

UNTIMED = ("sim", "replay")
"""Nodes that say what time it is, to whom use_sim_time is nothing."""

PASSED_OVER = ("--log-level", "--log-config-file", "-e", "--enclave")
"""What ROS says of logging and security, each with its value, for which magtwin has no use."""


class WrongArgument(ValueError):  # noqa: N818
    """An argument of ROS that means nothing here."""


def arguments(node: str, given: list[str]) -> list[str]:
    """The command line of magtwin for what ROS gives: `--ros-args -r a:=b -r __ns:=/c -p name:=value`.

    Namespace, name and remaps become options, parameters settings or options. Those of a file are read as
    ROS does: where its sections are `/**` or name the node, before those that are given one by one.

    Raises:
        WrongArgument: It is none of ROS, or a file of parameters cannot be read.
    """
    own: list[str] = []
    first: list[str] = []
    options: dict[str, str] = {}
    remaps: list[str] = []
    told: dict[str, str] = {}
    files: list[str] = []
    for flag, value in _split(given, own):
        if flag in PASSED_OVER:
            continue
        if flag == "--params-file":
            files.append(value)
            continue
        left, sign, right = value.partition(":=")
        if not sign:
            raise WrongArgument(f"{flag} takes name:=value, got {value!r}")
        left = left.rpartition(":")[2]  # of which node; this executable is one
        if flag in ("-p", "--param"):
            told[left] = right
        elif left in ("__ns", "__node", "__name"):
            options["namespace" if left == "__ns" else "node-name"] = right.strip("/")
        else:
            remaps += ["--remap", f"{left}:={right}"]
    whole = f"{options.get('namespace', 'robot')}/{options.get('node-name', f'magtwin_{node}')}".strip("/")
    parameters = {name: value for file in files for name, value in _read(file, whole).items()} | told
    for name, value in parameters.items():
        if name == FIRST[node]:
            first = [value]
        elif node == "magnetometer" and name not in OPTIONS[node]:
            own.append(f"{name}:={value}")
        elif name != "use_sim_time":
            own.append(f"--{name.replace('_', '-')}={value}")
        elif node not in UNTIMED:
            own.append(f"--sim-time={value}")
    said = [f"--{name}={value}" for name, value in options.items()]
    return ["ros", node, *first, *own, *said, *remaps]


def _split(given: list[str], own: list[str]) -> Iterator[tuple[str, str]]:
    """Arguments of ROS with their values; the others go to `own`."""
    words, inside = iter(given), False
    for word in words:
        if word in ("--ros-args", "--"):
            inside = word == "--ros-args"
        elif not inside:
            own.append(word)
        elif word in ("-r", "--remap", "-p", "--param", "--params-file", *PASSED_OVER):
            value = next(words, None)
            if value is None:
                raise WrongArgument(f"{word} takes a value")
            yield word, value
        elif ":=" in word:  # the old form of a remap
            yield "-r", word
        elif not word.startswith(("--enable-", "--disable-")):
            raise WrongArgument(f"ROS has no argument {word!r}")


def _read(file: str, node: str) -> dict[str, str]:
    """Parameters of a node in a file."""
    try:
        content = yaml.safe_load(Path(file).read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise WrongArgument(f"{file}: no file of parameters ({' '.join(str(error).split())})") from None
    found: dict[str, str] = {}
    for section, values in (content if isinstance(content, dict) else {}).items():
        parameters = values.get("ros__parameters") if isinstance(values, dict) else None
        if not isinstance(parameters, dict):
            raise WrongArgument(f"{file}: section {section!r} has no ros__parameters")
        if section == "/**" or str(section).strip("/") in (node, node.rpartition("/")[2]):
            found |= {str(name): _said(value) for name, value in parameters.items()}
    return found


def _said(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def start(node: str) -> None:
    """Be a node: by the magtwin of this Python, or the command, which may have a Python of its own."""
    try:
        command = arguments(node, sys.argv[1:])
    except WrongArgument as error:
        sys.exit(f"magtwin_ros {node}: {error}")
    try:
        from magtwin.cli import main
    except ModuleNotFoundError:
        if (found := shutil.which("magtwin")) is None:
            sys.exit(
                "magtwin is neither in this Python nor on the PATH: pip install 'magtwin[ros]' into an "
                "environment, and have its bin on the PATH"
            )
        os.execv(found, [found, *command])
    main(command)


def _starter(node: str) -> Callable[[], None]:
    return lambda: start(node)


sim, magnetometer, follow, record, replay, teleop = map(_starter, FIRST)
