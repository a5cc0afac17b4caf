"""Normals of scan points that have none: estimated from their neighbours, oriented by the body under them."""

from __future__ import annotations

import numpy as np

from avatar.checks import AvatarError, check_finite, check_shape
from avatar.geometry.trees import build_tree

NEIGHBOURS = 16
CHUNK = 50_000  # points at a time


def oriented_normals(points: np.ndarray, body: np.ndarray | None) -> np.ndarray:
    """Unit normals ``(M, 3)`` float32 of ``points (M, 3)``: the smallest principal axis of each one's 16 neighbours.

    They point away from the nearest of the posed body's vertices ``body (V, 3)``. Raises `AvatarError` without a body,
    or for fewer points than neighbours.
    """
    check_shape("points", points, "M 3")
    check_finite("points", points)
    if body is None:
        raise AvatarError("normals: expected a fitted body to orient them by, there is none. Hint: store normals.")
    if len(points) < NEIGHBOURS:
        raise AvatarError(f"points: expected at least {NEIGHBOURS} to estimate normals, got {len(points)}.")
    points, tree = points.astype(np.float64), build_tree(points)
    normals = np.empty_like(points)
    for start in range(0, len(points), CHUNK):
        ids = tree.query(points[start : start + CHUNK], k=NEIGHBOURS)[1]
        around = points[ids] - points[ids].mean(axis=1, keepdims=True)
        normals[start : start + CHUNK] = np.linalg.eigh(np.einsum("mki,mkj->mij", around, around))[1][:, :, 0]
    outward = points - body[build_tree(body).query(points)[1]]
    normals *= np.where((normals * outward).sum(axis=1) < 0, -1, 1)[:, None]
    return normals.astype(np.float32)
