"""Isaac Sim: the Action Graph has what its nodes' definitions have, and what magtwin's ROS 2 topics are."""

from dataclasses import replace

import pytest
from pxr import Usd, UsdPhysics

from magtwin.author.scene import author_scene
from magtwin.errors import InputError
from magtwin.export.isaac import GRAPHS, author_graph
from magtwin.export.ogn import message_fields, node_types
from magtwin.io.bags.sender import sender_of
from magtwin.io.bags.topics import SCAN, TOPICS
from magtwin.io.bags.types import layout
from magtwin.ros.magnetometer import INPUTS
from magtwin.spec.robot import PlacedRobot
from magtwin.usd.layers import open_stage
from magtwin.usd.scene import read_scene
from magtwin.usd.schema import only_prim_with

USD_TYPES = {"execution": "uint", "vectord[3]": "vector3d", "quatd[4]": "quatd"}
"""OmniGraph's types that USD calls otherwise."""

ROLES = {"vectord[3]": "double[3]", "quatd[4]": "double[4]"}
"""Roles that OmniGraph treats as plain tuples."""


def fits(given, taken):
    """Whether an output of one kind may be connected to an input of another; one of several must fit."""
    sides = [
        {ROLES.get(k, k) for k in ((kind,) if isinstance(kind, str) else kind)} for kind in (given, taken)
    ]
    return bool(sides[0] & sides[1])


@pytest.fixture(scope="module")
def authored(lab_scene):
    stage, scene = open_stage(lab_scene), read_scene(lab_scene)
    stage.SetEditTarget(stage.GetSessionLayer())
    (graph,) = author_graph(stage, scene)
    return stage, scene, graph


def kind_of(attribute):
    """The kind of an authored input or output by its node's definition, and the fields of its message."""
    prim = attribute.GetPrim()
    known = node_types()[prim.GetAttribute("node:type").Get()]
    namespace, name = attribute.GetName().split(":", 1)
    kinds = dict(getattr(known, namespace))
    if prim.GetAttribute("inputs:messageName"):
        package, folder, short = (
            prim.GetAttribute(f"inputs:message{part}").Get() for part in ("Package", "Subfolder", "Name")
        )
        kinds |= message_fields(f"{package}/{folder}/{short}")
    assert name in kinds, f"{prim.GetPath()}: {known.name} has no {attribute.GetName()}"
    return kinds[name]


def ports(prim):
    return [
        prop
        for prop in prim.GetAuthoredProperties()
        if prop.GetName().split(":")[0] in ("inputs", "outputs") and prop.GetName() != "node:type"
    ]


def test_every_node_input_and_output_is_one_of_its_definition_and_of_its_type(authored):
    _, _, graph = authored
    assert graph.GetTypeName() == "OmniGraph"
    assert graph.GetAttribute("evaluator:type").Get() == "execution"
    for prim in graph.GetChildren():
        assert prim.GetTypeName() == "OmniGraphNode"
        known = node_types()[prim.GetAttribute("node:type").Get()]
        assert prim.GetAttribute("node:typeVersion").Get() == known.version
        for prop in ports(prim):
            kind = kind_of(prop)
            if kind == "target":
                assert isinstance(prop, Usd.Relationship)
                continue
            wanted = USD_TYPES.get(kind, kind) if isinstance(kind, str) else "token"
            assert str(prop.GetTypeName()) == wanted, prop.GetPath()
            assert bool(prop.GetCustomDataByKey("isExecution")) == (kind == "execution")


def test_every_connection_goes_from_an_output_to_an_input_that_takes_it(authored):
    stage, _, graph = authored
    count = 0
    for prim in graph.GetChildren():
        for attribute in prim.GetAttributes():
            for path in attribute.GetConnections():
                source = stage.GetAttributeAtPath(path)
                assert source, path
                assert source.GetName().startswith("outputs:")
                assert attribute.GetName().startswith("inputs:")
                assert fits(kind_of(source), kind_of(attribute)), (path, attribute.GetPath())
                count += 1
    assert count > 60


def test_each_frame_comes_to_every_node_that_something_must_run(authored):
    _, _, graph = authored
    reached, seen = {graph.GetPath().AppendChild("tick")}, set()
    while reached - seen:
        seen |= (now := reached - seen)
        for prim in graph.GetChildren():
            attribute = prim.GetAttribute("inputs:execIn")
            if attribute and any(path.GetPrimPath() in now for path in attribute.GetConnections()):
                reached.add(prim.GetPath())
    for prim in graph.GetChildren():
        known = node_types()[prim.GetAttribute("node:type").Get()]
        assert ("execIn" in known.inputs) <= (prim.GetPath() in reached), prim.GetPath()


def test_topics_messages_and_qos_are_those_of_magtwins_own_robot(authored):
    stage, _, graph = authored
    seen = {}
    for prim in graph.GetChildren():
        topic = prim.GetAttribute("inputs:topicName")
        if not topic:
            continue
        name, short = topic.Get(), prim.GetAttribute("node:type").Get().split("ROS2")[1]
        known = TOPICS[name]
        message = prim.GetAttribute("inputs:messageName")
        said = message.Get() if message else short.removeprefix("Publish").removeprefix("Subscribe")
        said = {"Odometry": "Odometry", "RtxLidarHelper": "LaserScan"}.get(said, said)
        assert known.kind.endswith(f"/{said}")
        qos = stage.GetPrimAtPath(prim.GetAttribute("inputs:qosProfile").GetConnections()[0].GetPrimPath())
        wanted = known.qos.heard if short.startswith("Subscribe") else known.qos
        assert qos.GetAttribute("inputs:depth").Get() == wanted.depth
        assert (qos.GetAttribute("inputs:reliability").Get() == "reliable") == wanted.reliable
        seen[name] = short
    assert set(seen) == {
        *("/clock", "/robot/odom", "/robot/imu", "/robot/enu/pose"),
        *("/robot/battery_state", "/robot/joint_states", "/robot/scan", "/robot/cmd_vel"),
    }
    assert seen["/robot/cmd_vel"].startswith("Subscribe")


