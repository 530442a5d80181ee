"""Tolles-Lawson: regressors as others have them, coefficients that come back, runs that get quiet."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from places import DOCS
from scipy.signal import butter, sosfilt, sosfilt_zi
from scipy.spatial.transform import Rotation

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.files.file import shipped
from magtwin.learn.compensation.tolles_lawson import (
    TollesLawson,
    band_pass,
    compensate_run,
    design_matrix,
    fit_run,
    fit_tolles_lawson,
)
from magtwin.path import path_named
from magtwin.run.run import Run
from magtwin.sim.runs.simulate import simulate
from magtwin.spec.magnetics import EarthFieldSpec, PlatformFieldSpec
from magtwin.spec.robot import RobotSpec
from magtwin.spec.scene import Scene

RATE_HZ = 20.0
EARTH_NT = np.array([-2700.0, 24000.0, -38400.0])
PLATFORM = PlatformFieldSpec(
    hard_iron_nt=(415.0, 760.0, -300.0),
    soft_iron=(0.008, 0.001, 0.0, 0.001, -0.004, 0.0005, 0.0, 0.0005, 0.002),
    eddy_s=(0.004, 0.0, 0.0, 0.0, 0.004, 0.0, 0.0, 0.0, 0.006),
)
EARTH = EarthFieldSpec(
    b_world_nt=tuple(EARTH_NT.tolist()),
    latitude_deg=29.65,
    longitude_deg=-82.35,
    height_m=50,
    date="2026-01-01",
)
FLAT = AnomalyMap(
    values_nt=np.full((1, 2, 2), np.linalg.norm(EARTH_NT)),
    origin_m=(-3, -2),
    cell_m=(6, 4),
    headings_rad=np.zeros(1),
)


def manoeuvres(seconds: float, phase: float = 0.0) -> np.ndarray:
    """The Earth's field in the axes of a platform that yaws, pitches and rolls, shape (N, 3)."""
    t = np.arange(0, seconds, 1 / RATE_HZ) + phase
    yaw = 2 * np.pi * t / 60
    pitch, roll = np.radians(10) * np.sin(2 * np.pi * 0.21 * t), np.radians(15) * np.sin(2 * np.pi * 0.33 * t)
    return Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll])).inv().apply(EARTH_NT)


def with_platform(b: np.ndarray) -> np.ndarray:
    rate = np.gradient(b, 1 / RATE_HZ, axis=0)
    s, e = (np.reshape(m, (3, 3)) for m in (PLATFORM.soft_iron, PLATFORM.eddy_s))
    return b + b @ s.T + PLATFORM.hard_iron_nt + rate @ e.T


def figure_of_merit_flight(rate_hz: float) -> tuple[np.ndarray, np.ndarray]:
    """Vectors and scalar readings of an aircraft's calibration [nT]: on each of four headings it rolls by
    10 deg, pitches by 5 and yaws by 5, three times each, over the field of Ottawa.
    """
    t = np.arange(0, 160, 1 / rate_hz)
    leg, into = np.divmod(t, 40)
    swings = [
        np.sin(2 * np.pi * (into - first) / 4) * ((into >= first) & (into < first + 12))
        for first in (2, 15, 27)
    ]
    roll, pitch, yaw = np.radians([10, 5, 5])[:, None] * swings
    turned = Rotation.from_euler("ZYX", np.column_stack([np.pi / 2 * leg + yaw, pitch, roll]))
    b = with_platform(turned.inv().apply([17_300.0, -4_100.0, -50_900.0]))
    return b, np.linalg.norm(b, axis=1) + np.random.default_rng(4).normal(0, 0.5, len(t))


