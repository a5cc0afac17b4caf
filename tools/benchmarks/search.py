"""Nearest neighbours and the Chamfer distance with normals, by brute force, scipy, open3d and ours."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib.util import find_spec

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from avatar.geometry.neighbours import correspond, nearest, normal_difference, point_to_point
from avatar.geometry.sparse import gather_rows
from avatar.geometry.surface import interpolate, sample_surface, vertex_normals
from benchmarks.avatars import sample_outfit
from benchmarks.comparisons import Comparison, Job, absence
from benchmarks.open3d_search import open3d_nearest

Search = Callable[[np.ndarray, np.ndarray], np.ndarray]


def dressed_clouds(job: Job, points: int, scan_points: int) -> tuple[Tensor, ...]:
    """Template points 5 mm off a body, and its scan: ``(1, N, 3)`` and ``(1, M, 3)``, each with unit normals."""
    outfit = sample_outfit()
    frame = outfit.load("train", outfit.frames("train")[0])
    vertices, faces = torch.as_tensor(frame.body.vertices), outfit.template.faces
    generator = torch.Generator().manual_seed(0)
    samples = sample_surface(vertices, faces, points, generator)
    normals = torch.nn.functional.normalize(interpolate(vertex_normals(vertices, faces), samples), dim=-1)
    chosen = torch.randint(len(frame.scan.points), (scan_points,), generator=generator)
    scan = [torch.as_tensor(values)[chosen] for values in (frame.scan.points, frame.scan.normals)]
    return tuple(
        values[None].to(job.device) for values in (interpolate(vertices, samples) + 0.005 * normals, normals, *scan)
    )


def scipy_nearest(queries: np.ndarray, points: np.ndarray) -> np.ndarray:
    """KD-tree of scipy with its default options, on all threads."""
    return cKDTree(points).query(queries, workers=-1)[1]


def brute_nearest(queries: np.ndarray, points: np.ndarray) -> np.ndarray:
    """All distances, a thousand queries at once."""
    chunks = torch.as_tensor(queries).split(1000)
    cloud = torch.as_tensor(points)
    return torch.cat(
        [torch.cdist(chunk, cloud, compute_mode="donot_use_mm_for_euclid_dist").argmin(1) for chunk in chunks]
    ).numpy()


def other_libraries(names: tuple[str, ...]) -> tuple[dict[str, Search], dict[str, str]]:
    """Searches of the named libraries that are installed, and the reasons why others are missing."""
    known = {"brute force": brute_nearest, "scipy": scipy_nearest, "open3d": open3d_nearest}
    missing = {"open3d"} if find_spec("open3d") is None else set()
    there = {name: known[name] for name in names if name not in missing}
    return there, {name: absence(name) for name in names if name in missing}


def nearest_comparisons(job: Job) -> list[Comparison]:
    """Template points to scan points; ours are trees on the CPU and exact brute force on CUDA."""
    comparisons = []
    for points, scan_points, names in (
        (job.size(10_000, 500), job.size(8_000, 400), ("brute force", "scipy", "open3d")),
        (job.size(50_000, 800), job.size(40_000, 700), ("scipy", "open3d")),
    ):
        found, absent = other_libraries(names)
        load = partial(dressed_clouds, job, points, scan_points)

        def ours(load=load):
            cloud, _, scan, _ = load()
            return lambda: nearest(cloud, scan)[0].cpu().numpy()

        def theirs(search: Search, load=load):
            cloud, _, scan, _ = (values[0].cpu().numpy() for values in load())
            return lambda: search(cloud, scan)

        def gap(mine: np.ndarray, baseline: np.ndarray, load=load) -> float:
            cloud, _, scan, _ = (values[0].cpu().double().numpy() for values in load())
            lengths = [np.linalg.norm(scan[ids] - cloud, axis=1) for ids in (mine, baseline)]
            return float(np.abs(lengths[0] - lengths[1]).max())

        candidates = {"ours": ours} | {name: partial(theirs, search) for name, search in found.items()}
        comparisons.append(
            Comparison("nearest", f"{points:,} in {scan_points:,}", candidates, "ours", gap, absent, points)
        )
    return comparisons


def chamfer_comparisons(job: Job) -> list[Comparison]:
    """Both directions of the Chamfer distance and the normals' difference, as in training."""
    points, scan_points = job.size(50_000, 800), job.size(40_000, 700)
    found, absent = other_libraries(("scipy", "open3d"))

    def ours():
        cloud, normals, scan, scan_normals = dressed_clouds(job, points, scan_points)

        def run() -> np.ndarray:
            pairs = correspond(cloud, scan)
            there = point_to_point(cloud, gather_rows(scan, pairs.scan_of_point)).mean()
            back = point_to_point(scan, gather_rows(cloud, pairs.point_of_scan)).mean()
            turned = normal_difference(normals, gather_rows(scan_normals, pairs.scan_of_point)).mean()
            return torch.stack([there, back, turned]).cpu().numpy()

        return run

    def theirs(search: Search):
        cloud, normals, scan, scan_normals = (v[0].cpu().numpy() for v in dressed_clouds(job, points, scan_points))

        def run() -> np.ndarray:
            to_scan, to_points = search(cloud, scan), search(scan, cloud)
            there = np.square(cloud - scan[to_scan]).sum(1).mean()
            back = np.square(scan - cloud[to_points]).sum(1).mean()
            return np.array([there, back, np.abs(normals - scan_normals[to_scan]).sum(1).mean()])

        return run

    def gap(mine: np.ndarray, baseline: np.ndarray) -> float:
        return float(np.abs(mine / baseline - 1).max())

    candidates = {"ours": ours} | {name: partial(theirs, search) for name, search in found.items()}
    return [Comparison("chamfer", f"{points:,} with {scan_points:,}", candidates, "ours", gap, absent, points)]
