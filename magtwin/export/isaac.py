"""Action Graphs for Isaac Sim: each robot's ROS 2 topics.

The graph of a robot publishes clock, odometry, IMU, pose, battery, joints and scan, and drives the robot by
commands, on the topics and in the frames of `magtwin.io.bags.topics`. Isaac Sim has no magnetometer; these
topics are the inputs of the network. The graph was not run in Isaac Sim, but is checked against the
definitions of its nodes, see `magtwin.export.ogn`.
"""

import math
from typing import Any, NamedTuple

from pxr import Sdf, Usd, UsdPhysics

from magtwin.errors import InputError
from magtwin.export.ogn import Graph
from magtwin.frames import IDENTITY_XYZW
from magtwin.sim.sensors.battery import current_a, open_voltage
from magtwin.spec.base import ZERO3
from magtwin.spec.robot import RobotSpec
from magtwin.spec.scene import Scene
from magtwin.spec.sensors import BatterySpec, MountSpec
from magtwin.usd.geometry import BASE_LINK
from magtwin.usd.layers import WORLD
from magtwin.usd.schema import only_prim_with, place, prims_with
from magtwin.usd.sensors import IMU_TYPE, LIDAR_TYPE

GRAPHS = WORLD.AppendChild("Graphs")
"""Scope of the graphs; each has the name of its robot."""

ROBOT = "robot"
"""Namespace of the topics of a single robot."""

ROBOT_API, LINKS, JOINTS = "IsaacRobotAPI", "isaac:physics:robotLinks", "isaac:physics:robotJoints"

BRIDGE = "isaacsim.ros2.bridge."
CORE = "isaacsim.core.nodes."
SENSORS = "isaacsim.sensors.physics."
BREAK = "omni.graph.nodes.BreakVector"

FRAMES_HZ = 60.0
"""Default frame rate of Isaac Sim's playback [Hz]."""

DISCHARGING = 2
"""POWER_SUPPLY_STATUS_DISCHARGING of sensor_msgs/BatteryState."""

QOS, HEARD_QOS = "qos", "heard_qos"
"""Nodes with the QoS of published topics, and of commands: best effort, which matches every publisher."""


class _Parts(NamedTuple):
    """Prims of a robot for its graph."""

    articulation: Sdf.Path
    base: Sdf.Path
    imu: Sdf.Path
    lidar: Sdf.Path


def author_graph(stage: Usd.Stage, scene: Scene) -> list[Usd.Prim]:
    """Author an Action Graph for each robot of a scene.

    A single robot has topics such as /robot/odom; several robots have their own names instead of robot.

    Args:
        stage: The scene's stage; written to in its edit target.
        scene: The scene, with the robots' names on the stage.

    Returns:
        The graphs' prims.

    Raises:
        InputError: A robot is not on the stage, lacks Isaac Sim's robot schema, or lacks a sensor.
    """
    robots = {prim.GetName(): prim for prim in prims_with(stage.GetPseudoRoot(), "robot")}
    alone, graphs = len(scene.robots) == 1, list[Usd.Prim]()
    for robot in (placed.robot for placed in scene.robots):
        if robot.name not in robots:
            raise InputError(f"the stage has no robot {robot.name!r}; it has {', '.join(robots) or 'none'}")
        parts = _parts(robots[robot.name])
        if not stage.GetPrimAtPath(GRAPHS):
            stage.DefinePrim(GRAPHS, "Scope")
        graph, topics = Graph(stage, GRAPHS.AppendChild(robot.name)), f"/{ROBOT if alone else robot.name}"
        _clocks(graph, publish=not graphs)
        _odometry(graph, parts, f"{topics}/odom")
        _imu(graph, parts, f"{topics}/imu", frame_of(robot.imu, "imu"))
        _pose(graph, parts, f"{topics}/enu/pose")
        _battery(graph, robot.battery, f"{topics}/battery_state")
        _joints(graph, parts, f"{topics}/joint_states")
        _scan(graph, parts, f"{topics}/scan", frame_of(robot.lidar, "lidar"))
        _drive(graph, robot, parts, f"{topics}/cmd_vel")
        graphs.append(stage.GetPrimAtPath(graph.path))
    return graphs


def _clocks(graph: Graph, *, publish: bool) -> None:
    """Ticks, time stamps, and the QoS of `magtwin.io.bags.topics`."""
    graph.node("tick", "omni.graph.action.OnPlaybackTick")
    graph.node("time", f"{CORE}IsaacReadSimulationTime", resetOnStop=True)
    graph.node("stamp", f"{CORE}IsaacTimeSplitter")
    graph.connect("time.simulationTime", "stamp.time")
    graph.node("context", f"{BRIDGE}ROS2Context", useDomainIDEnvVar=True)
    kind = f"{BRIDGE}ROS2QoSProfile"
    reliable, best = {"reliability": "reliable"}, {"reliability": "bestEffort"}
    graph.node(QOS, kind, createProfile="Default for publishers/subscribers", depth=10, **reliable)
    graph.node(HEARD_QOS, kind, createProfile="Custom", depth=10, **best)
    if publish:
        graph.node("clock", f"{BRIDGE}ROS2PublishClock", topicName="/clock")
        _published(graph, "clock", QOS)


