"""Queries of triangle meshes with warp: distances to a body, cloth above and under other cloth, visible faces."""

from __future__ import annotations

import numpy as np
import torch

from avatar.checks import check_finite, check_shape, require
from avatar.geometry.surface import vertex_normals

VIEW_COUNT = 32
LOWEST_VIEW = -0.35  # cameras look from no lower than this sine of elevation: never straight up a skirt
TUCK_REACH = 0.03  # metres: inner cloth farther out than this is no longer taken for covered
TUCK_GAP = 0.004  # metres left between two garments
TUCK_ROUNDS = 3


def vectors(values: np.ndarray):
    """A warp array of 3-vectors on the CPU with a copy of values ``(N, 3)``."""
    warp = require("warp")
    warp.config.quiet = True
    return warp.array(np.ascontiguousarray(values, np.float32), dtype=warp.vec3, device="cpu")


def warp_mesh(vertices: np.ndarray, faces: np.ndarray, moving: bool = False):
    """A warp mesh on the CPU for closest points and rays; a moving one has velocities, which are zero."""
    warp = require("warp")
    indices = warp.array(np.ascontiguousarray(faces, np.int32).ravel(), dtype=int, device="cpu")
    return warp.Mesh(vectors(vertices), indices, vectors(np.zeros_like(vertices)) if moving else None)


def run_kernel(name: str, count: int, *arguments) -> None:
    """Launches a kernel of `avatar.simulate.kernels` on the CPU."""
    from avatar.simulate import kernels

    require("warp").launch(getattr(kernels, name), count, list(arguments), device="cpu")


def body_distances(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray, reach: float) -> np.ndarray:
    """Signed distances ``(N,)`` of points ``(N, 3)`` to a closed mesh wound outwards, metres.

    Negative inside; ``reach`` where nothing is nearer.
    """
    check_shape("points", points, "N 3")
    check_finite("points", points)
    mesh, distances = warp_mesh(vertices, faces), require("warp").zeros(len(points), dtype=float, device="cpu")
    run_kernel("signed_distances", len(points), mesh.id, vectors(points), reach, distances)
    return distances.numpy().astype(np.float64)


def penetration_depths(vertices: np.ndarray, faces: np.ndarray, cloth: np.ndarray) -> np.ndarray:
    """How deep each cloth vertex lies in the body, metres: ``(N,)``, 0 outside."""
    return np.maximum(-body_distances(vertices, faces, cloth, 0.1), 0)


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
    """Inner cloth ``(N, 3)`` with what shows through an outer garment, wound outwards, moved just under it.

    What moves is covered by the outer garment, so no visible surface changes but the one that should not show.
    """
    mesh, points = warp_mesh(outer, outer_faces), vectors(inner)
    normals = vertex_normals(torch.as_tensor(np.asarray(outer, np.float32)), torch.as_tensor(outer_faces)).numpy()
    for _ in range(TUCK_ROUNDS):
        run_kernel("tuck_under", len(inner), mesh.id, vectors(normals), TUCK_GAP, TUCK_REACH, points)
    return points.numpy().copy()


def view_directions(count: int = VIEW_COUNT) -> np.ndarray:
    """Unit directions ``(count, 3)`` towards cameras spread evenly over the sphere above `LOWEST_VIEW`."""
    height = np.linspace(LOWEST_VIEW, 0.95, count)
    angle = np.arange(count) * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - height**2)
    return np.stack([ring * np.sin(angle), height, ring * np.cos(angle)], -1)


def visible_faces(vertices: np.ndarray, faces: np.ndarray, views: np.ndarray | None = None) -> np.ndarray:
    """Which faces ``(F,)`` of all surfaces together, wound outwards, a camera sees from their front unobstructed.

    ``views (K, 3)`` are unit directions towards orthographic cameras; `view_directions` if None.
    """
    corners = np.asarray(vertices, np.float32)[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
    views = view_directions() if views is None else views
    mesh, warp = warp_mesh(vertices, faces), require("warp")
    seen = warp.zeros(len(faces), dtype=warp.uint8, device="cpu")
    arrays = [vectors(values) for values in (corners.mean(1), normals, views)]
    run_kernel("see_faces", len(faces), mesh.id, *arrays, 1e-4, seen)
    return seen.numpy().astype(bool)
