"""Order between surfaces: cloth outside the body, inner garments under outer ones."""

from __future__ import annotations

import numpy as np
import torch

from avatar.checks import require
from avatar.geometry.surface import vertex_normals
from avatar.simulate.visibility import body_distances, warp_mesh

TUCK_REACH = 0.03  # metres: inner cloth farther out than this is no longer taken for covered
TUCK_GAP = 0.004  # metres of room left between two garments
TUCK_ROUNDS = 3


def lift_off(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray, margin: float) -> np.ndarray:
    """Points ``(N, 3)``, those nearer to a closed mesh than the margin (metres) pushed out along its distance."""
    points = points.copy()
    for _ in range(5):
        distance = body_distances(vertices, faces, points, 0.1)
        close = distance < margin
        if not close.any():
            break
        around = points[close, None] + np.eye(3) * 1e-3
        ahead = body_distances(vertices, faces, around.reshape(-1, 3), 0.1).reshape(-1, 3)
        gradient = (ahead - distance[close, None]) / 1e-3
        gradient /= np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-9)
        points[close] += (margin - distance[close] + 2e-4)[:, None] * gradient
    return points


def tuck(inner: np.ndarray, outer: np.ndarray, outer_faces: np.ndarray) -> np.ndarray:
    """Inner cloth ``(N, 3)`` with what shows through an outer garment moved just under it.

    What moves is covered by the outer garment, so no visible surface changes but the one that should not show.

    Args:
        inner: inner cloth vertices, metres; outer: ``(V, 3)``; outer_faces: ``(F, 3)`` wound outwards.
    """
    warp = require("warp")
    from avatar.simulate import kernels

    mesh = warp_mesh(outer, outer_faces)
    normals = vertex_normals(torch.as_tensor(np.asarray(outer, np.float32)), torch.as_tensor(outer_faces)).numpy()
    normals = warp.array(normals, dtype=warp.vec3, device="cpu")
    points = warp.array(np.ascontiguousarray(inner, np.float32), dtype=warp.vec3, device="cpu")
    for _ in range(TUCK_ROUNDS):
        warp.launch(kernels.tuck_under, len(inner), [mesh.id, normals, TUCK_GAP, TUCK_REACH, points], device="cpu")
    return points.numpy().copy()
