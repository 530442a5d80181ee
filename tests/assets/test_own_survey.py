"""docs/own.md as it stands: a survey and a robot of one's own, from an empty folder to right readings."""

import re
import shlex
from pathlib import Path

import magpylib
import numpy as np
import pytest
from places import DOCS

from magtwin.cli import main
from magtwin.io.tables import read_parquet
from magtwin.usd.scene import read_scene

PAGE = DOCS / "own.md"
EARTH_NT = np.array([-1_800.0, 21_500.0, -43_000.0])
HARD_NT = np.array([350.0, -220.0, 500.0])
"""The surveying robot's own field, which the map then holds."""

ARM = np.array([-0.1, 0.0, 0.56])


def blocks(kind: str) -> list[str]:
    """The page's fenced blocks of a language."""
    found = re.findall(r"^```(\w*)\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.M | re.S)
    return [text for language, text in found if language == kind]


def steel() -> magpylib.Collection:
    rng = np.random.default_rng(11)
    places = np.column_stack(
        [rng.uniform(-2.8, 2.8, 30), rng.uniform(-2.3, 2.3, 30), rng.uniform(-0.6, -0.2, 30)]
    )
    moments = rng.normal(0, 6.0, (30, 3))
    return magpylib.Collection(
        [magpylib.misc.Dipole(position=p, moment=m) for p, m in zip(places, moments, strict=True)]
    )


def reading_nt(x: np.ndarray, y: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """What the robot reads at poses, by magpylib."""
    c, s = np.cos(yaw), np.sin(yaw)
    at = np.column_stack([x + c * ARM[0], y + s * ARM[0], np.full(len(x), ARM[2])])
    b = 1e9 * np.asarray(steel().getB(at)) + EARTH_NT
    body = np.column_stack([c * b[:, 0] + s * b[:, 1], c * b[:, 1] - s * b[:, 0], b[:, 2]])
    return np.linalg.norm(body + HARD_NT, axis=1)


def write_survey(file: Path, rows: int = 220) -> None:
    """A drive over a room of 5 x 4 m, its field in uT."""
    rng = np.random.default_rng(3)
    t = np.arange(rows) * 1.0
    x, y = 2.3 * np.sin(0.31 * t), 1.8 * np.sin(0.223 * t + 1.0)
    yaw = np.angle(np.exp(1j * (0.83 * t)))
    b = reading_nt(x, y, yaw) + rng.normal(0, 20, rows)
    lines = [
        f"{1763800000 + a:.3f},{b_:.4f},{c:.4f},{d:.4f},{e:.4f}"
        for a, b_, c, d, e in zip(t, x, y, yaw, b / 1e3, strict=True)
    ]
    file.write_text("\n".join(["timestamp,x,y,yaw,b_total", *lines]) + "\n")


@pytest.fixture(scope="module")
def followed(tmp_path_factory):
    """The folder after every command of the page, and what they printed."""
    folder = tmp_path_factory.mktemp("own")
    write_survey(folder / "survey.csv")
    (folder / "my_robot.urdf").write_text(blocks("xml")[0])
    (folder / "mine.toml").write_text(blocks("toml")[0])
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for command in "".join(blocks("")).splitlines():
            name, *words = shlex.split(command)
            assert name == "magtwin"
            if words[0] != "plot":  # needs OpenGL
                main(words)
    return folder


def test_the_page_ends_in_readings_of_the_field_that_was_surveyed(followed):
    run = read_parquet(followed / "run" / "run.parquet")
    met = np.isfinite(run["b_measured_nt"])
    assert met.mean() > 0.5
    assert np.ptp(run["p_world_base"], axis=0)[:2].max() > 1.0
    want = reading_nt(*run["p_world_base"][met, :2].T, run["yaw"][met])
    off = run["b_measured_nt"][met] - want
    assert np.ptp(want) > 1_000, "the way is worth a map"
    assert np.sqrt(np.mean(off**2)) < 80, "nT"
    assert str(run.metadata["truth"]).startswith("the fitted map; platform field from the robot's spec")
    assert run.metadata["magnetometer"] == "physical"


def test_the_page_ends_in_the_robot_that_the_urdf_describes(followed):
    robot = read_scene(followed / "mine" / "mine.usda").robot
    drive = robot.drive
    assert (drive.left_wheel_joint, drive.right_wheel_joint) == ("left_wheel_joint", "right_wheel_joint")
    assert drive.wheel_separation_m == pytest.approx(0.32, abs=1e-4)
    assert drive.wheel_radius_m == pytest.approx(0.07, abs=1e-4)
    assert robot.base_height_m == pytest.approx(0.07, abs=1e-4)
    assert robot.p_base_magnetometer == pytest.approx((-0.1, 0.0, 0.49))
    assert robot.footprint_radius_m == pytest.approx(np.hypot(0.18, 0.175), abs=1.1e-3)