def _published(graph: Graph, node: str, qos: str, after: str = "tick.tick", *, stamp: bool = True) -> None:
    """Connect the inputs of every ROS 2 node."""
    graph.connect(after, f"{node}.execIn")
    graph.connect("context.context", f"{node}.context")
    graph.connect(f"{qos}.qosProfile", f"{node}.qosProfile")
    if stamp:
        graph.connect("time.simulationTime", f"{node}.timeStamp")


def _odometry(graph: Graph, parts: _Parts, topic: str) -> None:
    """Exact pose relative to the start, and velocities in the robot's axes, without wheel slip."""
    graph.node("odometry", f"{CORE}IsaacComputeOdometry", chassisPrim=parts.base)
    graph.node(
        "publish_odometry",
        f"{BRIDGE}ROS2PublishOdometry",
        topicName=topic,
        odomFrameId="odom",
        chassisFrameId=BASE_LINK,
        publishRawVelocities=True,  # they are in the robot's axes already
    )
    graph.connect("tick.tick", "odometry.execIn")
    _published(graph, "publish_odometry", QOS, "odometry.execOut")
    for name in ("position", "orientation", "linearVelocity", "angularVelocity"):
        graph.connect(f"odometry.{name}", f"publish_odometry.{name}")


def _imu(graph: Graph, parts: _Parts, topic: str, frame: str) -> None:
    graph.node("imu", f"{SENSORS}IsaacReadIMU", imuPrim=parts.imu, readGravity=False)  # as imu_a is
    graph.node("publish_imu", f"{BRIDGE}ROS2PublishImu", topicName=topic, frameId=frame)
    graph.connect("tick.tick", "imu.execIn")
    _published(graph, "publish_imu", QOS, "imu.execOut")
    graph.connect("imu.orientation", "publish_imu.orientation")
    graph.connect("imu.angVel", "publish_imu.angularVelocity")
    graph.connect("imu.linAcc", "publish_imu.linearAcceleration")


def _pose(graph: Graph, parts: _Parts, topic: str) -> None:
    """Pose of motion capture: Isaac Sim has no publisher for it, so the message is built from numbers."""
    graph.node("pose", f"{CORE}IsaacReadWorldPose", prim=parts.base)
    graph.node("place", f"{BREAK}3")
    graph.node("turn", f"{BREAK}4")
    values = {"topicName": topic, "header:frame_id": "map"}
    _message(graph, "publish_pose", "geometry_msgs/msg/PoseStamped", QOS, **values)
    graph.connect("pose.translation", "place.tuple")
    graph.connect("pose.orientation", "turn.tuple")
    for axis in "xyz":
        graph.connect(f"place.{axis}", f"publish_pose.pose:position:{axis}")
    for axis in "xyzw":
        graph.connect(f"turn.{axis}", f"publish_pose.pose:orientation:{axis}")


def _battery(graph: Graph, spec: BatterySpec, topic: str) -> None:
    """The battery at the start of a run, with the load of the electronics: it does not discharge."""
    charge = spec.initial_fraction
    current = float(current_a(spec, spec.load_w, charge))
    graph.node("seldom", f"{CORE}IsaacSimulationGate", step=max(1, round(FRAMES_HZ / spec.rate_hz)))
    graph.connect("tick.tick", "seldom.execIn")
    values = {
        "topicName": topic,
        "header:frame_id": BASE_LINK,
        "voltage": float(open_voltage(spec, charge)) - spec.resistance_ohm * current,
        "current": -current,  # ROS counts current into the battery
        "percentage": charge,
        **dict.fromkeys(("temperature", "charge", "capacity", "design_capacity"), math.nan),
        "power_supply_status": DISCHARGING,
        "present": True,
    }
    kind = "sensor_msgs/msg/BatteryState"
    _message(graph, "publish_battery", kind, QOS, after="seldom.execOut", **values)


def _message(graph: Graph, node: str, kind: str, qos: str, after: str = "tick.tick", **values: Any) -> None:
    """A generic publisher of a message with a header."""
    graph.node(node, f"{BRIDGE}ROS2Publisher", message=kind, **values)
    _published(graph, node, qos, after, stamp=False)
    graph.connect("stamp.seconds", f"{node}.header:stamp:sec")
    graph.connect("stamp.nanoseconds", f"{node}.header:stamp:nanosec")


def _joints(graph: Graph, parts: _Parts, topic: str) -> None:
    graph.node("joints", f"{SENSORS}IsaacReadJointState", prim=parts.articulation)
    graph.node("publish_joints", f"{BRIDGE}ROS2PublishJointState", topicName=topic)
    graph.connect("tick.tick", "joints.execIn")
    _published(graph, "publish_joints", QOS, "joints.execOut")
    for name in ("Names", "Positions", "Velocities", "Efforts", "DofTypes"):
        graph.connect(f"joints.joint{name}", f"publish_joints.joint{name}")
    graph.connect("joints.stageMetersPerUnit", "publish_joints.stageMetersPerUnit")
    graph.connect("joints.sensorTime", "publish_joints.sensorTime")


