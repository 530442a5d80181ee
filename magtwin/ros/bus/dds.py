"""DdsBus: a node over cyclonedds, which reaches any ROS 2 on the network from any Python.

It follows the mapping of ROS 2: `/robot/odom` is the DDS topic `rt/robot/odom`, QoS profiles are DDS
policies, and messages are plain CDR. Such a node sends and receives like any other and is in the lists of
`ros2 node list`, but has no services.
"""

import os
import socket
import sys
import time
import warnings
import weakref
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from cyclonedds.builtin import BuiltinTopicDcpsSubscription
from cyclonedds.core import (
    DDSException,
    InstanceState,
    Policy,
    ReadCondition,
    SampleState,
    ViewState,
    WaitSet,
)
from cyclonedds.core import Qos as DdsQos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic as DdsTopic

from magtwin.errors import InputError, RepairWarning
from magtwin.io.bags.cdr import NS
from magtwin.io.bags.topics import CLOCK, Qos
from magtwin.io.bags.types import definition_of, typestore
from magtwin.ros.bus.bus import Bus, Endpoint, Handler, Message, Publisher, Subscription
from magtwin.ros.bus.clock import Alarm, Clock
from magtwin.ros.bus.graph import Discovered, Listed, qos_of
from magtwin.ros.bus.names import Names, Range
from magtwin.ros.bus.types import struct_of

MOST_TAKEN = 256
"""Messages of a topic taken at a time."""

CLOCK_DEPTH = 1000
"""Queue of /clock, so that each other message gets the time before it."""

_COMMON = (
    "<Compatibility><IgnoreTypeInformation>1.15</IgnoreTypeInformation></Compatibility>"  # differs in Kilted
    "<Tracing><Verbosity>none</Verbosity></Tracing>"
)
# A node that announces itself by multicast alone, as ROS does by default, is found by our announcements to
# each port of this machine; they go on, as such a node may start at any time.
_HERE = (
    '<General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>'
    "<AllowMulticast>false</AllowMulticast></General>"
    "<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>"
    "<SPDPInterval>1s</SPDPInterval><InitialLocatorPruneDelay>inf</InitialLocatorPruneDelay>"
    '<Peers><Peer address="127.0.0.1"/></Peers></Discovery>'
)
_ANYWHERE = "<Discovery><ParticipantIndex>auto</ParticipantIndex></Discovery>"

PORTS, PORTS_EACH = 7400, 250
"""First port of domain 0, and ports of each domain (OMG DDSI-RTPS 2.5, section 9.6.2.1)."""

_DOMAINS: dict[int, Domain] = {}
"""Configured domains; they must be configured before the first participant and outlive it."""


def sockets_of(domain: int) -> list[socket.socket]:
    """The sockets of this process that receive in a domain from every interface, as duplicates."""
    found = []
    ports = range(PORTS + PORTS_EACH * domain, PORTS + PORTS_EACH * (domain + 1))
    for entry in list(Path("/proc/self/fd").iterdir()):
        with suppress(OSError):  # closed by now
            if not str(entry.readlink()).startswith("socket:"):
                continue
            held = socket.socket(fileno=os.dup(int(entry.name)))
            udp = (held.family, held.type) == (socket.AF_INET, socket.SOCK_DGRAM)
            address, port = held.getsockname() if udp else ("", 0)
            if address == "0.0.0.0" and port in ports:
                found.append(held)
            else:
                held.close()
    return found


def _to_loopback(domain: int) -> None:
    """Let the sockets of a domain receive from this machine alone.

    cyclonedds binds them to every interface, whatever interfaces it is configured for.
    """
    if sys.platform != "linux":
        return
    for held in sockets_of(domain):
        with held:
            if held.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16):
                continue
            try:
                held.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo\0")
            except OSError as error:  # Linux before 5.7 leaves this to root
                text = f"other machines can send to port {held.getsockname()[1]} of this node ({error})"
                warnings.warn(f"{text}: close it in the firewall", RepairWarning, stacklevel=3)


