"""`mesh`: a thousand frames through one guarded Poisson worker, bad ones and deaths among them."""

from __future__ import annotations

import os
import signal
import threading

import numpy as np

from avatar.checks import AvatarError
from avatar.export.meshing import PoissonConfig, PoissonMesher, check_mesh
from avatar.records import PointCloud
from reliability.findings import Finding, all_of, none_of
from reliability.workers import resident_memory

POINTS, DEPTH = 4000, 6
WARM_UP = 0.1  # share of the frames after which memory is first looked at
GROWTH = 5.0  # per cent, at most
BAD_EVERY = 20  # frames


def bad_clouds() -> dict[str, PointCloud]:
    """Every class of cloud that crashes or hangs open3d, or that it answers with nothing."""
    sound = breathing_ball(0)
    points, normals = sound.points, sound.normals

    def with_entry(array: np.ndarray, value: float) -> np.ndarray:
        changed = array.copy()
        changed[7, 1] = value
        return changed

    return {
        "a point that is NaN": PointCloud(with_entry(points, np.nan), normals),
        "a point at infinity": PointCloud(with_entry(points, np.inf), normals),
        "a normal that is NaN": PointCloud(points, with_entry(normals, np.nan)),
        "one point": PointCloud(points[:1], normals[:1]),
        "no point": PointCloud(points[:0], normals[:0]),
        "identical points": PointCloud(np.zeros_like(points), normals),
        "normals of length zero": PointCloud(points, np.zeros_like(normals)),
        "huge coordinates": PointCloud(points * 1e30, normals),
        "tiny coordinates": PointCloud(points * 1e-12, normals),
        "points along a line": PointCloud(points * [1.0, 0.0, 0.0], normals),
        "random normals": PointCloud(points, np.random.default_rng(0).permutation(normals)),
        "a point far off": PointCloud(with_entry(points, 900.0), normals),
    }


def breathing_ball(frame: int) -> PointCloud:
    """Points on a ball whose surface moves from frame to frame."""
    rng = np.random.default_rng(frame)
    directions = rng.normal(size=(POINTS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radius = 0.8 + 0.1 * np.sin(4 * directions[:, :1] + frame)
    return PointCloud(radius * directions, directions)


def mesh_trial(frames: int) -> list[Finding]:
    """Meshes frame after frame in this very process; every twentieth is bad, and now and then the worker is killed."""
    bad, done, refused, untyped, killed, deaths = list(bad_clouds().values()), 0, 0, 0, 0, 0
    memory: list[int] = []
    with PoissonMesher(PoissonConfig(depth=DEPTH, max_hole=0.2, timeout_s=60)) as mesher:
        for frame in range(frames):
            kind = frame // BAD_EVERY if frame % BAD_EVERY == BAD_EVERY - 1 else None
            kill = kind is not None and kind % 4 == 3
            cloud = breathing_ball(frame) if kind is None or kill else bad[kind % len(bad)]
            if kill and mesher.worker_pid:
                killed += 1
                threading.Timer(0.02, os.kill, (mesher.worker_pid, signal.SIGKILL)).start()
            try:
                check_mesh(mesher.mesh(cloud))
                done += 1
            except AvatarError as error:
                refused += 1
                deaths += "died" in str(error)
            except Exception:
                untyped += 1
            if frame >= WARM_UP * frames and kind is None:
                memory.append(resident_memory(os.getpid()))
    growth = round(100 * (np.mean(memory[-20:]) / np.mean(memory[:20]) - 1), 2)
    good = frames - frames // BAD_EVERY
    spent = "workers killed with -9, each one failed frame at most"
    return [
        all_of("mesh", f"frames meshed or refused by name ({POINTS} points, depth {DEPTH})", done + refused, frames),
        Finding("mesh", "sound meshes, checked", done, f"of {good} good clouds", frames, good),
        none_of("mesh", "errors other than ours", untyped, frames),
        Finding("mesh", spent, deaths, f"of {killed}", killed, None, killed),
        Finding("mesh", "growth of the parent's memory after the first tenth", growth, "%", frames, None, GROWTH),
    ]
