"""Custom sensors and interference, as a user registers them."""

from types import MappingProxyType

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.path import path_named
from magtwin.run.run import Column
from magtwin.sim import extensions
from magtwin.sim.runs.simulate import simulate


@extensions.sensor("test_speedometer")
class Speedometer:
    columns = MappingProxyType({"speed_m_s": Column("m/s", "base_link", "measured forward speed")})

    def __init__(self, scene, rng):
        self.rng = rng

    def sense(self, motion, t, until_s=None):
        return {"speed_m_s": motion.at(t).v + 0.01 * self.rng.standard_normal(len(t))}


@extensions.interference("test_pump")
def pump_nt(columns, robot, rng):
    hum = 300.0 * np.sin(2 * np.pi * 0.8 * columns["t"])
    return np.column_stack([0 * hum, 0 * hum, hum])


def run_of(twin, **options):
    path = options.pop("path", path_named("figure8"))
    rng = np.random.default_rng(0)
    return simulate(twin.scene, path, anomaly_map=twin.field, rng=rng, duration_s=5.0, **options)


def test_a_registered_sensor_adds_its_columns_and_changes_no_others(twin):
    run, plain = run_of(twin, sensors=["test_speedometer"]), run_of(twin)
    assert run.spec("speed_m_s").unit == "m/s"
    assert np.std(run["speed_m_s"] - run["v_base"][:, 0]) == pytest.approx(0.01, rel=0.1)
    for name in plain:
        assert_array_equal(run[name], plain[name], err_msg=name)


def test_an_interference_term_is_added_to_the_field_at_the_sensor(twin):
    run, plain = run_of(twin, interference=["test_pump"]), run_of(twin)
    added = run["b_vector_nt"] - plain["b_vector_nt"]
    assert_allclose(
        np.linalg.norm(added, axis=1), np.abs(300 * np.sin(2 * np.pi * 0.8 * run["t"])), atol=1e-6
    )
    assert_allclose(run["b_truth_nt"], np.linalg.norm(run["b_vector_nt"], axis=1))
    assert_allclose(run["b_total_nt"], run["b_truth_nt"])
