"""What `<gazebo>`, `<ros2_control>`, `<transmission>` and `<safety_controller>` become on the stage."""

import textwrap

import numpy as np
import pytest
from made import BODY, INERTIAL, converted
from numpy.testing import assert_allclose
from pxr import Usd, UsdGeom, UsdPhysics, UsdRender, UsdShade
from validators import assert_valid

from magtwin.errors import InputError
from magtwin.usd.robot import read_notes
from magtwin.usd.schema import prims_with
from magtwin.usd.sensors import read_drive, read_imu, read_lidar, read_magnetometer

WHEEL = """<link name="{side}_wheel">{inertial}<collision><geometry><cylinder radius="0.04" length="0.02"/>
</geometry></collision></link><joint name="{side}" type="continuous"><parent link="base_link"/>
<child link="{side}_wheel"/><origin xyz="0 {y} 0" rpy="-1.5708 0 0"/><axis xyz="0 0 1"/>
<limit effort="2" velocity="10"/></joint>"""
CART = f'<link name="base_link">{BODY}</link><link name="eye"/>' + "".join(
    WHEEL.format(side=side, y=y, inertial=INERTIAL) for side, y in (("left", 0.15), ("right", -0.15))
)
EYE = """<joint name="eye_joint" type="fixed"><parent link="base_link"/><child link="eye"/>
<origin xyz="0 0 0.2"/></joint>"""


def cart(tmp_path, tags, **choices):
    """A two-wheeled robot with tags: its stage, its prim and the report."""
    path = tmp_path / "cart.urdf"
    path.write_text(f'<robot name="cart">\n{CART}{EYE}\n{textwrap.dedent(tags)}\n</robot>\n')
    return converted(path, **choices)


def on(link, sensor):
    return f'<gazebo reference="{link}">{sensor}</gazebo>'


def child_of_type(prim, kind):
    return next(p for p in Usd.PrimRange(prim) if p.GetTypeName() == kind)


def core(prim, name):
    return prim.GetAttribute(f"omni:sensor:Core:{name}").Get()


def world_direction(prim, local):
    """A direction of a prim in world axes."""
    matrix = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(prim))[:3, :3]
    return np.asarray(local, float) @ matrix


# --- contact --------------------------------------------------------------------------------------


def test_friction_bounce_and_compliance_reach_the_collider(tmp_path):
    tags = """<mu1>0.7</mu1><mu2>0.7</mu2><kp>1e6</kp><kd>100</kd><collision><surface><bounce>
    <restitution_coefficient>0.3</restitution_coefficient></bounce></surface></collision>"""
    _stage, robot, report = cart(tmp_path, on("left_wheel", tags))
    collider = robot.GetPrimAtPath("left_wheel/collisions").GetChildren()[0]
    grip = UsdShade.MaterialBindingAPI(collider).ComputeBoundMaterial("physics")[0].GetPrim()
    figures = {
        name: grip.GetAttribute(name).Get()
        for name in (
            "physics:staticFriction",
            "physics:restitution",
            "physxMaterial:compliantContactStiffness",
            "physxMaterial:compliantContactDamping",
        )
    }
    assert_allclose(list(figures.values()), [0.7, 0.3, 1e6, 100], rtol=1e-6)
    assert not report.unknown_tags
    assert not report.losses
    assert_valid(tmp_path / "cart.usda", tmp_path)


@pytest.mark.parametrize(
    "tags", ["<mu1>0.7</mu1><selfCollide>true</selfCollide>", '<mu1 value="0.7"/><selfCollide value="1"/>']
)
def test_a_figure_may_be_in_the_attribute_value_and_one_link_that_collides_with_its_robot_switches_all(
    tmp_path, tags
):
    _, robot, report = cart(tmp_path, on("left_wheel", tags))
    collider = robot.GetPrimAtPath("left_wheel/collisions").GetChildren()[0]
    grip = UsdShade.MaterialBindingAPI(collider).ComputeBoundMaterial("physics")[0].GetPrim()
    assert_allclose(grip.GetAttribute("physics:staticFriction").Get(), 0.7, rtol=1e-6)
    for name in ("newton:selfCollisionEnabled", "physxArticulation:enabledSelfCollisions"):
        assert robot.GetPrimAtPath("base_link").GetAttribute(name).Get() is True
    assert not report.unknown_tags


# --- sensors --------------------------------------------------------------------------------------

