"""Nearest neighbours on CUDA in one pass over the pairs, none of which is ever stored."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

QUERIES, POINTS = 32, 64  # a tile; 113 registers a thread and no spills on sm_90


@triton.jit
def search(queries, points, found, n, m, QUERIES: tl.constexpr, POINTS: tl.constexpr):
    """Nearest points of QUERIES queries of one row, POINTS at a time; lanes are compared once, at the end."""
    row = tl.program_id(1).to(tl.int64)
    place = tl.program_id(0) * QUERIES + tl.arange(0, QUERIES)
    asked = place < n
    query = queries + (row * n + place) * 3
    x = tl.load(query, mask=asked, other=0.0)[:, None]
    y = tl.load(query + 1, mask=asked, other=0.0)[:, None]
    z = tl.load(query + 2, mask=asked, other=0.0)[:, None]
    least = tl.full((QUERIES, POINTS), float("inf"), tl.float32)
    ids = tl.zeros((QUERIES, POINTS), tl.int32)
    lane = tl.arange(0, POINTS)
    for start in range(0, m, POINTS):
        other = start + lane
        there = other < m
        point = points + (row * m + other) * 3
        dx = x - tl.load(point, mask=there, other=float("inf"))[None, :]
        dy = y - tl.load(point + 1, mask=there, other=float("inf"))[None, :]
        dz = z - tl.load(point + 2, mask=there, other=float("inf"))[None, :]
        squared = dx * dx + dy * dy + dz * dz
        closer = squared < least
        least = tl.where(closer, squared, least)
        ids = tl.where(closer, other[None, :], ids)
    best = tl.argmin(least, axis=1)
    chosen = tl.sum(tl.where(lane[None, :] == best[:, None], ids, 0), axis=1)
    tl.store(found + row * n + place, chosen.to(tl.int64), mask=asked)


def nearest_fused(queries: Tensor, points: Tensor) -> Tensor:
    """Index of the nearest point to each query: ``(B, N, 3)`` and ``(B, M, 3)`` float32 to ``(B, N)`` int64.

    Squares of differences, rounded to float32 (a product and a sum at a time): of points whose distances differ by
    less than that, either may come. Coordinates that are not finite give an index in range.
    """
    frames, count, _ = queries.shape
    found = torch.empty(frames, count, dtype=torch.long, device=queries.device)
    tiles = (triton.cdiv(count, QUERIES), frames)
    with torch.cuda.device_of(queries):  # Triton launches on the current device, whatever the arrays are on
        search[tiles](queries.contiguous(), points.contiguous(), found, count, points.shape[1], QUERIES, POINTS)
    return found
