"""Graph: who publishes and subscribes, and the entry of a cyclonedds node in the node lists of ROS 2.

An endpoint carries the hash of its type in its user data (REP 2016). Nodes of ROS 2 list themselves in
messages on ros_discovery_info, whose form differs between Humble and later distributions.
"""

import time
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import InstanceState, Policy
from cyclonedds.core import Qos as DdsQos
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic as DdsTopic

from magtwin.io.bags.cdr import NS
from magtwin.io.bags.topics import LATCHED, Qos
from magtwin.io.bags.types import store_of
from magtwin.ros.bus.bus import Endpoint
from magtwin.ros.bus.types import ros_name, struct_of

MOST_TAKEN = 256
"""Endpoints that are taken at a time."""

LOOK_S = 1.0
"""Time between searches for nodes that read node lists [s]."""

LISTS = "ros_discovery_info"
"""DDS topic of node lists."""

LISTS_KIND = "rmw_dds_common/msg/ParticipantEntitiesInfo"
GID_BYTES = {"humble": 24, "jazzy": 16}
"""Size of the identifier of an endpoint in node lists, by the distribution that introduced it."""

_KEY = "typehash="
"""Before the hash of its type in the user data of an endpoint (REP 2016)."""


def qos_of(qos: Qos, digest: str) -> DdsQos:
    """DDS policies of a quality of service, for an endpoint of a message type with this hash, or none."""
    reliable = Policy.Reliability.Reliable(max_blocking_time=NS // 10)
    return DdsQos(
        reliable if qos.reliable else Policy.Reliability.BestEffort,
        Policy.History.KeepLast(qos.depth),
        Policy.Durability.TransientLocal if qos.latched else Policy.Durability.Volatile,
        Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False),
        Policy.Userdata(f"{_KEY}{digest};".encode() if digest else b""),
    )


def digest_of(qos: DdsQos) -> str:
    """The hash of the type of an endpoint, from its user data; "" if it has none, as in Humble."""
    data = qos[Policy.Userdata].data if Policy.Userdata in qos else b""
    entries = bytes(data).decode(errors="replace").split(";")
    return next((entry.removeprefix(_KEY) for entry in entries if entry.startswith(_KEY)), "")


class _Found(NamedTuple):
    topic: str
    endpoint: Endpoint
    participant: str


class Discovered:
    """The discovered publishers, or subscribers, of all topics."""

    def __init__(self, participant: DomainParticipant, builtin: Any = BuiltinTopicDcpsPublication) -> None:
        """Start to listen to DDS discovery."""
        self._reader = BuiltinDataReader(participant, builtin)
        self._found: dict[Any, _Found] = {}

    def of(self, topic: str) -> list[Endpoint]:
        """The endpoints of a topic, by its DDS name."""
        return [found.endpoint for found in self.found() if found.topic == topic]

    def found(self) -> Iterable[_Found]:
        """All endpoints."""
        while taken := self._reader.take(N=MOST_TAKEN):
            for offer in taken:
                if offer.sample_info.valid_data:
                    self._found[offer.key] = _Found(
                        offer.topic_name, _endpoint(offer), str(offer.participant_key)
                    )
                elif offer.sample_info.instance_state != InstanceState.Alive:
                    self._found.pop(offer.key, None)
        return self._found.values()


def _endpoint(offer: Any) -> Endpoint:
    return Endpoint(
        kind=ros_name(offer.type_name),
        reliable=isinstance(offer.qos[Policy.Reliability], Policy.Reliability.Reliable),
        latched=offer.qos[Policy.Durability] != Policy.Durability.Volatile,
        digest=digest_of(offer.qos),
    )


class Listed:
    """The entry of a node in node lists, as long as nodes of one form of lists are there.

    Nodes of Humble and of later distributions cannot read the lists of each other. The entry has the form
    of the other nodes, and is withdrawn while there are both.
    """

    def __init__(
        self,
        participant: DomainParticipant,
        name: str,
        namespace: str,
        offers: Discovered,
        gids: Callable[[], tuple[list[bytes], list[bytes]]],
    ) -> None:
        """Prepare; `gids` gives the identifiers of the node's subscriptions and publishers."""
        self._participant, self._offers, self._gids = participant, offers, gids
        self._name, self._namespace = name, f"/{namespace.strip('/')}"
        self._own = str(participant.guid)
        self._form, self._sent = "", b""
        self._writer: DataWriter[Any] | None = None
        self._looked = 0.0

    def look(self) -> None:
        """Publish the entry if it has changed; looks every `LOOK_S`."""
        if time.monotonic() - self._looked < LOOK_S:
            return
        self._looked = time.monotonic()
        others = (f for f in self._offers.found() if f.topic == LISTS and f.participant != self._own)
        forms = {"jazzy" if other.endpoint.digest else "humble" for other in others}
        form = forms.pop() if len(forms) == 1 else ""
        if form != self._form:
            self._form, self._sent, self._writer = form, b"", self._written_as(form) if form else None
        if self._writer is not None and (data := self._entry(form)) != self._sent:
            self._writer.write(struct_of(LISTS_KIND, store_of(form)).deserialize(data))
            self._sent = data

    def _written_as(self, form: str) -> "DataWriter[Any]":
        store = store_of(form)
        digest = "" if form == "humble" else store.hash_rihs01(LISTS_KIND)
        topic: DdsTopic[Any] = DdsTopic(self._participant, LISTS, struct_of(LISTS_KIND, store))
        return DataWriter(self._participant, topic, qos_of(LATCHED, digest))

    def _entry(self, form: str) -> bytes:
        """The message on `LISTS`."""
        store, size = store_of(form), GID_BYTES[form]
        gid, whole, node = (
            store.types[f"rmw_dds_common/msg/{name}"]
            for name in ("Gid", "ParticipantEntitiesInfo", "NodeEntitiesInfo")
        )

        def identifier(guid: bytes) -> Any:
            return gid(np.frombuffer(guid.ljust(size, b"\0"), np.uint8))

        readers, writers = ([identifier(guid) for guid in guids] for guids in self._gids())
        entry = node(self._namespace, self._name, readers, writers)
        listed = whole(identifier(self._participant.guid.bytes), [entry])
        return bytes(store.serialize_cdr(listed, LISTS_KIND, little_endian=True))
