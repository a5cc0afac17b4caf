"""Subsets of points: farthest-point sampling."""

from __future__ import annotations

import torch
from torch import Tensor

from avatar.checks import AvatarError, check_finite, check_shape


@torch.no_grad()
def farthest_points(points: Tensor, count: int, start: int = 0) -> Tensor:
    """Indices of a subset in which each point is the farthest from all before it (PointNet++).

    The start is fixed, so the same points give the same subset. No index comes twice, not even where points
    coincide. O(N count): call it once on a constant template.

    Args:
        points: ``(N, 3)``; count: subset size, at most N; start: index of the first pick.

    Returns:
        ``(count,)`` int64.

    Raises:
        AvatarError: for a count or start out of range, or coordinates that are not finite.
    """
    dims = check_shape("points", points, "N 3")
    if not 1 <= count <= dims["N"]:
        raise AvatarError(f"count: expected 1 to {dims['N']} points, got {count}.")
    if not 0 <= start < dims["N"]:
        raise AvatarError(f"start: expected an index in [0, {dims['N']}), got {start}.")
    check_finite("points", points)
    chosen = torch.empty(count, dtype=torch.long, device=points.device)
    distances = torch.full((dims["N"],), torch.inf, dtype=points.dtype, device=points.device)
    chosen[0] = start
    for i in range(1, count):
        distances = torch.minimum(distances, (points - points[chosen[i - 1]]).square().sum(dim=-1))
        distances[chosen[i - 1]] = -1  # below every distance: not chosen again
        chosen[i] = distances.argmax()
    return chosen
