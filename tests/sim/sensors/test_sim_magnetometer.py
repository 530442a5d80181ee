"""The simulated magnetometer: spectrum of its noise, what it makes of a field, lock, and its vector axes."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.signal import welch

from magtwin.sim.sensors.magnetometer import Magnetometer, lost_in, vector_gain
from magtwin.spec.sensors import MagnetometerSpec

RATE_HZ = 135.0
QUIET = MagnetometerSpec(noise_density_nt=0.0, resolution_nt=0.0, vector_noise_density_nt=0.0)
N = 2000
DOWN = np.tile([24_000.0, 0.0, -38_000.0], (N, 1))
FLAT = np.full(N, np.linalg.norm(DOWN[0]))


def read(spec, b=FLAT, vector=DOWN, *, seed=0, rate_hz=RATE_HZ, steep=False):
    sensor = Magnetometer(spec, rate_hz, np.random.default_rng(seed))
    axes = sensor.axes(vector, steep=steep)
    return {**sensor.read(b, vector), "b_vector_measured_nt": axes}


def scalar(spec, b=FLAT, vector=DOWN, **options):
    return read(spec, b, vector, **options)["b_measured_nt"]


def wave(frequency_hz: float, count: int = N) -> np.ndarray:
    return 41_000 + 500 * np.sin(2 * np.pi * frequency_hz * np.arange(count) / RATE_HZ)


# Noise


def spectrum(spec: MagnetometerSpec, count: int, rate_hz: float, window: int):
    noise = Magnetometer(spec, rate_hz, np.random.default_rng(7)).noisy(np.zeros(count))
    return welch(noise, rate_hz, nperseg=window)


def test_white_noise_has_its_density_at_every_rate():
    for rate in (20.0, 135.0):
        f, power = spectrum(replace(QUIET, noise_density_nt=0.3), 100_000, rate, 512)
        # 390 windows, half overlapping: a bin is off by a twentieth, the mean over a band by far less
        for low, high in ((0.05, 0.2), (0.2, 0.35), (0.35, 0.48)):
            band = (f > low * rate) & (f < high * rate)
            assert power[band].mean() == pytest.approx(0.09, rel=0.03)


def test_flicker_noise_falls_as_1_over_f_to_its_corner():
    density, corner = 0.002, 2.0
    spec = replace(QUIET, noise_density_nt=density, flicker_corner_hz=corner)
    f, power = spectrum(spec, 2**20, RATE_HZ, 2**14)
    want = density**2 * (1 + corner / f[1:])
    ratio = power[1:] / want
    # octaves from 0.03 to 31 Hz; the lowest holds 4 bins of 127 windows, so is itself off by a twentieth
    for low in 0.03 * 2.0 ** np.arange(10):
        band = (f[1:] >= low) & (f[1:] < 2 * low)
        assert ratio[band].mean() == pytest.approx(1, abs=0.12), low
    at_corner = np.abs(f - corner) < 0.1
    assert power[at_corner].mean() == pytest.approx(2 * density**2, rel=0.1)


# What it makes of a field


@pytest.mark.parametrize("frequency_hz", [0.5, 4.0, 12.0])
def test_the_low_pass_is_of_first_order(frequency_hz):
    corner = 4.0
    last = slice(N - 1080, N)  # 8 s, whole periods
    got = scalar(replace(QUIET, bandwidth_hz=corner), wave(frequency_hz))[last] - 41_000
    t = np.arange(N)[last] / RATE_HZ
    turned = np.exp(-2j * np.pi * frequency_hz * t)
    gain = 2 * np.mean(got * turned) / (500 / 1j)
    # 1 / (1 + j f / fc); linear between readings, the wave loses (pi f / rate)^2 / 3: 2.6 % of 12 Hz
    want = 1 / (1 + 1j * frequency_hz / corner)
    assert abs(gain - want) < 1e-3 + (np.pi * frequency_hz / RATE_HZ) ** 2 / 3 * abs(want)


def test_the_heading_error_follows_the_cosine_to_the_optical_axis():
    angle = np.linspace(0, np.pi, N)
    vector = 45_000 * np.column_stack([np.sin(angle), np.zeros(N), np.cos(angle)])
    off = read(replace(QUIET, heading_error_nt=3.0), FLAT, vector)["b_noise_nt"]
    assert_allclose(off, 3.0 * np.cos(angle), atol=1e-10)
    unknown = np.full((N, 3), np.nan)
    assert_array_equal(read(replace(QUIET, heading_error_nt=3.0), FLAT, unknown)["b_noise_nt"], 0)


# Lock

STEEP = replace(QUIET, gradient_max_nt_m=20e3, gradient_relock_nt_m=12e3, stuck_std_nt=40.0)


def test_lock_is_lost_above_one_gradient_and_found_below_another():
    gradient = np.array([1, 15, 21, 15, 13, 11, 15, 19, 25, np.nan, 5, np.nan]) * 1e3
    want = [0, 0, 1, 1, 1, 0, 0, 0, 1, 1, 0, 0]
    assert_array_equal(lost_in(STEEP, gradient), np.array(want, bool))
    assert not lost_in(QUIET, gradient).any()
    assert_array_equal(lost_in(replace(STEEP, gradient_relock_nt_m=20e3), [25e3, 20e3, 19e3]), [1, 1, 0])


def test_a_lost_lock_reads_one_value_near_the_latch_until_it_is_found():
    steep = np.zeros(N, bool)
    steep[100:200] = steep[500:900] = steep[950:960] = True
    spec = replace(STEEP, noise_density_nt=5.0, bandwidth_hz=30.0)
    columns = read(spec, wave(1.0), steep=steep)
    assert_array_equal(columns["flag_lost_lock"], steep)
    plateaus = [np.unique(columns["b_measured_nt"][rows]) for rows in (slice(100, 200), slice(500, 900))]
    assert [len(p) for p in plateaus] == [1, 1]  # exactly repeated
    assert plateaus[0] != plateaus[1]
    assert abs(plateaus[0][0] - 35_650) < 4 * 40
    fine = read(spec, wave(1.0))
    assert_array_equal(columns["b_measured_nt"][~steep], fine["b_measured_nt"][~steep])
    assert_allclose(wave(1.0) + columns["b_noise_nt"], columns["b_measured_nt"], rtol=0, atol=1e-9)


def test_a_field_along_the_optical_axis_or_across_it_loses_lock():
    angle = np.linspace(0, np.pi, N)
    vector = 45_000 * np.column_stack([np.sin(angle), np.zeros(N), np.cos(angle)])
    axis = read(replace(QUIET, dead_zone_axis=0.1), FLAT, vector)["flag_lost_lock"]
    plane = read(replace(QUIET, dead_zone_plane=0.2), FLAT, vector)["flag_lost_lock"]
    assert_array_equal(axis, (angle < 0.1) | (angle > np.pi - 0.1))
    assert_array_equal(plane, np.abs(angle - np.pi / 2) < 0.2)
    assert not read(replace(QUIET, dead_zone_axis=0.1), FLAT, np.full((N, 3), np.nan))["flag_lost_lock"].any()


# Vector axes

CROOKED = replace(
    QUIET,
    vector_bias_nt=(60.0, -40.0, 85.0),
    vector_scale=(0.004, -0.003, 0.002),
    vector_misalignment=(0.0, 0.006, -0.004, 0.005, 0.0, 0.007, -0.003, 0.002, 0.0),
)


def turning(count: int = N) -> np.ndarray:
    angle = np.linspace(0, 40, count)
    tilt = 0.4 * np.sin(np.linspace(0, 23, count))
    return 45_000 * np.column_stack(
        [np.cos(angle) * np.cos(tilt), np.sin(angle) * np.cos(tilt), np.sin(tilt)]
    )


def test_axes_are_measured_in_turn_and_held():
    b = turning(12)
    got = read(QUIET, FLAT[:12], b)["b_vector_measured_nt"]
    # readings 0 and 1 ago are those of the first field: an axis a reading, the third at 0
    for k in range(12):
        for axis in range(3):
            taken = max(row for row in range(-2, k + 1) if (row + 2) % 3 == axis)
            assert got[k, axis] == b[max(taken, 0), axis], (k, axis)


def test_calibration_errors_come_back_by_a_fit():
    spec = replace(CROOKED, vector_noise_density_nt=0.03)
    b = np.repeat(turning(900), 3, axis=0)  # each attitude long enough for all three axes
    got = read(spec, np.full(len(b), 45_000.0), b)["b_vector_measured_nt"][2::3]
    design = np.column_stack([b[2::3], np.ones(len(got))])
    solved = np.linalg.lstsq(design, got, rcond=None)[0]
    gain, bias = solved[:3].T, solved[3]
    std = 0.03 * math.sqrt(RATE_HZ / 6)
    assert_allclose(bias, spec.vector_bias_nt, atol=10 * std / math.sqrt(len(got)))
    scale = np.linalg.norm(gain, axis=1) - 1
    assert_allclose(scale, spec.vector_scale, atol=1e-6)
    pointing = gain / gain.diagonal()[:, None] - np.eye(3)  # row i: e_i and the misalignment
    assert_allclose(pointing, np.reshape(spec.vector_misalignment, (3, 3)), atol=2e-6)
    assert_allclose(gain, vector_gain(spec), atol=1e-6)


def test_lost_lock_holds_the_vector_and_dropouts_drop_it():
    lost = np.zeros(60, bool)
    lost[20:40] = True
    got = read(QUIET, FLAT[:60], turning(60), steep=lost)["b_vector_measured_nt"]
    assert_array_equal(got[20:40], np.tile(got[19], (20, 1)))
    assert not np.array_equal(got[43], got[19])
    always = read(QUIET, FLAT[:60], turning(60), steep=True)["b_vector_measured_nt"]
    assert np.isnan(always).all()
    columns = read(replace(QUIET, dropout_share=0.5), FLAT[:60], turning(60))
    missing = np.isnan(columns["b_measured_nt"])
    assert_array_equal(np.isnan(columns["b_vector_measured_nt"]), np.repeat(missing[:, None], 3, axis=1))