IMU = """<sensor name="imu" type="imu"><update_rate>100</update_rate><pose>0.1 0 0.2 0 0 1.5708</pose><imu>
<angular_velocity><x><noise type="gaussian"><mean>0</mean><stddev>0.03</stddev></noise></x>
<y><noise type="gaussian"><mean>0</mean><stddev>0.03</stddev></noise></y>
<z><noise type="gaussian"><mean>0</mean><stddev>0.03</stddev></noise></z></angular_velocity>
<linear_acceleration><x><noise type="gaussian"><stddev>0.3</stddev></noise></x>
<y><noise type="gaussian"><stddev>0.4</stddev></noise></y></linear_acceleration></imu></sensor>"""


def test_an_imu_keeps_its_rate_pose_and_noise_and_others_see_it_too(tmp_path):
    _stage, robot, report = cart(tmp_path, on("eye", IMU))
    (prim,) = prims_with(robot, "imu")
    spec = read_imu(prim)
    assert (spec.link, spec.rate_hz, spec.gyro_noise_std, spec.orientation_noise_std) == ("eye", 100, 0.03, 0)
    assert_allclose(spec.accel_noise_std, np.sqrt((0.3**2 + 0.4**2) / 2))  # the axes' root mean square
    assert_allclose(spec.p_link_sensor, [0.1, 0, 0.2])
    assert_allclose(world_direction(prim, [1, 0, 0]), [0, 1, 0], atol=1e-5)
    sensor = child_of_type(prim, "IsaacImuSensor")
    assert_allclose(sensor.GetAttribute("sensorPeriod").Get(), 0.01, rtol=1e-6)
    assert any("noise 0.3, 0.4 of the axes becomes their RMS" in note for note in report.notes)
    assert_valid(tmp_path / "cart.usda", tmp_path)


LIDAR = """<sensor name="scan" type="{type}"><update_rate>8</update_rate><{tag}><scan><horizontal>
<samples>{samples}</samples><resolution>1</resolution><min_angle>{least}</min_angle>
<max_angle>{most}</max_angle></horizontal><vertical><samples>{lines}</samples><min_angle>-0.1</min_angle>
<max_angle>0.1</max_angle></vertical></scan><range><min>0.15</min><max>12</max><resolution>0.01</resolution>
</range><noise><type>gaussian</type><mean>0</mean><stddev>0.02</stddev></noise></{tag}></sensor>"""


@pytest.mark.parametrize(("kind", "tag"), [("ray", "ray"), ("gpu_ray", "ray"), ("gpu_lidar", "lidar")])
def test_a_lidar_that_spins_keeps_its_rate_ranges_view_and_noise(tmp_path, kind, tag):
    text = LIDAR.format(type=kind, tag=tag, samples=361, least=-np.pi, most=np.pi, lines=3)
    _stage, robot, _ = cart(tmp_path, on("eye", text))
    (prim,) = prims_with(robot, "lidar")
    spec = read_lidar(prim)
    assert (spec.scan_rate_hz, spec.range_min_m, spec.range_max_m, spec.off_s) == (8, 0.15, 12, 0)
    lidar = child_of_type(prim, "OmniLidar")
    assert core(lidar, "scanType") == "ROTARY"
    assert (core(lidar, "validStartAzimuthDeg"), core(lidar, "validEndAzimuthDeg")) == (0, 360)
    assert core(lidar, "patternFiringRateHz") == 360 * 8  # a ray each degree
    assert_allclose(core(lidar, "emitterState:s001:elevationDeg"), np.degrees([-0.1, 0, 0.1]), atol=1e-5)
    assert_allclose([core(lidar, "rangeAccuracyM"), core(lidar, "rangeResolutionM")], [0.02, 0.01], rtol=1e-6)
    assert_valid(tmp_path / "cart.usda", tmp_path)


def test_a_range_finder_is_a_fixed_grid_of_rays_without_magtwins_schema(tmp_path):
    text = LIDAR.format(type="gpu_lidar", tag="lidar", samples=5, least=-0.2, most=0.2, lines=3)
    _stage, robot, _ = cart(tmp_path, on("eye", text))
    assert not prims_with(robot, "lidar")
    lidar = child_of_type(robot, "OmniLidar")
    assert (core(lidar, "scanType"), core(lidar, "numberOfEmitters")) == ("SOLID_STATE", 15)
    assert list(core(lidar, "numRaysPerLine")) == [5, 5, 5]
    azimuth = np.degrees([-0.2, -0.1, 0, 0.1, 0.2])
    assert_allclose(core(lidar, "emitterState:s001:azimuthDeg"), np.tile(azimuth, 3), atol=1e-5)


