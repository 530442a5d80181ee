from dataclasses import replace

import numpy as np
import pytest
from places import DATA

from magtwin.errors import InputError
from magtwin.urdf.description.description import read_description
from magtwin.urdf.description.model import Geometry
from magtwin.urdf.lint import lint

URDF = DATA / "urdf"


def doubts(name, **options):
    return lint(read_description(URDF / f"lint_{name}.urdf"), **options)


DOUBTS = {
    "dummies": ["frames with a mass of 0.01 kg and no shape, 0.02 kg in all (2): camera, imu"],
    "frame_outside": ["link 'button' at (0, 0.5, 0) m lies 0.4 m outside of the body"],
    "sides_swapped": [
        "link 'bump_left' is at y = -0.15 m and 'bump_right' at 0.15 m: swapped? left is +y (REP-103)"
    ],
    "stuck": [
        "joint 'drop' (prismatic) has an effort of 0 and velocity of 0: it cannot be driven",
        "joint 'drop' (prismatic) has both limits at 0.1: it cannot move",
    ],
    "too_large_inertia": [
        "link 'base_link' has a moment of inertia of 0.04 kg m2; no 1 kg within its shapes can have "
        "above 0.03"
    ],
    "too_small_inertia": [
        "link 'base_link' has a largest moment of inertia of 0.0001 kg m2; 1 kg spread over its shapes would "
        "have about 0.00667"
    ],
    "centre_outside": ["link 'base_link' has its centre of mass 0.4 m outside of its shapes"],
    "too_dense": ["link 'base_link' weighs 10 kg in 1e+03 cm3 or less: 10000 kg/m3, above copper"],
    "fine": [],
}
"""What is said of each file `lint_*`, all of its doubts."""


@pytest.mark.parametrize("name", DOUBTS)
def test_each_doubtful_input_raises_exactly_its_doubts(name):
    assert list(doubts(name)) == DOUBTS[name]


def test_every_doubtful_input_has_its_lines():
    assert {f"lint_{name}.urdf" for name in DOUBTS} == {p.name for p in URDF.glob("lint_*")}


def test_the_mass_is_compared_with_a_data_sheet_within_5_percent():
    assert doubts("fine", mass=1.04) == ()
    assert doubts("fine", mass=0.5) == ("the links weigh 1 kg in all, the data sheet says 0.5 kg (+100%)",)


def test_a_mesh_counts_where_it_can_be_read():
    description = read_description(URDF / "lint_fine.urdf")
    base = description.links["base_link"]
    mesh = Geometry("mesh", np.ones(1), filename="cube")
    visuals, collisions = (
        tuple(replace(part, geometry=mesh) for part in parts) for parts in (base.visuals, base.collisions)
    )
    base = replace(base, visuals=visuals, collisions=collisions)
    description = replace(description, links={**description.links, "base_link": base})
    cube = 0.01 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    lines = lint(description, vertices=lambda mesh: cube)
    assert [line.split(";")[0] for line in lines] == [
        "link 'top' at (0, 0, 0.1) m lies 0.09 m outside of the body",
        "link 'base_link' has a moment of inertia of 0.00667 kg m2",
        "link 'base_link' weighs 1 kg in 8 cm3 or less: 125000 kg/m3, above copper",
    ]

    def missing(mesh):
        raise InputError("missing")

    assert lint(description, vertices=missing) == lint(description) == ()


def test_the_real_robots_known_faults_are_found(real_data):
    description = read_description(real_data / "turtlebot4" / "turtlebot4.urdf")
    lines = lint(description, mass=3.945)
    assert lines[0].startswith("frames with a mass of 0.01 kg and no shape, 0.21 kg in all (21): imu_link")
    assert lines[1:7] == (
        "link 'button_1' at (0.06, 0.37, 0.1442) m lies 0.206 m outside of the body",
        "link 'button_2' at (0.06, -0.37, 0.1442) m lies 0.206 m outside of the body",
        "link 'bump_front_left' is at y = -0.0875 m and 'bump_front_right' at 0.0875 m: swapped? left is "
        "+y (REP-103)",
        "link 'bump_left' is at y = -0.1515 m and 'bump_right' at 0.1515 m: swapped? left is +y (REP-103)",
        *(
            f"joint 'wheel_drop_{side}_joint' (prismatic) has an effort of 0 and velocity of 0: it cannot be "
            "driven"
            for side in ("left", "right")
        ),
    )
    assert sum("tower_standoff' has a largest moment of inertia of 5.26e-05" in line for line in lines) == 4
    assert lines[-1] == "the links weigh 5.39 kg in all, the data sheet says 3.945 kg (+37%)"
    assert len(lines) == 12
