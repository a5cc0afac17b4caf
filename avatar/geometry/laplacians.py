"""Cotangent Laplacians of triangle meshes, sparse systems on them, and labels voted over a surface."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.sparse import csr_matrix, diags
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from avatar.checks import AvatarError, check_faces, check_shape

FLAT = 1e-12  # square metres; triangles smaller than this have no angles
STIFFEST = 1e3  # largest cotangent: triangles with an angle below 0.06 degrees count as having that angle


def cotangent_laplacian(vertices: np.ndarray, faces: np.ndarray, positive: bool = False) -> csr_matrix:
    """The positive semi-definite cotangent Laplacian ``(V, V)`` of a mesh, without the areas (dimensionless).

    ``positive`` takes negative weights of edges across obtuse angles for zero, so that a maximum principle holds: what
    is solved with the matrix stays within the bounds of its data. Raises `AvatarError` on wrong shapes or indices.
    """
    check_faces(faces, check_shape("vertices", vertices, "V 3")["V"])
    corners = np.asarray(vertices, np.float64)[faces]
    rows, columns, weights = [], [], []
    for corner in range(3):
        first, second = (corner + 1) % 3, (corner + 2) % 3
        to_first, to_second = corners[:, first] - corners[:, corner], corners[:, second] - corners[:, corner]
        across = np.linalg.norm(np.cross(to_first, to_second), axis=1)
        cotangent = np.einsum("fi,fi->f", to_first, to_second) / np.maximum(across, FLAT)
        rows.append(faces[:, first])
        columns.append(faces[:, second])
        weights.append(np.clip(cotangent, -STIFFEST, STIFFEST) / 2)
    shape = (len(vertices), len(vertices))
    edges = csr_matrix((np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))), shape=shape)
    edges = edges + edges.T
    if positive:
        edges.data = np.maximum(edges.data, 0)
    return (diags(np.asarray(edges.sum(axis=1)).reshape(-1)) - edges).tocsr()


def vertex_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The area ``(V,)`` that each vertex stands for, a third of the triangles around it, square metres."""
    areas = trimesh.triangles.area(np.asarray(vertices, np.float64)[faces])
    return np.bincount(faces.reshape(-1), areas.repeat(3) / 3, minlength=len(vertices))


def smooth_votes(
    vertices: np.ndarray, faces: np.ndarray, votes: np.ndarray, confidence: np.ndarray, length: float
) -> np.ndarray:
    """Votes ``(V,)`` in [0, 1] smoothed over a surface; where they are 0.5 is a clean border between two labels.

    Minimises ``sum area confidence (x - votes)^2 + length^2 sum cot (x_i - x_j)^2``: the relaxed form of a graph cut
    (random walker, Grady 2006), solved by one sparse factorisation. Vertices without ``confidence (V,)`` take what
    their neighbours have, by the shape of the surface; votes of patches narrower than about ``length`` metres are
    overruled. NaN on connected parts without any vote. Raises `AvatarError` on wrong shapes and negative values.
    """
    count = check_shape("vertices", vertices, "V 3")["V"]
    check_shape("votes", votes, "V", V=count)
    check_shape("confidence", confidence, "V", V=count)
    if length < 0 or (confidence < 0).any():
        raise AvatarError(f"length, confidence: expected at least 0, got {length} and {confidence.min()}.")
    links = cotangent_laplacian(vertices, faces, positive=True)
    _, part = connected_components(links, directed=False)
    known = np.bincount(part, np.where(confidence > 0, confidence, 0))[part] > 0
    mass = vertex_areas(vertices, faces) * confidence
    tiny = 1e-9 * max(mass.max(initial=0), 1e-12)
    system = (diags(np.where(known, mass + tiny * (mass <= 0), 1.0)) + max(length, 1e-4) ** 2 * links).tocsc()
    smoothed = splu(system).solve(np.where(known, mass * votes + tiny * (mass <= 0) * 0.5, 0.0))
    return np.where(known, np.clip(smoothed, 0, 1), np.nan)


def mesh_parts(faces: np.ndarray, count: int) -> np.ndarray:
    """The connected part ``(count,)`` that each vertex belongs to, counted from 0; vertices without faces are alone."""
    start, end = faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)
    links = csr_matrix((np.ones(len(start), bool), (start, end)), shape=(count, count))
    return connected_components(links, directed=False)[1]


def boundary_edges(faces: np.ndarray) -> np.ndarray:
    """The edges ``(E, 2)`` of one face alone, each in that face's direction."""
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    size = int(faces.max(initial=0)) + 1
    keys, back = edges[:, 0] * size + edges[:, 1], edges[:, 1] * size + edges[:, 0]
    return edges[~np.isin(keys, back)]
