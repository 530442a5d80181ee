"""Occupancy grids of labs: what the LiDAR sees is occupied, and map_server reads what is written."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.frames import quat_from_yaw
from magtwin.path.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, occupancy_of
from magtwin.path.room import Room
from magtwin.sim.sensors.lidar import ray_angles, scan
from magtwin.spec.lab import LabSpec
from magtwin.spec.obstacles import Obstacles
from magtwin.twin import open_twin, room_of


def at(grid: OccupancyGrid, p: np.ndarray) -> np.ndarray:
    """Values of the cells that hold points."""
    column, row = np.floor((p - grid.origin_m) / grid.resolution_m).astype(int).T
    return grid.cells[row, column]


def triangle(x: float, y: float, turn: float, size: float) -> np.ndarray:
    angle = turn + np.array([0.0, 2.2, 4.1])
    return np.array([x, y]) + size * np.column_stack([np.cos(angle), np.sin(angle)])


@settings(max_examples=25, deadline=None)
@given(
    x=st.floats(-3, 3), y=st.floats(-2, 2), turn=st.floats(0, 6.3), size=st.floats(0.002, 0.8),
    resolution=st.sampled_from([0.02, 0.05, 0.1]),
)  # fmt: skip
def test_outlines_are_occupied_and_nothing_that_is_farther_than_a_cell(x, y, turn, size, resolution) -> None:
    obstacles = Obstacles(("thing",), (triangle(x, y, turn, size),))
    grid = occupancy_of(Room(LabSpec(floor_m=(6.0, 3.5)), 0.17, obstacles), resolution_m=resolution)
    corners = obstacles.outlines[0]
    assert (at(grid, corners + 1e-6 * (corners.mean(0) - corners)) == OCCUPIED).all()
    assert at(grid, corners.mean(0)[None])[0] == OCCUPIED or size < resolution
    rows, columns = np.nonzero(grid.cells == OCCUPIED)
    centres = np.array(grid.origin_m) + (np.column_stack([columns, rows]) + 0.5) * resolution
    distance, _ = obstacles.clearance(centres)
    assert distance.max() <= resolution / np.sqrt(2) + 1e-6
    inside = np.argwhere(grid.cells == FREE)[:, ::-1]
    p = np.array(grid.origin_m) + (inside + 0.5) * resolution
    assert (np.abs(p) <= np.array([3.0, 1.75]) + 1e-9).all()


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (1.3, -0.9, 0.7), (-2.4, 1.2, -2.0)])
def test_rays_of_the_lidar_end_in_occupied_cells_and_pass_through_free_ones(pose) -> None:
    twin = open_twin("lab", magnetometer="map-only")
    grid, spec = occupancy_of(room_of(twin)), twin.scene.robot.lidar
    x, y, yaw = pose
    ranges = scan(twin.obstacles, ((x, y, 0.19), quat_from_yaw(yaw)), spec)
    angles = ray_angles(spec.rays) + yaw
    hit = np.isfinite(ranges)
    assert hit.mean() > 0.9
    ray = np.column_stack([np.cos(angles), np.sin(angles)])[hit]
    assert (at(grid, np.array([x, y]) + (ranges[hit, None] + 1e-3) * ray) == OCCUPIED).all()
    before = at(grid, np.array([x, y]) + (ranges[hit, None] - grid.resolution_m) * ray)
    assert (before == FREE).mean() > 0.9  # but where a ray grazes a wall


def test_map_server_reads_the_files(tmp_path: Path) -> None:
    cells = np.array([[FREE, FREE, OCCUPIED], [UNKNOWN, FREE, UNKNOWN]], np.int8)
    file, picture = OccupancyGrid(cells, 0.05, (-1.0, 2.0)).save(tmp_path / "lab.yaml")
    told = yaml.safe_load(file.read_text())
    assert (told["image"], told["resolution"], told["origin"]) == (picture.name, 0.05, [-1.0, 2.0, 0.0])
    assert told["mode"] == "trinary"
    # map_server: occupancy (255 - grey) / 255, occupied above one threshold, free below the other
    share = (255 - np.asarray(Image.open(picture), float)[::-1]) / 255
    read = np.full(share.shape, UNKNOWN)
    read[share > told["occupied_thresh"]] = OCCUPIED
    read[share < told["free_thresh"]] = FREE
    np.testing.assert_array_equal(read, cells)
    with pytest.raises(InputError, match="exists already"):
        OccupancyGrid(cells, 0.05, (0.0, 0.0)).save(tmp_path / "lab.yaml")


def test_wrong_resolutions_and_suffixes_are_refused(tmp_path: Path) -> None:
    room = Room(LabSpec(floor_m=(6.0, 3.5)), 0.17, Obstacles())
    for resolution, match in ((0.0, "above 0"), (np.nan, "above 0"), (1e-4, "too many")):
        with pytest.raises(InputError, match=match):
            occupancy_of(room, resolution_m=resolution)
    with pytest.raises(InputError, match=r"is a \.yaml file"):
        occupancy_of(room).save(tmp_path / "lab.pgm")


def test_the_command_writes_both_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["map", "occupancy", "lab", "--out", str(tmp_path / "map.yaml"), "--resolution-m", "0.1"])
    assert "OccupancyGrid: " in capsys.readouterr().out
    assert {file.name for file in tmp_path.iterdir()} == {"map.yaml", "map.pgm"}
    with pytest.raises(SystemExit):
        main(["map", "occupancy", "lab", "--out", str(tmp_path / "map.png")])
