"""Bus: the interface of a node to ROS 2.

There are two backends: rclpy, if it can be imported, and cyclonedds, which reaches any ROS 2 over the network
from any Python. Both take and give messages as CDR bytes, so a node behaves the same
with either.
"""

import importlib
import importlib.util
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, Protocol

from magtwin.errors import InputError, find
from magtwin.io.bags.topics import Qos
from magtwin.ros.bus.messages import content_of, leaf_of
from magtwin.ros.bus.names import Names, Range, range_of

Backend = Literal["auto", "rclpy", "cyclonedds"]

BACKENDS: Mapping[str, tuple[str, str]] = {
    "rclpy": ("magtwin.ros.bus.rclpy_bus", "RclpyBus"),
    "cyclonedds": ("magtwin.ros.bus.dds", "DdsBus"),
}
"""Module and class of each backend; the first one that can be imported is the default."""

MISSING = (
    "no ROS 2 can be imported: source an installation (source /opt/ros/jazzy/setup.bash), or install "
    "cyclonedds, which reaches ROS 2 over the network (pip install 'magtwin[ros]')"
)


@dataclass(frozen=True)
class Message:
    """A received message."""

    kind: str
    data: bytes
    """CDR, with its header."""

    sent_ns: int
    """Wall time of the sender [ns]."""

    received_ns: int
    """Wall time of receipt [ns]."""

    @cached_property
    def content(self) -> Any:
        """The message as an object of rosbags, with an attribute for each field.

        Raises:
            InputError: It is too short or too long for its type, or not plain CDR.
        """
        return content_of(self.kind, self.data)

    def read(self, wanted: Iterable[str]) -> dict[str, Any]:
        """Values of some leaves: numbers, arrays, strings; stamps in whole nanoseconds.

        Args:
            wanted: Names of the leaves, such as `transforms.0.header.stamp`; the name of a sequence of
                structures is its length.

        Raises:
            InputError: As for `content`; or it has fewer elements.
        """
        return {name: leaf_of(self.content, name) for name in wanted}


Handler = Callable[[Message], None]


@dataclass(frozen=True)
class Publisher:
    """Sends messages of one topic."""

    topic: str
    kind: str
    publish: Callable[[bytes], object]
    """Send a message, in CDR."""

    subscribers: Callable[[], int]
    """Number of subscribers."""


@dataclass(frozen=True)
class Subscription:
    """Receives messages of one topic."""

    topic: str
    publishers: Callable[[], int]
    """Number of publishers."""


@dataclass(frozen=True)
class Endpoint:
    """A publisher or subscriber of a topic, as discovered."""

    kind: str
    """Message type; "" if it is not a ROS type."""

    reliable: bool
    latched: bool
    digest: str = ""
    """REP 2011 hash of its type; "" before ROS 2 Iron."""


class Bus(Protocol):
    """A node of ROS 2."""

    name: str
    backend: str
    reach: Range
    """How far the node can be discovered."""

    _names: Names

    def publisher(self, topic: str, kind: str, qos: Qos) -> Publisher:
        """Advertise a topic; `Names` resolves its name."""

    def subscribe(self, topic: str, kind: str, handler: Handler, qos: Qos) -> Subscription:
        """Call `handler` for each message of a topic, in the thread that spins.

        A reliable subscription receives nothing from a best-effort publisher; `Qos.heard` matches every
        publisher.
        """

    def knows(self, kind: str) -> bool:
        """Whether messages of a type can be sent and received."""

    def resolve(self, topic: str) -> str:
        """The full name of a topic on the network."""
        return self._names.resolve(topic)

    def offers(self, topic: str) -> list[Endpoint]:
        """The publishers of a topic, including those of this node, as far as discovered."""

    def wants(self, topic: str) -> list[Endpoint]:
        """The subscribers of a topic, including those of this node, as far as discovered."""

    def types(self, topic: str) -> tuple[str, ...]:
        """Types in which a topic is published, as far as discovered."""
        return tuple(sorted({offer.kind for offer in self.offers(topic)} - {""}))

    def publishers(self, topic: str) -> int:
        """Number of publishers of a topic, including this node, as far as discovered."""
        return len(self.offers(topic))

    def timer(self, period_s: float, due: Callable[[], None], *, wall: bool = False) -> object:
        """Call `due` every `period_s` of the bus's clock, or of wall time, in the thread that spins."""

    def now_ns(self) -> int:
        """Time of the bus's clock [ns]: wall time, or /clock (0 before its first message)."""

    def due_wall_ns(self) -> int:
        """Wall time at which the current timer was due, as far as known [ns]."""

    def spin_once(self, timeout_s: float) -> None:
        """Handle messages, after waiting for them at most `timeout_s`, and call timers that are due."""

    def close(self) -> None:
        """Leave the network."""


def available() -> tuple[str, ...]:
    """Names of the backends that can be imported, the preferred one first."""
    return tuple(name for name in BACKENDS if importlib.util.find_spec(name) is not None)


def open_bus(
    name: str,
    *,
    names: Names | None = None,
    sim_time: bool = False,
    backend: Backend = "auto",
    domain: int | None = None,
    discovery: Range | None = None,
) -> Bus:
    """Join ROS 2 as a node.

    Args:
        name: Name of the node.
        names: Namespace and remaps.
        sim_time: Use the time of /clock.
        backend: ROS client library; "auto" is rclpy if it can be imported, else cyclonedds.
        domain: ROS domain. Default: ROS_DOMAIN_ID, or 0.
        discovery: How far the node can be discovered; see `magtwin.ros.bus.names.range_of`.

    Raises:
        InputError: The backend cannot be imported, or the domain or a variable of the environment is wrong.
    """
    if not name.isidentifier():
        raise InputError(f"a node's name has letters, digits and _; got {name!r}")
    if domain is None:
        text = os.environ.get("ROS_DOMAIN_ID", "0") or "0"
        if not text.isdigit():
            raise InputError(f"ROS_DOMAIN_ID must be a whole number from 0 to 232, got {text!r}")
        domain = int(text)
    if not 0 <= domain <= 232:
        raise InputError(f"a domain of ROS must be from 0 to 232, got {domain}", parameter="domain")
    installed, broken = available(), []
    if backend != "auto" and backend not in installed:
        find("backend", backend, BACKENDS)
        raise InputError(f"{backend} cannot be imported; {installed[0]} can" if installed else MISSING)
    for candidate in installed if backend == "auto" else (backend,):
        module, kind = BACKENDS[candidate]
        try:
            opened = getattr(importlib.import_module(module), kind)
        except ImportError as error:
            broken.append(f"{candidate} is installed but cannot be imported: {str(error).splitlines()[0]}")
            continue
        reach = range_of(discovery)
        bus: Bus = opened(name, names or Names(), sim_time=sim_time, domain=domain, reach=reach)
        return bus
    raise InputError("; ".join(broken) or MISSING)
