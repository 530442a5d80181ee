"""The Gaussian process, held against plain numpy and against surveys."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import approx_fprime

from magtwin.errors import InputError
from magtwin.field.fit.covariance import Covariance
from magtwin.field.fit.gp import fit_gp
from magtwin.field.fit.roughness import local_mean
from magtwin.field.grid import Grid
from magtwin.field.survey.readings import Readings

KERNELS = ("matern", "poisson")
PATCHES, APART = np.array([[-0.5, 0.0], [0.6, 0.4], [0.3, -0.8]]), 0.9


def some(count=14, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, (count, 2)), rng.uniform(0, 6, count), rng.integers(0, 3, count)


def figures_of(covariance, seed=1):
    """Figures of a field of 1 uT with a reach of 1 m."""
    figures = 0.3 * np.random.default_rng(seed).standard_normal(covariance.size)
    h = covariance.harmonics
    figures[:h] += 7
    figures[2 * h : 3 * h] += 6
    figures[3 * h] += 5
    if covariance.runs:
        figures[3 * h + 1] += 6
    return figures


def plainly(covariance, figures, p, yaw, q, turn):
    """The covariance by loops over pairs, from its equation."""
    h = covariance.harmonics
    s, reach, u = np.exp(figures[:h]), np.exp(figures[h : 2 * h]), np.exp(figures[2 * h : 3 * h])
    arm = figures[-2:] / 30 if h > 1 else np.zeros(2)
    own = figures[covariance.of_patches]

    def strength(at):
        if not len(own):
            return 1.0
        weight = [np.exp(-(np.linalg.norm(at - q) ** 2) / (2 * (0.7 * APART) ** 2)) for q in PATCHES]
        return np.exp(np.dot(weight, own) / np.sum(weight))

    def sensor(at, angle):
        c, d = np.cos(angle), np.sin(angle)
        return at + np.array([[c, -d], [d, c]]) @ arm

    def value(d, r):
        if covariance.kernel == "poisson":
            return (1 + d**2 / r**2) ** -1.5
        a = np.sqrt(5) * d / r
        return (1 + a + a**2 / 3) * np.exp(-a)

    out = np.zeros((len(p), len(q)))
    for i in range(len(p)):
        for j in range(len(q)):
            d = np.linalg.norm(sensor(p[i], yaw[i]) - sensor(q[j], turn[j]))
            for k in range(h):
                both = strength(p[i]) * strength(q[j]) if k == 0 else 1.0
                part = s[k] ** 2 * both * value(d, reach[k]) + u[k] ** 2
                out[i, j] += np.cos(k * (yaw[i] - turn[j])) * part
    return out


def survey(*, noise=20.0, seed=0, arm=(0.0, 0.0), rows=7, columns=8):
    """A gridded survey of a smooth field with a platform, whose sensor may stand beside base_link."""
    rng = np.random.default_rng(seed)
    grid = Grid(
        origin_m=(-0.9, -0.75),
        cell_m=(0.25, 0.25),
        headings_rad=tuple(np.radians([0.0, 90.0, 180.0, 270.0])),
        rows=rows,
        columns=columns,
    )
    p, yaw = grid.poses()
    p = p.reshape(-1, 2)
    yaw = yaw.ravel() + rng.normal(0, 0.1, len(p))
    b = truth(p, yaw, arm) + rng.normal(0, noise, len(p))
    node = np.indices(grid.shape).reshape(3, -1).T
    return Readings(p_xy=p, yaw=yaw, b_nt=b, grid=grid, node=node, name="made")


def truth(p, yaw, arm=(0.0, 0.0)):
    x = p[..., 0] + np.cos(yaw) * arm[0] - np.sin(yaw) * arm[1]
    y = p[..., 1] + np.sin(yaw) * arm[0] + np.cos(yaw) * arm[1]
    return (
        42_000
        + 2500 / (1 + 3 * (x**2 + y**2))
        + 400 * np.sin(1.5 * x)
        + 300 * np.cos(yaw)
        + 60 * np.cos(2 * yaw)
    )


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("harmonics", [1, 3])
@pytest.mark.parametrize("patches", [(), (PATCHES, APART)])
def test_the_covariance_is_its_equation_by_loops(kernel, harmonics, patches):
    covariance = Covariance(kernel, harmonics, False, *patches)
    figures = figures_of(covariance)
    (p, yaw, _), (q, turn, _) = some(), some(9, seed=4)
    expected = plainly(covariance, figures, p, yaw, q, turn)
    assert_allclose(covariance.between(figures, (p, yaw), (q, turn)), expected, rtol=1e-12)
    variance = np.diag(covariance.between(figures, (p, yaw), (p, yaw)))
    assert_allclose(variance, covariance.variance_nt2(figures, p), rtol=1e-12)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize(("harmonics", "runs"), [(1, False), (3, False), (1, True), (3, True)])
def test_the_likelihoods_gradient_is_that_of_finite_differences(kernel, harmonics, runs):
    covariance = Covariance(kernel, harmonics, runs, PATCHES, APART)
    figures, guess = figures_of(covariance), np.zeros(covariance.size)
    p, yaw, run = some()
    b = np.random.default_rng(3).normal(0, 1000, len(p))
    data = (guess, p, yaw, run, b)
    _, gradient = covariance.loss(figures, *data)
    numeric = approx_fprime(figures, lambda f: covariance.loss(f, *data)[0], 1e-6)
    assert_allclose(gradient, numeric, rtol=1e-4, atol=1e-4)  # a step of 1e-6 leaves about 1e-5


def test_the_likelihood_is_the_normal_densitys():
    from scipy.stats import multivariate_normal

    covariance = Covariance("matern", 3, False, PATCHES, APART)
    figures = figures_of(covariance)
    p, yaw, run = some()
    b = np.random.default_rng(3).normal(0, 1000, len(p))
    matrix = plainly(covariance, figures, p, yaw, p, yaw) + covariance.noise_nt2(figures) * np.eye(len(p))
    expected = -multivariate_normal(cov=matrix).logpdf(b) - len(p) / 2 * np.log(2 * np.pi)
    loss, _ = covariance.loss(figures, figures, p, yaw, run, b)  # at its guess the prior is nought
    assert_allclose(loss, expected, rtol=1e-10)


@pytest.mark.parametrize("kernel", KERNELS)
def test_mean_and_variance_are_the_textbooks_on_a_few_points(kernel, monkeypatch):
    readings = survey(rows=4, columns=4)
    monkeypatch.setattr("magtwin.field.fit.gp._patches", lambda *_: (PATCHES, APART))
    model = fit_gp(readings, kernel=kernel)
    covariance, figures = model.covariance, model.figures
    p, yaw = model.poses
    matrix = plainly(covariance, figures, p, yaw, p, yaw) + covariance.noise_nt2(figures) * np.eye(len(p))
    at, turn, _ = some(6)
    across = plainly(covariance, figures, at, turn, p, yaw)
    data = matrix @ model.alpha
    mean, variance = model.predict(at, turn)
    assert_allclose(mean, model.mean_nt + across @ np.linalg.solve(matrix, data), rtol=1e-9)
    own = np.diag(plainly(covariance, figures, at, turn, at, turn))
    textbook = own - np.sum(across * np.linalg.solve(matrix, across.T).T, axis=1)
    assert_allclose(variance, textbook * local_mean(*model.missed, at), rtol=1e-6)
    assert_allclose(np.sort(data + model.mean_nt), np.sort(readings.b_nt), rtol=1e-9)


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_smooth_field_is_told_between_its_nodes_to_its_noise(kernel):
    model = fit_gp(survey(), kernel=kernel)
    rng = np.random.default_rng(8)
    p, yaw = rng.uniform((-0.9, -0.75), (0.85, 0.75), (500, 2)), rng.uniform(0, 2 * np.pi, 500)
    mean, variance = model.predict(p, yaw)
    error = mean - truth(p, yaw)
    assert np.sqrt(np.mean(error**2)) < 20  # the noise of one reading
    assert 0.8 <= np.mean(np.abs(error) <= 1.645 * np.sqrt(variance)) <= 1
    sd = np.sqrt(variance + model.noise_nt2)
    assert 0.85 <= np.mean(np.abs(error + rng.normal(0, 20, 500)) <= 1.645 * sd) <= 0.97  # fresh readings


def test_a_field_that_is_rough_in_one_corner_is_told_to_be_so():
    whole = survey(noise=5.0)
    x, y = whole.p_xy.T
    rough = 3000 * np.sin(7 * x) * np.sin(6 * y) / (1 + np.exp(-12 * (x - 0.2)))
    model = fit_gp(whole.with_(b_nt=whole.b_nt + rough))
    west, east = model.covariance.variance_nt2(model.figures, np.array([[-0.8, 0.0], [0.8, 0.0]]))
    assert east > 1.5 * west  # the prior holds it back


def test_the_sensors_place_beside_base_link_is_found():
    model = fit_gp(survey(arm=(0.03, -0.02), noise=5.0))
    assert_allclose(model.parameters["p_base_sensor_m"], [0.03, -0.02], atol=0.006)


def test_one_heading_has_no_harmonics_and_holds_for_all():
    whole = survey()
    only = whole.take(whole.node[:, 0] == 0).with_(yaw=np.zeros(56))
    model = fit_gp(only)
    assert model.covariance.harmonics == 1
    at = [[0.1, 0.1]]
    assert_array_equal(model.predict(at, 0.0), model.predict(at, 2.0))


def test_runs_that_disagree_widen_the_noise():
    rng = np.random.default_rng(0)
    p, run = rng.uniform(-1, 1, (180, 2)), np.repeat([0, 1, 2], 60)
    bias = np.array([-300.0, 0.0, 300.0])[run]
    b = truth(p, 0.0) + bias + rng.normal(0, 10, 180)
    model = fit_gp(Readings(p_xy=p, yaw=np.zeros(180), b_nt=b, run=run, runs=("a", "b", "c")))
    assert 100 < model.parameters["run_sd_nt"] < 900
    assert model.noise_nt2 > model.parameters["run_sd_nt"] ** 2 * 0.99


def test_a_drive_of_many_readings_is_averaged_to_a_bound():
    rng = np.random.default_rng(0)
    t = np.linspace(0, 40, 30_000)
    p = np.column_stack([1.2 * np.sin(1.1 * t), 1.2 * np.sin(1.7 * t)])
    b = truth(p, 0.0) + rng.normal(0, 30, len(t))
    model = fit_gp(Readings(p_xy=p, yaw=np.zeros(len(t)), b_nt=b))
    assert model.parameters["conditioned_on"] <= 4000
    at = rng.uniform((-1, -1), (1, 1), (200, 2))
    assert np.sqrt(np.mean((model.predict(at, 0.0)[0] - truth(at, 0.0)) ** 2)) < 20  # of noise 30


def test_an_unknown_kernel_and_readings_without_an_area_are_refused():
    with pytest.raises(InputError, match='kernel must be "matern" or "poisson", got \'rbf\''):
        fit_gp(survey(), kernel="rbf")
    with pytest.raises(InputError, match="3 good readings"):
        fit_gp(survey().take(np.arange(3)))
    with pytest.raises(InputError, match="stuck"):
        fit_gp(survey().with_(good=np.zeros(224, bool)))
    with pytest.raises(InputError, match="a stuck sensor"):
        fit_gp(survey().with_(b_nt=np.full(224, 4e4)))