CAMERA = """<sensor name="eye" type="{type}"><update_rate>30</update_rate><pose>0 0 0 0 0.2 0</pose><camera>
<horizontal_fov>1.2</horizontal_fov><image><width>640</width><height>480</height></image><clip>
<near>0.05</near><far>8</far></clip><noise><type>gaussian</type><mean>0</mean><stddev>0.007</stddev></noise>
</camera></sensor>"""


@pytest.mark.parametrize(
    ("kind", "channels"), [("camera", ["colour"]), ("depth", ["depth"]), ("rgbd_camera", ["colour", "depth"])]
)
def test_a_camera_keeps_its_view_resolution_range_and_direction(tmp_path, kind, channels):
    _stage, robot, _ = cart(tmp_path, on("eye", CAMERA.format(type=kind)))
    camera = UsdGeom.Camera(child_of_type(robot, "Camera"))
    gf = camera.GetCamera(Usd.TimeCode.Default())
    assert_allclose(np.radians(gf.GetFieldOfView(gf.FOVHorizontal)), 1.2, rtol=1e-6)
    assert_allclose(
        np.tan(np.radians(gf.GetFieldOfView(gf.FOVVertical)) / 2), np.tan(0.6) * 480 / 640, rtol=1e-6
    )
    assert_allclose([gf.clippingRange.min, gf.clippingRange.max], [0.05, 8], rtol=1e-6)
    forward = world_direction(camera.GetPrim(), [0, 0, -1])  # pitched down by 0.2 rad
    assert_allclose(forward, [np.cos(0.2), 0, -np.sin(0.2)], atol=1e-6)
    assert_allclose(world_direction(camera.GetPrim(), [1, 0, 0]), [0, -1, 0], atol=1e-6)  # right
    product = UsdRender.Product(child_of_type(robot, "RenderProduct"))
    assert tuple(product.GetResolutionAttr().Get()) == (640, 480)
    assert product.GetCameraRel().GetTargets() == [camera.GetPath()]
    assert [path.name for path in product.GetOrderedVarsRel().GetTargets()] == channels
    metadata = camera.GetPrim().GetParent().GetCustomDataByKey("magtwin:sensor")
    assert (metadata["rateHz"], metadata["noiseStd"]) == (30, 0.007)
    assert_valid(tmp_path / "cart.usda", tmp_path)


def test_a_magnetometer_is_magtwins_with_its_noise_in_nanotesla(tmp_path):
    noise = "<x><noise type='gaussian'><mean>0</mean><stddev>2e-8</stddev></noise></x>"
    text = f'<sensor name="mag" type="magnetometer"><update_rate>50</update_rate><magnetometer>{noise}'
    _stage, robot, report = cart(tmp_path, on("eye", f"{text}</magnetometer></sensor>"))
    (prim,) = prims_with(robot, "magnetometer")
    spec = read_magnetometer(prim)
    assert spec.rate_hz == 50
    assert_allclose(spec.noise_std_nt, 20)
    assert any("assumed to be tesla" in note for note in report.notes)


def test_a_contact_sensor_is_nvidias_on_the_body(tmp_path):
    text = '<sensor name="bump" type="contact"><update_rate>50</update_rate></sensor>'
    _stage, robot, _ = cart(tmp_path, on("base_link", text))
    body = robot.GetPrimAtPath("base_link")
    assert "PhysxContactReportAPI" in body.GetPrimTypeInfo().GetAppliedAPISchemas()
    sensor = body.GetPrimAtPath("bump")
    assert sensor.GetTypeName() == "IsaacContactSensor"
    assert_allclose(sensor.GetAttribute("sensorPeriod").Get(), 0.02, rtol=1e-6)


def test_a_sensor_without_a_counterpart_is_kept_as_text_on_its_link_and_counted(tmp_path):
    text = '<sensor name="gps" type="navsat"><update_rate>1</update_rate></sensor>'
    _stage, robot, report = cart(tmp_path, on("eye", text))
    assert report.unknown_tags == {"gazebo/sensor": 1}
    kept = robot.GetPrimAtPath("base_link/eye").GetCustomDataByKey("magtwin:unconverted")
    assert list(kept) == [f"gazebo: {text}".replace('name="gps" type="navsat"', 'name="gps" type="navsat"')]
    assert any("sensor 'gps' of link 'eye' is of type 'navsat'" in note for note in report.notes)


