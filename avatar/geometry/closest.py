"""Exact closest points on a triangle mesh, with a sign: how far a point lies from a surface, and on which side."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import trimesh

from avatar.checks import AvatarError, check_finite, check_shape
from avatar.geometry.trees import build_tree

FIRST_CANDIDATES = 8  # triangles tried for each query before asking whether a farther one could be closer
CHUNK_PAIRS = 1 << 17  # query-triangle pairs compared at once: what fits a processor's cache is fastest


class SurfaceHits(NamedTuple):
    """Closest points ``(N, 3)`` on a mesh, their triangles and signed distances, ``(N,)``, metres, negative inside."""

    points: np.ndarray
    face_ids: np.ndarray
    signed_distances: np.ndarray


def closest_on_mesh(
    queries: np.ndarray, vertices: np.ndarray, faces: np.ndarray, exact_within: float = np.inf
) -> SurfaceHits:
    """The closest point of a mesh ``(V, 3)``, ``(F, 3)`` to each query ``(N, 3)``, exactly, and the query's side of it.
    The sign is that of the angle-weighted pseudo-normal (Baerentzen and Aanaes 2005), which is right for every closed
    mesh wound counter-clockwise from outside, also at edges and vertices. Beyond ``exact_within`` metres the first
    triangles tried will do (the distance is then too large, by less than the size of an average triangle); that saves
    most of the time where far points do not matter.
    """
    check_shape("queries", queries, "N 3")
    check_shape("vertices", vertices, "V 3")
    if check_shape("faces", faces, "F 3")["F"] == 0:
        raise AvatarError("faces: expected a mesh with faces, got none.")
    queries, vertices = np.asarray(queries, np.float64), np.asarray(vertices, np.float64)
    check_finite("queries", queries)
    check_finite("vertices", vertices)
    face_ids = _closest_faces(queries, vertices, np.asarray(faces), exact_within)
    points, weights = closest_on_triangles(queries, vertices[faces[face_ids]])
    away = queries - points
    normals = _pseudo_normals(trimesh.Trimesh(vertices, faces, process=False), face_ids, weights)
    sides = np.where((away * normals).sum(axis=1) < 0, -1.0, 1.0)
    return SurfaceHits(points, face_ids, sides * np.linalg.norm(away, axis=1))


def _closest_faces(queries: np.ndarray, vertices: np.ndarray, faces: np.ndarray, exact_within: float) -> np.ndarray:
    """The closest triangle of each query ``(N,)``: candidates by the distance of their pieces' centres. Lists of
    candidates grow until no piece left out could be closer: its centre is too far away for its size. Long triangles are
    cut into pieces about as small as the average one, for a single long one would make every search wide.
    """
    corners = vertices[faces]
    areas = trimesh.triangles.area(corners)
    longest = 1.6 * np.sqrt(areas.mean()) + np.ptp(corners) * 1e-3
    _, owners, centres, reach = cut_triangles(vertices, faces, longest)
    tree, reach = build_tree(centres), reach.max()
    face_ids, remaining, k = np.empty(len(queries), np.int64), np.arange(len(queries)), FIRST_CANDIDATES
    while len(remaining):
        k, unsure = min(k, tree.n), []
        for ids in np.array_split(remaining, len(remaining) * k // CHUNK_PAIRS + 1):
            radii, found = tree.query(queries[ids], k=np.arange(1, k + 1), workers=-1)
            candidates = owners[found]
            squared, _ = _candidates(np.repeat(queries[ids], k, axis=0), corners[candidates.ravel()])
            squared = np.minimum.reduce(squared).reshape(-1, k)
            face_ids[ids] = candidates[np.arange(len(ids)), squared.argmin(axis=1)]
            nearest = np.sqrt(np.maximum(squared.min(axis=1), 0))
            unsure.append(ids[(nearest > radii[:, -1] - reach) & (nearest <= exact_within)])
        remaining = np.concatenate(unsure) if k < tree.n else remaining[:0]
        k *= 3
    return face_ids


def cut_triangles(vertices: np.ndarray, faces: np.ndarray, longest: float) -> tuple[np.ndarray, ...]:
    """Triangles cut into pieces of at most an edge length: corners ``(P, 3, 3)``, faces, centres, reach from them."""
    places, pieces, owners = trimesh.remesh.subdivide_to_size(vertices, faces, longest, max_iter=20, return_index=True)
    centres = places[pieces].mean(axis=1)
    return places[pieces], owners, centres, np.linalg.norm(places[pieces] - centres[:, None], axis=2).max(axis=1)


def closest_on_triangles(queries: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The closest point of one triangle to each query. ``(N, 3)`` and ``(N, 3, 3)`` to points and weights, ``(N, 3)``.
    Weights are barycentric; those of a point on an edge or at a corner are exactly zero elsewhere.
    """
    squared, weights = _candidates(queries, corners)
    best = np.array(weights)[np.argmin(squared, axis=0), :, np.arange(len(queries))]
    return np.einsum("ni,nij->nj", best, corners), best


def _candidates(queries: np.ndarray, corners: np.ndarray) -> tuple[list, list]:
    """Squared distances ``(N,)`` to the closest points inside triangles and on their edges, with barycentric weights. A
    triangle is a + s u + t v, and the squared distance a quadratic in (s, t), from dot products alone. Inside comes
    first, infinitely far where the plane's minimum is not inside.
    """
    first, second, away = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], queries - corners[:, 0]
    products = ((first, first), (first, second), (second, second), (away, first), (away, second), (away, away))
    uu, uv, vv, au, av, aa = (np.einsum("ni,ni->n", *pair) for pair in products)
    tiny, zero = np.finfo(np.float64).tiny, np.zeros(len(queries))
    area = uu * vv - uv * uv
    area = np.where(area > 0, area, np.inf)  # of a triangle without area the edges are all there is
    s, t = (vv * au - uv * av) / area, (uu * av - uv * au) / area
    inside = (s > 0) & (t > 0) & (s + t < 1)
    s, t = s * inside, t * inside
    on_first, on_second = np.clip(au / np.maximum(uu, tiny), 0, 1), np.clip(av / np.maximum(vv, tiny), 0, 1)
    on_third = np.clip((av - au + uu - uv) / np.maximum(uu - 2 * uv + vv, tiny), 0, 1)
    weights = [(1 - s - t, s, t), (1 - on_first, on_first, zero), (1 - on_second, zero, on_second)]
    weights.append((zero, 1 - on_third, on_third))
    squared = [aa + s * (s * uu + 2 * t * uv - 2 * au) + t * (t * vv - 2 * av) for _, s, t in weights]
    squared[0] = np.where(inside, np.minimum.reduce(squared), np.inf)
    return squared, weights


def _pseudo_normals(mesh: trimesh.Trimesh, face_ids: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Pseudo-normals where closest points lie: of the face, of the edge or, weighted by angles, of the corner."""
    normals, on = mesh.face_normals[face_ids], weights > 0
    edge, corner = on.sum(axis=1) == 2, on.sum(axis=1) == 1
    sums = np.zeros((len(mesh.edges_unique), 3))
    np.add.at(sums, mesh.faces_unique_edges.ravel(), np.repeat(mesh.face_normals, 3, axis=0))
    across = (weights[edge].argmin(axis=1) + 1) % 3  # a face's edge i runs from its corner i to the next
    normals[edge] = sums[mesh.faces_unique_edges[face_ids[edge], across]]
    normals[corner] = mesh.vertex_normals[mesh.faces[face_ids[corner], weights[corner].argmax(axis=1)]]
    return normals
