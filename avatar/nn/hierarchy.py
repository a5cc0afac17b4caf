"""The point hierarchy of PointNet++ and its sparse gathers: all that depends on the template alone, computed once."""

from __future__ import annotations

import copy
import hashlib
import itertools
from dataclasses import astuple, dataclass

import torch
from torch import Tensor, nn

from avatar.checks import AvatarError, check_shape
from avatar.geometry.neighbours import ball_query, k_nearest
from avatar.geometry.sparse import SparseRows, gather_sum
from avatar.geometry.surface import farthest_points

BUILT: dict[tuple, nn.ModuleList] = {}  # hierarchies by their points and sizes, the oldest first
KEPT = 4  # as many of them


@dataclass
class HierarchyConfig:
    """Sizes of the levels of a point hierarchy, finest first."""

    points: tuple[int, ...] = (4096, 2048, 1024, 512, 256, 128)
    radii: tuple[float, ...] = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6)  # metres
    neighbours: int = 32  # group size of every ball query
    spread: bool = True  # groups are spread over their balls; False takes the nearest points, far inside the radius

    def __post_init__(self):
        self.points, self.radii = tuple(self.points), tuple(self.radii)
        if len(self.points) != len(self.radii) or not self.points:
            got = f"{len(self.points)} and {len(self.radii)}"
            raise AvatarError(f"points, radii: expected one radius a level, got {got}.")
        if any(a <= b for a, b in itertools.pairwise(self.points)) or min(self.radii) <= 0:
            got = f"{self.points}, {self.radii}"
            raise AvatarError(f"points, radii: expected falling sizes and positive radii, got {got}.")


class FixedRows(nn.Module):
    """Weighted sums of rows that stay the same, with their transpose made once: ``(..., V, C)`` to ``(..., R, C)``."""

    def __init__(self, sparse: SparseRows, shape: tuple[int, ...] = (-1,)):
        """Keeps the sums; ``shape`` is that of the R results."""
        super().__init__()
        self.rows, self.shape, back = sparse.rows, shape, sparse.transpose()
        for name in ("ids", "starts", "weights"):
            self.register_buffer(name, getattr(sparse, name), persistent=False)
            self.register_buffer(f"back_{name}", getattr(back, name), persistent=False)

    @classmethod
    def of_groups(cls, groups: Tensor, rows: int) -> FixedRows:
        """Gathers constant groups ``(S, K)`` of rows: ``(B, N, C)`` to ``(B, S, K, C)``."""
        return cls(SparseRows.of_table(groups.reshape(-1, 1), rows), groups.shape)

    def forward(self, values: Tensor) -> Tensor:
        sparse = SparseRows(self.ids, self.starts, self.weights, self.rows)
        back = SparseRows(self.back_ids, self.back_starts, self.back_weights, len(self.starts))
        return gather_sum(values, sparse, back).unflatten(-2, self.shape)


class Level(nn.Module):
    """One step of a hierarchy: how to gather from the finer level, and how to interpolate back to it.

    Buffers: ``positions (S, 3)`` of this level's points, ``finer_positions (N, 3)``, ``groups (S, K)`` ball-query
    neighbours in the finer level, ``up_ids (N, 3)`` and ``up_weights (N, 3)`` inverse-squared-distance weights of
    the three nearest coarse points (PointNet++ eq. 2).
    """

    def __init__(self, finer: Tensor, coarse: Tensor, radius: float, neighbours: int, ranks: Tensor | None = None):
        """Builds the step from points ``(N, 3)`` to some of them ``(S, 3)``; ``ranks (N,)`` as in `ball_query`."""
        super().__init__()
        self.radius, self.spread = radius, ranks is not None
        up_ids = k_nearest(finer[None], coarse[None], min(3, len(coarse)))[0]
        inverse = 1 / ((finer[:, None] - coarse[up_ids]).square().sum(dim=-1) + 1e-8)
        for name, value in {
            "positions": coarse,
            "finer_positions": finer,
            "groups": ball_query(coarse, finer, radius, neighbours, ranks),
            "up_ids": up_ids,
            "up_weights": inverse / inverse.sum(dim=1, keepdim=True),
        }.items():
            self.register_buffer(name, value.clone(), persistent=False)
        self.group = FixedRows.of_groups(self.groups, len(finer))
        self.interpolate_up = FixedRows(SparseRows.of_table(self.up_ids, len(coarse), self.up_weights))


def centre_rows(level: Level) -> FixedRows:
    """Picks each coarse point's own row among the finer ones: ``(B, N, C)`` to ``(B, S, C)``."""
    own = k_nearest(level.positions[None], level.finer_positions[None], 1)[0]
    return FixedRows(SparseRows.of_table(own, len(level.finer_positions)))


def build_levels(positions: Tensor, config: HierarchyConfig) -> nn.ModuleList:
    """The levels of a hierarchy over constant points ``(V, 3)``, finest first; nested farthest-point subsets.

    Each call gives modules of its own; the same points and sizes are searched once a process, as a run's network is
    built again for predictions and scores. Raises `AvatarError` when the template has no more points than the finest
    level.
    """
    count = check_shape("positions", positions, "V 3")["V"]
    if count <= config.points[0]:
        expected = f"a finest level below the template's {count} vertices"
        raise AvatarError(f"points: expected {expected}, got {config.points[0]}.")
    finer = positions.detach()
    digest = hashlib.sha256(finer.cpu().numpy().tobytes()).digest()
    key = (digest, str(finer.dtype), str(finer.device), *astuple(config))
    if key not in BUILT:
        built = _search_levels(finer, config)
        while len(BUILT) >= KEPT:
            BUILT.pop(next(iter(BUILT)))
        BUILT[key] = built
    return copy.deepcopy(BUILT[key])


def _search_levels(finer: Tensor, config: HierarchyConfig) -> nn.ModuleList:
    levels = nn.ModuleList()
    order = farthest_points(finer, config.points[0])
    ranks = torch.arange(len(order), len(order) + len(finer), device=order.device)  # of the others, as they come
    ranks[order] = torch.arange(len(order), device=order.device)
    for count, radius in zip(config.points, config.radii):
        levels.append(Level(finer, finer[order[:count]], radius, config.neighbours, ranks if config.spread else None))
        finer, order = levels[-1].positions, torch.arange(count, device=order.device)
        ranks = order
    return levels