def test_a_figure_of_merit_flight_is_compensated_as_by_deinterfs_own_example():
    """Its example, on a flight of our own, as its data are to be fetched: container, terms, a band-pass of
    0.1 to 0.6 Hz at 10 Hz, fit and transform. Its penalty is of other units than ours, so both go without.
    """
    pytest.importorskip("deinterf")
    from deinterf.compensator.tmi.linear import Terms
    from deinterf.compensator.tmi.linear import TollesLawson as Peer
    from deinterf.foundation.sensors import MagVector, Tmi
    from deinterf.utils.data_ioc import DataIoC
    from sklearn.linear_model import LinearRegression

    b, readings = figure_of_merit_flight(10)
    fom = DataIoC().with_data(MagVector(bx=b[:, 0], by=b[:, 1], bz=b[:, 2]))
    for ours, theirs in (
        (("permanent", "induced5", "eddy8"), Terms.Terms_16),
        (("permanent", "induced6", "eddy9"), Terms.Terms_18),
    ):
        matrix, _ = design_matrix(b, 1.0, ours)
        assert_allclose(matrix, np.asarray(fom[theirs]), rtol=1e-12, atol=1e-9)
        peer = Peer(terms=theirs, estimator=LinearRegression(fit_intercept=False))
        clean = np.asarray(peer.fit_transform(fom, Tmi(tmi=readings))).ravel()
        model = fit_tolles_lawson(readings, b, 10.0, terms=ours, band_hz=(0.1, 0.6), ridge=0.0)
        mine = model.compensate(readings, b, 10.0)
        assert readings.std() > 100
        apart = mine - clean
        assert (apart - apart.mean()).std() < 0.01 * readings.std(), ours


def test_coefficients_of_a_linear_platform_come_back():
    b = manoeuvres(300)
    matrix, _ = design_matrix(b, RATE_HZ)
    rng = np.random.default_rng(1)
    true = np.concatenate([rng.normal(0, 300, 3), rng.normal(0, 3e-3, 6), rng.normal(0, 3e-3, 9)])
    readings = np.linalg.norm(EARTH_NT) + matrix @ true
    model = fit_tolles_lawson(readings, b, RATE_HZ, ridge=0.0)
    assert_allclose(model.compensate(readings, b, RATE_HZ).std(), 0, atol=1e-3)  # nT, of a few hundred
    assert model.residual_sd_nt < 1e-3


@pytest.fixture(scope="module")
def calibration():
    """A robot that drives about in a uniform field, above a map that knows only that field."""
    robot = RobotSpec(name="robot", asset="robot.usda", platform=PLATFORM)
    scene = Scene(name="field", map_layer="flat.usdc", robot=robot, earth=EARTH)

    def run(path: str, seed: int):
        return simulate(
            scene, path_named(path), anomaly_map=FLAT, rng=np.random.default_rng(seed), rate_hz=20
        )

    return run


def test_a_run_compensated_by_another_s_fit_loses_over_95_percent_of_its_variance(calibration):
    model = fit_run(calibration("figure8", 1), band_hz=None)
    run, report = compensate_run(calibration("curvilinear", 2), model)
    removed = {figure.name: figure.value for figure in report.figures}["variance removed"]
    assert removed > 0.95
    left = run["b_measured_nt"] - run["b_map_nt"]
    assert left.std() < 0.25 * calibration("curvilinear", 2)["b_disturbance_nt"].std()
    assert run.metadata["tolles_lawson"] == "permanent induced6 eddy9"


def test_a_run_without_vectors_is_refused(calibration):
    run = calibration("figure8", 1)
    nothing = np.full((run.rows, 3), np.nan)
    with pytest.raises(InputError, match="no field vectors in b_vector_measured_nt"):
        fit_run(run.with_columns(b_vector_measured_nt=nothing))


def test_the_longest_unbroken_stretch_is_used(calibration):
    run = calibration("figure8", 1)
    measured = run["b_measured_nt"].copy()
    measured[40] = np.nan
    model = fit_run(run.with_columns(b_measured_nt=measured), band_hz=None, ridge=1e-6)
    b, v = (run[name][41:] for name in ("b_measured_nt", "b_vector_measured_nt"))
    same = fit_tolles_lawson(b - run["b_map_nt"][41:], v, 20.0, band_hz=None, ridge=1e-6)
    assert_allclose(model.coefficients, same.coefficients, rtol=1e-6)


