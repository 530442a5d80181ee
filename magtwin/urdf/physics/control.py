"""Control: the mobile base and the commands of a robot, from plugins, controllers and `<transmission>`."""

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

from magtwin.errors import InputError
from magtwin.urdf.description.extensions import MODULES
from magtwin.urdf.description.tag import Tags
from magtwin.urdf.options import DriveRule
from magtwin.urdf.physics.drive import POSITION_STIFFNESS, WHEEL_DAMPING, holds_position, own_gain
from magtwin.urdf.physics.mechanism import SINGLE, Mechanism
from magtwin.urdf.physics.mobile_base import MobileBase

COMMANDS = {"velocity": "velocity", "position": "position", "effort": "none"}
"""Type of drive by command interface; effort on a continuous joint needs none: the torque is from outside."""


def read_base(tags: Tags, controllers: Path | None = None) -> MobileBase | None:
    """The mobile base that a plugin or a controller of the description defines, or None.

    Args:
        tags: Tags of the description.
        controllers: YAML with the settings of controllers, which precede plugins.

    Raises:
        InputError: The file of `controllers` names an unknown joint, has an invalid number, or has no
            controller that drives wheels.
    """
    if controllers is None and not tags.have("plugin"):
        return None
    controller: Any = import_module(MODULES["plugin"])
    base: MobileBase | None
    if controllers is None:
        base = controller.base_of_plugin(tags) or controller.base_of_plugin_settings(tags)
        return base
    base = controller.base_of_settings(tags, controllers)
    if base is None:
        raise InputError(f"{controllers}: has no controller of a mobile base", parameter="controllers")
    return base


def read_commands(tags: Tags, mechanism: Mechanism) -> tuple[DriveRule, ...]:
    """Drive rules from `<ros2_control>` and `<transmission>`; the user's rules come before them.

    A velocity or position interface becomes a drive with the default gains; effort leaves a continuous joint
    free. A joint that holds a position by default does so unless it is commanded by velocity alone: an arm
    that nothing holds would fall. Joints that cannot move or follow another get no rule. Interfaces of
    unknown joints are left out.
    """
    rules: dict[str, DriveRule] = {}
    joints = {joint.name: joint for joint in mechanism.description.joints.values()}
    for name, kinds in _commands(tags):
        if name in rules or name in mechanism.welded or name in mechanism.mimics:
            continue
        if (
            set(kinds) != {"velocity"}
            and joints[name].type in SINGLE
            and holds_position(joints[name], mechanism)
        ):
            continue
        kind = COMMANDS[kinds[0]]
        gains: dict[str, float] = {}
        if kind == "velocity":
            gains = {"damping": WHEEL_DAMPING + own_gain(joints[name])}
        elif kind == "position":
            gains = {"stiffness": POSITION_STIFFNESS, "damping": POSITION_STIFFNESS / 10}
        pattern = "".join(f"[{c}]" if c in "*?[" else c for c in name)  # matches this name only
        rules[name] = DriveRule(joints=pattern, type=kind, **gains)  # type: ignore[arg-type]
    return tuple(rules.values())


def _commands(tags: Tags) -> Iterator[tuple[str, list[str]]]:
    """Joint and its interfaces for commands, in the order of `COMMANDS`."""
    for tag in ("ros2_control", "transmission"):
        for block in tags.blocks(tag):
            for joint in tags.findall(block, "joint"):
                interfaces = tags.findall(joint, "command_interface")
                tags.findall(joint, "state_interface")
                text = [e.get("name", "") for e in interfaces]
                if tag == "transmission":
                    text = [
                        kind for kind in COMMANDS if kind in tags.text(joint, "hardwareInterface").lower()
                    ]
                name = joint.get("name", "")
                if all(name != known.name for known in tags.description.joints.values()):
                    fault = f"<{tag}> names no joint {name!r}: its interfaces are left out"
                    tags.description.repair("name-unknown", fault, joint)
                    continue
                kinds = [kind for kind in COMMANDS if kind in text]
                if kinds:
                    yield name, kinds
