"""The whole way on the real laboratory: APRILab's survey, released network and released path."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.cli import main


@pytest.fixture(scope="session")
def real_run(real_data, tmp_path_factory):
    """A Run of the real laboratory, made by the commands of the README; (run, folder of the real data)."""
    from magtwin.io.tables import read_parquet

    real, out = real_data / "aprilab", tmp_path_factory.mktemp("aprilab")
    magtwin = lambda *arguments: main([str(a) for a in arguments])  # noqa: E731
    magtwin("map", "import", real / "maps", "--out", out / "aprilab.usdc", "--licence", "MIT")
    magtwin(
        "network",
        "convert",
        real / "models" / "nn_magnetometer_model_v0.0.1.pth",
        "--out",
        out / "released.safetensors",
    )
    magtwin(
        *("scene", "aprilab", "--out", out / "scene"),
        *("--map", out / "aprilab.usdc", "--network", out / "released.safetensors"),
    )
    magtwin(
        *("run", out / "scene" / "aprilab.usda", "--path", real / "paths" / "figure8_path.csv"),
        *("--out", out / "run.parquet"),
    )
    return read_parquet(out / "run.parquet"), real


def test_the_map_column_is_what_scipy_interpolates_and_unknown_beside_latched_nodes(real_run):
    from scipy.interpolate import RegularGridInterpolator

    from magtwin.field.survey.nodes import read_survey

    run, real = real_run
    tables = [np.loadtxt(real / "maps" / f"{h}_map.csv", delimiter=",") for h in (0, 90, 180, 270)]
    grids = [t[:, 3].reshape(15, 25) for t in tables]
    masked = (~read_survey(real / "maps")[0].valid).astype(float)
    x, y = np.linspace(-3, 3, 25), np.linspace(-1.75, 1.75, 15)
    p = run["p_world_base"]
    poses = np.column_stack([run["yaw"] % (2 * np.pi), p[:, 1], p[:, 0]])
    expected, weight = (
        RegularGridInterpolator((np.arange(5) * np.pi / 2, y, x), np.stack([*layers, layers[0]]))(poses)
        for layers in (grids, masked)
    )
    assert run.rows > 6000
    known = weight < 1e-9
    assert_array_equal(run["flag_outside_map"], ~known)
    assert 0.8 < known.mean() < 1  # this path passes the corner where the survey's sensor had lost lock
    assert_allclose(run["b_map_nt"][known], expected[known], atol=0.01, rtol=0)  # float32: steps of 0.004 nT
    for column in ("b_map_nt", "b_total_nt", "b_measured_nt"):
        assert_array_equal(np.isnan(run[column]), ~known)


def test_the_disturbance_column_is_what_torch_predicts_from_the_twenty_signals(real_run):
    import torch

    from magtwin.learn.models.predictor import load_predictor
    from magtwin.learn.training.module import NetModule

    run, real = real_run
    odometry, imu = np.hstack([run["odom_v"], run["odom_w"]]), np.hstack([run["imu_w"], run["imu_a"]])
    others = [run[name] for name in ("battery_v", "battery_fraction", "lidar_on")]
    x = np.column_stack([np.degrees(run["yaw"]) % 360, odometry, run["imu_q_xyzw"], imu, *others])
    assert x.shape[1] == 20
    released = NetModule.of(load_predictor(real / "models" / "nn_magnetometer_model_v0.0.1.pth")).double()
    layers = [part for linear in released.layers for part in (linear, torch.nn.ReLU())]
    with torch.no_grad():
        z = torch.nn.Sequential(*layers[:-1])((torch.tensor(x) - released.x_mean) / released.x_scale)
        expected = (released.y_mean + released.y_scale * z.squeeze(-1)).numpy()
    assert_allclose(run["b_disturbance_nt"], expected, atol=0.05, rtol=0)


def test_the_command_line_gives_the_same_bytes_for_one_seed_and_others_for_another(
    tmp_path, lab_scene, capsys
):
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        out = str(tmp_path / f"{name}.parquet")
        main(["run", str(lab_scene), "--seed", str(seed), "--out", out, "--json"])
        metadata = json.loads(capsys.readouterr().out)["metadata"]
        assert metadata["seed"] == seed
    a, b, c = ((tmp_path / f"{name}.parquet").read_bytes() for name in "abc")
    assert a == b
    assert a != c
