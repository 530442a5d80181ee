import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from test_network import a_net

from magtwin.learn.data.inputs import inputs_of
from magtwin.learn.models.calibration import Spread
from magtwin.learn.models.hybrid import Hybrid
from magtwin.learn.models.linear import Linear

NAMES = ("odom_v_x", "imu_w_z")


@pytest.fixture(scope="module")
def hybrid():
    """A base and a network of random figures, trained on inputs within 1 of 0."""
    x = np.random.default_rng(0).uniform(-1, 1, (400, 2))
    base = Linear(
        inputs=inputs_of(x, NAMES),
        constant_nt=300.0,
        coefficients_nt=np.array([40.0, -10.0]),
        spread=Spread(900.0, np.array([100.0, 0.0])),
        penalty=1e-3,
    )
    return Hybrid(base=base, net=a_net(NAMES, (8,)), sd_factor=1.5)


def test_it_is_the_base_and_what_the_network_adds_with_the_spread_of_the_base(hybrid):
    x = np.random.default_rng(1).uniform(-0.9, 0.9, (50, 2))
    mean, sd = hybrid.predict(x)
    base, spread = hybrid.base.predict(x)
    assert_allclose(mean, base + hybrid.net.predict(x)[0], rtol=1e-12)
    assert_array_equal(sd, 1.5 * spread)


def test_outside_its_training_the_network_stays_as_at_the_edge_and_the_base_goes_on(hybrid):
    edge = np.array([[hybrid.base.inputs.high[0], 0.0]])
    far = edge + np.array([[3.0, 0.0]])
    slope = hybrid.base.coefficients_nt[0] / hybrid.base.inputs.scale[0]
    assert_allclose(hybrid.predict(far)[0] - hybrid.predict(edge)[0], 3.0 * slope, rtol=1e-9)
    assert hybrid.outside(far).tolist() == [True]


def test_the_base_alone_is_a_hybrid_without_a_network(hybrid):
    alone = Hybrid(base=hybrid.base, net=None)
    x = np.zeros((3, 2))
    assert_array_equal(alone.predict(x)[0], hybrid.base.predict(x)[0])
    assert (alone.layers_text, alone.parameters_count) == ("linear in 2", 3)
    assert hybrid.layers_text == "linear in 2 + 2-8-1"