def _scan(graph: Graph, parts: _Parts, topic: str, frame: str) -> None:
    graph.node("once", f"{CORE}OgnIsaacRunOneSimulationFrame")
    graph.node("beams", f"{CORE}IsaacCreateRenderProduct", cameraPrim=parts.lidar)
    graph.node(
        "publish_scan", f"{BRIDGE}ROS2RtxLidarHelper", topicName=topic, frameId=frame, type="laser_scan"
    )
    graph.connect("tick.tick", "once.execIn")
    graph.connect("once.step", "beams.execIn")
    _published(graph, "publish_scan", QOS, "beams.execOut", stamp=False)
    graph.connect("beams.renderProductPath", "publish_scan.renderProductPath")


def _drive(graph: Graph, robot: RobotSpec, parts: _Parts, topic: str) -> None:
    """The latest command, within the drive's limits, as rates of the wheels."""
    drive = robot.drive
    graph.node("command", f"{BRIDGE}ROS2SubscribeTwist", topicName=topic)
    graph.node("forward", f"{BREAK}3")
    graph.node("turning", f"{BREAK}3")
    graph.node(
        "controller",
        "isaacsim.robot.wheeled_robots.DifferentialController",
        wheelRadius=drive.wheel_radius_m,
        wheelDistance=drive.wheel_separation_m,
        maxLinearSpeed=drive.v_max,
        maxAngularSpeed=drive.w_max,
        maxAcceleration=drive.a_max,
        maxDeceleration=drive.a_max,
        maxAngularAcceleration=drive.alpha_max,
        maxWheelSpeed=drive.wheel_rate_max,
    )
    lefts = (drive.left_wheel_joint, *drive.more_left_wheel_joints)
    rights = (drive.right_wheel_joint, *drive.more_right_wheel_joints)
    axles = [f"wheels_{i + 1}" if i else "wheels" for i in range(max(len(lefts), len(rights)))]
    for i, axle in enumerate(axles):  # two rates each, which is what the controller makes
        names = [lefts[min(i, len(lefts) - 1)], rights[min(i, len(rights) - 1)]]
        graph.node(
            axle,
            f"{CORE}IsaacArticulationController",
            targetPrim=parts.articulation,
            jointNames=names,
        )
    _published(graph, "command", HEARD_QOS, stamp=False)
    graph.connect("tick.tick", "controller.execIn")  # each frame, as its limits of acceleration go by time
    graph.connect("tick.deltaSeconds", "controller.dt")
    for axle in axles:
        graph.connect("tick.tick", f"{axle}.execIn")
        graph.connect("controller.velocityCommand", f"{axle}.velocityCommand")
    graph.connect("command.linearVelocity", "forward.tuple")
    graph.connect("command.angularVelocity", "turning.tuple")
    graph.connect("forward.x", "controller.linearVelocity")
    graph.connect("turning.z", "controller.angularVelocity")


def frame_of(mount: MountSpec, name: str) -> str:
    """Frame of a sensor's messages: its link, or its own frame if its pose differs from the link's."""
    straight = (mount.p_link_sensor, mount.q_link_sensor_xyzw) == (ZERO3, IDENTITY_XYZW)
    return mount.link if straight else name


def _parts(root: Usd.Prim) -> _Parts:
    """The prims of a robot that Isaac Sim needs."""
    if ROBOT_API not in root.GetMetadata("apiSchemas").GetAppliedItems():
        raise InputError(
            f"{place(root)}: has no {ROBOT_API}, so Isaac Sim does not see a robot; convert its URDF "
            "with `magtwin robot`"
        )
    links = root.GetRelationship(LINKS).GetForwardedTargets()
    joints = root.GetRelationship(JOINTS).GetForwardedTargets()
    if not links or not joints:
        raise InputError(f"{place(root)}: {LINKS if not links else JOINTS} lists none; list them in order")
    base = root.GetStage().GetPrimAtPath(links[0])
    if not base or not base.HasAPI(UsdPhysics.RigidBodyAPI):
        raise InputError(f"{place(root)}: {LINKS} begins with {links[0]}, which is no rigid body")
    roots = [prim for prim in Usd.PrimRange(root) if prim.HasAPI(UsdPhysics.ArticulationRootAPI)]
    if len(roots) != 1:
        raise InputError(f"{place(root)}: has {len(roots)} articulation roots; it needs one")
    return _Parts(
        articulation=roots[0].GetPath(),
        base=links[0],
        imu=_child(only_prim_with(root, "imu"), IMU_TYPE).GetPath(),
        lidar=_child(only_prim_with(root, "lidar"), LIDAR_TYPE).GetPath(),
    )


def _child(mount: Usd.Prim, kind: str) -> Usd.Prim:
    children = [prim for prim in mount.GetChildren() if prim.GetTypeName() == kind]
    if len(children) != 1:
        raise InputError(f"{place(mount)}: has {len(children)} children of type {kind}; it needs one")
    return children[0]
