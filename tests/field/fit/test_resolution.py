"""The spacing and headings of a map, held against fields whose waves are known."""

import numpy as np
import pytest

from magtwin.field.fit.fit import raster
from magtwin.field.fit.resolution import HEADINGS, PARTS, SHARE, resolution
from magtwin.field.survey.readings import Readings


class Waves:
    """A method that knows a field of one wavelength and one harmonic of the heading, with a given sd."""

    method, parameters, noise_nt2 = "waves", {}, 0.0

    def __init__(self, *, length=1.0, size=500.0, harmonic=1, turned=500.0, sd=50.0):
        self.number, self.size, self.harmonic, self.turned, self.sd = (
            2 * np.pi / length,
            size,
            harmonic,
            turned,
            sd,
        )

    def predict(self, p_xy, yaw):
        p, yaw = np.broadcast_arrays(np.asarray(p_xy), np.asarray(yaw)[..., None])
        x, y, yaw = p[..., 0], p[..., 1], yaw[..., 0]
        value = 4e4 + self.size * np.sin(self.number * x) * np.cos(self.number * y)
        value = value + self.turned * np.cos(self.harmonic * yaw)
        return value, np.full(value.shape, self.sd**2)


def drive(count=1500):
    rng = np.random.default_rng(0)
    p, yaw = rng.uniform(0, 4, (count, 2)), rng.uniform(0, 2 * np.pi, count)
    return Readings(p_xy=p, yaw=yaw, b_nt=np.full(count, 4e4) + rng.normal(size=count) * 500, name="waves")


def errors(model, readings, step, count):
    """What interpolation errs by, measured on a dense set of poses."""
    rng = np.random.default_rng(1)
    cell, part = rng.uniform(0.5, 3.5, (20_000, 2)), rng.uniform(size=(20_000, 2))
    corners = [(i, j) for i in (0, 1) for j in (0, 1)]
    mixed = sum(
        np.abs(1 - i - part[:, 0])
        * np.abs(1 - j - part[:, 1])
        * model.predict(cell + step * np.array([i, j]), np.zeros(20_000))[0]
        for i, j in corners
    )
    nodes = mixed - model.predict(cell + step * part, np.zeros(20_000))[0]
    yaw, apart = rng.uniform(0, 2 * np.pi, 20_000), 2 * np.pi / count
    low = np.floor(yaw / apart) * apart
    share = (yaw - low) / apart
    at = np.zeros((20_000, 2))
    turn = (1 - share) * model.predict(at, low)[0] + share * model.predict(at, low + apart)[0]
    return np.sqrt(np.mean(nodes**2)), np.sqrt(np.mean((turn - model.predict(at, yaw)[0]) ** 2))


@pytest.mark.parametrize("sd", [20.0, 60.0, 200.0])
def test_the_error_of_interpolation_is_measured_right_and_small_against_the_sd(sd):
    model, readings = Waves(sd=sd), drive()
    found = resolution(model, readings)
    nodes, turn = errors(model, readings, found.spacing_m, len(found.headings_rad))
    # 400 probes: a mean square to within sqrt(2 / 400), so its root to some 5 %, three of them allowed
    assert abs(found.nodes_nt - nodes) < 0.15 * nodes
    assert abs(found.turn_nt - turn) < 0.15 * turn
    assert found.sd_nt == pytest.approx(sd)
    if len(found.headings_rad) < HEADINGS[-1]:
        assert found.turn_nt <= SHARE * sd
    if found.spacing_m > 0.31 / PARTS[-1]:
        assert found.nodes_nt <= SHARE * sd


def test_a_smooth_field_gets_wide_nodes_and_one_that_no_heading_changes_four_headings():
    wide = resolution(Waves(length=10.0, turned=0.0), drive())
    fine = resolution(Waves(length=0.4, harmonic=2), drive())
    assert wide.spacing_m == pytest.approx(0.3 / PARTS[0])
    assert len(wide.headings_rad) == 4
    assert fine.spacing_m == pytest.approx(0.3 / PARTS[-1])
    assert len(fine.headings_rad) == 24


def test_fewer_headings_are_enough_for_a_less_sure_fit():
    counts = [len(resolution(Waves(sd=sd), drive()).headings_rad) for sd in (1.0, 50.0, 200.0, 2_000.0)]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] == 24
    assert counts[-1] == 4


def test_a_spacing_and_headings_that_are_given_stand_and_their_errors_are_in_the_map():
    readings = drive()
    field = raster(Waves(), readings, spacing_m=0.5, headings_rad=[0.0, np.pi])
    assert field.cell_m == (0.5, 0.5)
    assert len(field.headings_rad) == 2
    nodes, turn = errors(Waves(), readings, 0.5, 2)
    assert field.parameters["error between nodes [nT]"] == pytest.approx(nodes, rel=0.15)
    assert field.parameters["error between headings [nT]"] == pytest.approx(turn, rel=0.15)
