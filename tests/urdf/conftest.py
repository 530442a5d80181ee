"""What several files of this folder read and none changes: the real robot, converted once."""

import pytest

from magtwin.urdf.convert import convert_with_report


@pytest.fixture(scope="session")
def real_robot(real_data, tmp_path_factory):
    """Description, root layer and report of the real TurtleBot 4."""
    return _converted(real_data, tmp_path_factory, "turtlebot4")


@pytest.fixture(scope="session")
def tagged_robot(real_data, tmp_path_factory):
    """The same with Gazebo's tags, and boxes in the place of two meshes that upstream lacks."""
    return _converted(real_data, tmp_path_factory, "turtlebot4_gazebo_tags")


def _converted(real_data, tmp_path_factory, name):
    path = real_data / "turtlebot4" / f"{name}.urdf"
    out = tmp_path_factory.mktemp(name) / "turtlebot4" / "turtlebot4.usda"
    return path, out, convert_with_report(path, out)
