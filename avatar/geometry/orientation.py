"""Orientation of triangle meshes: the share of faces wound against the rest, and the signed volume."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree


@dataclass(frozen=True)
class Winding:
    """How the faces of a mesh are wound.

    ``against`` is the share of faces, 0 to 0.5, wound against the majority of their connected piece; ``volume`` the
    signed volume in cubed units of the vertices, positive where faces are counter-clockwise seen from outside; both
    count only where most faces agree (a mesh of which half are flipped has no volume to speak of). Of an open mesh
    the volume is the one closed by a fan from the mean of its vertices.
    """

    against: float
    volume: float

    @property
    def inward(self) -> bool:
        """Whether the mesh as a whole is wound inward."""
        return self.volume < 0


def measure_winding(vertices: np.ndarray, faces: np.ndarray) -> Winding:
    """Measures the winding of faces ``(F, 3)`` over ``vertices (V, 3)``; vertices at equal positions count as one.

    Two faces at an edge agree where they run along it in opposite directions; edges of three or more faces say
    nothing. Agreement is followed along a spanning forest of the faces, so that one bad edge spoils nothing else.
    """
    vertices = np.asarray(vertices, np.float64)
    joined = np.unique(vertices, axis=0, return_inverse=True)[1].reshape(-1)[faces]
    count = len(faces)
    one, other, agree = _neighbours(joined)
    weights = coo_matrix((np.ones(len(one)), (one, other)), (count, count))
    forest = minimum_spanning_tree(weights).tocoo()
    signs = dict(zip(zip(one.tolist(), other.tolist()), agree.tolist()))
    same = np.array([signs[pair] for pair in zip(forest.row.tolist(), forest.col.tolist())], bool)
    # the double cover: face f as it is (f) and turned round (f + count)
    rows = np.concatenate([forest.row, forest.row + count])
    turned = np.where(same, 0, count)
    columns = np.concatenate([forest.col + turned, (forest.col + turned + count) % (2 * count)])
    cover = coo_matrix((np.ones(len(rows)), (rows, columns)), (2 * count, 2 * count))
    pieces, labels = connected_components(cover, directed=False)
    kept, flipped = np.bincount(labels[:count], minlength=pieces), np.bincount(labels[count:], minlength=pieces)
    against = int(np.minimum(kept, flipped).sum()) // 2  # each piece is there twice
    a, b, c = (vertices[faces[:, corner]] - vertices.mean(axis=0) for corner in range(3))
    volume = float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)
    return Winding(against / max(count, 1), volume)


def _neighbours(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of faces ``(P,), (P,)`` that share an edge with each other alone, first below second, and if they agree."""
    starts, ends = faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)
    owners = np.repeat(np.arange(len(faces)), 3)
    low, high = np.minimum(starts, ends), np.maximum(starts, ends)
    order = np.lexsort((owners, high, low))
    low, high, owners, forward = low[order], high[order], owners[order], (starts < ends)[order]
    new = np.ones(len(low) + 1, bool)
    new[1:-1] = (low[1:] != low[:-1]) | (high[1:] != high[:-1])
    firsts = np.flatnonzero(new)
    pairs = firsts[:-1][np.diff(firsts) == 2]
    pairs = pairs[(low[pairs] != high[pairs]) & (owners[pairs] != owners[pairs + 1])]
    one, other, agree = owners[pairs], owners[pairs + 1], forward[pairs] != forward[pairs + 1]
    unique = np.unique(one * (len(faces) + 1) + other, return_index=True)[1]  # two faces may share two edges
    return one[unique], other[unique], agree[unique]
