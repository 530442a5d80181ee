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

from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.files.file import shipped
from magtwin.io.tables import write_parquet
from magtwin.learn.compensation.platform import fit_platform, platform_of_run
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
from magtwin.spec.sensors import LidarSpec

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


def test_regressors_are_those_of_deinterf():
    peer = pytest.importorskip("deinterf.compensator.tmi.linear.terms")
    from deinterf.foundation.sensors import MagVector
    from deinterf.utils.data_ioc import DataIoC

    b = manoeuvres(60)
    container = DataIoC().with_data(MagVector(*b.T))
    for ours, theirs in (
        (("permanent", "induced5", "eddy8"), peer.Terms.Terms_16),
        (("permanent", "induced6", "eddy9"), peer.Terms.Terms_18),
    ):
        matrix, names = design_matrix(b, 1.0, ours)  # its derivatives are a sample apart
        assert matrix.shape[1] == len(names) == len(set(names))
        assert_allclose(matrix, np.asarray(container[theirs]), rtol=1e-12, atol=1e-9)


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


def test_the_diagonal_terms_are_those_of_the_whole_matrix():
    b = manoeuvres(30)
    whole, names = design_matrix(b, RATE_HZ)
    diagonal, kept = design_matrix(b, RATE_HZ, ("induced3", "eddy3"))
    assert kept == ("induced xx", "induced yy", "induced zz", "eddy xdx", "eddy ydy", "eddy zdz")
    assert_allclose(diagonal, whole[:, [names.index(name) for name in kept]])


def test_coefficients_of_a_linear_platform_come_back():
    b = manoeuvres(300)
    matrix, _ = design_matrix(b, RATE_HZ)
    rng = np.random.default_rng(1)
    true = np.concatenate([rng.normal(0, 300, 3), rng.normal(0, 3e-3, 6), rng.normal(0, 3e-3, 9)])
    readings = np.linalg.norm(EARTH_NT) + matrix @ true
    model = fit_tolles_lawson(readings, b, RATE_HZ, ridge=0.0)
    assert_allclose(model.compensate(readings, b, RATE_HZ).std(), 0, atol=1e-3)  # nT, of a few hundred
    assert model.residual_sd_nt < 1e-3


def test_held_out_manoeuvres_lose_over_95_percent_of_the_platform_s_variance():
    train, test = (with_platform(manoeuvres(180, phase)) for phase in (0.0, 500.0))
    noise = np.random.default_rng(2).normal(0, 1, (2, len(train)))
    model = fit_tolles_lawson(np.linalg.norm(train, axis=1) + noise[0], train, RATE_HZ)
    readings = np.linalg.norm(test, axis=1) + noise[1]
    assert readings.std() > 100
    assert model.compensate(readings, test, RATE_HZ).var() < 0.05 * readings.var()


def test_a_constant_bias_is_fitted_without_a_band():
    b = manoeuvres(200)
    readings = np.linalg.norm(with_platform(b), axis=1) + 1234.0
    model = fit_tolles_lawson(
        readings - np.linalg.norm(EARTH_NT), b, RATE_HZ, terms=("permanent", "eddy9", "bias"), band_hz=None
    )
    assert model.coefficients[-1] == pytest.approx(1234.0, abs=400)
    assert abs(np.mean(model.compensate(readings, b, RATE_HZ)) - np.linalg.norm(EARTH_NT)) < 1


def test_the_vector_fit_recovers_the_platform():
    b = manoeuvres(120)
    found = fit_platform(b, with_platform(b), RATE_HZ)
    assert_allclose(found.hard_iron_nt, PLATFORM.hard_iron_nt, rtol=1e-6)
    assert_allclose(found.soft_iron, PLATFORM.soft_iron, atol=1e-10)
    assert_allclose(found.eddy_s, PLATFORM.eddy_s, atol=1e-10)
    assert found.left_motor_nt_nm == (0.0, 0.0, 0.0)
    assert found.left_wheel_moment == 0


