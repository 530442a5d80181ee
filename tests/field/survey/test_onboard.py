"""Signals of a robot that drives, and the map of its room at rest from one drive."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.errors import InputError
from magtwin.field.fit.fit import OFFSET_SD_NT, fit, offset_sd_nt, raster
from magtwin.field.maps.map import NOISE, OFFSET, TABLED
from magtwin.field.sources.harmonic import HarmonicField
from magtwin.field.survey.onboard import lacking, prior_sd_nt, signals_of
from magtwin.field.survey.readings import Readings
from magtwin.field.survey.saved import load_readings, save_readings
from magtwin.io.surveys.maps import _shared
from magtwin.io.surveys.readings import _together
from magtwin.report.verdict import Z_90

P_W, U_FULL, U_EMPTY = 15.0, 16.2, 12.4
OWN_NT = np.array([[900.0, -500.0, -300.0], [150.0, -200.0, 1300.0]])  # of LiDAR and current


def columns(t):
    """A robot that stands, then drives at 5 rad/s, while its pack empties."""
    rate = np.where(t < 10, 0.0, 5.0)
    angle = np.concatenate([[0.0], np.cumsum(rate[:-1] * np.diff(t))])
    charge, on = 0.95 - 2e-4 * t, (t % 20 > 12).astype(float)
    volts = U_EMPTY + (U_FULL - U_EMPTY) * charge
    power = P_W + 2.3 * on + 0.1 * 2 * rate
    held = np.floor(t / 2 + 1e-9).astype(int) * 40  # rows 2 s apart, as batteries report
    return {
        "wheel_angle": np.column_stack([angle, angle]),
        "lidar_on": on,
        "battery_a": (power / volts)[held],
        "battery_v": volts[held],
        "battery_fraction": charge[held],
    }, power / volts - P_W / U_FULL


def test_signals_are_zero_at_rest_and_the_current_is_that_above_a_full_packs():
    t = np.arange(0, 600, 0.05)
    known, current = columns(t)
    signals, names = signals_of(t, known)
    found = dict(zip(names, signals.T, strict=True))
    still, drives = t < 9, t > 11
    for side in ("left", "right"):
        for kind, speed in (("friction", 1.0), ("rate", 5.0), ("acceleration", 0.0)):
            assert_allclose(found[f"{kind} {side}"][still], 0.0, atol=1e-9)
            assert_allclose(found[f"{kind} {side}"][drives], speed, atol=1e-6)
        assert_allclose(found[f"cos {side}"], np.cos(known["wheel_angle"][:, 0]))
    assert np.sqrt(np.mean((found["current"] - current) ** 2)) < 0.1 * current.std()
    assert lacking(names) == []
    always = signals_of(t, known | {"lidar_on": np.ones(len(t))})[1]
    assert lacking(always) == ["lidar_on (at times off)"]
    assert signals_of(t[:1], known) == signals_of(t[::-1], known) == signals_of(t, {}) == (None, ())
    assert lacking(("lidar",)) == ["wheel_angle", "battery_a"]
    assert len(prior_sd_nt(names)) == len(names)
    assert (prior_sd_nt(names) > 0).all()


@pytest.fixture(scope="module")
def room():
    rng = np.random.default_rng(3)
    m = rng.normal(0, [[4.0]], (8, 3))
    p = np.column_stack([rng.uniform(-2, 2, (8, 2)), rng.uniform(-0.7, -0.4, 8)])
    own = {"hard_iron_nt": np.array([300.0, 500.0, 400.0]), "soft_iron": np.zeros((3, 3))}
    uniform = np.array([-2e3, 2.4e4, -3.8e4])
    return HarmonicField(
        p_world_dipole=p, m_world=m, b_uniform_nt=uniform, p_base_sensor=np.array([0, 0, 0.3]), **own
    )


@pytest.fixture(scope="module")
def drive(room):
    t = np.arange(0, 300, 0.2)
    p = np.column_stack([1.2 * np.sin(0.11 * t), np.sin(0.173 * t + 1)])
    yaw = np.arctan2(0.173 * np.cos(0.173 * t + 1), 0.132 * np.cos(0.11 * t))
    known, current = columns(np.arange(0, 300, 0.05))
    signals, names = signals_of(np.arange(0, 300, 0.05), known)
    own = np.column_stack([known["lidar_on"], current])[::4] @ OWN_NT
    still = room.magnitude_nt(p, yaw)
    moving = [
        replace(room, hard_iron_nt=room.hard_iron_nt + h).magnitude_nt(q, a)
        for h, q, a in zip(own, p, yaw, strict=True)
    ]
    b = np.array(moving) + np.random.default_rng(0).normal(0, 5, len(t))
    assert np.ptp(np.array(moving) - still) > 500
    return Readings(
        p_xy=p, yaw=yaw, b_nt=b, t=t, signals=signals[::4], signal_names=names, height_m=0.3, name="d"
    )


def test_a_map_of_a_drive_is_that_of_the_robot_at_rest(room, drive):
    rng = np.random.default_rng(1)
    at, yaw = drive.p_xy[rng.integers(len(drive), size=400)], rng.uniform(0, 2 * np.pi, 400)
    want, model = room.magnitude_nt(at, yaw), fit(drive, "auto")
    field = raster(model, drive, spacing_m=0.1)
    value, sd = field.lookup_with_sd(at, yaw)
    off = (value - want)[np.isfinite(value)]
    assert np.sqrt(np.mean(off**2)) < 60
    assert abs(off.mean()) < 40
    assert np.mean(np.abs(off) <= Z_90 * sd[np.isfinite(value)]) > 0.8
    assert OFFSET not in field.parameters
    assert field.noise_nt2 > 200**2 > model.noise_nt2  # a reading has the fields of LiDAR and battery
    assert_allclose(field.lookup_with_sd(at, yaw, reading=True)[1] ** 2, sd**2 + field.noise_nt2)
    assert field.parameters[NOISE] == pytest.approx(field.noise_nt2**0.5)


def test_a_harmonic_map_holds_the_field_of_its_fit_and_bounds_its_table(room, drive):
    rng = np.random.default_rng(2)
    model = fit(drive.with_(signals=None, signal_names=()).take(np.arange(0, 1500, 10)), "harmonic")
    field = raster(model, drive, spacing_m=0.2)
    p, yaw = drive.p_xy[rng.integers(len(drive), size=500)], rng.uniform(0, 2 * np.pi, 500)
    known = np.isfinite(field.lookup(p, yaw))
    exact, want = field.exact(p, yaw), model.predict(p, yaw)[0]
    assert_allclose(exact[known], want[known], rtol=1e-10)
    assert np.isnan(exact[~known]).all()
    off = np.abs(field.lookup(p, yaw) - exact)[known]
    assert 0.5 * off.max() < field.parameters[TABLED] < 10 * off.max()
    with pytest.raises(InputError, match="does not hold the field"):
        replace(field, values_nt=field.values_nt + 1.0).exact(p, yaw)


def test_what_the_signals_lack_stays_an_offset_and_is_named(drive):
    some = drive.with_(signals=drive.signals[:, :2], signal_names=drive.signal_names[:2])
    assert offset_sd_nt(some, some.signal_names) == offset_sd_nt(drive) == OFFSET_SD_NT
    assert offset_sd_nt(drive, drive.signal_names) == 0
    assert "record lidar_on (at times off), battery_a with it" in _shared(some, "auto")[-1]
    assert "take --method auto" in _shared(drive, "gp")[-1]
    assert not any("one drive" in doubt for doubt in _shared(drive, "auto"))


def test_signals_are_kept_on_disk_and_by_drives_that_have_the_same(drive, tmp_path):
    save_readings(drive, tmp_path / "d.parquet")
    again = load_readings(tmp_path / "d.parquet")
    assert again.signal_names == drive.signal_names
    assert_array_equal(again.signals, drive.signals)
    assert len(_together([drive, again]).signals) == 2 * len(drive)
    assert _together([drive, again.with_(signals=None, signal_names=())]).signals is None
