"""Belief: the tempering of a likelihood by the size and the kind of the map's error."""

import numpy as np
import pytest

from magtwin.field.maps.map import AnomalyMap
from magtwin.localization.belief import table_of, tempering


def belief(node_sd_nt, between_sd_nt):
    shape = (4, 5, 6)
    return table_of(
        AnomalyMap(
            values_nt=np.full(shape, 40_000.0),
            variance_nt2=np.full(shape, node_sd_nt**2),
            between_nt2=None if between_sd_nt is None else np.full((2, *shape), between_sd_nt**2),
            origin_m=(0.0, 0.0),
            cell_m=(0.5, 0.5),
            headings_rad=np.arange(4) * np.pi / 2,
        ),
        (0.0, 2.5, 0.0, 2.0),
    )


@pytest.mark.parametrize(
    ("node_sd_nt", "kappa"), [(0.0, 1.0), (100.0, 1.5), (150.0, 1.75), (600.0, 4.0), (2000.0, 4.0)]
)
def test_random_errors_temper_by_their_size(node_sd_nt, kappa):
    assert tempering(belief(node_sd_nt, None), 20.0) == pytest.approx(kappa)