def test_the_vector_fit_recovers_moments_to_two_percent_through_noise():
    rng = np.random.default_rng(3)
    b = manoeuvres(300)
    torques, on = rng.uniform(-0.05, 0.05, (len(b), 2)), rng.random(len(b)) < 0.3
    motors = np.array([[3300.0, 6600.0, -3000.0], [5200.0, 3700.0, -4500.0]])
    lidar = np.array([380.0, -210.0, -540.0])
    measured = with_platform(b) + torques @ motors + on[:, None] * lidar + rng.normal(0, 20, b.shape)
    found = fit_platform(b, measured, RATE_HZ, motor_nm=torques, lidar_on=on)
    assert_allclose(found.hard_iron_nt, PLATFORM.hard_iron_nt, rtol=0.02)
    assert_allclose([found.left_motor_nt_nm, found.right_motor_nt_nm], motors, rtol=0.02)
    assert_allclose(found.lidar_nt, lidar, rtol=0.02)


EVERYTHING = replace(
    PLATFORM,
    left_motor_nt_nm=(-3300.0, -6600.0, 3000.0),
    right_motor_nt_nm=(-5200.0, -3700.0, 4500.0),
    lidar_nt=(200.0, -250.0, -1200.0),
    lidar_cos_nt=(0.0, 60.0, 150.0),
    lidar_sin_nt=(90.0, 0.0, 0.0),
    left_wheel_moment=0.012,
    left_wheel_phase=1.0,
    right_wheel_moment=0.009,
    right_wheel_phase=4.0,
    caster_moment=0.006,
    caster_phase=2.0,
    p_base_caster=(0.125, 0.0, 0.0139),
)


def calibration_run(
    platform: PlatformFieldSpec, *, seed: int = 0, path: str = "figure8"
) -> tuple[Run, Scene]:
    """A robot that drives about, its LiDAR on and off; and its scene, which does not know its figures."""
    robot = RobotSpec(
        name="robot",
        asset="robot.usda",
        p_base_magnetometer=(-0.05, 0.02, 0.35),
        q_base_magnetometer_link_xyzw=(0.0, 0.0, 0.6, 0.8),
        lidar=LidarSpec(on_s=15.0, off_s=10.0),
        platform=PlatformFieldSpec(p_base_caster=EVERYTHING.p_base_caster),
    )
    scene = Scene(name="field", map_layer="flat.usdc", robot=robot, earth=EARTH)
    run = simulate(
        replace(scene, robot=replace(robot, platform=platform)),
        path_named(path),
        anomaly_map=FLAT,
        rng=np.random.default_rng(seed),
        duration_s=90.0,
        rate_hz=60.0,
    )
    return run, scene


def test_a_run_gives_back_the_moments_of_the_robot_that_drove_it():
    run, scene = calibration_run(EVERYTHING, path="split_lawnmower")  # its corners tell motors and iron apart
    found = platform_of_run(run, scene)
    # the field turns about z alone, so h and S's third column cannot be told apart: what they do together can
    up = EARTH.b_world_nt[2]
    permanent = [np.add(p.hard_iron_nt, np.multiply(p.soft_iron[2::3], up)) for p in (found, EVERYTHING)]
    assert np.linalg.norm(permanent[0] - permanent[1]) < 0.02 * np.linalg.norm(permanent[1])
    level = [np.reshape(p.soft_iron, (3, 3))[:, :2] for p in (found, EVERYTHING)]
    assert_allclose(*level, rtol=0.02, atol=1e-4)  # of 24,000 nT, 2 nT
    for name in ("left_motor_nt_nm", "right_motor_nt_nm", "lidar_nt", "lidar_cos_nt", "lidar_sin_nt"):
        want = np.array(getattr(EVERYTHING, name))
        assert_allclose(getattr(found, name), want, rtol=0.02, atol=1.0, err_msg=name)
    for name in ("left_wheel", "right_wheel", "caster"):
        for what in ("moment", "phase"):
            figure = f"{name}_{what}"
            assert getattr(found, figure) == pytest.approx(getattr(EVERYTHING, figure), rel=0.02), figure


