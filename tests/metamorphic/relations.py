"""Surveys and maps in other places, axes and orders, for relations between results."""

from dataclasses import replace

import numpy as np

from magtwin.field.grid import Grid
from magtwin.field.sources.harmonic import HarmonicField

SHIFT = np.array([3.0, -2.0])


def rotation(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def room():
    """A room of 2.2 x 1.8 m over dipoles in its floor, as a robot with hard iron reads it."""
    rng = np.random.default_rng(0)
    return HarmonicField(
        p_world_dipole=rng.uniform((-1.2, -1.0, -0.8), (1.2, 1.0, -0.2), (6, 3)),
        m_world=rng.normal(scale=6.0, size=(6, 3)),
        b_uniform_nt=(-2_745.6, 24_067.1, -38_418.4),
        hard_iron_nt=(300.0, -200.0, 150.0),
        soft_iron=np.zeros((3, 3)),
        p_base_sensor=(0.0, 0.0, 0.4),
    )


def moved(survey):
    """The survey, moved by `SHIFT`."""
    grid = survey.grid
    if grid is not None:
        x, y = np.array(grid.origin_m) + SHIFT
        grid = replace(grid, origin_m=(float(x), float(y)))
    return survey.with_(p_xy=survey.p_xy + SHIFT, grid=grid)


def turned(survey, degrees):
    """The survey, turned about the origin; a gridded one by a quarter."""
    angle, grid, node = np.radians(degrees), survey.grid, survey.node
    if grid is not None:
        assert degrees == 90
        x0, _, _, y1 = grid.extent
        headings = np.radians((np.rint(np.degrees(grid.headings_rad)) + 90) % 360)
        order = np.argsort(headings)
        h, j, i = node.T
        node = np.column_stack([np.argsort(order)[h], i, grid.rows - 1 - j])
        grid = Grid(
            origin_m=(-y1, x0),
            cell_m=grid.cell_m[::-1],
            headings_rad=tuple(headings[order].tolist()),
            rows=grid.columns,
            columns=grid.rows,
        )
    p = survey.p_xy @ rotation(angle).T
    earth = survey.earth_nt
    if earth is not None:
        earth = (*(rotation(angle) @ earth[:2]).tolist(), earth[2])
    return survey.with_(p_xy=p, yaw=survey.yaw + angle, grid=grid, node=node, earth_nt=earth)


def permuted(survey):
    return survey.take(np.random.default_rng(5).permutation(len(survey)))


def doubled(survey):
    return survey.take(np.repeat(np.arange(len(survey)), 2))


def split(survey):
    """The survey in two runs, cut in the middle of its time."""
    run = (survey.t >= np.median(survey.t)).astype(int)
    return survey.with_(run=run, runs=("first", "second"))


def later(survey):
    """The survey, on a clock that began earlier."""
    return survey.with_(t=survey.t + 86_400.0)


def turned_map(field):
    """The map, turned about the origin by a quarter."""
    x0, _, _, y1 = field.extent
    headings = np.mod(field.headings_rad + np.pi / 2, 2 * np.pi)
    order = np.argsort(headings)

    def turn(layers):
        return None if layers is None else np.rot90(layers, axes=(2, 1))[order]

    return replace(
        field,
        values_nt=turn(field.values_nt),
        valid=turn(field.valid),
        variance_nt2=turn(field.variance_nt2),
        between_nt2=None,
        origin_m=(-y1, x0),
        cell_m=field.cell_m[::-1],
        headings_rad=headings[order],
        harmonic=None,
    )
