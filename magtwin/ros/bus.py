"""Bus: what a node needs of ROS 2, whoever carries it.

Two carry it: rclpy, where it can be imported, and cyclonedds, which meets any ROS 2 on the network over DDS
from any Python. Both are handed messages as bytes, which `magtwin.io.bags.cdr` makes of fields by the one
table of types, `magtwin.io.bags.types.layout`; so a node says and hears the same with either.
"""

import importlib
import importlib.util
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np

from magtwin.errors import InputError, find
from magtwin.io.bags.cdr import Messages, decode, encode
from magtwin.io.bags.topics import Qos
from magtwin.io.bags.types import layout
from magtwin.ros.parameters import Parameter

Backend = Literal["auto", "rclpy", "cyclonedds"]

BACKENDS: Mapping[str, tuple[str, str]] = {
    "rclpy": ("magtwin.ros.rclpy_bus", "RclpyBus"),
    "cyclonedds": ("magtwin.ros.dds", "DdsBus"),
}
"""Modules and classes of those that carry a bus, the first that can be imported being taken."""

MISSING = (
    "no ROS 2 can be imported: source an installation (source /opt/ros/jazzy/setup.bash), or install "
    "cyclonedds, which meets ROS 2 over the network (pip install 'magtwin[ros]')"
)


def to_bytes(kind: str, fields: Mapping[str, Any]) -> bytes:
    """One message in CDR.

    Args:
        kind: Its type, such as `sensor_msgs/msg/Imu`.
        fields: Values by leaf name, as for `magtwin.io.bags.cdr.encode`.
    """
    return encode(layout(kind, fields), fields, 1).tobytes()


@dataclass(frozen=True)
class Message:
    """A message as it came in."""

    kind: str
    data: bytes
    """CDR, its header included."""

    sent_ns: int
    """When it was sent, by the sender's wall clock [ns]."""

    received_ns: int
    """When it was taken in, by ours [ns]."""

    def read(self, wanted: Iterable[str], counts: Mapping[str, int] | None = None) -> dict[str, Any]:
        """Values of some leaves: numbers, arrays, strings; stamps in whole nanoseconds.

        Args:
            wanted: Names of the leaves.
            counts: Lengths of sequences of structures, as for `magtwin.io.bags.types.layout`.

        Raises:
            InputError: It is too short for its type, or not plain CDR.
        """
        buffer = np.frombuffer(self.data, np.uint8)
        message = Messages(np.zeros(1, np.int64), buffer, np.zeros(1, np.int64), np.array([len(buffer)]))
        return {name: value[0] for name, value in decode(layout(self.kind, counts), message, wanted).items()}


Heard = Callable[[Message], None]


class Publisher(Protocol):
    """Where messages of one topic go."""

    topic: str
    kind: str

    def publish(self, data: bytes) -> None:
        """Send a message, in CDR."""

    def subscribers(self) -> int:
        """How many listen."""


class Subscription(Protocol):
    """Where messages of one topic come from."""

    topic: str
    kind: str

    def publishers(self) -> int:
        """How many send."""


class Timer(Protocol):
    """What is called in even steps of the bus's clock."""

    def cancel(self) -> None:
        """Call it no more."""


class Bus(Protocol):
    """A node of ROS 2."""

    name: str
    backend: str

    def publisher(self, topic: str, kind: str, qos: Qos) -> Publisher:
        """Offer a topic; its name is namespaced and remapped by the bus's `Names`."""

    def subscribe(self, topic: str, kind: str, heard: Heard, qos: Qos) -> Subscription:
        """Have `heard` called for each message of a topic, in the thread that spins."""

    def service(self, name: str, called: Callable[[], None]) -> bool:
        """Offer a service without arguments (std_srvs/srv/Empty); whether that can be done here.

        DDS alone cannot: each middleware of ROS 2 has its own way of telling whom an answer is for.
        """

    def settable(
        self, table: Mapping[str, Parameter], values: Mapping[str, Any], changed: Callable[[str, Any], None]
    ) -> bool:
        """Let others read a node's parameters, and set them while it runs; whether that can be done here.

        DDS alone cannot, for the reason that it has no services. `use_sim_time` is the bus's own.

        Args:
            table: What can be set, with ranges.
            values: What it is set to.
            changed: Called with name and value of what others set, if it may be; in the thread that spins.
        """

    def knows(self, kind: str) -> bool:
        """Whether messages of a type can be said and heard here."""

    def resolve(self, topic: str) -> str:
        """The name of a topic on the network."""

    def types(self, topic: str) -> tuple[str, ...]:
        """Types in which others offer a topic, as far as they have been discovered."""

    def publishers(self, topic: str) -> int:
        """How many offer a topic, this node among them, as far as they have been discovered."""

    def timer(self, period_s: float, due: Callable[[], None], *, wall: bool = False) -> Timer:
        """Have `due` called each `period_s` of the bus's clock, or the wall's, in the thread that spins."""

    def now_ns(self) -> int:
        """Time on the bus's clock [ns]: wall time, or /clock's in sim time (0 before the first)."""

    def due_wall_ns(self) -> int:
        """When the timer that is being called was due, by the wall, as far as that is known [ns]."""

    def spin_once(self, timeout_s: float) -> None:
        """Take in what has come, waiting for it at most `timeout_s`; timers that are due are called."""

    def close(self) -> None:
        """Leave the network."""