def test_wheel_angles_need_the_robot_and_every_signal_its_rows():
    b = manoeuvres(20)
    with pytest.raises(InputError, match="wheel_angle needs the robot"):
        fit_platform(b, with_platform(b), RATE_HZ, wheel_angle=np.zeros((len(b), 2)))
    with pytest.raises(InputError, match="motor_nm must have 400 rows, got 3"):
        fit_platform(b, with_platform(b), RATE_HZ, motor_nm=np.zeros((3, 2)))
    with pytest.raises(InputError, match="must be finite"):
        fit_platform(b, with_platform(b), RATE_HZ, lidar_on=np.full(len(b), np.nan))


def test_a_held_out_run_of_a_whole_robot_loses_over_95_percent_of_the_platforms_variance():
    # all but the LiDAR, which no attitude tells of
    plain = replace(EVERYTHING, lidar_nt=(0, 0, 0), lidar_cos_nt=(0, 0, 0), lidar_sin_nt=(0, 0, 0))
    first, (run, _) = calibration_run(plain, seed=1)[0], calibration_run(plain, seed=2, path="curvilinear")
    # in a uniform field over a map of it, what the map does not know is what the platform adds
    platform = run["b_truth_nt"] - run["b_map_nt"]
    assert platform.std() > 100
    left = {}
    for vector, column in (("measured", "b_vector_measured_nt"), ("exact", "b_vector_nt")):
        model = fit_run(first, vector=vector, band_hz=None)
        assert model.report("fit").metadata["vector"] == column
        left[vector] = (platform - model.interference_nt(run[column], 60.0)).var()
    # the exact vector is as long as the reading itself, so it tells all; axes that are read in turn do not
    assert left["exact"] < 1e-6 * platform.var() < left["measured"] < 0.05 * platform.var()


def test_a_fit_takes_what_the_vector_axes_read_and_the_exact_field_only_when_asked(calibration, tmp_path):
    run = calibration("figure8", 1)
    model = fit_run(run, band_hz=None)
    same = fit_run(run.with_columns(b_vector_nt=np.full((run.rows, 3), np.nan)), band_hz=None)
    assert model == same
    exact = fit_run(run, vector="exact", band_hz=None)
    assert exact.coefficients != model.coefficients
    blind = run.with_columns(b_vector_measured_nt=np.full((run.rows, 3), np.nan))
    with pytest.raises(InputError, match=r'no field vectors in b_vector_measured_nt.*vector="exact"'):
        fit_run(blind)
    exact.save(tmp_path / "model.json")
    compensated, report = compensate_run(blind, TollesLawson.load(tmp_path / "model.json"))
    assert report.metadata["vector"] == "b_vector_nt"
    assert np.isfinite(compensated["b_measured_nt"]).all()


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
    blind = run.with_columns(b_vector_nt=nothing, b_vector_measured_nt=nothing)
    for vector in ("measured", "exact"):
        with pytest.raises(InputError, match=r"no field vectors in .*; record a vector magnetometer"):
            fit_run(blind, vector=vector)


def test_the_longest_unbroken_stretch_is_used(calibration):
    run = calibration("figure8", 1)
    measured = run["b_measured_nt"].copy()
    measured[40] = np.nan
    model = fit_run(run.with_columns(b_measured_nt=measured), band_hz=None, ridge=1e-6)
    b, v = (run[name][41:] for name in ("b_measured_nt", "b_vector_measured_nt"))
    same = fit_tolles_lawson(b - run["b_map_nt"][41:], v, 20.0, band_hz=None, ridge=1e-6)
    assert_allclose(model.coefficients, same.coefficients, rtol=1e-6)


def test_a_model_comes_back_from_its_file(tmp_path):
    b = with_platform(manoeuvres(100))
    model = fit_tolles_lawson(np.linalg.norm(b, axis=1), b, RATE_HZ)
    model.save(tmp_path / "model.json")
    assert TollesLawson.load(tmp_path / "model.json") == model


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{", "not a Tolles-Lawson model"),
        ("[]", "not a Tolles-Lawson model"),
        ('{"terms": ["permanent"]}', "KeyError: 'coefficients'"),
        ("[" * 100_000, "RecursionError"),
    ],
)
def test_a_file_that_is_no_model_is_refused(tmp_path, text, says):
    (tmp_path / "model.json").write_text(text)
    with pytest.raises(InputError, match=says):
        TollesLawson.load(tmp_path / "model.json")


