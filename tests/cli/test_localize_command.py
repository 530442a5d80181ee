"""`magtwin localize` and `magtwin new localizer.py`: what a user types, and what is printed and written."""

import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import magtwin as mt
from magtwin.cli import main
from magtwin.errors import InputError, MismatchWarning
from magtwin.files.file import shipped
from magtwin.learn.data.labels import labelled
from magtwin.learn.inference.magnetometer import NeuralMagnetometer
from magtwin.localization.readings import onboard
from magtwin.tasks.localizing import localization, prior_of, thinned


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run in the shipped lab, and a localizer that `magtwin new` wrote."""
    folder = tmp_path_factory.mktemp("localize")
    main(["run", "lab", "--duration-s", "20", "--seed", "3", "--out", str(folder / "run.parquet"), "--quiet"])
    main(["new", str(folder / "my_filter.py"), "--quiet"])
    return folder


@pytest.fixture
def here(place: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(place)
    monkeypatch.setattr(sys, "path", list(sys.path))
    return place


def test_a_new_localizer_runs_as_it_stands_and_beats_dead_reckoning(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["localize", "run.parquet", "--map", "lab", "--method", "my_filter:MyLocalizer"]
    main([*arguments, "--option", "particles=1000", "--out", "out"])
    printed = capsys.readouterr().out
    names = {file.name for file in (here / "out").iterdir()}
    drawn = {"localize.rrd", "localize.png", "localize.html"}
    assert names == {"run.parquet", "estimate.tum", "truth.tum"} | drawn
    result = localization("run.parquet", "lab", method="my_filter:MyLocalizer", options={"particles": 1000})
    assert result.scores is not None
    assert result.scores.rmse_m < 0.15
    assert printed.splitlines()[1] == result.report().verdict
    assert result.report().verdict.startswith("Better than dead reckoning: ")
    run = mt.load_run(here / "out" / "run.parquet")
    assert run.metadata["localizer"] == "my_filter:MyLocalizer"
    for name in ("est_p_world_base", "est_yaw", "est_covariance", "est_lost"):
        np.testing.assert_array_equal(run[name], result.run[name])
    truth = np.loadtxt(here / "out" / "truth.tum")
    np.testing.assert_allclose(truth[:, 1:3], run["p_world_base"][:, :2], atol=1e-8)


def test_without_a_map_it_is_slam_and_has_no_bound(here: Path) -> None:
    main(["localize", "run.parquet", "--map", "none", "--method", "odometry", "--out", "slam", "--quiet"])
    result = localization("run.parquet", None, method="odometry")
    assert result.bounds is None
    assert "bound" not in {figure.name for figure in result.report().figures}
    assert (here / "slam" / "localize.png").stat().st_size > 10_000


def test_without_a_true_pose_it_estimates_and_gives_no_verdict(here: Path) -> None:
    run = mt.load_run("run.parquet").select("t", "b_measured_nt", "odom_p", "odom_q_xyzw")
    run.save("bare.parquet", force=True)
    with pytest.raises(InputError, match="no true pose to start from; give a `prior`"):
        localization("bare.parquet", "lab", method="odometry")
    words = ["localize", "bare.parquet", "--map", "lab", "--method", "odometry", "--prior=0,0,0.8"]
    main([*words, "--out", "bare", "--quiet"])
    assert not (here / "bare" / "truth.tum").exists()
    result = localization("bare.parquet", "lab", method="odometry", prior="0,0,0.8")
    assert result.report().verdict == "No verdict: the run has no true pose to compare with."


def test_motion_capture_with_gaps_is_what_errors_count_against(here: Path) -> None:
    whole = mt.load_run("run.parquet")
    onboard = whole.select("t", "b_measured_nt", "odom_p", "odom_q_xyzw")
    lost = (whole["t"] > 10) & (whole["t"] < 10.5)
    p = np.where(lost[:, None], 99.0, whole["p_world_base"])  # the last pose is held: anything
    captured = onboard.with_columns(mocap_p=p, mocap_q_xyzw=whole["q_world_base_xyzw"], flag_pose_lost=lost)
    exact, result = (localization(each, "lab", method="ekf", prior="tracking") for each in (whole, captured))
    np.testing.assert_allclose(result.track.pose, exact.track.pose)
    known = ~result.run["flag_pose_lost"]
    off = np.hypot(*(exact.track.pose - exact.truth)[known, :2].T)
    assert 0 < np.count_nonzero(~known) < 5
    assert result.scores.rmse_m == pytest.approx(np.sqrt(np.mean(off**2)))
    assert result.scores.bound_m["correlated"] == pytest.approx(exact.scores.bound_m["correlated"], rel=0.05)
    said = result.report().metadata["errors"]
    assert said == f"differences from the pose of motion capture (mocap_p), known at {known.sum()} of them"
    assert exact.report().metadata["errors"] == "differences from the true pose"
    recorded = whole.with_columns(flag_pose_lost=lost).with_metadata(truth="motion capture, /vrpn/pose")
    said = localization(recorded, "lab", method="ekf", prior="tracking").report().metadata["errors"]
    assert said == f"differences from the pose of motion capture, /vrpn/pose, known at {known.sum()} of them"
    away = captured.with_columns(flag_pose_lost=whole["t"] < 5)
    assert localization(away, "lab", method="odometry", prior="0,0,0.8").bounds is None
    with pytest.raises(InputError, match="no true pose at its first reading"):
        localization(away, "lab", method="odometry")


def test_a_network_predicts_the_own_field_at_the_poses_of_a_first_pass(here: Path) -> None:
    weights = str(shipped("weights", "turtlebot4_hybrid.safetensors"))
    run = thinned(mt.load_run("run.parquet"), 5.0)
    plain, result = (
        localization(run, "lab", method=method, compensator=how)
        for method, how in (("rbpf-iron", "none"), ("rbpf-network", weights))
    )
    at = onboard(run).with_columns(
        p_world_base=np.pad(plain.track.pose[:, :2], ((0, 0), (0, 1))), yaw=plain.track.pose[:, 2]
    )
    (peer,) = NeuralMagnetometer.load(weights).read([labelled(at, plain.problem.belief)], outside=False)
    known = np.isfinite(peer.disturbance_nt)
    assert known.mean() > 0.9
    np.testing.assert_allclose(
        result.run["disturbance_nt"][known],
        peer.disturbance_nt[known],
        atol=1e-3 * np.ptp(peer.disturbance_nt),
    )
    paper = str(shipped("weights", "turtlebot4_paper.safetensors"))
    with pytest.raises(InputError, match="the network reads battery_fraction, which a localizer is not told"):
        localization(
            run.select(*(set(run) - {"battery_fraction"})), "lab", method="rbpf-network", compensator=paper
        )
    with pytest.raises(InputError, match="so it needs a map"):
        localization(run, None, method="rbpf-network", compensator=weights)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--method", "odometri"], "no localizer 'odometri'; did you mean 'odometry'?"),
        (["--method", "my_filter:MyLocaliser"], "did you mean 'MyLocalizer'?"),
        (["--method", "../filters:Thing"], "give MODULE:CLASS, without folders and .py"),
        (["--method", "filters.py:Thing"], "give MODULE:CLASS, without folders and .py"),
        (["--method", "nowhere:Thing"], "'nowhere:Thing' cannot be imported: ModuleNotFoundError"),
        (["--method", "odometry", "--option", "speed=3"], "has no option 'speed'; it has none"),
        (["--method", "my_filter:MyLocalizer", "--option", "particls=3"], "did you mean 'particles'?"),
        (["--prior", "glob"], "no prior 'glob'; did you mean 'global'?"),
        (["--prior", "9,0,0"], "the --prior x, y = 9, 0 m is off the floor"),
        (["--prior", "1,a,0"], "a --prior is x,y,yaw [m, m, rad], got '1,a,0'"),
        (["--map", "lap"], "lap: no map layer, stage, folder of CSVs or shipped scene"),
        (["--rate-hz", "0"], "--rate-hz must be above 0 Hz, got 0.0"),
        (["--sensor", "whit_nt=3"], "--sensor has no 'whit_nt'; did you mean 'white_nt'?"),
        (["--sensor", "white_nt=much"], "--sensor white_nt is a number, got 'much'"),
        (["--sensor", "lever_arm_m=0.1"], "lever_arm_m is two numbers [m]"),
        (["--sensor", "white_nt=1e300"], "white_nt of SensorModel must be finite"),
        (["--seed", "-1"], "--seed must be a whole number from 0 up, got -1"),
        (["--odometry", "yaw_std=-1"], "--odometry yaw_std of OdometryModel must be finite and not negative"),
    ],
)
def test_a_wrong_input_is_refused_in_one_line(
    here: Path, refusal: Callable[..., str], given: list[str], said: str
) -> None:
    arguments = ["localize", "run.parquet", "--quiet"]
    for option, default in (("--map", "lab"), ("--method", "odometry"), ("--out", "refused")):
        arguments += [] if option in given else [option, default]
    assert said in refusal(*arguments, *given)
    assert not (here / "refused").exists()


def test_a_run_off_the_map_or_without_odometry_is_refused(here: Path) -> None:
    run, field = mt.load_run("run.parquet"), mt.open_twin("lab").field
    far = dataclasses.replace(field, origin_m=(50.0, 50.0), harmonic=None, name="far")
    with pytest.raises(InputError, match=r"off the map: 0% .* on map 'far', which covers x 50.00 to 56.00 m"):
        localization(run, far, method="odometry")
    half = dataclasses.replace(field, origin_m=(-4.2, -1.75), harmonic=None, name="half")
    with pytest.warns(MismatchWarning, match="readings are off the map or on masked nodes"):
        localization(run, half, method="odometry", prior="0,0,0.8")
    without = mt.Run({name: run[name] for name in run if not name.startswith("odom_")}, run.metadata)
    with pytest.raises(InputError, match="no column 'odom_p', which localization needs"):
        localization(without, field, method="odometry")


def test_a_map_of_another_checksum_is_told_of(here: Path) -> None:
    field = mt.open_twin("lab").field
    other = dataclasses.replace(field, values_nt=field.values_nt + 5, harmonic=None, name="other")
    other.save("other.usdc", force=True)
    with pytest.warns(MismatchWarning, match="map 'other' is not the map 'lab' of scene 'lab'"):
        localization("run.parquet", "other.usdc", method="odometry")


def test_a_prior_is_drawn_about_the_truth_with_the_spread_that_it_states(here: Path) -> None:
    run = thinned(mt.load_run("run.parquet"), 5.0)
    true = np.array([*run["p_world_base"][0, :2], run["yaw"][0]])
    drawn = [prior_of(run, seed=seed) for seed in range(300)]
    z = (np.array([prior.mean for prior in drawn]) - true) / drawn[0].sd
    np.testing.assert_allclose(z.mean(axis=0), 0, atol=4 / np.sqrt(300))
    np.testing.assert_allclose(z.std(axis=0), 1, atol=0.17)  # 4 standard deviations of a spread of 300 draws
    headings = [prior_of(run, "heading", seed=seed) for seed in range(100)]
    away = np.degrees([prior.mean[2] - true[2] for prior in headings])
    assert np.abs(away).max() <= 10
    assert np.abs(away).max() > 8
    assert all(prior.is_global for prior in headings)
    assert prior_of(run, "global").sd == (np.inf,) * 3
    assert prior_of(run, "1,-2,0.5").mean == (1.0, -2.0, 0.5)