ONE = {"terms": ["permanent"], "coefficients": [1], "band_hz": None, "ridge": 0, "residual_sd_nt": 0}


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{", "not a Tolles-Lawson model"),
        ("[]", "not a Tolles-Lawson model"),
        ('{"terms": ["permanent"]}', "KeyError: 'coefficients'"),
        ("[" * 100_000, "RecursionError"),
        (json.dumps(ONE), "1 coefficients for 3 columns"),
        (json.dumps(ONE | {"vector": "exact"}), "fitted to exact vectors"),
        (json.dumps(ONE | {"preset": "magnaw"}), "no preset 'magnaw'"),
    ],
)
def test_a_file_that_is_no_model_is_refused(tmp_path, text, says):
    (tmp_path / "model.json").write_text(text)
    with pytest.raises(InputError, match=says):
        TollesLawson.load(tmp_path / "model.json")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"terms": ("permanent", "induced")}, "no Tolles-Lawson term 'induced'"),
        ({"terms": ("eddy8", "eddy9")}, "each once"),
        ({"terms": ()}, "at least one"),
        ({"rate_hz": 0.0}, "rate_hz must be above 0"),
        ({"band_hz": (0.9, 0.1)}, "band_hz must ascend"),
        ({"band_hz": (1e-300, 0.9)}, "band_hz must begin at"),
        ({"band_hz": (0.1, 10.0)}, "half the rate, 10 Hz"),
        ({"terms": ("permanent", "bias")}, "a pass band excludes a bias"),
        ({"preset": "magnaw"}, "no preset 'magnaw'; did you mean 'magnav'"),
        ({"ridge": -1.0}, "ridge must not be below 0"),
        ({"b_nt": np.full(400, np.nan)}, "b_nt must be finite, got nan in row 0"),
        ({"b_nt": np.ones(3)}, r"must have shape \(400,\)"),
        ({"b_vector_nt": np.zeros((400, 3))}, "not zero"),
        ({"b_vector_nt": np.zeros((400, 2))}, r"shape \(N, 3\)"),
        ({"b_nt": np.ones(10), "b_vector_nt": np.ones((10, 3))}, "10 readings are too few for 18"),
        ({"b_nt": np.ones(25), "b_vector_nt": np.ones((25, 3))}, "too few for the band-pass"),
    ],
)
def test_what_cannot_be_fitted_is_refused(change, says):
    b = manoeuvres(20)
    given = {"b_nt": np.linalg.norm(b, axis=1), "b_vector_nt": b, "rate_hz": RATE_HZ, **change}
    with pytest.raises(InputError, match=says):
        fit_tolles_lawson(**given)


def test_the_page_on_compensation_takes_out_what_it_says():
    page = DOCS / "compensate.md"
    (code,) = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    told: dict = {}
    exec(code.replace("scenes/lab/lab.usda", str(shipped("scenes", "lab", "lab.usda"))), told)
    figures = {figure.name: figure for figure in told["report"].figures}
    assert figures["before"].value > 100
    assert figures["variance removed"].value > 0.98
    assert "share" in figures["variance removed"].note
    # of the four headings that a lawnmower knows, other ones follow less
    mown = fit_run(told["drive"]("lawnmower", seed=1), band_hz=None)
    _, report = compensate_run(told["drive"]("curvilinear", seed=2), mown)
    assert report.figures[-1].value < figures["variance removed"].value - 0.2
    # and of a model that is none of this robot's, the report says that it makes things worse
    wrong = replace(mown, coefficients=tuple(-2 * c for c in mown.coefficients))
    removed = compensate_run(told["drive"]("curvilinear", seed=2), wrong)[1].figures[-1]
    assert removed.value < 0
    assert removed.note.startswith("below 0: more variance than before")