# --- drives ---------------------------------------------------------------------------------------

GZ = """<gazebo><plugin filename="gz-sim-diff-drive-system" name="gz::sim::systems::DiffDrive">
<left_joint>left</left_joint><right_joint>right</right_joint><wheel_separation>0.31</wheel_separation>
<wheel_radius>0.041</wheel_radius><odom_publish_frequency>20</odom_publish_frequency>
<max_linear_velocity>0.5</max_linear_velocity><max_angular_velocity>2</max_angular_velocity>
<max_linear_acceleration>1.5</max_linear_acceleration><max_angular_acceleration>6</max_angular_acceleration>
</plugin></gazebo>"""
CLASSIC = """<gazebo><plugin filename="libgazebo_ros_diff_drive.so" name="drive"><update_rate>20</update_rate>
<left_joint>left</left_joint><right_joint>right</right_joint><wheel_separation>0.31</wheel_separation>
<wheel_diameter>0.082</wheel_diameter></plugin></gazebo>"""
ROS1 = """<gazebo><plugin name="drive" filename="libgazebo_ros_diff_drive.so"><leftJoint>left</leftJoint>
<rightJoint>right</rightJoint><wheelSeparation>0.31</wheelSeparation><wheelDiameter>0.082</wheelDiameter>
</plugin></gazebo>"""


def test_a_drive_plugin_becomes_the_drive_of_the_robot(tmp_path):
    _stage, robot, report = cart(tmp_path, GZ)
    spec = read_drive(robot)
    assert (spec.left_wheel_joint, spec.right_wheel_joint) == ("left", "right")
    assert (spec.wheel_separation_m, spec.wheel_radius_m) == (0.31, 0.041)
    assert (spec.v_max, spec.w_max, spec.a_max, spec.alpha_max) == (0.5, 2, 1.5, 6)
    assert spec.odometry_rate_hz == 20
    assert robot.GetAttribute("isaac:robotType").Get() == "Wheeled"
    assert not report.unknown_tags


@pytest.mark.parametrize("plugin", [CLASSIC, ROS1])
def test_older_plugins_give_a_diameter_and_limits_come_from_the_wheels(tmp_path, plugin):
    _stage, robot, report = cart(tmp_path, plugin)
    spec = read_drive(robot)
    assert_allclose([spec.wheel_separation_m, spec.wheel_radius_m], [0.31, 0.041])
    assert_allclose([spec.v_max, spec.w_max], [10 * 0.041, 2 * 10 * 0.041 / 0.31])
    assert any("TurtleBot 4's values are used for a_max" in note for note in report.notes)


YAML = """/**:
  diffdrive_controller:
    ros__parameters:
      left_wheel_names: [left]
      right_wheel_names: [right]
      wheel_separation: 0.3
      wheel_separation_multiplier: 1.1
      wheel_radius: 0.04
      cmd_vel_timeout: 0.25
      publish_rate: 40.0
      linear.x.max_velocity: 0.6
      angular:
        z: {max_velocity: 2.5, has_acceleration_limits: false, max_acceleration: 9.0}
"""
CONTROL = """<gazebo><plugin filename="libgz_ros2_control-system.so" name="gz_ros2_control::Plugin">
<parameters>control.yaml</parameters></plugin></gazebo>"""


def test_a_controllers_settings_become_the_drive_of_the_robot(tmp_path):
    (tmp_path / "control.yaml").write_text(YAML)
    _stage, robot, _ = cart(tmp_path, CONTROL)
    spec = read_drive(robot)
    assert_allclose(
        [spec.wheel_separation_m, spec.wheel_radius_m, spec.v_max, spec.w_max], [0.33, 0.04, 0.6, 2.5]
    )
    assert (spec.command_timeout_s, spec.odometry_rate_hz) == (0.25, 40)
    assert spec.alpha_max == 7.725  # its limit is switched off, so it is not used