def test_a_model_whose_coefficients_do_not_fit_its_terms_is_refused(tmp_path):
    broken = {"terms": ["permanent"], "coefficients": [1], "band_hz": None, "ridge": 0, "residual_sd_nt": 0}
    (tmp_path / "model.json").write_text(json.dumps(broken))
    with pytest.raises(InputError, match="1 coefficients for 3 columns"):
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


def test_compensate_says_which_vectors_it_took(calibration, tmp_path, capsys):
    write_parquet(calibration("figure8", 1), tmp_path / "run.parquet")
    told = {}
    for name, options in (("measured", []), ("exact", ["--truth"])):
        model = str(tmp_path / f"{name}.json")
        main(
            [
                "compensate",
                "fit",
                str(tmp_path / "run.parquet"),
                "--out",
                model,
                "--no-band",
                "--json",
                *options,
            ]
        )
        fitted = json.loads(capsys.readouterr().out)["metadata"]["vector"]
        out = ["--out", str(tmp_path / f"{name}.parquet"), "--json"]
        main(["compensate", "apply", str(tmp_path / "run.parquet"), model, *out])
        told[name] = fitted, json.loads(capsys.readouterr().out)["metadata"]["vector"]
    assert told == {"measured": ("b_vector_measured_nt",) * 2, "exact": ("b_vector_nt",) * 2}


def test_compensate_takes_a_preset_and_keeps_it(calibration, tmp_path, capsys):
    run, model = tmp_path / "run.parquet", tmp_path / "model.json"
    write_parquet(calibration("figure8", 1), run)
    main(["compensate", "fit", str(run), "--preset", "magnav", "--no-band", "--out", str(model), "--json"])
    assert json.loads(capsys.readouterr().out)["metadata"]["preset"] == "magnav"
    assert TollesLawson.load(model).preset == "magnav"
    assert TollesLawson.load(model) == fit_run(calibration("figure8", 1), band_hz=None, preset="magnav")
    model.write_text(model.read_text().replace('"magnav"', '"magnaw"'))
    with pytest.raises(InputError, match="no preset 'magnaw'"):
        TollesLawson.load(model)


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


def test_the_presets_own_penalty_leaves_the_noise_and_that_of_magnavs_test_far_more():
    b, readings = figure_of_merit_flight(10.0)
    left = {
        ridge: float(np.std(fit.compensate(readings, b, 10.0)))
        for ridge in (None, 1e-3)
        for fit in [fit_tolles_lawson(readings, b, 10.0, ridge=ridge, preset="magnav")]
    }
    page = (DOCS / "compensate.md").read_text()
    (line,) = re.findall(
        r"the default leaves ([\d.]+) nT of (\d+) nT.*?`ridge=1e-3` leaves\s+(\d+) nT", page, re.DOTALL
    )
    assert [float(word) for word in line] == [round(left[None], 1), round(readings.std()), round(left[1e-3])]
    assert left[None] < 0.6  # the noise of a reading is 0.5 nT
    assert "ridge=1e-3, preset" not in page


def test_the_figures_of_both_reports_are_those_of_the_raw_arrays(calibration):
    run = calibration("figure8", seed=1)
    model = fit_run(run, band_hz=None, ridge=1e-6)
    vector, field = (
        run["b_vector_measured_nt"],
        run["b_measured_nt"] - run["b_map_nt"],
    )
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


def test_the_preset_magnav_drops_the_terms_along_z_and_takes_a_bias():
    b, readings = figure_of_merit_flight(10.0)
    _, names = design_matrix(b, 10.0, ("induced5", "eddy8", "bias"), preset="magnav")
    assert "induced yy" in names
    assert not {"induced zz", "eddy zdz"} & set(names)
    both = [
        fit_tolles_lawson(readings, b, 10.0, terms=terms, preset="magnav").compensate(readings, b, 10.0)
        for terms in (("permanent", "induced6", "eddy9"), ("permanent", "induced6", "eddy9", "bias"))
    ]
    assert np.std(both[0] - both[1]) < 0.5
