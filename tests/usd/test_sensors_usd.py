"""What is authored is what is read: each spec through its prim and back, to the bit."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics

from magtwin.errors import InputError
from magtwin.spec.drive import DriveSpec
from magtwin.spec.magnetics import PlatformFieldSpec
from magtwin.spec.sensors import (
    MAGNETOMETER_KINDS,
    BatterySpec,
    ImuSpec,
    LidarSpec,
    MagnetometerSpec,
    MocapSpec,
)
from magtwin.usd import sensors

LINK = "/robot/some_link"

unhurried = settings(deadline=None)  # USD loads plugins at the first example

number = st.floats(allow_nan=False, allow_infinity=False)
not_negative = st.floats(0, 1e300)
above_zero = st.floats(1e-300, 1e300)
vec3 = st.tuples(number, number, number)
turns = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)
unit = turns.map(lambda q: tuple((np.array(q) / np.linalg.norm(q)).tolist()))
mount = {"link": st.just("some_link"), "p_link_sensor": vec3, "q_link_sensor_xyzw": unit}
text = st.text(st.characters(exclude_categories=("Cs", "Cc")), max_size=12)
name = st.from_regex(r"[A-Za-z_][A-Za-z0-9_]{0,12}", fullmatch=True)


def ordered(values):
    """Two of the values, the lesser first."""
    return st.tuples(values, values).map(lambda pair: tuple(sorted(pair)))


def figures_of(spec, **known):
    """Specs whose numbers, and tuples of numbers, are above 0."""
    drawn = {
        f.name: st.tuples(*[above_zero] * len(f.default)) if isinstance(f.default, tuple) else above_zero
        for f in fields(spec)
    }
    return st.builds(spec, **drawn | known)


def stage_with_link() -> Usd.Stage:
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.Xform.Define(stage, "/robot")
    UsdGeom.Xform.Define(stage, LINK)
    return stage


def stage_with_wheels(spec: DriveSpec) -> Usd.Stage:
    stage = stage_with_link()
    for joint in spec.sides:
        UsdPhysics.RevoluteJoint.Define(stage, f"/robot/joints/{joint}")
    return stage


lidars = st.fixed_dictionaries(
    {
        **mount,
        "scan_rate_hz": above_zero,
        "on_s": not_negative,
        "phase_s": not_negative,
        "rays": st.integers(1, 100_000),
    }
)
batteries = st.builds(
    BatterySpec,
    model=st.sampled_from(["power", "linear"]),
    discharge=st.lists(st.floats(0, 1), max_size=5).map(lambda between: (0.0, *sorted(between), 1.0)),
    capacity_wh=above_zero,
    load_w=not_negative,
    initial_fraction=st.floats(0, 1),
    voltage_full_v=st.just(1e300),
    voltage_noise_std_v=not_negative,
    rate_hz=above_zero,
)
SPECS = {
    "magnetometer": st.builds(
        MagnetometerSpec,
        **mount,
        rate_hz=above_zero,
        noise_density_nt=not_negative,
        kind=st.sampled_from(MAGNETOMETER_KINDS),
        vector_bias_nt=vec3,
        vector_misalignment=st.tuples(*[number] * 9),
        network=st.sampled_from([None, Path(__file__)]),
        network_sha256=text,
        inputs=st.lists(text, max_size=4).map(tuple),
    ),
    "imu": st.builds(
        ImuSpec,
        **mount,
        rate_hz=above_zero,
        gyro_noise_std=not_negative,
        tilt=st.tuples(not_negative, not_negative),
        accel_vibration=st.tuples(not_negative, not_negative, not_negative),
    ),
    "lidar": st.builds(
        lambda figures, ranges: LidarSpec(**figures, range_min_m=ranges[0], range_max_m=ranges[1]),
        lidars,
        ordered(not_negative).filter(lambda ranges: ranges[0] < ranges[1]),
    ),
    "battery": st.builds(
        lambda spec, volts: replace(spec, voltage_empty_v=volts[0], voltage_full_v=volts[1]),
        batteries,
        ordered(above_zero),
    ),
    "mocap": figures_of(
        MocapSpec, offset_m=st.tuples(number, number), offset_drift_m=st.tuples(number, number)
    ),
    "platform": figures_of(PlatformFieldSpec),
    "footprint": above_zero,
}


@pytest.mark.parametrize("noun", SPECS)
@unhurried
@given(st.data())
def test_a_spec_survives_the_stage_to_the_bit(noun, data):
    spec, stage = data.draw(SPECS[noun]), stage_with_link()
    root = stage.GetPrimAtPath("/robot")
    if noun in sensors.ON_ROOT:
        assert sensors.read_on_root(sensors.define_on_root(root, noun, spec), noun) == spec
        return
    define, read = (getattr(sensors, f"{verb}_{noun}") for verb in ("define", "read"))
    assert read(define(root, spec) if noun == "footprint" else define(stage, f"{LINK}/{noun}", spec)) == spec


def test_a_sensor_is_placed_where_the_spec_says():
    stage = stage_with_link()
    UsdGeom.XformCommonAPI(stage.GetPrimAtPath(LINK)).SetTranslate((0, 0, 1))
    quarter = (0.0, 0.0, 0.5**0.5, 0.5**0.5)  # a quarter turn about z
    spec = ImuSpec(link="some_link", p_link_sensor=(1.0, 2.0, 3.0), q_link_sensor_xyzw=quarter)
    prim = sensors.define_imu(stage, f"{LINK}/imu", spec)
    world = UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default())
    assert Gf.IsClose(world.Transform(Gf.Vec3d(1, 0, 0)), Gf.Vec3d(1, 3, 4), 1e-12)


def test_a_layer_over_a_sensor_holds_only_what_it_changes():
    stage = stage_with_link()
    spec = MagnetometerSpec(
        link="some_link", rate_hz=100.0, noise_density_nt=1.0, p_link_sensor=(0.1, 0.0, 0.0)
    )
    sensors.define_magnetometer(stage, f"{LINK}/mag", spec)
    imu, lidar = ImuSpec(link="some_link", rate_hz=61.0), LidarSpec(link="some_link", range_min_m=0.2)
    sensors.define_imu(stage, f"{LINK}/imu", imu)
    sensors.define_lidar(stage, f"{LINK}/lidar", lidar)
    session = Sdf.Layer.CreateAnonymous(".usda")
    stage.GetSessionLayer().subLayerPaths.append(session.identifier)
    stage.SetEditTarget(session)
    sensors.define_imu(stage, f"{LINK}/imu", imu)
    sensors.define_lidar(stage, f"{LINK}/lidar", lidar)
    assert session.empty
    sensors.define_magnetometer(stage, f"{LINK}/mag", replace(spec, noise_density_nt=2.0))
    attributes = session.GetPrimAtPath(f"{LINK}/mag").attributes
    assert [a.name for a in attributes] == ["magtwin:magnetometer:noiseDensityNtPerRootHz"]


def test_a_network_is_named_relative_to_the_edited_layer_and_moves_with_it(tmp_path):
    (tmp_path / "a" / "weights").mkdir(parents=True)
    (tmp_path / "a" / "weights" / "net.safetensors").write_bytes(b"net")
    stage = Usd.Stage.CreateNew(str(tmp_path / "a" / "s.usda"))
    UsdGeom.Xform.Define(stage, LINK)
    spec = MagnetometerSpec(link="some_link", network=tmp_path / "a" / "weights" / "net.safetensors")
    prim = sensors.define_magnetometer(stage, f"{LINK}/mag", spec)
    assert prim.GetAttribute("magtwin:magnetometer:network").Get().path == "./weights/net.safetensors"
    stage.Save()
    (tmp_path / "a").rename(tmp_path / "b")
    moved = Usd.Stage.Open(str(tmp_path / "b" / "s.usda"))
    read = sensors.read_magnetometer(moved.GetPrimAtPath(f"{LINK}/mag"))
    assert read.network == tmp_path / "b" / "weights" / "net.safetensors"


def test_nvidias_imu_and_lidar_carry_what_they_can():
    stage = stage_with_link()
    imu = sensors.define_imu(stage, f"{LINK}/imu", ImuSpec(link="some_link", rate_hz=50.0))
    lidar = sensors.define_lidar(stage, f"{LINK}/lidar", LidarSpec(link="some_link", range_max_m=8.0))
    imu_sensor, omni = imu.GetChild("imu_sensor"), lidar.GetChild("omni_lidar")
    assert imu_sensor.GetTypeName() == "IsaacImuSensor"
    assert imu_sensor.GetAttribute("sensorPeriod").Get() == pytest.approx(0.02)
    assert omni.GetTypeName() == "OmniLidar"
    assert omni.GetMetadata("apiSchemas").GetAppliedItems() == [sensors.LIDAR_API, sensors.EMITTER_API]
    assert omni.GetAttribute("omni:sensor:Core:numberOfEmitters").Get() == 1
    assert omni.GetAttribute("omni:sensor:Core:patternFiringRateHz").Get() == 720 * 8
    assert omni.GetAttribute("omni:sensor:Core:scanRateBaseHz").Get() == 8
    assert omni.GetAttribute("omni:sensor:Core:farRangeM").Get() == 8.0


def battery_of_text(stage):
    battery = stage.GetRootLayer().GetPrimAtPath("/robot/battery")
    battery.RemoveProperty(battery.attributes["magtwin:battery:loadW"])
    Sdf.AttributeSpec(battery, "magtwin:battery:loadW", Sdf.ValueTypeNames.String).default = "much"


def put(path, attribute, value):
    return lambda stage: stage.GetPrimAtPath(path).GetAttribute(attribute).Set(value)


def one_joint(stage):
    robot = stage.GetPrimAtPath("/robot")
    left = robot.GetRelationship("magtwin:drive:leftWheelJoint").GetTargets()
    robot.GetRelationship("magtwin:drive:rightWheelJoint").SetTargets(left)


TURN = Gf.Quatd(1, 1, 0, 0)


@pytest.mark.parametrize(
    ("noun", "change", "words"),
    [
        ("battery", put("/robot/battery", "magtwin:battery:capacityWh", -1.0), "capacity_wh"),
        ("battery", put("/robot/battery", "magtwin:battery:loadW", float("nan")), "finite, got nan"),
        ("battery", put("/robot/battery", "magtwin:battery:voltageFullV", 5.0), "voltage_empty_v"),
        ("battery", battery_of_text, "magtwin:battery:loadW must be a double, got"),
        ("imu", put(f"{LINK}/imu", "magtwin:imu:gyroNoiseStdRadPerS", float("inf")), "gyro_noise_std"),
        ("imu", put(f"{LINK}/imu", "xformOp:orient", TURN), "q_link_sensor_xyzw"),
        ("lidar", put(f"{LINK}/lidar", "magtwin:lidar:rangeMinM", 12.0), "range_min_m"),
        ("drive", one_joint, "right_wheel_joint .* differ"),
        ("drive", lambda stage: stage.RemovePrim("/robot/joints/left_wheel_joint"), "leftWheelJoint must"),
        ("plain", lambda stage: None, "has no MagtwinBatteryAPI"),
    ],
)
def test_what_makes_no_sense_is_refused_by_prim(noun, change, words):
    stage = stage_with_wheels(DriveSpec())
    robot = stage.GetPrimAtPath("/robot")
    prim = {
        "battery": lambda: sensors.define_battery(stage, "/robot/battery", BatterySpec()),
        "imu": lambda: sensors.define_imu(stage, f"{LINK}/imu", ImuSpec(link="some_link")),
        "lidar": lambda: sensors.define_lidar(stage, f"{LINK}/lidar", LidarSpec(link="some_link")),
        "drive": lambda: sensors.define_drive(robot, DriveSpec()),
        "plain": lambda: robot,
    }[noun]()
    change(stage)
    with pytest.raises(InputError, match=f"</robot.*{words}"):
        {"plain": sensors.read_battery}.get(noun, getattr(sensors, f"read_{noun}", None))(prim)


def test_a_sensor_away_from_its_link_and_a_drive_without_its_joint_are_refused():
    with pytest.raises(InputError, match=r"</robot/mag>: this sensor sits on 'some_link'"):
        sensors.define_magnetometer(stage_with_link(), "/robot/mag", MagnetometerSpec(link="some_link"))
    robot = stage_with_wheels(DriveSpec())  # held in a name: a prim does not keep its stage alive
    with pytest.raises(InputError, match=r"no joint 'left_whel_joint'.*did you mean 'left_wheel_joint'"):
        sensors.define_drive(
            robot.GetPrimAtPath("/robot"), replace(DriveSpec(), left_wheel_joint="left_whel_joint")
        )
