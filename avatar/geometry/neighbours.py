"""Exact nearest neighbours, by KD-trees on the CPU and brute force on devices, and distances to them, unreduced."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from avatar.checks import AvatarError, check_shape
from avatar.geometry.trees import Tree, build_tree

CHUNK_PAIRS = 1 << 27  # distances held at once by the chunked search of devices: 512 MiB in float32
WARNED: set[str] = set()  # kinds of errors of Triton that have been reported
report = logging.getLogger(__name__)


def nearest(queries: Tensor, points: Tensor) -> Tensor:
    """Index of the nearest point to each query. ``(B, N, 3)`` and ``(B, M, 3)`` to ``(B, N)`` int64."""
    return k_nearest(queries, points, 1).squeeze(-1)


@torch.no_grad()
def k_nearest(queries: Tensor, points: Tensor, k: int, trees: Sequence[Tree] = ()) -> Tensor:
    """Indices of k nearest points to each query, nearest first: ``(B, N, 3)``, ``(B, M, 3)`` to ``(B, N, k)`` int64.

    Exact on every device: distances are sums of squared differences, never the expanded product form. Among points at
    the same distance any may come, the same each time. ``trees`` are those of the points on the CPU, where they are
    built already. Raises `AvatarError` on wrong shapes, k below 1, fewer than k points or, on the CPU, coordinates that
    are not finite; on a device, where a check would stall the stream, their indices stay in range.
    """
    dims = check_shape("points", points, "B M 3", B=check_shape("queries", queries, "B N 3")["B"])
    if not 1 <= k <= dims["M"]:
        raise AvatarError(f"k, points: expected k of 1 to the {dims['M']} points, got {k}.")
    if queries.device.type == "cpu":
        trees = trees or [build_tree(cloud) for cloud in points.double().numpy()]
        return torch.stack([_query(tree, query, k) for tree, query in zip(trees, queries.double().numpy())])
    if k == 1 and queries.is_cuda and torch.float64 not in (queries.dtype, points.dtype):
        found = try_fused(queries.float(), points.float())
        if found is not None:
            return found.unsqueeze(-1)
    return torch.stack([_k_nearest_chunked(q, p, k) for q, p in zip(queries, points)])


@dataclass(frozen=True)
class Correspondences:
    """Nearest neighbours both ways: ``scan_of_point (B, N)`` and ``point_of_scan (B, M)``, int64, no gradient."""

    scan_of_point: Tensor
    point_of_scan: Tensor


@torch.no_grad()
def correspond(points: Tensor, scan: Tensor) -> Correspondences:
    """What `nearest` gives for points ``(B, N, 3)`` in a scan ``(B, M, 3)`` and the other way, faster on the CPU.

    Points are queried in the order of their own tree, so the other tree's branches stay in the processor's cache. Among
    points at the same distance another may come than from `nearest`. Raises `AvatarError` as `k_nearest`.
    """
    dims = check_shape("points", points, "B N 3")
    check_shape("scan", scan, "B M 3", B=dims["B"])
    if points.device.type != "cpu" or not (points.shape[1] and scan.shape[1]):
        return Correspondences(nearest(points, scan), nearest(scan, points))
    clouds = [cloud.double().numpy() for batch in (points, scan) for cloud in batch]
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:  # scipy lets go of Python's lock
        trees = list(pool.map(build_tree, clouds))
        found = list(pool.map(_query_in_order, trees, trees[len(points) :] + trees[: len(points)]))
    return Correspondences(torch.stack(found[: len(points)]), torch.stack(found[len(points) :]))


class FixedPoints:
    """Points ``(M, 3)`` that stay the same, such as a body at rest: their tree is built once, at the first search."""

    def __init__(self, points: Tensor):
        check_shape("points", points, "M 3")
        self.points, self.trees = points.detach(), []

    def k_nearest(self, queries: Tensor, k: int) -> Tensor:
        """Indices ``(..., k)`` of the k nearest points to queries ``(..., 3)`` on any device; as `k_nearest`."""
        check_shape("queries", queries, "... 3")
        self.points = self.points.to(queries.device)
        if queries.device.type == "cpu" and not self.trees:
            self.trees = [build_tree(self.points.double().numpy())]
        found = k_nearest(queries.reshape(1, -1, 3), self.points[None], k, self.trees)[0]
        return found.unflatten(0, queries.shape[:-1])


def try_fused(queries: Tensor, points: Tensor) -> Tensor | None:
    """`kernels.nearest_fused`; None, with one warning for each kind of error, where Triton is missing or fails.

    It needs a C compiler, too. What fails once, such as for want of memory, is tried again at the next call; a package
    that is not there is not looked for again.
    """
    if WARNED & {"ImportError", "ModuleNotFoundError"}:
        return None
    try:
        from avatar.geometry.kernels import nearest_fused

        return nearest_fused(queries, points)
    except Exception as error:  # whatever a compiler or a driver says: it is only slower without
        kind, text = type(error).__name__, "Nearest neighbours on CUDA go the slow way, for Triton failed (%s: %s)."
        if kind not in WARNED:
            WARNED.add(kind)
            report.warning(text, kind, error)
        return None


def _query(tree: Tree, queries: np.ndarray, k: int) -> Tensor:
    """Indices ``(N, k)`` of the nearest points of a tree to finite queries."""
    try:
        _, ids = tree.query(queries, k=k, workers=torch.get_num_threads())
    except ValueError as error:
        raise AvatarError(f"queries: expected finite coordinates ({error}).") from error
    return torch.from_numpy(ids).reshape(len(queries), k).long()


def _query_in_order(tree: Tree, other: Tree) -> Tensor:
    """Indices ``(N,)`` of the nearest points of the other tree to this tree's points, queried in this tree's order."""
    ids = torch.empty(tree.n, dtype=torch.long)
    ids[tree.indices] = torch.from_numpy(other.query(tree.data[tree.indices])[1])
    return ids


def _k_nearest_chunked(queries: Tensor, points: Tensor, k: int) -> Tensor:
    """Brute force over chunks of queries for one cloud, with squares of differences (exact)."""
    chunk = max(1, CHUNK_PAIRS // len(points))
    found = []
    for part in queries.split(chunk):
        squared = (part[:, None, 0] - points[None, :, 0]).square_()
        for axis in (1, 2):
            squared.add_((part[:, None, axis] - points[None, :, axis]).square_())
        found.append(squared.argmin(dim=1, keepdim=True) if k == 1 else squared.topk(k, largest=False).indices)
    return torch.cat(found)


def ball_query(centres: Tensor, points: Tensor, radius: float, k: int, ranks: Tensor | None = None) -> Tensor:
    """Up to k points within a radius of each centre, its nearest first; short lists repeat their nearest point.

    Of a ball that holds more, the nearest to its centre or, with ``ranks (N,)``, those of lowest rank beside the very
    nearest: ranks in the order of farthest-point sampling spread them over the ball, whatever the density of points.
    For a constant template, called once (CloSET 4, network architecture). ``(S, 3)`` and ``(N, 3)``, metres, to
    ``(S, k)`` int64. A centre with no point in reach gets its nearest point k times.
    """
    check_shape("centres", centres, "S 3")
    check_shape("points", points, "N 3")
    if ranks is not None:
        return _ranked_ball_query(centres, points, radius, k, ranks)
    reach = min(k, len(points))
    ids = k_nearest(centres[None], points[None], reach)[0]
    distances = (points[ids] - centres[:, None]).norm(dim=-1)
    ids = torch.where(distances <= radius, ids, ids[:, :1])
    return torch.cat([ids, ids[:, :1].expand(-1, k - reach)], dim=1)


def _ranked_ball_query(centres: Tensor, points: Tensor, radius: float, k: int, ranks: Tensor) -> Tensor:
    groups, order = nearest(centres[None], points[None])[0, :, None].expand(-1, k).cpu().numpy().copy(), ranks.cpu()
    tree = build_tree(points.double().cpu().numpy())
    balls = tree.query_ball_point(centres.double().cpu().numpy(), radius, return_sorted=False)
    for group, ball in zip(groups, balls):
        others = np.setdiff1d(np.asarray(ball, np.int64), group[:1], assume_unique=True)
        kept = others[order.numpy()[others].argsort()[: k - 1]]
        group[1 : 1 + len(kept)] = kept
    return torch.from_numpy(groups).to(points.device)


def point_to_point(points: Tensor, anchors: Tensor) -> Tensor:
    """Squared distance of each point to its anchor (CloSET eq. 4). ``(B, N, 3)`` twice to ``(B, N)``, m^2."""
    dims = check_shape("points", points, "B N 3")
    check_shape("anchors", anchors, "B N 3", **dims)
    return (points - anchors).square().sum(dim=-1)


def point_to_plane(points: Tensor, anchors: Tensor, normals: Tensor) -> Tensor:
    """Squared distance of each point to the tangent plane at its anchor. ``(B, N, 3)`` thrice to ``(B, N)``, m^2.

    With nearest scan points as anchors this approximates squared point-to-surface distance and does not penalise
    sliding along the cloth (POP's prediction-to-scan term).
    """
    dims = check_shape("points", points, "B N 3")
    check_shape("anchors", anchors, "B N 3", **dims)
    check_shape("normals", normals, "B N 3", **dims)
    return ((points - anchors) * normals).sum(dim=-1).square()


def normal_difference(normals: Tensor, anchor_normals: Tensor) -> Tensor:
    """L1 distance between unit normals (CloSET eq. 5). ``(B, N, 3)`` twice to ``(B, N)``, in [0, 2 sqrt 3]."""
    dims = check_shape("normals", normals, "B N 3")
    check_shape("anchor_normals", anchor_normals, "B N 3", **dims)
    return (normals - anchor_normals).abs().sum(dim=-1)
