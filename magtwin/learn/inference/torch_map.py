"""TorchMap: an anomaly map in torch, differentiable, on any device."""

from typing import Any

import torch
from numpy.typing import ArrayLike

from magtwin.errors import InputError
from magtwin.field.maps.lookup import EDGE, TURN, Lookup, blend, sides
from magtwin.field.maps.map import AnomalyMap, Outside


class TorchMap(torch.nn.Module):
    """`AnomalyMap.lookup` on tensors, differentiable in p and yaw.

    Its buffers are float64 on the CPU; `.to(device)` and `.float()` convert them, and it computes in their
    precision. In float64 values and derivatives are the bytes of `AnomalyMap.lookup` and `gradient`. There
    are no derivatives with respect to the map's values.
    """

    values: torch.Tensor
    """Values of the nodes [nT], 0 where masked; the first layer is repeated at the end."""
    holes: torch.Tensor
    """1 at masked nodes and 0 elsewhere; empty if no node is masked."""
    origin: torch.Tensor
    """World x and y of the first node [m], shape (2,)."""
    cell: torch.Tensor
    """Distance between nodes along x and y [m], shape (2,)."""
    last: torch.Tensor
    """Last column and row, shape (2,)."""
    knots: torch.Tensor
    """Angles of the layers above the first [rad], shape (H,)."""
    gaps: torch.Tensor
    """Angles from each layer to the next [rad], shape (H,)."""

    def __init__(self, field: AnomalyMap) -> None:
        super().__init__()
        grid = Lookup(field.values_nt, field.valid, field.origin_m, field.cell_m, field.headings_rad)
        *_, self._first, self._per_rad, self._layers, self._rows, self._columns = grid.figures
        self._name, self._extent = field.name, field.extent
        arrays: dict[str, ArrayLike] = {
            "values": grid.values,
            "holes": () if grid.holes is None else grid.holes,
            "origin": field.origin_m,
            "cell": field.cell_m,
            "last": (self._columns - 1, self._rows - 1),
            "knots": grid.knots,
            "gaps": grid.gaps,
        }
        for name, array in arrays.items():
            self.register_buffer(name, torch.tensor(array, dtype=torch.float64))

    def lookup(
        self, p_xy: torch.Tensor, yaw: torch.Tensor | float, *, outside: Outside = "nan"
    ) -> torch.Tensor:
        """Field at poses.

        Args:
            p_xy: Points in world [m], shape (..., 2).
            yaw: Headings [rad], shape (...); the two shapes are broadcast.
            outside: Result off the grid: "nan", "clamp" (the field of the nearest point) or "raise", which
                waits for the device.

        Returns:
            Field magnitude [nT], shape (...), of the type of `p_xy`.

        Raises:
            InputError: A point lies off the grid and `outside` is "raise".
        """
        p, yaw = _broadcast(p_xy, yaw, self.values)
        if outside not in ("nan", "clamp", "raise"):
            raise InputError(f'outside must be "nan", "clamp" or "raise", got {outside!r}')
        with torch.no_grad():
            u, angle = (p - self.origin) / self.cell, yaw - self._first
            edge = torch.clamp(4 * torch.finfo(u.dtype).eps * self.last, min=EDGE)
            inside = (u >= -edge) & (u <= self.last + edge)
            if outside == "raise":
                self._refuse(~(inside.all(-1) | u.isnan().any(-1)), p)
            known = (~u.isnan() if outside == "clamp" else inside).all(-1) & angle.isfinite()
            held = torch.where(known[..., None], u, 0.0).clamp(min=torch.zeros_like(self.last), max=self.last)
            low = torch.minimum(held.floor(), self.last - 1)
            turned = torch.where(known, angle, 0.0)
            turned = (turned - TURN * (turned / TURN).floor()).clamp(0, TURN)
            if self._per_rad < 0:
                layer = torch.searchsorted(self.knots, turned, right=True) - 1
                rate = 1 / self.gaps[layer]
                wh = (turned - self.knots[layer]) / self.gaps[layer]
            else:
                layer = (turned * self._per_rad).long().clamp(max=self._layers - 1)
                rate = torch.full_like(turned, self._per_rad)
                wh = turned * self._per_rad - layer
            i, j = low.long().unbind(-1)
            node = (layer * self._rows + j) * self._columns + i
            wx, wy = (held - low).unbind(-1)
            rates = [*torch.where(inside, 1 / self.cell, 0.0).unbind(-1), rate]
            unknown = [~known] * 3
            if len(self.holes):
                holes = self._corners(self.holes, node)
                known = known & ~(blend(holes, wx, wy, wh) > EDGE)
                across = sides(holes, wx, wy, wh, 1.0)
                unknown = [~known | ((r != 0) & (s > EDGE)) for r, s in zip(rates, across, strict=True)]
        moved = (*p.unbind(-1), yaw)
        weights = zip(moved, (wx, wy, wh), rates, unknown, strict=True)
        wx, wy, wh = (_Weight.apply(*each) for each in weights)
        b = blend(self._corners(self.values, node), wx, wy, wh)
        return torch.where(known, b, torch.nan).to(p_xy.dtype)

    forward = lookup

    def _corners(self, grid: torch.Tensor, node: torch.Tensor) -> list[torch.Tensor]:
        ways = (0, 1, self._columns, self._columns + 1)
        layer = self._rows * self._columns
        return [grid[node + up + along] for up in (0, layer) for along in ways]

    def _refuse(self, off: torch.Tensor, p: torch.Tensor) -> None:
        if off.any():
            x0, x1, y0, y1 = self._extent
            where = ", ".join(f"{c:.3f}" for c in p[off][0].tolist())
            raise InputError(
                f"{int(off.sum())} of {off.numel()} points lie off the map {self._name!r} "
                f"(x {x0:g}..{x1:g}, y {y0:g}..{y1:g} m), the first at ({where}); "
                'keep inside, or ask for outside="clamp" or "nan"'
            )


class _Weight(torch.autograd.Function):
    """A known weight with its derivative by a coordinate: `rate`, or nan if unknown."""

    @staticmethod
    def forward(
        _at: torch.Tensor, weight: torch.Tensor, _rate: torch.Tensor, _unknown: torch.Tensor
    ) -> torch.Tensor:
        return weight.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[torch.Tensor, ...], output: torch.Tensor) -> None:
        ctx.save_for_backward(*inputs[2:])

    @staticmethod
    def backward(ctx: Any, *slopes: torch.Tensor) -> tuple[torch.Tensor, None, None, None]:
        rate, unknown = ctx.saved_tensors
        return (slopes[0] * rate).masked_fill(unknown, torch.nan), None, None, None


def _broadcast(
    p: torch.Tensor, yaw: torch.Tensor | float, like: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Points and headings of one shape, in the map's precision."""
    if p.ndim == 0 or p.shape[-1] != 2:
        raise InputError(f"p_xy must have shape (..., 2), got {tuple(p.shape)}")
    if p.device != like.device:
        raise InputError(f"p_xy is on {p.device}, the field on {like.device}; move one with .to()")
    angle = torch.as_tensor(yaw, dtype=like.dtype, device=like.device)
    shape = torch.broadcast_shapes(p.shape[:-1], angle.shape)
    return p.to(like.dtype).expand(*shape, 2), angle.expand(shape)
