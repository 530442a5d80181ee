"""A plain program of rclpy, without magtwin, meets the simulated robot: types, units, frames and time."""

import json
import os
import subprocess
import threading
from pathlib import Path

import numpy as np
import pytest
from nodes import DOMAINS
from places import ROOT

from magtwin.io.bags.topics import MAGNITUDE
from magtwin.ros.bus import Message, open_bus
from magtwin.ros.simulate import Simulator
from magtwin.twin import Twin

pytest.importorskip("cyclonedds", reason="extra ros is not installed")

BUILD = ROOT / "build"

STRANGER = """
import json, time
import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry
from diagnostic_msgs.msg import DiagnosticArray
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import BatteryState, Imu, JointState, LaserScan, MagneticField
from std_msgs.msg import Float64, Float64MultiArray, String
from rclpy.qos import QoSProfile, DurabilityPolicy

rclpy.init()
node = Node("stranger", parameter_overrides=[Parameter("use_sim_time", value=True)])
heard, due = {}, []

def keep(name):
    return lambda m: heard.setdefault(name, []).append(m)

latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
for name, kind, qos in (
    ("qtfm/magnitude", MagneticField, 10), ("qtfm/field", MagneticField, 10),
    ("qtfm/total_field_nt", Float64, 10), ("odom", Odometry, 10), ("imu", Imu, 10),
    ("enu/pose", PoseStamped, 10), ("scan", LaserScan, 10), ("joint_states", JointState, 10),
    ("battery_state", BatteryState, 10), ("robot_description", String, latched), ("/clock", Clock, 10),
    ("magtwin/reading", Float64MultiArray, 10), ("magtwin/columns", String, latched),
    ("/diagnostics", DiagnosticArray, 10),
):
    node.create_subscription(kind, name if name[0] == "/" else "/robot/" + name, keep(name), qos)
drive = node.create_publisher(Twist, "/robot/cmd_vel", qos_profile_sensor_data)  # best effort

def tick():
    now = node.get_clock().now().nanoseconds
    if now:
        due.append(now / 1e9)
    command = Twist()
    command.linear.x = 0.25
    drive.publish(command)

node.create_timer(0.1, tick)
begin = time.monotonic()
while (len(due) < 20 or len(heard) < 14) and time.monotonic() < begin + 120:
    rclpy.spin_once(node, timeout_sec=0.1)
field, odom = heard["qtfm/magnitude"][-1], heard["odom"][-1]
print(json.dumps({
    "heard": sorted(heard),
    "tesla": field.magnetic_field.x, "sd": field.magnetic_field_covariance[0] ** 0.5,
    "vector": [heard["qtfm/field"][-1].magnetic_field.x, heard["qtfm/field"][-1].magnetic_field.z],
    "nt": heard["qtfm/total_field_nt"][-1].data,
    "frames": [field.header.frame_id, odom.header.frame_id, odom.child_frame_id,
               heard["enu/pose"][-1].header.frame_id, heard["imu"][-1].header.frame_id],
    "stamp": field.header.stamp.sec + 1e-9 * field.header.stamp.nanosec,
    "speed": max(o.twist.twist.linear.x for o in heard["odom"]),
    "wheels": list(heard["joint_states"][-1].name),
    "volts": heard["battery_state"][-1].voltage,
    "rays": len(heard["scan"][-1].ranges),
    "urdf": heard["robot_description"][-1].data[:200],
    "sim": due,
}))
"""


