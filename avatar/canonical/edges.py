"""Which points of a scan are neighbours, and where its surface is too hollow to trust that they are."""

from __future__ import annotations

import numpy as np
import torch

from avatar.checks import check_shape
from avatar.geometry.trees import build_tree
from avatar.records import Scan

CONCAVE = 20.0  # 1/m; the paper's 0.2 read per centimetre: grooves of less than 2.5 cm radius
CURVATURE_POINTS, CURVATURE_NEIGHBOURS = 10_000, 16  # on a clothed person, patches of 3 cm radius
EDGE_NEIGHBOURS = 6


def smooth_edges(scan: Scan, count: int, rng: np.random.Generator) -> np.ndarray:
    """At most ``count`` edges ``(E, 2)`` of a scan with neither end in a concave region.

    Edges of the triangles of a mesh, or from points to a few of their nearest ones. Body parts that touch run together
    in a scan, and where they do the surface is concave: weights must not be smoothed across (SCANimate eq. 12 and
    appendix A.4). A scan that is concave everywhere, such as one with its normals turned inside, keeps its edges.
    """
    if scan.faces is None:
        edges = neighbour_edges(scan.points, rng.permutation(len(scan.points))[: -(-count // EDGE_NEIGHBOURS)])
    else:
        edges = np.stack([scan.faces, np.roll(scan.faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    concave = mean_curvature(scan.points, scan.normals) < -CONCAVE
    smooth = edges[~concave[edges].any(axis=1)]
    return rng.permutation(smooth if len(smooth) else edges)[:count]


def neighbour_edges(points: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Edges ``(S k, 2)`` from some of the points, given by index, to those nearest to each; they stand together."""
    count = min(EDGE_NEIGHBOURS, len(points) - 1)
    _, ids = nearest_ids(points, points[starts], count + 1)
    return np.stack([np.repeat(starts, count), ids[:, 1:].reshape(-1)], axis=1)


def nearest_ids(points: np.ndarray, queries: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Distances and indices ``(Q, count)`` of the points nearest to queries, on all of torch's threads."""
    tree = build_tree(points)
    distances, ids = tree.query(queries, k=count, workers=torch.get_num_threads())
    return distances.reshape(len(queries), count), ids.reshape(len(queries), count)


def mean_curvature(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Mean curvature ``(N,)`` of the surface under oriented points, 1/m: positive where it bulges, negative in hollows.

    From how far the neighbours lie below the tangent plane; exact on spheres, and not troubled by a scanner's noise,
    because the neighbours are drawn from a thinned cloud and so lie centimetres away.
    """
    check_shape("normals", normals, "N 3", **check_shape("points", points, "N 3"))
    thinned = points[:: -(-len(points) // CURVATURE_POINTS)]
    _, ids = nearest_ids(thinned, points, min(CURVATURE_NEIGHBOURS, len(thinned)))
    offsets = thinned[ids] - points[:, None]
    below = -np.einsum("nkc,nc->n", offsets, normals)
    return 2 * below / np.maximum(np.einsum("nkc,nkc->n", offsets, offsets), 1e-12)
