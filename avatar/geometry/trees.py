"""KD-trees over points, all built here, in a way that also ends where numbers below 1e-308 count as zero."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from avatar.checks import AvatarError

Tree = cKDTree
LEAF = 32  # points in a leaf; on surfaces a little faster than scipy's 10 or 16


def build_tree(points: np.ndarray) -> Tree:
    """A KD-tree of points ``(M, D)`` of any float type, none included, split at the midpoints of its cells.

    Where denormal numbers count as zero, as in every command (`environment.prepared_process`), scipy's default tree
    recurses until the stack overflows if the median of an axis is its minimum, 0; so do midpoint splits of the points'
    own bounds below 5e-308. With ``compact_nodes=False`` another axis is tried, so building ends for all coordinates;
    it is also faster. Raises `AvatarError` when a coordinate is not finite.
    """
    try:
        return cKDTree(points, leafsize=LEAF, balanced_tree=False, compact_nodes=False)
    except ValueError as error:
        raise AvatarError(f"points: expected finite coordinates ({error}).") from error