@pytest.mark.parametrize(
    ("distribution", "speed", "reach"),
    [("jazzy", 1.0, "LOCALHOST"), ("jazzy", 4.0, "SUBNET"), ("kilted", 4.0, "SUBNET")],
)
def test_a_stranger_in_rclpy_sees_the_robot_obeys_its_clock_and_drives_it(
    twin: Twin, monkeypatch: pytest.MonkeyPatch, distribution: str, speed: float, reach: str
) -> None:
    python = BUILD / f"ros-{distribution}" / "bin" / "python"
    if not python.exists():
        pytest.skip(f"no rclpy of {distribution}: `make ros` installs it into build/ros-{distribution}")
    domain = next(DOMAINS)
    for name in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_LOCALHOST_ONLY", "CYCLONEDDS_URI"):
        monkeypatch.delenv(name, raising=False)
    bus = open_bus("sim", backend="cyclonedds", domain=domain)
    assert bus.reach == "localhost"  # whatever the stranger's reach
    simulator, over = Simulator(twin, bus, speed=speed, lidar="on"), threading.Event()
    simulated = threading.Thread(target=simulator.run, args=(over.is_set,))
    simulated.start()
    try:
        env = {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": reach}
        ended = subprocess.run([python, "-c", STRANGER], env=env, capture_output=True, text=True)
    finally:
        over.set()
        simulated.join()
        bus.close()
    assert ended.returncode == 0, ended.stderr
    seen = json.loads(ended.stdout.splitlines()[-1])
    field = {"qtfm/magnitude", "qtfm/field", "qtfm/total_field_nt", "magtwin/reading", "magtwin/columns"}
    sensors = {"odom", "imu", "enu/pose", "battery_state", "scan", "joint_states", "robot_description"}
    assert set(seen["heard"]) == field | sensors | {"/clock", "/diagnostics"}  # the wheels have no tf2_msgs
    assert 2e-5 < seen["tesla"] < 7e-5
    assert seen["nt"] == pytest.approx(1e9 * seen["tesla"], rel=0.05)  # perhaps of the reading beside it
    assert seen["frames"] == ["magnetometer_link", "odom", "base_link", "map", "imu_link"]
    assert seen["wheels"] == ["left_wheel_joint", "right_wheel_joint"]
    assert seen["rays"] == 720
    assert 12 < seen["volts"] < 17
    assert "<robot" in seen["urdf"]
    assert seen["speed"] > 0.2
    sim = seen["sim"]
    assert abs(seen["stamp"] - sim[-1]) < 0.5
    assert sorted(set(sim)) == sim
    # 19 steps of 0.1 s of /clock; by the wall they would be 7.6 s of it at four times real time.
    assert 1.7 < sim[19] - sim[0] < 4.0


OURS = """
import sys, threading, time
sys.path[:0] = sys.argv[1:3]
from magtwin.files.file import shipped
from magtwin.ros.bus import open_bus
from magtwin.ros.simulate import Simulator
from magtwin.twin import open_twin
import rclpy
from std_msgs.msg import Empty

twin = open_twin(shipped("scenes", "lab", "lab.usda"), magnetometer="map-only")
lines = []
bus = open_bus("sim")
simulator, over = Simulator(twin, bus, speed=2.0, say=lines.append), threading.Event()
simulated = threading.Thread(target=simulator.run, args=(over.is_set,))
simulated.start()
rclpy.init()
node = rclpy.create_node("caller")
knob = node.create_publisher(Empty, "/robot/reset", 10)
while not node.count_subscribers(sys.argv[3]):
    time.sleep(0.05)
start = simulator.online.t
while simulator.online.t < start + 3.0:
    time.sleep(0.05)
while not any("reset" in line for line in lines):
    knob.publish(Empty())
    time.sleep(0.2)
assert simulator.online.t < 2.0
while simulator.online.t < 1.0:
    time.sleep(0.05)
over.set()
simulated.join()
print(bus.backend, len(lines))
bus.close()
"""


def test_the_robot_is_simulated_on_rclpy_too_and_reset(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    python = BUILD / "ros-jazzy" / "bin" / "python"
    if not python.exists():
        pytest.skip("no rclpy of jazzy: `make ros` installs it into build/ros-jazzy")
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    domain = next(DOMAINS)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    libraries = str(Path(np.__file__).parents[1])  # magtwin's own, beside rclpy of that environment
    ear, heard = open_bus("ear", backend="cyclonedds"), list[Message]()
    ear.subscribe(MAGNITUDE.name, MAGNITUDE.kind, heard.append, MAGNITUDE.qos)
    command = [python, "-c", OURS, str(BUILD.parent), libraries, MAGNITUDE.name]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as ours:
        while ours.poll() is None:
            ear.spin_once(0.05)
        said, errors = ours.communicate()
    ear.close()
    assert said.startswith("rclpy"), errors
    stamps = [m.read(["header.stamp"])["header.stamp"] for m in heard]
    assert len(stamps) > 50  # who hears late hears less
    assert min(np.diff(stamps)) < -1e9  # time began anew
    assert 2e-5 < heard[-1].read(["magnetic_field"])["magnetic_field"][0] < 7e-5