def magnav_reference(b: np.ndarray, readings: np.ndarray, rate_hz: float, penalty: float):
    """Regressors, filtered regressors and compensated readings, from the equations of MagNav.jl."""
    total = np.linalg.norm(b, axis=1)
    change = np.vstack([b[1] - b[0], (b[2:] - b[:-2]) / 2, b[-1] - b[-2]])
    x, y, z = (b / total[:, None]).T
    columns = [x, y, z]
    pairs = ((x, 0), (x, 1), (x, 2), (y, 1), (y, 2), (z, 2))
    columns += [unit * b[:, axis] / 50_000 for unit, axis in pairs]
    columns += [unit * change[:, axis] / 50_000 for unit in (x, y, z) for axis in range(3)]
    matrix = np.column_stack(columns)
    stages = butter(4, [0.1 / (rate_hz / 2), 0.9 / (rate_hz / 2)], "bandpass", output="sos")
    start = sosfilt_zi(stages)

    def filtered(signal):
        ends = 2 * signal[0] - signal[24:0:-1], 2 * signal[-1] - signal[-2:-26:-1]
        long = np.concatenate([ends[0], signal, ends[1]])
        for _ in range(2):
            long = sosfilt(stages, long, zi=start * long[0])[0][::-1]
        return long[24:-24][20:-20]

    along = np.column_stack([filtered(column) for column in matrix.T])
    normal = along.T @ along + penalty * np.eye(18)
    return matrix, along, readings - matrix @ np.linalg.solve(normal, along.T @ filtered(readings))


@pytest.mark.parametrize("penalty", [0.0, 1e-3])
def test_the_preset_magnav_gives_its_arrays(penalty, tmp_path):
    b, readings = figure_of_merit_flight(10.0)
    matrix, along, compensated = magnav_reference(b, readings, 10.0, penalty)
    ours, names = design_matrix(b, 10.0, preset="magnav")
    assert len(names) == 18
    assert_allclose(ours, matrix, rtol=1e-12, atol=1e-12 * np.abs(matrix).max())
    filtered = band_pass(ours, (0.1, 0.9), 10.0, preset="magnav")
    assert_allclose(filtered, along, rtol=0, atol=1e-12 * np.abs(matrix).max())
    model = fit_tolles_lawson(readings, b, 10.0, ridge=penalty, preset="magnav")
    model.save(tmp_path / "model.json")
    got = TollesLawson.load(tmp_path / "model.json").compensate(readings, b, 10.0)
    assert np.std(got - compensated) < 1e-3  # nT; MagNav.jl allows its own arrays 0.1
    assert np.mean(got) == pytest.approx(np.mean(compensated), abs=0.1)
    default = fit_tolles_lawson(readings, b, 10.0, ridge=0.0).compensate(readings, b, 10.0)
    assert np.std(default - compensated) > 0.01


def test_the_figures_of_both_reports_are_those_of_the_raw_arrays(calibration):
    run = calibration("figure8", seed=1)
    model = fit_run(run, band_hz=None, ridge=1e-6)
    vector, field = (run["b_vector_measured_nt"], run["b_measured_nt"] - run["b_map_nt"])
    fine = np.isfinite(field) & np.isfinite(vector).all(axis=1)
    assert fine[np.argmax(fine) :].all()  # so that the longest stretch is all of it
    b, y = vector[fine], field[fine]
    matrix, names = design_matrix(b, 1 / float(np.median(np.diff(run["t"]))))
    modelled = matrix @ np.array(model.coefficients)
    left = y - y.mean() - (modelled - modelled.mean())
    fitted = {figure.name: figure.value for figure in model.report("fit").figures}
    assert fitted["coefficients"] == len(names) == len(model.coefficients)
    assert fitted["ridge"] == 1e-6
    assert_allclose(fitted["residual"], left.std(), rtol=1e-9)
    compensated, report = compensate_run(run, model)
    applied = {figure.name: figure.value for figure in report.figures}
    assert applied["readings"] == fine.sum()
    assert_allclose(applied["before"], y.std(), rtol=1e-12)
    assert_allclose(applied["after"], left.std(), rtol=1e-9)
    assert_allclose(applied["variance removed"], 1 - left.var() / y.var(), rtol=1e-9)
    assert_allclose((compensated["b_measured_nt"] - run["b_map_nt"])[fine] - y.mean(), left, atol=1e-6)
    assert f"standard deviation {left.std():,.0f} nT against {y.std():,.0f} nT" in report.verdict
    assert f"a ratio of {left.std() / y.std():.2f}" in report.verdict


