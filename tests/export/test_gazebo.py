"""Worlds of Gazebo: what stands in the SDF is what stands in the lab."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.export.gazebo import export_world
from magtwin.twin import open_twin


def numbers(element: ElementTree.Element | None) -> np.ndarray:
    assert element is not None
    assert element.text
    return np.array(element.text.split(), float)


def footprint(link: ElementTree.Element) -> np.ndarray:
    """Corners of a link's collision in world, shape (K, 2)."""
    pose = numbers(link.find("pose"))
    box = link.find("collision/geometry/box/size")
    if box is None:
        assert not pose[:3].any()
        return np.array([numbers(point) for point in link.iterfind("collision/geometry/polyline/point")])
    x, y, height = numbers(box)
    assert pose[2] == pytest.approx(height / 2)  # it stands on the floor
    corners = np.array([[-x, -y], [x, -y], [x, y], [-x, y]]) / 2
    c, s = np.cos(pose[5]), np.sin(pose[5])
    return corners @ np.array([[c, s], [-s, c]]) + pose[:2]


def test_every_obstacle_of_the_lab_stands_in_the_world_where_it_stands_in_the_lab(tmp_path: Path) -> None:
    twin = open_twin("lab", magnetometer="map-only")
    root = ElementTree.parse(export_world(twin.scene_file, tmp_path / "lab.sdf")).getroot()
    links = root.findall("world/model[@name='obstacles']/link")
    assert len(links) == len(twin.obstacles)
    assert len({link.get("name") for link in links}) == len(links)  # SDF refuses names used twice
    kinds = set()
    for link, outline in zip(links, twin.obstacles.outlines, strict=True):
        corners = footprint(link)
        away = np.hypot(*(corners[:, None] - outline).transpose(2, 0, 1))
        assert max(away.min(axis=0).max(), away.min(axis=1).max()) < 1e-6
        parts = {
            part: ElementTree.tostring(element)
            for part in ("collision", "visual")
            if (element := link.find(f"{part}/geometry")) is not None
        }
        assert parts["collision"].strip() == parts["visual"].strip()
        kinds.add(len(outline) == 4)
    assert kinds == {True, False}  # boxes and prisms
    earth = twin.scene.earth
    assert earth is not None
    np.testing.assert_allclose(numbers(root.find("world/magnetic_field")) * 1e9, earth.b_world_nt, rtol=1e-7)


def test_the_command_writes_a_world_and_refuses_what_it_cannot_hold(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "lab.sdf"
    main(["export", "lab", "--out", str(out)])
    assert ElementTree.parse(out).getroot().tag == "sdf"
    with pytest.raises(SystemExit):
        main(["export", "lab", "--target", "gazebo", "--run", "a.parquet", "--out", str(tmp_path / "b.sdf")])
    assert "plays no run" in capsys.readouterr().err
    with pytest.raises(InputError, match=r"is a \.sdf file"):
        export_world("lab.usda", tmp_path / "lab.world")
