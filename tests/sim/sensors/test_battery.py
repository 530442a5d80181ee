"""Battery: energy bookkeeping, closed forms of the load, sag, the discharge curve, the linear model."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.sim.motion.drive import Motion
from magtwin.sim.sensors.battery import (
    STEP_S,
    Battery,
    Discharge,
    open_voltage,
    wheels_energy_j,
)
from magtwin.spec.drive import DriveSpec
from magtwin.spec.sensors import BatterySpec

DRIVE = DriveSpec()
STILL = Motion(DRIVE, 0.02, np.zeros(10), np.zeros(10))


def battery_of(spec: BatterySpec, on=False, seed: int = 0) -> Battery:
    return Battery(spec, DRIVE, lambda t: np.full(np.shape(t), on), np.random.default_rng(seed))


def discharged(spec: BatterySpec, motion: Motion = STILL, seconds: float = 600.0, on=False) -> Discharge:
    battery = battery_of(spec, on)
    times = np.arange(int(seconds / STEP_S) + 2) * STEP_S
    return battery.draw(
        wheels_energy_j(battery.spec, DRIVE, motion.at(times)), np.full(len(times) - 1, on), STEP_S
    )


def ramp(v: float, steps: int = 1000) -> Motion:
    """Up to a speed in half a second, along, and to a stop again."""
    speed = np.minimum(np.arange(steps) * v / 25, v)
    return Motion(DRIVE, 0.02, np.minimum(speed, speed[::-1]), np.zeros(steps))


@settings(max_examples=25, deadline=None)
@given(
    resistance=st.floats(0, 0.5),
    load=st.just(0.0) | st.floats(1e-3, 60),
    initial=st.floats(0.2, 1),
    speed=st.floats(0.05, 0.3),
    on=st.booleans(),
)
def test_what_the_pack_loses_is_what_was_drawn_and_its_own_heat(resistance, load, initial, speed, on):
    spec = BatterySpec(resistance_ohm=resistance, load_w=load, initial_fraction=initial)
    pack = discharged(spec, ramp(speed), 120.0, on)
    drawn = np.cumsum(pack.power_w + resistance * pack.current_a**2) * STEP_S
    lost = (initial - pack.fraction) * spec.capacity_wh * 3600
    assert_allclose(lost, drawn, rtol=1e-9, atol=1e-7)
    assert_allclose(pack.voltage_v * pack.current_a, pack.power_w, rtol=1e-12)
    rest = open_voltage(spec, np.append(initial, pack.fraction[:-1]))
    assert_allclose(pack.voltage_v, rest - resistance * pack.current_a, rtol=1e-12)


def test_the_load_is_that_of_electronics_lidar_and_motors():
    motion = ramp(0.25)
    spec = BatterySpec(load_w=15.0, lidar_w=2.3)
    standing, spinning, driving = (
        discharged(spec, m, 40.0, on).power_w.sum() * STEP_S
        for m, on in ((STILL, False), (STILL, True), (motion, False))
    )
    steps = len(discharged(spec, seconds=40.0).power_w)
    assert standing == pytest.approx(15.0 * steps * STEP_S)
    assert spinning - standing == pytest.approx(2.3 * steps * STEP_S)
    way = motion.poses[-1, 0]
    work = (spec.drag_n * way + spec.mass_kg * 0.25**2 / 2) / spec.motor_efficiency
    assert driving - standing == pytest.approx(work, rel=1e-9)


@pytest.mark.parametrize("model", ["power", "linear"])
def test_charge_is_never_below_0_and_an_empty_pack_stays_empty(model):
    spec = BatterySpec(model=model, capacity_wh=0.1, initial_fraction=0.5)
    pack = discharged(spec, seconds=60.0)
    assert pack.fraction.min() == 0
    assert_array_equal(pack.fraction[round(30 / STEP_S) :], 0)
    assert np.isfinite(pack.voltage_v).all()
    assert np.isfinite(pack.current_a).all()


def test_the_linear_model_is_the_papers():
    spec = BatterySpec(model="linear", load_w=13.0, initial_fraction=0.75, latency_s=0.0, jitter_s=0.0)
    pack = discharged(spec, ramp(0.3), 7000.0, on=True)
    times = np.arange(1, len(pack.fraction) + 1) * STEP_S
    assert_allclose(pack.fraction, np.maximum(0.75 - 0.5 * times / 3600, 0.0), atol=1e-10)
    assert_allclose(pack.voltage_v[1:], open_voltage(spec, pack.fraction[:-1]))
    assert_allclose(pack.current_a * pack.voltage_v, 13.0)


def test_voltage_has_gaussian_noise_and_charge_and_current_have_none():
    spec = BatterySpec(rate_hz=10.0, voltage_noise_std_v=0.05, latency_s=0.0, jitter_s=0.0)
    pack = discharged(spec, seconds=2000.0)
    t = np.arange(1, 20_000) / 10.0
    read = battery_of(spec).sense(STILL, t)
    ended = np.floor(t / STEP_S + 1e-9).astype(int) - 1  # the last step that has ended
    assert_array_equal(read["battery_fraction"], pack.fraction[ended])
    assert_array_equal(read["battery_a"], pack.current_a[ended])
    noise = read["battery_v"] - pack.voltage_v[ended]
    assert noise.std() == pytest.approx(0.05, rel=0.03)
    assert noise.mean() == pytest.approx(0.0, abs=4 * 0.05 / np.sqrt(len(t)))
