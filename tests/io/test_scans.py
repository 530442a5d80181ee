"""Scans of a run: through the twin, as a table, in the recording, from the command line."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.testing import assert_array_equal
from rerun.chunk import RrdReader

from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.io.rerun.file import write_rrd
from magtwin.io.rerun.world import SCAN
from magtwin.io.scans import read_scans, write_scans
from magtwin.path import path_named
from magtwin.sim.sensors.lidar import Scans
from magtwin.twin import open_twin, scan, simulate


@pytest.fixture(scope="module")
def twin(lab_scene):
    return open_twin(lab_scene, network="none")


@pytest.fixture(scope="module")
def run(twin):
    return simulate(twin, "figure8", duration_s=6.0, lidar="on", rate_hz=50.0)


@pytest.fixture(scope="module")
def scans(twin, run) -> Scans:
    return scan(twin, run)


def test_in_the_lab_every_scan_sees_the_walls_all_round(twin, run, scans):
    assert len(scans.t) == 45
    assert np.isfinite(scans.ranges_m).all()
    half = np.array(twin.scene.lab.floor_m) / 2
    for points in scans.points_world():
        outside = np.abs(points[:, :2]) - half
        noise = 6 * twin.scene.robot.lidar.range_noise_std_m
        assert outside.max(axis=1).min() > -noise  # on a wall, or beyond it through none
        assert outside.max() < noise + 0.01
    lidar = scans.p_world_lidar[:, 2]
    assert np.ptp(lidar) == 0
    assert lidar[0] == pytest.approx(0.19, abs=0.02)


def test_a_table_of_scans_comes_back_to_the_bit_and_is_written_alike(scans, tmp_path):
    write_scans(scans, tmp_path / "a.parquet")
    write_scans(read_scans(tmp_path / "a.parquet"), tmp_path / "b.parquet")
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()
    back = read_scans(tmp_path / "a.parquet")
    for name in ("t", "arrival", "p_world_lidar", "q_world_lidar_xyzw", "ranges_m"):
        assert_array_equal(getattr(back, name), getattr(scans, name))
    assert pq.read_schema(tmp_path / "a.parquet").field("ranges_m").metadata[b"unit"] == b"m"


def test_what_is_no_table_of_scans_is_refused(scans, tmp_path):
    write_scans(scans, tmp_path / "a.parquet")
    with pytest.raises(InputError, match="exists"):
        write_scans(scans, tmp_path / "a.parquet")
    pq.write_table(pa.table({"t": [1.0]}), tmp_path / "t.parquet")
    with pytest.raises(InputError, match="column 'arrival' is missing"):
        read_scans(tmp_path / "t.parquet")
    (tmp_path / "cut.parquet").write_bytes((tmp_path / "a.parquet").read_bytes()[:-9])
    with pytest.raises(InputError, match="cut short"):
        read_scans(tmp_path / "cut.parquet")


def test_the_recording_holds_every_scan_and_is_cleared_when_the_lidar_stops(twin, run, tmp_path):
    on = (run["t"] < 2.0) | (run["t"] > 4.0)
    scans = scan(twin, run.with_columns(lidar_on=on))
    write_rrd(run, tmp_path / "run.rrd", twin, planned=path_named("figure8"), scans=scans)
    sizes = []
    for chunk in RrdReader(tmp_path / "run.rrd").stream().to_chunks():
        batch = chunk.to_record_batch()
        if chunk.entity_path == f"/{SCAN}" and "sim_time" in batch.schema.names:
            sizes += [len(points) for points in batch.column("Points3D:positions").to_pylist()]
    assert np.count_nonzero(sizes) == len(scans.t)
    assert sizes.count(0) == 2
    assert sum(sizes) == sum(len(points) for points in scans.points_world())


def test_the_command_line_writes_scans_beside_the_run(lab_scene, tmp_path, monkeypatch):
    monkeypatch.setenv("MAGTWIN_RUN_LIDAR", "on")
    run = ["run", str(lab_scene), "--network", "none", "--duration-s", "2", "--scans", "--json"]
    main([*run, "--out", str(tmp_path / "a.parquet")])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.parquet", "a.scans.parquet"]
    assert len(read_scans(tmp_path / "a.scans.parquet").t) == 15
    main([*run, "--out", str(tmp_path / "out")])
    assert {"run.parquet", "run.rrd", "run.scans.parquet"} <= {p.name for p in (tmp_path / "out").iterdir()}
