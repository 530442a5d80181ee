"""TorchMap: an anomaly map in torch, differentiable in position and heading."""

from typing import Any

import torch

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap, Outside


class TorchMap(torch.nn.Module):
    """`AnomalyMap.lookup` on tensors of any device, differentiable in p and yaw.

    Values and derivatives are those of `AnomalyMap.lookup_with_gradient`, in float64 on the CPU. There are
    no second derivatives, and none with respect to the map's values.
    """

    def __init__(self, field: AnomalyMap) -> None:
        super().__init__()
        self.field = field

    def lookup(
        self, p_xy: torch.Tensor, yaw: torch.Tensor | float, *, outside: Outside = "nan"
    ) -> torch.Tensor:
        """Field at poses.

        Args:
            p_xy: Points in world [m], shape (..., 2).
            yaw: Headings [rad], shape (...); the two shapes are broadcast.
            outside: Result off the grid: "nan", "clamp" (the field of the nearest point) or "raise".

        Returns:
            Field magnitude [nT], shape (...), of the type and on the device of `p_xy`.

        Raises:
            InputError: A point lies off the grid and `outside` is "raise".
        """
        if p_xy.ndim == 0 or p_xy.shape[-1] != 2:
            raise InputError(f"p_xy must have shape (..., 2), got {tuple(p_xy.shape)}")
        angle = torch.as_tensor(yaw, dtype=torch.float64, device=p_xy.device)
        shape = torch.broadcast_shapes(p_xy.shape[:-1], angle.shape)
        p = p_xy.double().expand(*shape, 2)
        pose = torch.cat([p, angle.expand(shape)[..., None]], dim=-1)
        b: torch.Tensor = _Lookup.apply(pose, self.field, outside)
        return b.to(p_xy.dtype)

    forward = lookup


class _Lookup(torch.autograd.Function):
    """Field at poses (..., 3); its derivatives are the map's gradient."""

    @staticmethod
    def forward(ctx: Any, pose: torch.Tensor, field: AnomalyMap, outside: Outside) -> torch.Tensor:
        x = pose.detach().cpu().numpy()
        value, gradient = (
            torch.as_tensor(of) for of in field.lookup_with_gradient(x[..., :2], x[..., 2], outside=outside)
        )
        ctx.save_for_backward(gradient.to(pose.device))
        return value.to(pose.device)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, slope: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        return slope[..., None] * ctx.saved_tensors[0], None, None
