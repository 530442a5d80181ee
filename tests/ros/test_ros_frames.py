"""Frames of live messages: poses of parts of a robot, and vectors of mounted sensors."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from magtwin.io.bags.topics import IMU, POSE, TF_STATIC, Topic
from magtwin.ros.bus import Message, Names, Subscription, to_bytes
from magtwin.ros.inputs import Input, LiveFrames

NS = 10**9
ARM, MOUNT = np.array([0.1, -0.05, 0.2]), Rotation.from_euler("zyx", (0.7, 0.3, -0.4))
PLACE, HEADING = np.array([1.0, 2.0, 0.0]), Rotation.from_euler("z", 0.5)
ODOMETRY_KIND = "nav_msgs/msg/Odometry"


class Still:
    """A bus whose clock stands, and whose messages the test sends."""

    def __init__(self) -> None:
        self.handlers: dict[str, Callable[[Message], None]] = {}
        self.kinds: dict[str, str] = {}

    def resolve(self, name: str) -> str:
        return Names().resolve(name)

    def knows(self, kind: str) -> bool:
        return True

    def types(self, name: str) -> tuple[str, ...]:
        return (self.kinds[name],) if name in self.kinds else ()

    def now_ns(self) -> int:
        return 5 * NS

    def subscribe(self, name: str, kind: str, handler: Callable[[Message], None], qos: Any) -> Subscription:
        self.handlers[name], self.kinds[name] = handler, kind
        return Subscription(name, lambda: 1)

    def send(self, name: str, fields: dict[str, Any]) -> None:
        kind = self.kinds[name]
        self.handlers[name](Message(kind, to_bytes(kind, fields), 5 * NS, 5 * NS))

    def place(self, *frames: str) -> None:
        """Send the mount as the transform between two frames."""
        each = {"header.frame_id": frames[0], "child_frame_id": frames[1]}
        each |= {"transform.translation": ARM, "transform.rotation": MOUNT.as_quat()}
        self.send(TF_STATIC.name, {"transforms": 1} | {f"transforms.0.{k}": v for k, v in each.items()})


def heard(topic: Topic, kind: str, *, axes: Any = None) -> tuple[Still, Input, list[str]]:
    """A bus, an input of a type, and what the input says."""
    bus, lines = Still(), list[str]()
    bus.kinds[topic.name] = kind
    one = Input(bus, topic, frames=LiveFrames(bus, axes), max_age_s=1.0, say=lines.append)  # type: ignore[arg-type]
    one.look()
    return bus, one, lines


def pose(header: str, child: str, p: Any = PLACE, q: Rotation = HEADING) -> dict[str, Any]:
    fields = {"pose.pose.position": p, "pose.pose.orientation": q.as_quat(), "child_frame_id": child}
    return {"header.stamp": np.int64(5 * NS), "header.frame_id": header, **fields}


def test_the_pose_of_a_camera_is_refused_until_its_place_is_known_and_then_that_of_the_base() -> None:
    bus, one, lines = heard(POSE, ODOMETRY_KIND)
    there, turned = PLACE + HEADING.apply(ARM), HEADING * MOUNT
    fault = "it is the pose of 'camera_link', and no tree of frames has the way from base_link to there: "
    fault += "publish that transform, or the pose of base_link"
    for _ in range(3):
        bus.send(POSE.name, pose("map", "camera_link", there, turned))
        assert one.fresh(5 * NS) is None
        assert fault in one.status(5 * NS).message
    assert lines == [f"/robot/enu/pose: {fault}"]
    assert one.missing() == f"no fresh /robot/enu/pose: {fault}"
    bus.place("base_link", "camera_link")
    bus.send(POSE.name, pose("map", "camera_link", there, turned))
    columns = one.fresh(5 * NS)
    assert columns is not None
    assert_allclose(columns["mocap_p"][0], PLACE, atol=1e-12)
    assert_allclose(columns["mocap_q_xyzw"][0], HEADING.as_quat(), atol=1e-12)
    assert one.status(5 * NS).message == "fresh"


@pytest.mark.parametrize("own", [False, True])
def test_an_imu_is_turned_into_base_link_or_into_the_axes_of_the_scenes_imu(own: bool) -> None:
    bus, one, _ = heard(IMU, IMU.kind, axes={"IMU": MOUNT.as_quat()} if own else None)
    bus.place("base_link", "imu_link")
    rates, a = np.array([0.0, 0.0, 0.2]), np.array([0.3, 0.1, 0.0])
    sent = {"orientation": (HEADING * MOUNT).as_quat(), "angular_velocity": MOUNT.inv().apply(rates)}
    sent |= {"linear_acceleration": MOUNT.inv().apply(a), "header.stamp": np.int64(5 * NS)}
    bus.send(IMU.name, {**sent, "header.frame_id": "imu_link"})
    columns = one.fresh(5 * NS)
    assert columns is not None
    if own:
        assert_array_equal(columns["imu_w"][0], sent["angular_velocity"])
        assert_array_equal(columns["imu_q_xyzw"][0], sent["orientation"])
    else:
        assert_allclose(columns["imu_w"][0], rates, atol=1e-12)
        assert_allclose(columns["imu_a"][0], a, atol=1e-12)
        assert_allclose(columns["imu_q_xyzw"][0], HEADING.as_quat(), atol=1e-12)