def test_the_magnetometers_node_finds_in_isaac_every_topic_that_it_can_read(authored):
    _, _, graph = authored
    topics = {a.Get() for prim in graph.GetChildren() if (a := prim.GetAttribute("inputs:topicName"))}
    assert {topic.name for topic in (*INPUTS, SCAN)} <= topics


@pytest.mark.parametrize("message", ["geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/BatteryState"])
def test_fields_of_messages_are_the_leaves_that_magtwin_itself_writes(message):
    basic = {"text": "token", "f8": "double", "f4": "float", "u1": "uint"}
    parts = {3: "xyz", 4: "xyzw"}
    want = {}
    for leaf in layout(message):
        name = leaf.name.replace(".", ":")
        if leaf.kind == "time":
            want |= {f"{name}:sec": "int", f"{name}:nanosec": "uint"}
        elif leaf.count in parts:
            want |= {f"{name}:{part}": "double" for part in parts[leaf.count]}
        else:
            want[name] = "bool" if name == "present" else basic[leaf.kind] + ("" if leaf.count else "[]")
    assert message_fields(message) == want


def test_frames_of_messages_are_those_that_a_bag_of_the_robot_names(authored):
    _, scene, graph = authored
    who = sender_of(scene.robot)
    assert graph.GetChild("publish_imu").GetAttribute("inputs:frameId").Get() == who.imu_frame
    assert graph.GetChild("publish_scan").GetAttribute("inputs:frameId").Get() == who.lidar_frame
    assert graph.GetChild("publish_pose").GetAttribute("inputs:header:frame_id").Get() == who.map_frame
    assert graph.GetChild("publish_battery").GetAttribute("inputs:header:frame_id").Get() == who.base_frame
    odometry = graph.GetChild("publish_odometry")
    assert odometry.GetAttribute("inputs:odomFrameId").Get() == who.odom_frame
    assert odometry.GetAttribute("inputs:chassisFrameId").Get() == who.base_frame
    assert graph.GetChild("wheels").GetAttribute("inputs:jointNames").Get() == [
        joint.name for joint in who.wheel_joints
    ]


def test_prims_that_nodes_name_are_what_isaac_looks_for(authored):
    stage, _, graph = authored

    def target(node, name):
        (path,) = graph.GetChild(node).GetRelationship(f"inputs:{name}").GetTargets()
        return stage.GetPrimAtPath(path)

    assert target("odometry", "chassisPrim").HasAPI(UsdPhysics.RigidBodyAPI)
    assert target("pose", "prim") == target("odometry", "chassisPrim")
    assert target("wheels", "targetPrim").HasAPI(UsdPhysics.ArticulationRootAPI)
    assert target("joints", "prim") == target("wheels", "targetPrim")
    imu, lidar = target("imu", "imuPrim"), target("beams", "cameraPrim")
    assert imu.GetTypeName() == "IsaacImuSensor"
    assert imu.GetParent().GetParent().HasAPI(UsdPhysics.RigidBodyAPI)
    assert lidar.GetTypeName() == "OmniLidar"
    robot = target("wheels", "targetPrim").GetParent()
    names = [joint.GetName() for joint in robot.GetChild("joints").GetChildren()]
    assert set(graph.GetChild("wheels").GetAttribute("inputs:jointNames").Get()) <= set(names)


@pytest.mark.usefixtures("allow_neighbours")
def test_robots_that_share_a_lab_have_topics_of_their_own_and_one_clock(lab_scene, tmp_path):
    scene = read_scene(lab_scene)
    second = PlacedRobot(robot=replace(scene.robot, name="second"), start=(1.0, 1.0, 0.0))
    file = author_scene(replace(scene, others=(second,)), tmp_path / "two", by_reference=True)
    stage = open_stage(file)
    graphs = author_graph(stage, read_scene(file))
    assert [g.GetPath().name for g in graphs] == [scene.robot.name, "second"]
    topics = [
        prim.GetAttribute("inputs:topicName").Get()
        for graph in graphs
        for prim in graph.GetChildren()
        if prim.GetAttribute("inputs:topicName")
    ]
    assert len(topics) == len(set(topics)) == 15
    assert {"/clock", "/second/odom", f"/{scene.robot.name}/odom"} <= set(topics)


def test_what_is_no_robot_to_isaac_is_refused_with_what_to_do(lab_scene):
    scene = read_scene(lab_scene)
    stage = open_stage(lab_scene)
    stage.SetEditTarget(stage.GetSessionLayer())
    root = only_prim_with(stage.GetPseudoRoot(), "robot")
    with pytest.raises(InputError, match="the stage has no robot 'nobody'; it has turtlebot4"):
        author_graph(stage, replace(scene, robot=replace(scene.robot, name="nobody")))
    imu = only_prim_with(root, "imu").GetChildren()[0]
    imu.SetActive(False)
    with pytest.raises(InputError, match="has 0 children of type IsaacImuSensor"):
        author_graph(stage, scene)
    imu.SetActive(True)
    root.GetRelationship("isaac:physics:robotLinks").SetTargets([])
    with pytest.raises(InputError, match="robotLinks lists none"):
        author_graph(stage, scene)
    assert not stage.GetPrimAtPath(GRAPHS)
