"""Fields in torch: the numbers of numpy, and derivatives that torch, the map and small steps agree on."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.learn.training.torch_map import TorchMap

QUARTERS = (0.0, 90.0, 180.0, 270.0)
HEADINGS = [QUARTERS, (33.0,), (0.0, 180.0), (15.0, 100.0, 110.0, 300.0)]


def field_map(*, degrees=QUARTERS, masked=0.0, seed=0):
    rng = np.random.default_rng(seed)
    values = 41_000 + 3_000 * rng.standard_normal((len(degrees), 6, 9))
    return AnomalyMap(
        values_nt=values,
        valid=rng.random(values.shape) >= masked,
        origin_m=(-1.0, 0.5),
        cell_m=(0.25, 0.1),
        headings_rad=np.radians(degrees),
        name="lab",
    )


def poses(field, count, seed=1):
    """Poses in and about the map, some on nodes, some at the headings of layers, some no pose at all."""
    rng = np.random.default_rng(seed)
    x0, x1, y0, y1 = field.extent
    p = rng.uniform((x0 - 0.2, y0 - 0.1), (x1 + 0.2, y1 + 0.1), (count, 2))
    yaw = rng.uniform(-20, 20, count)
    p[::4] = np.round((p[::4] - field.origin_m) / field.cell_m) * field.cell_m + field.origin_m
    yaw[::3] = rng.choice(field.headings_rad, len(yaw[::3]))
    p[1, 0], p[2, 1], yaw[3], yaw[5], p[6, 0] = np.nan, np.nan, np.nan, np.inf, np.inf
    return p, yaw


def by_autograd(look, p, yaw):
    """Values at poses, and their derivatives by x, y and yaw."""
    p = torch.tensor(p, requires_grad=True)
    yaw = torch.tensor(yaw, requires_grad=True)
    b = look(p, yaw)
    slopes = torch.autograd.grad(b.sum(), (p, yaw))
    return b.detach().numpy(), np.column_stack([slope.numpy() for slope in slopes])


@pytest.mark.parametrize("degrees", HEADINGS)
@pytest.mark.parametrize("masked", [0.0, 0.1])
@pytest.mark.parametrize("outside", ["nan", "clamp"])
def test_a_map_in_torch_gives_the_bytes_of_its_lookup_and_the_derivatives_of_its_gradient(
    degrees, masked, outside
):
    field = field_map(degrees=degrees, masked=masked)
    p, yaw = poses(field, 2_000)
    b, slopes = by_autograd(lambda *pose: TorchMap(field).lookup(*pose, outside=outside), p, yaw)
    want_b, want_slopes = field.lookup_with_gradient(p, yaw, outside=outside)
    assert_array_equal(b, want_b)
    assert_allclose(
        slopes, want_slopes, rtol=1e-12, atol=1e-9
    )  # sums of 8 products of 1e5 nT, in another order


@pytest.mark.parametrize("degrees", HEADINGS)
def test_derivatives_of_a_map_are_what_small_steps_say(degrees):
    torch_map = TorchMap(field_map(degrees=degrees))
    rng = np.random.default_rng(2)
    at = rng.uniform(0.1, 0.9, (20, 2)) + rng.integers(0, 5, (20, 2))  # away from where derivatives jump
    p = torch.tensor(at * (0.25, 0.1) + (-1.0, 0.5), requires_grad=True)
    yaw = torch.tensor(rng.uniform(0.62, 1.5, 20), requires_grad=True)
    assert torch.autograd.gradcheck(torch_map.lookup, (p, yaw), rtol=1e-6)


def test_a_pose_can_be_found_by_descending_to_a_known_field():
    x, y = np.meshgrid(np.arange(9) * 0.25, np.arange(9) * 0.25)
    bowl = 41_000 + 500 * ((x - 0.6) ** 2 + (y - 1.3) ** 2)
    torch_map = TorchMap(
        AnomalyMap(values_nt=bowl[None], origin_m=(0.0, 0.0), cell_m=(0.25, 0.25), headings_rad=[0.0])
    )
    p = torch.tensor([1.6, 0.4], requires_grad=True)
    descent = torch.optim.SGD([p], lr=5e-4)
    for _ in range(60):
        descent.zero_grad()
        torch_map(p, 0.0).backward()
        descent.step()
    assert_allclose(p.detach(), (0.6, 1.3), atol=0.15)  # the least node's cell and half a step


def test_poses_in_single_precision_are_looked_up_in_double():
    field = field_map()
    rng = np.random.default_rng(3)
    p = rng.uniform(field.extent[::2], field.extent[1::2], (500, 2)).astype(np.float32)
    yaw = rng.uniform(-3, 3, 500).astype(np.float32)
    want = field.lookup(p, yaw)
    double = TorchMap(field).lookup(torch.tensor(p), torch.tensor(yaw))
    assert double.dtype == torch.float32
    assert_allclose(double, want, rtol=0, atol=0.004)  # half a unit in the last place of 65,536 nT


def test_shapes_are_broadcast_and_kept_in_torch():
    torch_map = TorchMap(field_map())
    assert torch_map(torch.zeros(2), 0.0).shape == ()
    assert torch_map(torch.zeros(4, 1, 2), torch.zeros(7)).shape == (4, 7)
    assert torch_map(torch.zeros(0, 2), 0.0).shape == (0,)


def test_what_torch_cannot_look_up_is_refused():
    torch_map = TorchMap(field_map())
    with pytest.raises(InputError, match=r"shape \(\.\.\., 2\), got \(3,\)"):
        torch_map(torch.zeros(3), 0.0)
    with pytest.raises(InputError, match="outside must be"):
        torch_map(torch.zeros(2), 0.0, outside="zero")
    with pytest.raises(InputError, match=r"^1 of 2 points lie off the map 'lab'.*\(9\.000, 0\.700\)"):
        torch_map(torch.tensor([[0.0, 0.7], [9.0, 0.7]]), 0.0, outside="raise")
    assert torch_map(torch.tensor([0.0, 0.7]), 0.0, outside="raise") > 0
