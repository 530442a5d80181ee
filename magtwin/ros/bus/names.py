"""Names: the place of a node in the ROS network: namespace, remaps, and how far it can be discovered."""

import os
import socket
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

from magtwin.errors import InputError

Range = Literal["localhost", "subnet"]
"""Discovery range: this machine, or every host of the network, as in ROS_AUTOMATIC_DISCOVERY_RANGE."""


@dataclass(frozen=True)
class Names:
    """Names of a node on the network: its namespace and its remaps."""

    namespace: str = "/robot"
    """Namespace of relative names; "" is the root."""

    remaps: Mapping[str, str] = field(default_factory=dict)
    """Name on the network, by the name that the node uses, with or without its namespace."""

    def resolve(self, name: str) -> str:
        """The full name of a topic on the network.

        A relative name (`odom`) is in the namespace, `/clock` is global. `/robot/...` and `/magtwin/...` of
        `magtwin.io.bags.topics.TOPICS` count as relative.
        """
        relative = relative_name(name)
        space = f"/{self.namespace.strip('/')}".rstrip("/")
        whole = relative if relative.startswith("/") else f"{space}/{relative}"
        target = next((self.remaps[n] for n in (name, relative, whole) if n in self.remaps), whole)
        return target if target.startswith("/") else f"{space}/{target}"


def relative_name(name: str) -> str:
    """A name of the tables without the prefix that stands for the namespace: `odom` for `/robot/odom`."""
    return name.removeprefix("/robot/") if not name.startswith("/magtwin/") else name[1:]


def within(robot: str, name: str) -> str:
    """The name of a topic of one of several robots: `ann/odom` for `/robot/odom`; `/clock` is shared."""
    relative = relative_name(name)
    return relative if relative.startswith("/") or not robot else f"{robot}/{relative}"


def names_of(namespace: str = "robot", remaps: Iterable[str] = ()) -> Names:
    """Names from a command line: `remaps` of the form a:=b.

    Raises:
        InputError: A remap has another form, or a name is not a ROS name.
    """
    table = {}
    for remap in remaps:
        left, sign, right = remap.partition(":=")
        if not sign or not is_name(left) or not is_name(right):
            raise InputError(f"a remap is a name:=another, such as odom:=/vicon/odom; got {remap!r}")
        table[left] = right
    if namespace and not is_name(namespace):
        raise InputError(f"namespace {namespace!r} is not a ROS name: use letters, digits, _ and /")
    return Names(namespace, table)


def is_name(name: str) -> bool:
    """Whether a text is a ROS name."""
    parts = name.strip("/").split("/")
    return all(part.isidentifier() and part.isascii() for part in parts)


def checked_prefix(prefix: str) -> str:
    """A prefix of frame names, such as `tb4/`.

    Raises:
        InputError: It is not made of letters, digits, _ and /, or begins with a /.
    """
    if prefix and (prefix.startswith("/") or not is_name(prefix.rstrip("/"))):
        raise InputError(
            f"a prefix of frames has letters, digits, _ and /, such as tb4/; got {prefix!r}",
            parameter="frame_prefix",
        )
    return prefix


def range_of(asked: Range | None = None) -> Range:
    """How far a node can be discovered.

    In ROS the default is the subnet. Here it is this machine, because ROS 2 has no authentication: whoever
    reaches a robot's cmd_vel drives it.

    Args:
        asked: What the user asked for. Default: ROS_LOCALHOST_ONLY, else ROS_AUTOMATIC_DISCOVERY_RANGE, else
            localhost.

    Raises:
        InputError: A variable has a value that ROS does not know, or that lets no node find another.
    """
    if asked is not None:
        if asked not in get_args(Range):
            raise InputError(f"discovery is localhost or subnet, got {asked!r}", parameter="discovery")
        return asked
    if (only := os.environ.get("ROS_LOCALHOST_ONLY", "")) in ("0", "1"):
        return "localhost" if only == "1" else "subnet"
    text = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper()
    known: Mapping[str, Range] = {
        "": "localhost",
        "LOCALHOST": "localhost",
        "SUBNET": "subnet",
        "SYSTEM_DEFAULT": "subnet",
    }
    if text not in known:
        raise InputError(
            f"ROS_AUTOMATIC_DISCOVERY_RANGE must be LOCALHOST, SUBNET or SYSTEM_DEFAULT, got {text!r}"
            + ("; with OFF no node finds another" if text == "OFF" else "")
        )
    return known[text]


def interfaces() -> tuple[str, ...]:
    """Names of the network interfaces of this machine but loopback."""
    return tuple(name for _, name in socket.if_nameindex() if name != "lo")
