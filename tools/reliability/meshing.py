"""`mesh`: a thousand frames meshed by one Poisson worker process, with invalid point clouds and killed workers."""

from __future__ import annotations

import os
import signal
import threading

import numpy as np

from avatar.checks import AvatarError
from avatar.export.meshing import PoissonConfig, PoissonMesher
from avatar.io.meshes import check_mesh
from avatar.records import PointCloud
from reliability.findings import Finding, all_of, none_of
from reliability.workers import resident_memory

POINTS, DEPTH = 4000, 6
WARM_UP = 0.1  # share of the frames after which memory is first measured
GROWTH = 5.0  # per cent, at most
INVALID_EVERY = 20  # frames


def invalid_clouds() -> dict[str, PointCloud]:
    """Point clouds of every class that crashes or hangs open3d, or gives an empty mesh."""
    valid = deforming_sphere(0)
    points, normals = valid.points, valid.normals

    def with_entry(array: np.ndarray, value: float) -> np.ndarray:
        changed = array.copy()
        changed[7, 1] = value
        return changed

    return {
        "a NaN point": PointCloud(with_entry(points, np.nan), normals),
        "an infinite point": PointCloud(with_entry(points, np.inf), normals),
        "a NaN normal": PointCloud(points, with_entry(normals, np.nan)),
        "one point": PointCloud(points[:1], normals[:1]),
        "no point": PointCloud(points[:0], normals[:0]),
        "identical points": PointCloud(np.zeros_like(points), normals),
        "normals of length zero": PointCloud(points, np.zeros_like(normals)),
        "huge coordinates": PointCloud(points * 1e30, normals),
        "tiny coordinates": PointCloud(points * 1e-12, normals),
        "collinear points": PointCloud(points * [1.0, 0.0, 0.0], normals),
        "random normals": PointCloud(points, np.random.default_rng(0).permutation(normals)),
        "an outlier": PointCloud(with_entry(points, 900.0), normals),
    }


def deforming_sphere(frame: int) -> PointCloud:
    """Points on a sphere that deforms from frame to frame."""
    rng = np.random.default_rng(frame)
    directions = rng.normal(size=(POINTS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radius = 0.8 + 0.1 * np.sin(4 * directions[:, :1] + frame)
    return PointCloud(radius * directions, directions)


def mesh_trial(frames: int) -> list[Finding]:
    """Meshes frame after frame in this process; every twentieth is invalid, or its worker is killed."""
    invalid, done, refused, untyped, killed, ended = list(invalid_clouds().values()), 0, 0, 0, 0, 0
    memory: list[int] = []
    with PoissonMesher(PoissonConfig(depth=DEPTH, max_hole=0.2, timeout_s=60)) as mesher:
        for frame in range(frames):
            kind = frame // INVALID_EVERY if frame % INVALID_EVERY == INVALID_EVERY - 1 else None
            kill = kind is not None and kind % 4 == 3
            cloud = deforming_sphere(frame) if kind is None or kill else invalid[kind % len(invalid)]
            if kill and mesher.worker_pid:
                killed += 1
                threading.Timer(0.02, os.kill, (mesher.worker_pid, signal.SIGKILL)).start()
            try:
                check_mesh(mesher.mesh(cloud))
                done += 1
            except AvatarError as error:
                refused += 1
                ended += "died" in str(error)
            except Exception:
                untyped += 1
            if frame >= WARM_UP * frames and kind is None:
                memory.append(resident_memory(os.getpid()))
    growth = round(100 * (np.mean(memory[-20:]) / np.mean(memory[:20]) - 1), 2)
    valid = frames - frames // INVALID_EVERY
    failed = "workers killed by SIGKILL, each one failed frame at most"
    return [
        all_of(
            "mesh",
            f"frames meshed or refused with a typed error ({POINTS} points, depth {DEPTH})",
            done + refused,
            frames,
        ),
        Finding("mesh", "valid meshes", done, f"of {valid} valid clouds", frames, valid),
        none_of("mesh", "untyped errors", untyped, frames),
        Finding("mesh", failed, ended, f"of {killed}", killed, None, killed),
        Finding(
            "mesh", "growth of the parent process's memory after the first tenth", growth, "%", frames, None, GROWTH
        ),
    ]
