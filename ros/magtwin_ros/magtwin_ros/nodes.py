"""`ros2 run magtwin_ros NODE ...` is `magtwin ros NODE ...`, with the arguments of ROS read too."""

import sys

from magtwin.cli import main

TIMED = ("magnetometer",)
"""Nodes whose settings are name:=value, and use_sim_time one of them."""


def arguments(node: str, given: list[str]) -> list[str]:
    """The command line of magtwin for what ROS gives: `--ros-args -r a:=b -r __ns:=/c -p name:=value`.

    `__node` is passed over, as nodes have their names; a namespace and remaps become options, parameters
    settings or, for nodes without settings, options.
    """
    own, ros, inside = [], [], False
    for word in given:
        if word in ("--ros-args", "--"):
            inside = word == "--ros-args"
        else:
            (ros if inside else own).append(word)
    words = iter(ros)
    for word in words:
        if word in ("-r", "--remap"):
            left, _, right = next(words, "").partition(":=")
            if left == "__ns":
                own += ["--namespace", right.strip("/")]
            elif left != "__node":
                own += ["--remap", f"{left.rpartition(':')[2]}:={right}"]
        elif word in ("-p", "--param"):
            name, _, value = next(words, "").partition(":=")
            if node in TIMED:
                own.append(f"{name}:={value}")
            elif name == "use_sim_time":
                own += ["--sim-time"] * (value.lower() == "true" and node != "sim")
            else:
                own += [f"--{name.replace('_', '-')}", value]
    return ["ros", node, *own]


def _node(name: str) -> None:
    main(arguments(name, sys.argv[1:]))


def sim() -> None:
    """The simulator."""
    _node("sim")


def magnetometer() -> None:
    """The magnetometer."""
    _node("magnetometer")


def follow() -> None:
    """The path follower."""
    _node("follow")


def record() -> None:
    """The recorder."""
    _node("record")


def replay() -> None:
    """The player."""
    _node("replay")


def teleop() -> None:
    """Driving by hand."""
    _node("teleop")