PER_AMPERE_NT = np.array([180.0, -90.0, 60.0])


def flight_with_motors(seconds=200.0, delay_s=0.2):
    """Readings of a drone whose battery's current makes a field, late by `delay_s`, and that current [A]."""
    rng, b = np.random.default_rng(1), manoeuvres(seconds)
    t = np.arange(len(b)) / RATE_HZ
    amperes = 12 + 6 * np.sign(np.sin(2 * np.pi * t / 17)) + 3 * np.sin(2 * np.pi * t / 5.3)
    late = np.interp(t - delay_s, t, amperes)
    b = b + PLATFORM.hard_iron_nt + late[:, None] * PER_AMPERE_NT
    size = np.linalg.norm(b, axis=1) + rng.normal(0, 5.0, len(b))
    return Run(columns={"t": t, "b_measured_nt": size, "b_vector_measured_nt": b, "battery_a": amperes}), t


def test_the_field_of_a_battery_s_current_and_its_delay_come_back_inside_their_intervals():
    run, _ = flight_with_motors()
    model = fit_run(run, terms=("permanent", "induced5", "current"), band_hz=None)
    assert model.delay_s == pytest.approx(0.2)
    current = np.array(model.coefficients[-3:])
    assert_allclose(current, PER_AMPERE_NT, atol=12.0)  # cosines of the disturbed field
    assert max(model.sd[-3:]) < 20.0
    assert model.residual_sd_nt < 30.0
    clean, _ = compensate_run(run, model)
    assert clean["b_measured_nt"].std() < 0.1 * run["b_measured_nt"].std()


def test_a_saved_model_keeps_intervals_and_delay(tmp_path):
    model = fit_run(flight_with_motors()[0], terms=("permanent", "current"), band_hz=None)
    model.save(tmp_path / "model.json")
    assert TollesLawson.load(tmp_path / "model.json") == model


def test_what_a_drive_does_not_excite_is_said_to_be_undetermined_and_not_exported():
    yaw = np.linspace(0, 12 * np.pi, 3000)
    b = Rotation.from_euler("Z", yaw[:, None]).inv().apply(EARTH_NT)
    size = np.linalg.norm(b + np.array(PLATFORM.hard_iron_nt), axis=1)
    model = fit_tolles_lawson(size, b, RATE_HZ, terms=("permanent",), band_hz=None)
    assert np.isinf(model.sd).tolist() == [False, False, True]  # on a level floor u_z is constant
    said = {figure.name: str(figure.value) for figure in model.report("model").figures}
    assert said["permanent z"] == "not determined: the drive does not excite it"
    made = model.parameters("px4")
    assert set(made) == {"CAL_MAG0_XOFF", "CAL_MAG0_YOFF"}
    assert made["CAL_MAG0_XOFF"] == pytest.approx(415e-5, abs=2e-4)  # in gauss
    assert made["CAL_MAG0_YOFF"] == pytest.approx(-760e-5, abs=2e-4)  # to the right
    offset = model.parameters("ardupilot")["COMPASS_OFS_X"]
    assert offset == pytest.approx(-4.15, abs=0.2)  # milligauss, added
