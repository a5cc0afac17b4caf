"""What lies inside the body and what can be seen: distances, penetration and per-face visibility, with warp."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avatar.checks import check_finite, check_shape, require

VIEW_COUNT = 32
LOWEST_VIEW = -0.35  # cameras look from no lower than this sine of elevation: never straight up a skirt


@dataclass(frozen=True)
class Penetration:
    """How far cloth reaches into the body: ``share`` of vertices inside, ``mean`` and ``deepest`` depth, metres."""

    share: float
    mean: float
    deepest: float


def warp_mesh(vertices: np.ndarray, faces: np.ndarray):
    """A warp mesh on the CPU for closest points and rays."""
    warp = require("warp")
    warp.config.quiet = True
    return warp.Mesh(
        points=warp.array(np.ascontiguousarray(vertices, np.float32), dtype=warp.vec3, device="cpu"),
        indices=warp.array(np.ascontiguousarray(faces, np.int32).ravel(), dtype=int, device="cpu"),
    )


def body_distances(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray, reach: float) -> np.ndarray:
    """Signed distances of points to a closed mesh, negative inside, ``reach`` where nothing is nearer.

    Args:
        vertices: ``(V, 3)`` metres; faces: ``(F, 3)`` wound outwards; points: ``(N, 3)``; reach: metres.

    Returns:
        ``(N,)`` metres.
    """
    check_shape("points", points, "N 3")
    check_finite("points", points)
    warp = require("warp")
    from avatar.simulate import kernels

    mesh = warp_mesh(vertices, faces)
    queries = warp.array(np.ascontiguousarray(points, np.float32), dtype=warp.vec3, device="cpu")
    distances = warp.zeros(len(points), dtype=float, device="cpu")
    warp.launch(kernels.signed_distances, len(points), [mesh.id, queries, reach, distances], device="cpu")
    return distances.numpy().astype(np.float64)


def measure_penetration(vertices: np.ndarray, faces: np.ndarray, cloth: np.ndarray) -> Penetration:
    """How many cloth vertices lie inside the body, and how deep."""
    depths = np.maximum(-body_distances(vertices, faces, cloth, 0.1), 0)
    inside = depths > 0
    return Penetration(
        float(inside.mean()), float(depths[inside].mean()) if inside.any() else 0.0, float(depths.max(initial=0))
    )


def view_directions(count: int = VIEW_COUNT) -> np.ndarray:
    """Unit directions ``(count, 3)`` towards cameras spread evenly over the sphere above `LOWEST_VIEW`."""
    height = np.linspace(LOWEST_VIEW, 0.95, count)
    angle = np.arange(count) * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - height**2)
    return np.stack([ring * np.sin(angle), height, ring * np.cos(angle)], -1)


def visible_faces(vertices: np.ndarray, faces: np.ndarray, views: np.ndarray | None = None) -> np.ndarray:
    """Which faces some camera sees from their front, with nothing between.

    Args:
        vertices: ``(V, 3)`` of all surfaces together, metres; faces: ``(F, 3)`` wound outwards.
        views: ``(K, 3)`` unit directions towards orthographic cameras; `view_directions` if None.

    Returns:
        ``(F,)`` bool.
    """
    warp = require("warp")
    from avatar.simulate import kernels

    corners = np.asarray(vertices, np.float32)[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
    views = view_directions() if views is None else views
    mesh = warp_mesh(vertices, faces)
    arrays = [
        warp.array(np.ascontiguousarray(a, np.float32), dtype=warp.vec3, device="cpu")
        for a in (corners.mean(1), normals, views)
    ]
    seen = warp.zeros(len(faces), dtype=warp.uint8, device="cpu")
    warp.launch(kernels.see_faces, len(faces), [mesh.id, *arrays, 1e-4, seen], device="cpu")
    return seen.numpy().astype(bool)
