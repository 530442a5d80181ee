"""RclpyBus: a node over rclpy, from a sourced installation of ROS 2 or from its wheels."""

import importlib
import time
from collections.abc import Callable, Mapping
from typing import Any

import rclpy
import rclpy.parameter
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from magtwin.errors import InputError
from magtwin.io.bags.topics import Qos
from magtwin.parallel.machine import variables
from magtwin.ros.bus.bus import Bus, Endpoint, Handler, Message, Publisher, Subscription
from magtwin.ros.bus.names import Names, Range

MOST_AT_ONCE = 256
"""Callbacks that run before `spin_once` returns."""


OTHER_S = 0.02
"""Longest wait for messages while there is a second node, which is looked at in between [s]."""


def qos_of(qos: Qos) -> QoSProfile:
    """The rclpy profile of a quality of service."""
    return QoSProfile(
        depth=qos.depth,
        history=HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.RELIABLE if qos.reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if qos.latched else DurabilityPolicy.VOLATILE,
    )


def class_of(kind: str) -> Any:
    """The rclpy class of a message type.

    Raises:
        InputError: Its package is not installed.
    """
    package, space, name = kind.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.{space}"), name)
    except ImportError as error:
        raise InputError(
            f"the ROS package {package} is not installed, which has {kind}; install "
            f"ros-jazzy-{package.replace('_', '-')} or that of your distribution, or use cyclonedds"
        ) from error


def _endpoint(info: Any) -> Endpoint:
    digest = str(getattr(info, "topic_type_hash", ""))  # none in Humble
    return Endpoint(
        kind=info.topic_type,
        reliable=info.qos_profile.reliability != ReliabilityPolicy.BEST_EFFORT,
        latched=info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL,
        digest=digest if digest.startswith("RIHS01_") else "",
    )


class RclpyBus(Bus):
    """As `magtwin.ros.bus.Bus`."""

    backend = "rclpy"

    def __init__(self, name: str, names: Names, *, sim_time: bool, domain: int, reach: Range) -> None:
        self.name, self._names, self.reach = name, names, reach
        self._domain, self._sim_time = domain, sim_time
        self._context, self._node, self._executor = self._joined(name)
        self._calls, self._due_ns, self._kinds = 0, 0, dict[str, str]()
        self._other: tuple[Context, Node, SingleThreadedExecutor] | None = None

    def _joined(self, name: str) -> tuple[Context, Node, SingleThreadedExecutor]:
        """A node and what spins it."""
        context = Context()
        with variables({"ROS_AUTOMATIC_DISCOVERY_RANGE": self.reach.upper(), "ROS_LOCALHOST_ONLY": None}):
            rclpy.init(args=[], context=context, domain_id=self._domain)
        node = Node(
            name,
            context=context,
            namespace=self._names.namespace or "/",
            use_global_arguments=False,
            parameter_overrides=[rclpy.parameter.Parameter("use_sim_time", value=self._sim_time)],
        )
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        return context, node, executor

    def _node_for(self, whole: str, kind: str) -> Node:
        """The node for a topic of a type; a node of rclpy can have a topic in one type only."""
        if self._kinds.setdefault(whole, kind) == kind:
            return self._node
        if self._other is None:
            self._other = self._joined(f"{self.name}_other_types")
        return self._other[1]

    def publisher(self, topic: str, kind: str, qos: Qos) -> Publisher:
        """As for `Bus`."""
        whole = self._names.resolve(topic)
        sender = self._node_for(whole, kind).create_publisher(
            class_of(kind), whole, qos_of(qos)
        )  # takes CDR bytes
        return Publisher(whole, kind, sender.publish, sender.get_subscription_count)

    def subscribe(self, topic: str, kind: str, handler: Handler, qos: Qos) -> Subscription:
        """As for `Bus`."""
        whole = self._names.resolve(topic)

        def receive(data: bytes, info: Mapping[str, Any]) -> None:
            self._calls += 1
            handler(Message(kind, bytes(data), int(info["source_timestamp"]), time.time_ns()))

        node = self._node_for(whole, kind)
        node.create_subscription(class_of(kind), whole, receive, qos_of(qos), raw=True)
        return Subscription(whole, lambda: sum(offer.kind == kind for offer in self.offers(topic)))

    def knows(self, kind: str) -> bool:
        """As for `Bus`: types of installed packages."""
        try:
            return class_of(kind) is not None
        except InputError:
            return False

    def offers(self, topic: str) -> list[Endpoint]:
        """As for `Bus`."""
        found = self._node.get_publishers_info_by_topic(self._names.resolve(topic))
        return [_endpoint(info) for info in found]

    def wants(self, topic: str) -> list[Endpoint]:
        """As for `Bus`."""
        found = self._node.get_subscriptions_info_by_topic(self._names.resolve(topic))
        return [_endpoint(info) for info in found]

    def timer(self, period_s: float, due: Callable[[], None], *, wall: bool = False) -> Any:
        """As for `Bus`."""

        def call() -> None:
            self._calls += 1
            self._due_ns = time.time_ns()  # rclpy does not report when it was due
            due()

        clock = Clock(clock_type=ClockType.STEADY_TIME) if wall else None
        return self._node.create_timer(period_s, call, clock=clock)

    def now_ns(self) -> int:
        """As for `Bus`."""
        return int(self._node.get_clock().now().nanoseconds)

    def due_wall_ns(self) -> int:
        """As for `Bus`."""
        return self._due_ns

    def spin_once(self, timeout_s: float) -> None:
        """As for `Bus`."""
        before = self._calls
        if self._other is not None:
            self._other[2].spin_once(timeout_sec=0.0)
            timeout_s = min(timeout_s, OTHER_S)
        self._executor.spin_once(timeout_sec=timeout_s)
        for _ in range(MOST_AT_ONCE):
            if self._calls == before:
                return
            before = self._calls
            self._executor.spin_once(timeout_sec=0.0)

    def close(self) -> None:
        """As for `Bus`."""
        parts = [(self._context, self._node, self._executor), *([self._other] if self._other else [])]
        for context, node, executor in parts:
            executor.shutdown()
            node.destroy_node()
            rclpy.shutdown(context=context)
