"""Nearest neighbours by open3d, which `avatar.geometry.neighbours` is compared with."""

from __future__ import annotations

import numpy as np

from avatar.checks import require


def open3d_nearest(queries: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Index ``(N,)`` of the nearest of ``(M, 3)`` points to each of ``(N, 3)`` queries, tree building included.

    Raises:
        AvatarError: when open3d is not installed.
    """
    core = require("open3d.core")
    search = core.nns.NearestNeighborSearch(core.Tensor(np.ascontiguousarray(points)))
    search.knn_index()
    return search.knn_search(core.Tensor(np.ascontiguousarray(queries)), 1)[0].numpy()[:, 0]