@dataclass(frozen=True)
class Names:
    """How a node's names are found on the network: its namespace, and what is called otherwise."""

    namespace: str = "/robot"
    """Where relative names stand; "" is the root."""

    remaps: Mapping[str, str] = field(default_factory=dict)
    """By the name that a node uses, with or without its namespace, the one that it has on the network."""

    def resolve(self, name: str) -> str:
        """The name of a topic on the network, from the root.

        A relative name (`odom`) is in the namespace, `/clock` is global. `/robot/...` of
        `magtwin.io.bags.topics.TOPICS` counts as relative.
        """
        relative = name.removeprefix("/robot/")
        whole = relative if relative.startswith("/") else f"{self._space}/{relative}"
        for candidate in (name, relative, whole):
            if candidate in self.remaps:
                target = self.remaps[candidate]
                return target if target.startswith("/") else f"{self._space}/{target}"
        return whole

    @property
    def _space(self) -> str:
        space = self.namespace.strip("/")
        return f"/{space}" if space else ""


def names_of(namespace: str = "robot", remaps: Iterable[str] = ()) -> Names:
    """Names from a command line: `remaps` of the form a:=b.

    Raises:
        InputError: One is not of that form, or not a name of ROS.
    """
    table = {}
    for remap in remaps:
        left, sign, right = remap.partition(":=")
        if not sign or not _is_name(left) or not _is_name(right):
            raise InputError(f"a remap is a name:=another, such as odom:=/vicon/odom; got {remap!r}")
        table[left] = right
    if namespace and not _is_name(namespace):
        raise InputError(f"namespace {namespace!r} is none of ROS: letters, digits, _ and / are")
    return Names(namespace, table)


def _is_name(name: str) -> bool:
    parts = name.strip("/").split("/")
    return all(part.isidentifier() and part.isascii() for part in parts)


def available() -> tuple[str, ...]:
    """Names of the backends that can be imported here, the preferred one first."""
    return tuple(name for name in BACKENDS if importlib.util.find_spec(name) is not None)


def open_bus(
    name: str,
    *,
    names: Names | None = None,
    sim_time: bool = False,
    backend: Backend = "auto",
    domain: int | None = None,
) -> Bus:
    """Join ROS 2 as a node.

    Args:
        name: The node's.
        names: Namespace and remaps.
        sim_time: Whether its clock is /clock's.
        backend: Who carries it; "auto" takes rclpy where it can be imported, else cyclonedds.
        domain: The domain; None takes ROS_DOMAIN_ID, or 0.

    Raises:
        InputError: The backend cannot be imported, or the domain is none.
    """
    if not name.isidentifier():
        raise InputError(f"a node's name has letters, digits and _; got {name!r}")
    if domain is None:
        told = os.environ.get("ROS_DOMAIN_ID", "0") or "0"
        if not told.isdigit():
            raise InputError(f"ROS_DOMAIN_ID must be a whole number from 0 to 232, it is {told!r}")
        domain = int(told)
    if not 0 <= domain <= 232:
        raise InputError(f"a domain of ROS must be from 0 to 232, got {domain}")
    opened = _backend(backend)
    bus: Bus = opened(name, names or Names(), sim_time=sim_time, domain=domain)
    return bus


def _backend(name: Backend) -> Any:
    """The class of who carries a bus: of that name, or the first that can be imported."""
    there = available()
    if name != "auto" and name not in there:
        find("backend", name, BACKENDS)
        raise InputError(MISSING if not there else f"{name} cannot be imported here; {there[0]} can")
    broken = []
    for one in there if name == "auto" else (name,):
        module, kind = BACKENDS[one]
        try:
            return getattr(importlib.import_module(module), kind)
        except ImportError as error:
            broken.append(f"{one} is installed but cannot be imported: {str(error).splitlines()[0]}")
    raise InputError("; ".join(broken) or MISSING)


def localhost_only() -> bool:
    """Whether the environment asks to stay on this machine, by the variables of ROS 2."""
    reach = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper()
    return os.environ.get("ROS_LOCALHOST_ONLY", "") == "1" or reach == "LOCALHOST"
