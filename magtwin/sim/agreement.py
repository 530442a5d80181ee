"""Agreement: whether a map and the things that are said to make it fit together."""

from dataclasses import dataclass

import numpy as np

from magtwin.field.map import AnomalyMap
from magtwin.names import RefusedError
from magtwin.sim.survey import field_at_rest_nt
from magtwin.spec import Scene

MOST_NODES = 4000
"""Nodes that are compared at most, evenly over the map."""

ALWAYS_NT = 1000.0
"""Difference up to which map and sources are never called contradictory [nT]: another robot's iron, errors of
pose and the interpolation of a fitted map together make that much."""

SHARE = 0.5
"""Difference, over the map's own standard deviation, above which they contradict each other: the sources then
leave more than a quarter of the map's variance unexplained."""


@dataclass(frozen=True)
class Agreement:
    """How far a map is from the exact field of a scene's Earth, sources and furniture."""

    rms_nt: float
    """Root mean square of the difference over the map's nodes [nT]."""

    largest_nt: float
    """The largest difference [nT]."""

    place: tuple[float, float, float]
    """Where that is: x [m], y [m], heading [rad]."""

    spread_nt: float
    """Standard deviation of the map over its nodes [nT]."""

    @property
    def contradicts(self) -> bool:
        """Whether the sources are no description of the map."""
        return self.rms_nt > max(ALWAYS_NT, SHARE * self.spread_nt)

    def __str__(self) -> str:
        x, y, yaw = self.place
        return (
            f"the map and the field of Earth, sources and furniture differ by {self.rms_nt:,.3g} nT rms, at "
            f"most {self.largest_nt:,.3g} nT at ({x:.2f}, {y:.2f}) m, heading {np.degrees(yaw):.0f} deg"
        )


def check_against_sources(scene: Scene, field: AnomalyMap) -> Agreement:
    """Compare a map with what a scene's robot would read at its nodes.

    Args:
        scene: A scene whose Earth's field is known, with sources or furniture.
        field: Its map.

    Returns:
        The difference.

    Raises:
        RefusedError: They contradict each other: the rms difference is above `ALWAYS_NT` and above `SHARE`
            of the map's standard deviation.
    """
    h, j, i = np.nonzero(field.valid)
    every = max(1, -(-len(h) // MOST_NODES))
    h, j, i = h[::every], j[::every], i[::every]
    p = np.column_stack([field.origin_m[0] + field.cell_m[0] * i, field.origin_m[1] + field.cell_m[1] * j])
    yaw = field.headings_rad[h] if field.recorded_yaw is None else field.recorded_yaw[h, j, i]
    exact = field_at_rest_nt(scene, p, yaw, height_m=field.height_m)
    values = field.values_nt[h, j, i]
    apart = np.abs(values - exact)
    worst = int(np.argmax(apart))
    found = Agreement(
        float(np.sqrt(np.mean(apart**2))),
        float(apart[worst]),
        (float(p[worst, 0]), float(p[worst, 1]), float(yaw[worst])),
        float(np.std(values)),
    )
    if found.contradicts:
        raise RefusedError(
            f"scene {scene.name!r}: {found}; the map itself varies by {found.spread_nt:,.3g} nT, so they "
            "contradict each other: leave out the map to have the scene surveyed, or leave out what was "
            "not there (magnetization = [] keeps a piece without its field)"
        )
    return found
