"""Scene -> USD -> Scene: every figure of every part comes back, none is forgotten."""

from dataclasses import fields, is_dataclass, replace

import pytest

from magtwin.author.scene import author_scene
from magtwin.errors import InputError
from magtwin.files.file import shipped
from magtwin.spec.robot import PlacedRobot
from magtwin.twin import scene_from_toml
from magtwin.usd.scene import read_scene

pytestmark = pytest.mark.usefixtures("allow_neighbours")  # scenes by reference

DERIVED = (
    "base_height_m",
    "p_base_magnetometer",
    "q_base_magnetometer_link_xyzw",
    "q_base_imu_link_xyzw",
    "p_base_lidar",
    "q_base_lidar_link_xyzw",
)
"""Of a robot: where its links and sensors stand, which the stage says by their transforms."""

GIVEN = {"name", "asset", "map_layer", "map_sha256", "link", "left_wheel_joint", "right_wheel_joint"}
"""What names something that must be there."""


def others(value):
    """Values that a field of this one may have in its stead."""
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, int):
        return [value + 1]
    if isinstance(value, float):
        return [value * 1.0625 + 0.03125, value * 0.9375, value + 1e-3]
    if isinstance(value, tuple) and value and all(isinstance(v, float) for v in value):
        turned = [(0.0, 0.0, 0.6, 0.8)] if len(value) == 4 else []
        spread = [tuple(v * 1.0625 + 0.03125 * (i + 1) for i, v in enumerate(value))]
        return [*turned, *spread, tuple(v * 0.9375 + 1e-3 for v in value)]
    return []


def other(spec, left):
    """A spec of which every figure is another; the names of those that cannot be are put into `left`."""
    for field in fields(spec):
        value = getattr(spec, field.name)
        if field.name in GIVEN or field.name in DERIVED:
            continue
        if is_dataclass(value):
            spec = replace(spec, **{field.name: other(value, left)})
            continue
        for candidate in others(value):
            try:
                spec = replace(spec, **{field.name: candidate})
                break
            except InputError:
                continue
        else:
            left.add(f"{type(spec).__name__}.{field.name}")
    return spec


@pytest.fixture(scope="module")
def everything(tmp_path_factory):
    """A scene with two robots, an Earth's field, sources and furniture, in which every figure is another."""
    base, left = scene_from_toml(shipped("scenes", "lab.toml")), set()
    robot = other(base.robot, left)
    second = replace(robot, name="second", footprint_radius_m=0.3)
    scene = replace(
        base,
        name="everything",
        robot=robot,
        lab=other(base.lab, left),
        earth=replace(other(base.earth, left), measured=True),
        sources=tuple(other(source, left) for source in base.sources[:12]),
        furniture=tuple(other(piece, left) for piece in base.furniture),
        start=(0.5, -0.25, 0.0),
        path="sine",
        others=(PlacedRobot(robot=second, start=(-1.0, 0.5, 0.0), path="figure8"),),
    )
    read = read_scene(author_scene(scene, tmp_path_factory.mktemp("scene") / "s", by_reference=True))
    return base, scene, read, left


def parts(spec, path=""):
    """Every figure of a spec, and of the specs in it, by its way there."""
    for field in fields(spec):
        value, way = getattr(spec, field.name), f"{path}{field.name}"
        if field.name in DERIVED:
            continue
        if is_dataclass(value):
            yield from parts(value, f"{way}.")
        elif isinstance(value, tuple) and value and is_dataclass(value[0]):
            for i, one in enumerate(value):
                yield from parts(one, f"{way}[{i}].")
        else:
            yield way, value


def test_every_figure_of_a_scene_comes_back_from_usd(everything):
    _, scene, read, _ = everything
    want, got = dict(parts(scene)), dict(parts(read))
    assert want.keys() == got.keys()
    assert len(want) > 500
    assert {way: got[way] for way in want if got[way] != want[way]} == {}


def test_those_figures_are_none_that_a_default_would_give(everything):
    base, scene, _, left = everything
    before = dict(parts(base))
    same = {
        way
        for way, value in parts(replace(scene, others=()))
        if way.startswith(("robot.", "lab.")) and before[way] == value
    }
    names = {way.rpartition(".")[2] for way in same}
    assert names <= GIVEN | {name.rpartition(".")[2] for name in left}
    # What cannot be another figure: words, and what the scene has none of.
    assert len(left) < 29, sorted(left)
