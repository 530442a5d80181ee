"""TUM files, read by evo."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from magtwin.errors import InputError
from magtwin.frames import quat_from_yaw
from magtwin.localization.scores import score
from magtwin.localization.track import EST_COLUMNS, Track
from magtwin.localization.tum import save_tum, save_tum_folder
from magtwin.run.run import Run


@pytest.fixture
def made():
    t = 1.7e9 + np.arange(300) / 5  # a clock of today
    truth = np.column_stack([np.cos(t / 9), np.sin(t / 7), t / 9])
    rng = np.random.default_rng(0)
    pose = truth + rng.normal(0, 0.1, truth.shape) + (0.05, 0.2, 0.3)
    n = len(t)
    return Track(t, pose, np.full((n, 3, 3), np.nan), np.zeros(n), np.zeros(n, bool)), truth


def test_evo_finds_our_errors_without_alignment(made, tmp_path):
    metrics = pytest.importorskip("evo.core.metrics", reason="evo is not installed (extra dev)")
    from evo.core import sync
    from evo.tools import file_interface

    track, truth = made
    files = [
        save_tum(tmp_path / "truth.tum", track.t, truth),
        save_tum(tmp_path / "estimate.tum", track.t, track.pose),
    ]
    pair = sync.associate_trajectories(*map(file_interface.read_tum_trajectory_file, map(str, files)))
    assert pair[0].num_poses == len(track.t)
    ours = score(track, truth)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data(pair)
    assert ape.get_statistic(metrics.StatisticsType.rmse) == pytest.approx(ours.rmse_m, rel=1e-7)
    assert ape.get_statistic(metrics.StatisticsType.median) == pytest.approx(ours.median_m, rel=1e-6)
    turn = metrics.APE(metrics.PoseRelation.rotation_angle_rad)
    turn.process_data(pair)
    assert turn.get_statistic(metrics.StatisticsType.rmse) == pytest.approx(ours.heading_rad, rel=1e-6)


def test_a_localized_run_becomes_three_files(made, tmp_path):
    track, truth = made
    zero = np.zeros(len(track.t))
    run = Run(
        {
            "t": track.t,
            "p_world_base": np.column_stack([truth[:, :2], zero]),
            "q_world_base_xyzw": quat_from_yaw(truth[:, 2]),
            "odom_p": np.column_stack([truth[:, :2] - truth[0, :2], zero]),
            "odom_q_xyzw": quat_from_yaw(truth[:, 2]),
        }
    )
    with pytest.raises(InputError, match="est_p_world_base"):
        save_tum_folder(run, tmp_path / "none")
    run = run.with_columns(**track.columns()).with_specs(**EST_COLUMNS)
    files = save_tum_folder(run, tmp_path / "tum")
    assert [file.name for file in files] == ["estimate.tum", "truth.tum", "odometry.tum"]
    estimate, true, odometry = (np.loadtxt(file) for file in files)
    assert_allclose(estimate[:, 0], track.t, atol=1e-6)
    assert_allclose(estimate[:, 1:3], track.pose[:, :2], atol=1e-9)
    assert_allclose(true[:, 4:], quat_from_yaw(truth[:, 2]), atol=1e-9)
    assert_allclose(odometry[0, 1:4], 0, atol=1e-9)
    assert files[2].read_text().startswith("# t [s] x y z [m] qx qy qz qw, base_link in odom\n")


def test_poses_that_are_not_finite_are_refused(made, tmp_path):
    track, truth = made
    truth[7, 1] = np.nan
    with pytest.raises(InputError, match="row 7"):
        save_tum(tmp_path / "truth.tum", track.t, truth)
    assert not list(tmp_path.iterdir())
    with pytest.raises(InputError, match=r"\(N, 3\)"):
        save_tum(tmp_path / "truth.tum", track.t, truth[:, :2])
