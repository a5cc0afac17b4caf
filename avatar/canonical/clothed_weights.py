"""Skinning weights of a garment's mesh from the body under it: inpainted where they are far apart, or diffused."""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import diags
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from avatar.checks import AvatarError, check_shape
from avatar.geometry.closest import closest_on_mesh, closest_on_triangles
from avatar.geometry.laplacians import cotangent_laplacian, vertex_areas
from avatar.geometry.surface import vertex_normals
from avatar.records import Mesh, Template

MATCH_DISTANCE = 0.05  # of the garment's bounding box's diagonal
MATCH_ANGLE = 30.0  # degrees
FEWEST_KEPT = 8  # largest weights kept a vertex


def body_weights_at(points: np.ndarray, template: Template) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weights ``(N, J)``, distances ``(N,)`` and normals ``(N, 3)`` of the closest points of the body's surface."""
    vertices, faces = template.vertices.numpy().astype(np.float64), template.faces.numpy()
    hits = closest_on_mesh(points, vertices, faces)
    corners = faces[hits.face_ids]
    _, shares = closest_on_triangles(np.asarray(points, np.float64), vertices[corners])
    blend = lambda values: np.einsum("nk,nkc->nc", shares, values[corners])  # noqa: E731
    normals = blend(vertex_normals(template.vertices, template.faces).numpy())
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return blend(template.weights.numpy()), np.abs(hits.signed_distances), normals


def inpaint_weights(mesh: Mesh, template: Template) -> np.ndarray:
    """Weights ``(V, J)`` of a garment by robust transfer (Abdrashitov et al. 2023).

    A vertex takes the weights of the closest point of the body where that is within 5% of the garment's diagonal and
    the normals are within 30 degrees; all others are inpainted by the smoothest function that agrees with those:
    minimal ``tr W^T (L + L M^-1 L) W``, in units of the garment's diagonal; then `tidy_weights`. Connected parts
    without a vertex that agrees take the closest point's. Garment and body in the canonical pose, wound outwards.
    """
    vertices = np.asarray(mesh.vertices, np.float64)
    found, distances, normals = body_weights_at(vertices, template)
    own = vertex_normals(torch.from_numpy(vertices), torch.from_numpy(mesh.faces)).numpy()
    size = np.linalg.norm(np.ptp(vertices, axis=0))
    agree = np.einsum("vc,vc->v", own, normals) >= np.cos(np.radians(MATCH_ANGLE))
    fixed = (distances <= MATCH_DISTANCE * size) & agree
    scaled = vertices / size
    stiffness = cotangent_laplacian(scaled, mesh.faces)
    _, part = connected_components(stiffness, directed=False)
    fixed |= np.bincount(part, fixed)[part] == 0
    masses = np.maximum(vertex_areas(scaled, mesh.faces), 1e-12)
    energy = (stiffness + stiffness @ diags(1 / masses) @ stiffness).tocsr()
    weights, free = found.copy(), ~fixed
    if free.any():
        rows = energy[free]
        weights[free] = splu(rows[:, free].tocsc()).solve(-(rows[:, fixed] @ found[fixed]))
    return tidy_weights(weights)


def diffuse_weights(mesh: Mesh, template: Template) -> np.ndarray:
    """Weights ``(V, J)`` of a garment by heat that the body gives to it, the more the closer it is (as bone heat).

    Solves ``(L + M H) W = M H B`` with B the closest point's weights and H one over the squared distance to it: close
    cloth keeps the body's weights, far cloth blends those of all the body around it. Positive, and sums to 1.
    """
    vertices = np.asarray(mesh.vertices, np.float64)
    found, distances, _ = body_weights_at(vertices, template)
    heat = vertex_areas(vertices, mesh.faces) / np.maximum(distances, 1e-3) ** 2
    system = cotangent_laplacian(vertices, mesh.faces, positive=True) + diags(np.maximum(heat, 1e-12))
    return tidy_weights(splu(system.tocsc()).solve(np.maximum(heat, 1e-12)[:, None] * found))


def tidy_weights(weights: np.ndarray) -> np.ndarray:
    """Weights ``(V, J)`` without negative values, the eight largest of each row scaled to sum to 1, float32.
    Raises `AvatarError` for a row without any positive weight.
    """
    check_shape("weights", weights, "V J")
    weights = np.maximum(weights, 0)
    least = np.sort(weights, axis=1)[:, -min(FEWEST_KEPT, weights.shape[1])][:, None]
    weights = np.where(weights >= least, weights, 0)
    totals = weights.sum(axis=1, keepdims=True)
    if len(weights) and not totals.min() > 0:
        raise AvatarError(f"weights: expected a positive weight a vertex, {int((totals <= 0).sum())} have none.")
    return (weights / totals).astype(np.float32)
