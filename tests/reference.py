"""Slow truths: the plainest loops that say what the fast functions must give. Numpy, one point at a time."""

from __future__ import annotations

import math

import numpy as np


def nearest_loop(queries: np.ndarray, points: np.ndarray, k: int) -> np.ndarray:
    """Indices ``(N, k)`` of the k nearest points to each query, nearest first, the lower index first in a tie."""
    found = []
    for query in queries:
        distances = [sum((a - b) ** 2 for a, b in zip(query, point)) for point in points]
        found.append(sorted(range(len(points)), key=lambda i: (distances[i], i))[:k])
    return np.array(found)


def chamfer_loop(points: np.ndarray, scan: np.ndarray) -> tuple[float, float]:
    """Mean squared distance to the nearest neighbour, points to scan and scan to points."""

    def one_way(sources, targets):
        return sum(min(sum((s - t) ** 2) for t in targets) for s in sources) / len(sources)

    return one_way(points, scan), one_way(scan, points)


def farthest_loop(points: np.ndarray, count: int, start: int) -> list[int]:
    """Farthest-point sampling: each pick is the point whose nearest picked point is farthest, lowest index first."""
    chosen = [start]
    while len(chosen) < count:
        gaps = [min(sum((p - points[c]) ** 2) for c in chosen) if i not in chosen else -1 for i, p in enumerate(points)]
        chosen.append(gaps.index(max(gaps)))
    return chosen


def ball_loop(centres: np.ndarray, points: np.ndarray, radius: float, k: int) -> list[list[int]]:
    """The k nearest points within a radius, nearest first; short lists repeat the nearest point of all."""
    groups = []
    for centre in centres:
        order = sorted(range(len(points)), key=lambda i: math.dist(centre, points[i]))
        inside = [i for i in order if math.dist(centre, points[i]) <= radius][:k]
        groups.append(inside + [order[0]] * (k - len(inside)))
    return groups


def ranked_ball_loop(
    centres: np.ndarray, points: np.ndarray, radius: float, k: int, ranks: list[int]
) -> list[list[int]]:
    """The nearest point, then the k - 1 of lowest rank within a radius; short lists repeat the nearest."""
    groups = []
    for nearest, *others in ball_loop(centres, points, radius, len(points)):
        group = [nearest, *sorted(set(others) - {nearest}, key=lambda i: ranks[i])][:k]
        groups.append(group + [nearest] * (k - len(group)))
    return groups


def barycentric_loop(values: np.ndarray, vertex_ids: np.ndarray, barycentric: np.ndarray) -> np.ndarray:
    """Values ``(V, C)`` blended at each sample: ``(N, C)``."""
    return np.array([sum(w * values[v] for v, w in zip(ids, weights)) for ids, weights in zip(vertex_ids, barycentric)])


def rotation_loop(axis_angle: np.ndarray) -> np.ndarray:
    """Rodrigues' formula for one rotation vector."""
    angle = math.sqrt(sum(axis_angle**2))
    if angle == 0:
        return np.eye(3)
    x, y, z = axis_angle / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def skin_loop(
    vertices: np.ndarray, weights: np.ndarray, joints: np.ndarray, parents: tuple[int, ...], pose: np.ndarray
) -> np.ndarray:
    """Linear blend skinning of one body from its rest pose: every vertex moved by every joint, then blended."""
    world = []
    for joint, parent in enumerate(parents):
        local = np.eye(4)
        local[:3, :3] = rotation_loop(pose[joint])
        local[:3, 3] = joints[joint] - (joints[parent] if parent >= 0 else 0)
        world.append(world[parent] @ local if parent >= 0 else local)
    posed = np.zeros_like(vertices)
    for v, vertex in enumerate(vertices):
        for joint in range(len(parents)):
            moved = world[joint] @ np.append(vertex - joints[joint], 1.0)
            posed[v] += weights[v, joint] * moved[:3]
    return posed
