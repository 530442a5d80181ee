from dataclasses import dataclass

import numpy as np
import pytest

from magtwin.errors import InputError
from magtwin.learn.data.split import PARTS, split


@dataclass(frozen=True)
class Recorded:
    name: str
    session: str
    path: str
    labelled: int = 100


LOG = [
    Recorded(f"run_{i:02d}", f"day {i % 10}", ("sine", "figure8", "lawnmower", "manual")[i % 4], 50 + 7 * i)
    for i in range(40)
]


def deal(log=LOG, by="session", seed=0, **options):
    return split(log, by, rng=np.random.default_rng(seed), **options)


def keys(log, by, names):
    return {getattr(one, "name" if by == "run" else by) for one in log if one.name in names}


@pytest.mark.parametrize("by", ["session", "run", "path"])
def test_nothing_is_on_two_sides_and_nothing_is_lost(by):
    for seed in range(5):
        found = deal(by=by, seed=seed)
        sides = [keys(LOG, by, found.names(part)) for part in PARTS]
        assert all(sides)
        assert len(sides[0] | sides[1] | sides[2]) == sum(map(len, sides))
        assert sorted(sum((found.names(part) for part in PARTS), ())) == [one.name for one in LOG]
        assert not found.leak


def test_the_seed_decides_and_the_order_of_recordings_does_not():
    assert deal(seed=1) == deal(seed=1)
    assert deal(seed=1) != deal(seed=2)
    assert set(deal(LOG[::-1], seed=1).test) == set(deal(seed=1).test)


def test_a_split_by_row_deals_rows_of_every_run_once_and_says_that_it_leaks():
    found = deal(by="row")
    assert "both sides" in found.leak
    masks = np.array([found.rows(part, "run_05", 20_000) for part in PARTS])
    assert (masks.sum(axis=0) == 1).all()
    np.testing.assert_allclose(masks.mean(axis=1), [0.7, 0.15, 0.15], atol=0.02)
    other = found.rows("train", "run_06", 20_000)
    assert 0.5 < (other == masks[0]).mean() < 0.66
    assert (found.rows("train", "run_05", 300) == masks[0][:300]).all()


def test_by_run_a_recordings_rows_are_all_in_its_part():
    found = deal(by="run")
    assert found.rows("test", found.test[0], 7).all()
    assert not found.rows("train", found.test[0], 7).any()


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"by": "sesion"}, "did you mean 'session'"),
        ({"hold_out": ["day 33"]}, "hold out 'day 33'; did you mean 'day 3'"),
        ({"log": []}, "0 sessions cannot be dealt"),
        ({"log": LOG[:2]}, "2 sessions cannot be dealt to 3 parts .*record more, or split by run"),
    ],
)
def test_what_cannot_be_split_is_refused(options, text):
    with pytest.raises(InputError, match=text):
        deal(**options)
