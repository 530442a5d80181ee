"""The whole way on the real laboratory: APRILab's survey, released network and released path."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from magtwin.cli import main


@pytest.fixture(scope="session")
def real_run(tmp_path_factory):
    """A Run of the real laboratory, made by the commands of the README; (run, folder of the real data)."""
    from conftest import REAL

    from magtwin.io.tables import read_parquet

    if not REAL.is_dir():
        pytest.skip(f"the real data are not at {REAL}; `magtwin fetch` gets them for use by hand")
    real, out = REAL / "aprilab", tmp_path_factory.mktemp("aprilab")
    magtwin = lambda *arguments: main([str(a) for a in arguments])  # noqa: E731
    magtwin("map", "import", real / "maps", "--out", out / "aprilab.usdc", "--licence", "MIT")
    magtwin(
        "net",
        "convert",
        real / "models" / "nn_magnetometer_model_v0.0.1.pth",
        "--out",
        out / "released.safetensors",
    )
    magtwin(
        *("scene", "aprilab", "--out", out / "scene"),
        *("--map", out / "aprilab.usdc", "--net", out / "released.safetensors"),
    )
    magtwin(
        *("run", out / "scene" / "aprilab.usda", "--path", real / "paths" / "figure8_path.csv"),
        *("--parquet", out / "run.parquet"),
    )
    return read_parquet(out / "run.parquet"), real


def test_the_map_column_is_what_scipy_interpolates_from_the_survey(real_run):
    from scipy.interpolate import RegularGridInterpolator

    run, real = real_run
    tables = [np.loadtxt(real / "maps" / f"{h}_map.csv", delimiter=",") for h in (0, 90, 180, 270)]
    grids = [t[:, 3].reshape(15, 25) for t in tables]
    closed = np.stack([*grids, grids[0]])
    x, y = np.linspace(-3, 3, 25), np.linspace(-1.75, 1.75, 15)
    scipy_map = RegularGridInterpolator((np.arange(5) * np.pi / 2, y, x), closed)
    p = run["p_world_base"]
    expected = scipy_map(np.column_stack([run["yaw"] % (2 * np.pi), p[:, 1], p[:, 0]]))
    assert run.rows > 6000
    assert_allclose(run["b_map_nt"], expected, atol=0.01, rtol=0)  # map values are float32: steps of 0.004 nT


def test_the_disturbance_column_is_what_torch_predicts_from_the_twenty_signals(real_run):
    import torch

    from magtwin.learn.checkpoint import read_checkpoint

    run, real = real_run
    odometry, imu = np.hstack([run["odom_v"], run["odom_w"]]), np.hstack([run["imu_w"], run["imu_a"]])
    x = np.column_stack(
        [
            np.degrees(run["yaw"]) % 360,
            odometry,
            run["imu_q_xyzw"],
            imu,
            run["battery_v"],
            run["battery_fraction"],
            run["lidar_on"],
        ]
    )
    assert x.shape[1] == 20
    released = read_checkpoint(real / "models" / "nn_magnetometer_model_v0.0.1.pth")
    layers = []
    for weight, bias in released.layers:
        linear = torch.nn.Linear(weight.shape[1], weight.shape[0], dtype=torch.float64)
        linear.weight.data, linear.bias.data = torch.tensor(weight).double(), torch.tensor(bias).double()
        layers += [linear, torch.nn.ReLU()]
    with torch.no_grad():
        z = torch.nn.Sequential(*layers[:-1])(torch.tensor((x - released.x_mean) / released.x_scale))
    expected = released.y_mean + released.y_scale * z.squeeze(-1).numpy()
    assert_allclose(run["b_disturbance_nt"], expected, atol=0.05, rtol=0)


def test_the_total_field_stays_within_what_the_laboratory_can_have(real_run):
    run, _ = real_run
    total = run["b_total_nt"]
    assert_allclose(total, run["b_map_nt"] + run["b_disturbance_nt"], rtol=1e-15)
    assert total.min() > 34_000
    assert total.max() < 55_000


def test_the_command_line_gives_the_same_bytes_for_one_seed_and_others_for_another(
    tmp_path, lab_scene, capsys
):
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        main(["run", str(lab_scene), "--seed", str(seed), "--parquet", str(tmp_path / name), "--json"])
        facts = json.loads(capsys.readouterr().out)["facts"]
        assert facts["seed"] == seed
    a, b, c = ((tmp_path / name).read_bytes() for name in "abc")
    assert a == b
    assert a != c
