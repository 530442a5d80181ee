"""Specs: what makes no sense is refused at birth, by field, class and value."""

import importlib
import math
import pkgutil
from dataclasses import fields, replace
from pathlib import Path

import pytest

import magtwin.spec as spec
from magtwin.errors import InputError
from magtwin.frames import IDENTITY_XYZW
from magtwin.spec.base import Spec
from magtwin.spec.drive import DriveSpec
from magtwin.spec.furniture import FurnitureSpec
from magtwin.spec.lab import LabSpec, SurveySpec
from magtwin.spec.magnetics import EarthFieldSpec, PlatformFieldSpec, SourceSpec
from magtwin.spec.plant import PlantSpec
from magtwin.spec.robot import PlacedRobot, RobotSpec
from magtwin.spec.scene import Scene
from magtwin.spec.sensors import BatterySpec, ImuSpec, LidarSpec, MagnetometerSpec, MocapSpec, MountSpec
from magtwin.spec.walls import Door, Wall, Window

ROBOT = RobotSpec(name="robot", asset=Path("robot.usda"))
EARTH = EarthFieldSpec(
    b_world_nt=(0.0, 2e4, -4e4), latitude_deg=29.6, longitude_deg=-82.3, height_m=20.0, date="2026-01-01"
)
SPECS = (
    MagnetometerSpec(),
    ImuSpec(),
    LidarSpec(),
    BatterySpec(),
    MocapSpec(),
    PlantSpec(
        play_thresholds_nt=(1.0,),
        play_weights=(1.0,),
        warm_up_s=(1.0,),
        warm_up_nt=(0.0,) * 3,
        warm_up_soft_iron=(0.0,),
    ),
    SurveySpec(),
    DriveSpec(),
    PlatformFieldSpec(),
    ROBOT,
    LabSpec(),
    Wall((0.0, 0.0), (1.0, 0.0)),
    Door("wall_0", 0.5),
    Window("wall_0", 0.5),
    EARTH,
    SourceSpec(name="beam", p_world=(0.0, 0.0, 0.0), m_world=(0.0, 0.0, 1.0)),
    SourceSpec(
        name="crate",
        p_world=(0.0, 0.0, 0.0),
        shape="cuboid",
        size_m=(1.0, 1.0, 1.0),
        magnetization=(1.0, 0, 0),
    ),
    FurnitureSpec(name="desk", kind="desk", p_world=(0.0, 0.0, 0.0), magnetization=(1e3,) * 6),
    PlacedRobot(robot=ROBOT),
    Scene(name="lab", map_layer=Path("map.usdc"), robot=ROBOT),
)


def numbers() -> list:
    """Each spec with the name of each field that holds a number or several."""
    held = [(s, f.name, getattr(s, f.name)) for s in SPECS for f in fields(s)]
    wanted = [(s, name) for s, name, v in held if isinstance(v, float) or (isinstance(v, tuple) and v)]
    return [pytest.param(s, name, id=f"{type(s).__name__}.{name}") for s, name in wanted]


def test_every_spec_is_checked_here():
    modules = [
        vars(importlib.import_module(f"magtwin.spec.{m.name}")) for m in pkgutil.iter_modules(spec.__path__)
    ]
    public = {v for m in modules for v in m.values() if isinstance(v, type) and issubclass(v, Spec)}
    public = {v for v in public if not v.__name__.startswith("_")}
    assert public - {Spec, MountSpec} == {type(s) for s in SPECS}


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(("given", "name"), numbers())
def test_no_number_of_a_spec_may_be_infinite_or_none(given, name, bad):
    value = getattr(given, name)
    wrong = (*value[:-1], bad) if isinstance(value, tuple) else bad
    said = rf"^{name} of [a-z ]+ must be finite, got .*{bad}"
    with pytest.raises(InputError, match=said):
        replace(given, **{name: wrong})


@pytest.mark.parametrize(
    ("given", "change", "said"),
    [
        (ImuSpec(), {"q_link_sensor_xyzw": (0.0, 0.0, 0.0, 0.0)}, "unit quaternion"),
        (LidarSpec(), {"q_link_sensor_xyzw": (0.0, 0.0, 1.0, 2e-3)}, "unit quaternion"),
        (ROBOT, {"q_base_imu_link_xyzw": (0.0, 0.0, 0.0, 2.0)}, "of robot .* unit quaternion"),
        (EARTH, {"latitude_deg": -90.1}, r"latitude_deg of earth field .* -90\.1"),
        (EARTH, {"longitude_deg": 361.0}, r"longitude_deg of earth field .* 361"),
        (EARTH, {"date": "2026-02-30"}, "date .* YYYY-MM-DD, got '2026-02-30'"),
        (EARTH, {"date": "20260101"}, "YYYY-MM-DD"),
        (LidarSpec(), {"range_min_m": 12.0}, "range_min_m .* below range_max_m 12"),
        (BatterySpec(), {"voltage_full_v": 12.0}, "voltage_full_v .* voltage_empty_v 12.44"),
        (DriveSpec(), {"left_wheel_joint": "right_wheel_joint"}, "differ from left_wheel_joint"),
        (BatterySpec(), {"initial_fraction": 1.5}, r"0\.\.1, got 1\.5"),
        *((given, {"rate_hz": 0.0}, "rate_hz") for given in SPECS[:2]),
        (DriveSpec(), {"odometry_scale": (1.0, 0.0)}, "odometry_scale .* above 0"),
        (DriveSpec(), {"wheel_errors": (0.0, -1.0)}, "wheel_errors .* above -1"),
        (ImuSpec(), {"accel_vibration": (1.0, -1.0, 1.0)}, "accel_vibration .* below 0"),
        (LidarSpec(), {"rays": 90.5}, "rays .* whole number"),
        (BatterySpec(), {"model": "magic"}, "model .* 'magic'"),
        (BatterySpec(), {"discharge": (0.0, 0.6, 0.5, 1.0)}, "discharge .* rise"),
        (LabSpec(), {"floor_m": (6.0, 0.0)}, "floor_m of lab"),
    ],
)
def test_what_makes_no_sense_is_refused(given, change, said):
    with pytest.raises(InputError, match=said):
        replace(given, **change)


def test_a_turn_in_single_precision_and_a_battery_of_constant_voltage_are_taken():
    third = 0.577350258827209  # 1 / sqrt 3 to single precision
    assert ImuSpec(q_link_sensor_xyzw=(third, third, third, 0.0)).q_link_sensor_xyzw[0] == third
    assert BatterySpec(voltage_empty_v=12.0, voltage_full_v=12.0).voltage_full_v == 12.0
    assert ROBOT.q_base_magnetometer_xyzw == ROBOT.q_base_imu_xyzw == IDENTITY_XYZW