class DdsBus(Bus):
    """As `magtwin.ros.bus.Bus`."""

    backend = "cyclonedds"

    def __init__(self, name: str, names: Names, *, sim_time: bool, domain: int, reach: Range) -> None:
        self.name, self._names, self.reach = name, names, reach
        try:
            if domain not in _DOMAINS and "CYCLONEDDS_URI" not in os.environ:
                where = _HERE if reach == "localhost" else _ANYWHERE
                xml = f'<CycloneDDS><Domain Id="any">{where}{_COMMON}</Domain></CycloneDDS>'
                _DOMAINS[domain] = Domain(domain, xml)
            self._participant = DomainParticipant(domain, qos=DdsQos(Policy.Userdata(b"enclave=/;")))
            if reach == "localhost" and domain in _DOMAINS:
                _to_loopback(domain)
        except DDSException as error:
            raise InputError(
                f"cyclonedds cannot join domain {domain} ({error}); is CYCLONEDDS_URI right, the network up, "
                "and are there fewer than 32 nodes on this machine?"
            ) from error
        self._waiting = WaitSet(self._participant)
        self._topics: dict[tuple[str, str], DdsTopic[Any]] = {}
        self._writers: list[DataWriter[Any]] = []
        self._readers: list[tuple[DataReader[Any], str, Handler]] = []
        self._conditions: list[ReadCondition] = []
        self._offers = Discovered(self._participant)
        self._wants: Discovered | None = None
        self._listed = Listed(self._participant, name, names.namespace, self._offers, self._gids)
        self.clock = Clock(sim_time=sim_time)
        if sim_time:
            self.subscribe(CLOCK.name, CLOCK.kind, self._tick, replace(CLOCK.qos.heard, depth=CLOCK_DEPTH))

    def publisher(self, topic: str, kind: str, qos: Qos) -> Publisher:
        """As for `Bus`."""
        whole = self._names.resolve(topic)
        writer: DataWriter[Any] = DataWriter(
            self._participant, self._topic(whole, kind), qos_of(qos, definition_of(kind)[1])
        )
        self._writers.append(writer)  # its latched message lives as long as it does
        held = weakref.proxy(writer)  # a publisher that outlives its closed bus must not keep the participant
        return Publisher(
            whole,
            kind,
            lambda data: held.write(struct_of(kind).deserialize(data)),
            lambda: len(held.get_matched_subscriptions()),
        )

    def subscribe(self, topic: str, kind: str, handler: Handler, qos: Qos) -> Subscription:
        """As for `Bus`."""
        whole = self._names.resolve(topic)
        reader: DataReader[Any] = DataReader(
            self._participant, self._topic(whole, kind), qos_of(qos, definition_of(kind)[1])
        )
        fresh = ReadCondition(reader, SampleState.NotRead | ViewState.Any | InstanceState.Any)
        self._waiting.attach(fresh)
        self._conditions.append(fresh)
        self._readers.append((reader, kind, handler))
        held = weakref.proxy(reader)
        return Subscription(whole, lambda: len(held.get_matched_publications()))

    def knows(self, kind: str) -> bool:
        """As for `Bus`: the types of the distributions of ROS 2."""
        return kind in typestore().fielddefs

    def offers(self, topic: str) -> list[Endpoint]:
        """As for `Bus`."""
        return self._offers.of(f"rt{self._names.resolve(topic)}")

    def wants(self, topic: str) -> list[Endpoint]:
        """As for `Bus`."""
        if self._wants is None:
            self._wants = Discovered(self._participant, BuiltinTopicDcpsSubscription)
        return self._wants.of(f"rt{self._names.resolve(topic)}")

    def timer(self, period_s: float, due: Callable[[], None], *, wall: bool = False) -> Alarm:
        """As for `Bus`."""
        return self.clock.timer(period_s, due, wall=wall)

    def now_ns(self) -> int:
        """As for `Bus`."""
        return self.clock.now_ns()

    def due_wall_ns(self) -> int:
        """As for `Bus`."""
        return self.clock.due_wall_ns

    def spin_once(self, timeout_s: float) -> None:
        """As for `Bus`."""
        self._listed.look()
        left = self.clock.left_s(timeout_s)
        if self._conditions and left > 0:
            self._waiting.wait(round(left * NS))
        elif left > 0:
            time.sleep(left)
        self._take()
        self.clock.run_due()

    def close(self) -> None:
        """As for `Bus`."""
        for held in (self._conditions, self._readers, self._writers, self._topics):
            held.clear()  # type: ignore[attr-defined]
        del self._waiting, self._listed, self._offers, self._wants, self._participant

    def _gids(self) -> tuple[list[bytes], list[bytes]]:
        """Identifiers of the subscriptions and publishers of this node."""
        return [reader.guid.bytes for reader, *_ in self._readers], [w.guid.bytes for w in self._writers]

    def _topic(self, whole: str, kind: str) -> "DdsTopic[Any]":
        if (whole, kind) not in self._topics:
            self._topics[whole, kind] = DdsTopic(self._participant, f"rt{whole}", struct_of(kind))
        return self._topics[whole, kind]

    def _take(self) -> None:
        """Handle all received messages in the order of sending."""
        received: list[tuple[int, str, Handler, bytes]] = []
        # /clock, the first reader, comes last: it gives the others their time.
        for reader, kind, handler in reversed(self._readers):
            while taken := reader.take(N=MOST_TAKEN):
                valid = [sample for sample in taken if sample.sample_info.valid_data]
                received += [(s.sample_info.source_timestamp, kind, handler, s.cdr) for s in valid]
                if len(taken) < MOST_TAKEN:
                    break
        now = time.time_ns()
        for sent_ns, kind, handler, data in sorted(received, key=lambda entry: entry[0]):
            if self._readers:  # a handler may close the node
                handler(Message(kind, data, sent_ns, now))

    def _tick(self, message: Message) -> None:
        with suppress(InputError):  # a damaged message
            self.clock.tell(int(message.read(["clock"])["clock"]), message.sent_ns)
        self.clock.run_due()  # at each tick, even if several arrive at once
