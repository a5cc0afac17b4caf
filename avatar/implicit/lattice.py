"""A smooth field read from a lattice: evaluated once at its nodes, interpolated between them."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import torch
from torch import Tensor, nn

from avatar.checks import AvatarError, check_shape

MAX_NODES = 1 << 24
CHUNK = 65_536  # nodes evaluated at once


class FieldLattice(nn.Module):
    """A frozen field ``(B, N, 3) -> (B, N, C)`` as trilinear look-ups: a hundredth of a network's work a point.

    For fields that hardly change over a few centimetres, as skinning weights do. Differentiable in the points;
    outside its box the value at the border is given.
    """

    def __init__(self, field: Callable[[Tensor], Tensor], box: Tensor, spacing: float):
        """Evaluates the field.

        Args:
            field: what to tabulate, called with ``(1, N, 3)`` points.
            box: ``(2, 3)`` lowest and highest corner, metres.
            spacing: metres between nodes.
        """
        super().__init__()
        check_shape("box", box, "2 3")
        if spacing <= 0:
            raise AvatarError(f"spacing: expected above 0 metres, got {spacing}.")
        cells = ((box[1] - box[0]) / spacing).ceil().long().clamp(min=1)
        if (cells + 1).double().prod() > MAX_NODES:
            raise AvatarError(f"spacing: expected at most {MAX_NODES} nodes, {spacing} m makes more of this box.")
        steps = [spacing * torch.arange(int(count) + 1, dtype=box.dtype, device=box.device) for count in cells]
        nodes = torch.stack(torch.meshgrid(*steps, indexing="ij"), dim=-1).reshape(-1, 3) + box[0]
        with torch.no_grad():
            values = torch.cat([field(chunk[None])[0] for chunk in nodes.split(CHUNK)])
        self.spacing = spacing
        self.register_buffer("cells", cells, persistent=False)
        self.register_buffer("origin", box[0].clone(), persistent=False)
        self.register_buffer("values", values, persistent=False)

    def forward(self, points: Tensor) -> Tensor:
        """Interpolated values ``(B, N, C)`` at points ``(B, N, 3)``; where a point is NaN, so are its values."""
        check_shape("points", points, "B N 3")
        place = ((points - self.origin) / self.spacing).clamp(min=0).minimum(self.cells.to(points.dtype))
        low = place.detach().nan_to_num().floor().long().minimum(self.cells - 1)
        share = place - low
        sides = (1 - share, share)
        blended = 0
        for corner in product((0, 1), repeat=3):
            x, y, z = (low[..., axis] + corner[axis] for axis in range(3))
            row = (x * (self.cells[1] + 1) + y) * (self.cells[2] + 1) + z
            weight = sides[corner[0]][..., 0] * sides[corner[1]][..., 1] * sides[corner[2]][..., 2]
            blended = blended + weight.unsqueeze(-1) * self.values[row]
        return blended