@pytest.mark.parametrize(
    "tags",
    [
        '<ros2_control name="c"><joint name="left"><command_interface name="{0}"/></joint></ros2_control>',
        '<transmission name="t"><type>simple</type><joint name="left"><hardwareInterface>'
        "hardware_interface/{1}JointInterface</hardwareInterface></joint></transmission>",
    ],
)
@pytest.mark.parametrize(
    ("kind", "gains"), [("velocity", (0, 5)), ("position", (100, 10)), ("effort", (0, 0))]
)
def test_command_interfaces_choose_the_drive(tmp_path, tags, kind, gains):
    stage, _, _ = cart(tmp_path, tags.format(kind, kind.capitalize()))
    drive = UsdPhysics.DriveAPI(stage.GetPrimAtPath("/cart/joints/left"), "angular")
    per_rad = np.array([drive.GetStiffnessAttr().Get(), drive.GetDampingAttr().Get()]) * 180 / np.pi
    assert_allclose(per_rad, gains, atol=1e-5)


# --- settings that cannot be used -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("0.04", "round", "wheel_radius must be a number above 0, got 'round'"),
        ("[left]", "[lefft]", "left_wheel_names: no joint 'lefft'; did you mean 'left'"),
    ],
)
def test_bad_settings_of_a_plugin_are_left_out_and_those_of_the_user_refused(tmp_path, old, new, words):
    (tmp_path / "control.yaml").write_text(YAML.replace(old, new))
    _stage, robot, report = cart(tmp_path, CONTROL)
    (fault,) = [entry for row in report.repairs for entry in row.entries if row.kind == "drive-incomplete"]
    assert f"control.yaml: {words}" in fault.text
    assert not prims_with(robot, "drive")
    with pytest.raises(InputError, match=words.partition(",")[0]):
        cart(tmp_path, "", controllers=tmp_path / "control.yaml")


# --- the real robot -------------------------------------------------------------------------------


def test_the_real_robots_sensors_all_arrive(tagged_robot):
    stage = Usd.Stage.Open(str(tagged_robot[1]))
    robot = stage.GetDefaultPrim()
    kinds = [p.GetTypeName() for p in stage.Traverse()]
    counts = {k: kinds.count(k) for k in ("OmniLidar", "IsaacImuSensor", "Camera", "IsaacContactSensor")}
    assert counts == {"OmniLidar": 12, "IsaacImuSensor": 1, "Camera": 1, "IsaacContactSensor": 1}
    (lidar,) = prims_with(robot, "lidar")
    spec = read_lidar(lidar)
    assert (spec.link, spec.scan_rate_hz, spec.range_min_m, spec.range_max_m) == (
        "rplidar_link",
        62,
        0.164,
        12,
    )
    drive = read_drive(robot)  # of the control.yaml in the package beside
    figures = (drive.wheel_separation_m, drive.wheel_radius_m, drive.v_max, drive.w_max, drive.a_max)
    assert figures == (0.233, 0.03575, 0.46, 1.9, 0.9)


def test_the_real_robot_passes_the_validators_and_nothing_is_silent(tagged_robot, tmp_path):
    _, out, report = tagged_robot
    assert_valid(out, tmp_path)
    assert report.unknown_tags["gazebo/sensor/visualize"] == 13
    assert any("tags without a meaning here are kept as text" in note for note in read_notes(out))
    assert [line.count for line in report.repairs if line.kind == "mesh-missing"] == [2]  # lacks upstream
    assert not report.losses


def test_settings_come_before_tags_and_leave_one_sensor_of_each_kind(tmp_path, real_data):
    from magtwin.author.robot import RobotSettings, build_robot
    from magtwin.spec.sensors import ImuSpec, LidarSpec, MagnetometerSpec
    from magtwin.usd.robot import load_robot

    settings = RobotSettings(
        lidar=LidarSpec(link="rplidar_link", scan_rate_hz=7.5),
        imu=ImuSpec(link="oakd_imu_frame", rate_hz=200),
        magnetometer=MagnetometerSpec(link="tower_sensor_plate"),
    )
    urdf = real_data / "turtlebot4" / "turtlebot4_gazebo_tags.urdf"
    out = tmp_path / "turtlebot4" / "turtlebot4.usda"
    report = build_robot(urdf, settings, out)
    spec = load_robot(out)  # needs one of each
    assert (spec.lidar.scan_rate_hz, spec.imu.link, spec.drive.v_max) == (7.5, "oakd_imu_frame", 0.46)
    assert "lidar 'rplidar' of link 'rplidar_link': the settings replace the URDF's tags" in (report.notes)
    assert "imu 'imu' of link 'imu_link' is not simulated here: the settings name another" in report.notes
    assert_valid(out, tmp_path)
