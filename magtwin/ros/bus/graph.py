"""Graph: who publishes and subscribes, as far as discovered.

An endpoint carries the hash of its type in its user data (REP 2016).
"""

from typing import Any

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import InstanceState, Policy
from cyclonedds.core import Qos as DdsQos
from cyclonedds.domain import DomainParticipant

from magtwin.io.bags.types import definition_of
from magtwin.ros.bus.bus import Endpoint
from magtwin.ros.bus.types import ros_name

MOST_TAKEN = 256
"""Endpoints that are taken at a time."""

_KEY = "typehash="


def user_data(kind: str) -> Any:
    """The user data of an endpoint: the hash of its type."""
    return Policy.Userdata(f"{_KEY}{definition_of(kind)[1]};".encode())


def digest_of(qos: DdsQos) -> str:
    """The hash of the type of an endpoint, from its user data; "" if it has none, as in Humble."""
    data = qos[Policy.Userdata].data if Policy.Userdata in qos else b""
    entries = bytes(data).decode(errors="replace").split(";")
    return next((entry.removeprefix(_KEY) for entry in entries if entry.startswith(_KEY)), "")


class Discovered:
    """The discovered publishers, or subscribers, of all topics."""

    def __init__(self, participant: DomainParticipant, builtin: Any = BuiltinTopicDcpsPublication) -> None:
        """Start to listen to DDS discovery."""
        self._reader = BuiltinDataReader(participant, builtin)
        self._found: dict[Any, tuple[str, Endpoint]] = {}

    def of(self, topic: str) -> list[Endpoint]:
        """The endpoints of a topic, by its DDS name."""
        while taken := self._reader.take(N=MOST_TAKEN):
            for offer in taken:
                if offer.sample_info.valid_data:
                    self._found[offer.key] = offer.topic_name, _endpoint(offer)
                elif offer.sample_info.instance_state != InstanceState.Alive:
                    self._found.pop(offer.key, None)
        return [endpoint for name, endpoint in self._found.values() if name == topic]


def _endpoint(offer: Any) -> Endpoint:
    return Endpoint(
        kind=ros_name(offer.type_name),
        reliable=isinstance(offer.qos[Policy.Reliability], Policy.Reliability.Reliable),
        latched=offer.qos[Policy.Durability] != Policy.Durability.Volatile,
        digest=digest_of(offer.qos),
    )
