"""Meshes from oriented points: open3d's Poisson reconstruction behind a guard, then trimmed to the points.

open3d crashes or hangs on bad input and, rarely, on good input. It therefore runs in a process of its own, gets
checked arrays only, and a frame that kills it is one failed frame.

Its surfaces are closed: caps across sleeves, necks and hems, which no points support, are trimmed. Dropping a fixed
share of low-density vertices (POP's way) leaves ragged boundaries and also removes parts of closed surfaces, so support
is measured against the points. A vertex is unsupported where its nearest points all lie to one side (their centroid is
shifted along the surface as on a boundary, whatever their density) and nothing follows on the other, or where the
nearest point is far. The surface is cut along the line between, through its triangles.
"""

from __future__ import annotations

import multiprocessing
import pickle
import threading
from collections.abc import Iterable
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from avatar.checks import AvatarError, DataError, check_oriented
from avatar.export.poisson import serve
from avatar.geometry.trees import build_tree
from avatar.invocation import install_line
from avatar.io.ledger import Ledger, file_digest, keyed
from avatar.io.meshes import FORMATS, check_mesh, write_mesh
from avatar.io.points import read_points
from avatar.processes import interrupts_blocked
from avatar.progress import tracked
from avatar.records import Mesh, PointCloud

SOURCE = ("avatar.export.meshing",)
MIN_POINTS = 100
EXTENTS = (1e-3, 1e3)  # metres; outside, open3d hangs or the units are wrong
GRACE_S = 5.0  # beyond timeout_s, for a worker that is stuck before or amid its answer
START_TIMEOUT_S = 120.0  # importing open3d from a cold disk
NEIGHBOURS = 24
BOUNDARY_SHIFT = 4 / (3 * np.pi)  # centroid of a half disc, in radii: what a vertex on a straight boundary sees
LOOK_AHEAD = 0.9  # share of the look-ahead ball that must be empty; its surface touches the vertex's own boundary
SPACING_NEIGHBOUR = 8  # the point itself counted; its distance measures the local spacing
HOLE_SPACINGS = 2.5  # random points leave gaps this many such distances wide
BARELY = 1e-3  # how far below the cut forgiven vertices are put


class MeshingError(AvatarError):
    """A cloud that could not be meshed, with the reason. The program goes on, and so may the next cloud."""


@dataclass
class PoissonConfig:
    """How point clouds become meshes."""

    depth: int = 8  # octree levels: 2 ** depth cells across 1.1 times the cloud; 8 is about 8 mm for a person
    max_hole: float = 0.03  # metres; gaps in the points up to this wide are closed, wider ones stay open
    min_part: float = 0.005  # connected parts with a smaller share of the area are dropped
    timeout_s: float = 120.0  # seconds for one cloud
    max_points: int = 1_000_000
    memory_gb: float = 8.0  # address space of the worker, GiB; 0 for no limit

    def __post_init__(self):
        ranges = {"depth": (4, 12), "max_hole": (1e-3, 10), "min_part": (0, 1), "timeout_s": (0.001, 86400)}
        ranges |= {"max_points": (MIN_POINTS, 20_000_000), "memory_gb": (0, 1024)}
        for name, (low, high) in ranges.items():
            if not low <= (value := getattr(self, name)) <= high:
                raise AvatarError(f"{name}: expected a number from {low} to {high}, got {value}.")


class PoissonMesher:
    """Meshes clouds one after another in one worker process, which is replaced when it dies or hangs.

    A context manager: ``with PoissonMesher() as mesher: mesh = mesher.mesh(cloud)``. The same cloud gives the
    same mesh, bit for bit. As with every spawned process, a script that uses it needs the usual
    ``if __name__ == "__main__":``.
    """

    def __init__(self, config: PoissonConfig | None = None):
        self.config = config or PoissonConfig()
        self._process = self._connection = None

    def __enter__(self) -> PoissonMesher:
        return self

    def __exit__(self, *exception) -> None:
        self.close()

    @property
    def worker_pid(self) -> int | None:
        """Process id of the worker, None while there is none."""
        return self._process.pid if self._process is not None else None

    def mesh(self, cloud: PointCloud) -> Mesh:
        """The surface, float32 and int64, of a cloud whose normals point outwards; open where the points leave it open.

        Raises `MeshingError` for points that cannot be meshed, a timeout, or a worker that died, with the reason;
        `AvatarError` when open3d cannot be imported.
        """
        points, normals = check_cloud(cloud, self.config.max_points)
        raw = self._solve(points, normals)
        try:
            check_mesh(raw)
        except AvatarError as error:
            raise MeshingError(f"Poisson reconstruction gave no valid surface: {error}") from error
        mesh = trim_surface(raw, PointCloud(points, normals), self.config.max_hole, self.config.min_part)
        if not len(mesh.faces):
            raise MeshingError(
                "no part of the reconstructed surface is supported by the points. They may be noise, or further "
                f"apart than max_hole={self.config.max_hole} m; make max_hole larger."
            )
        return Mesh(mesh.vertices.astype(np.float32), mesh.faces.astype(np.int64))

    def close(self) -> None:
        """Ends the worker. The next `mesh` starts another."""
        if self._process is not None:
            self._connection.close()
            self._process.kill()
            self._process.join()
        self._process = self._connection = None

    def _solve(self, points: np.ndarray, normals: np.ndarray) -> Mesh:
        """One job for the worker; whatever goes wrong, the next job finds a fresh one."""
        if self._process is None or not self._process.is_alive():
            self._start()
        config, answer = self.config, None
        watchdog = threading.Timer(config.timeout_s + GRACE_S, self._process.kill)  # a worker that does not even listen
        watchdog.start()
        try:
            self._connection.send((points, normals, config.depth))
            if not self._connection.poll(config.timeout_s):
                raise MeshingError(f"no surface within timeout_s={config.timeout_s} s; depth={config.depth}.")
            answer = self._connection.recv()
            if isinstance(answer, str):
                raise MeshingError(f"open3d: {answer}")
        except (EOFError, OSError, pickle.UnpicklingError) as error:
            self._process.join(timeout=5)
            raise MeshingError(
                f"the meshing process died (exit code {self._process.exitcode}) on {len(points)} points. Try a lower "
                f"depth than {config.depth}, or more than memory_gb={config.memory_gb}."
            ) from error
        finally:
            watchdog.cancel()
            if not isinstance(answer, tuple):
                self.close()
        return Mesh(*answer)

    def _start(self) -> None:
        self.close()
        context = multiprocessing.get_context("spawn")  # a forked copy of a threaded process may hang
        self._connection, far_end = context.Pipe()
        arguments = (far_end, int(self.config.memory_gb * 2**30))
        self._process = context.Process(target=serve, args=arguments, name="poisson", daemon=True)
        with interrupts_blocked():
            self._process.start()
        far_end.close()
        try:
            if not self._connection.poll(START_TIMEOUT_S):
                self.close()
                raise MeshingError(f"the meshing process did not start within {START_TIMEOUT_S} s.")
            reason = self._connection.recv()
        except (EOFError, OSError) as error:
            self.close()
            raise AvatarError(
                "the meshing process died while importing open3d. A script that meshes needs "
                f"'if __name__ == \"__main__\":'; otherwise run: {install_line('open3d')}"
            ) from error
        if reason:
            self.close()
            raise AvatarError(f"open3d cannot be imported ({reason}). Run: {install_line('open3d')}")


def check_cloud(cloud: PointCloud, max_points: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and unit normals as float64; raises `MeshingError` for all that is known to crash or hang open3d."""
    try:
        dims = check_oriented(cloud.points, cloud.normals)
    except AvatarError as error:
        raise MeshingError(str(error)) from error
    if dims["N"] > max_points:
        raise MeshingError(f"points: expected at most max_points={max_points}, got {dims['N']}.")
    points = np.ascontiguousarray(cloud.points, np.float64)
    normals = np.ascontiguousarray(cloud.normals, np.float64)
    different = len(np.unique(points, axis=0))
    if different < MIN_POINTS:
        raise MeshingError(f"points: expected at least {MIN_POINTS} different ones, got {different}.")
    extent = float(np.ptp(points, axis=0).max())
    if not EXTENTS[0] <= extent <= EXTENTS[1]:
        raise MeshingError(
            f"points: expected {EXTENTS[0]} to {EXTENTS[1]} m from end to end, got {extent:.3g} m. "
            "Convert them to metres, and remove outliers."
        )
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    if lengths.min() < 1e-6:
        raise MeshingError(f"normals: expected directions, got {int((lengths < 1e-6).sum())} of length zero.")
    return points, normals / lengths


def require_poisson() -> None:
    """Raises `AvatarError`, with the line to run, where open3d is not installed; it is not imported for that."""
    if find_spec("open3d") is None:
        raise AvatarError(f"meshing needs open3d. Run: {install_line('open3d')}")


@dataclass(frozen=True)
class MeshingReport:
    """What became of each frame of a folder: ``done`` and ``skipped`` names, ``failed`` name to reason."""

    done: tuple[str, ...] = ()
    skipped: tuple[str, ...] = ()
    failed: dict[str, str] = field(default_factory=dict)


def mesh_folder(
    predictions_dir: Path,
    meshes_dir: Path,
    formats: tuple[str, ...] = ("ply", "obj", "glb"),
    frames: Iterable[str] | None = None,
    config: PoissonConfig | None = None,
) -> MeshingReport:
    """Meshes the point clouds ``<name>.ply`` of one folder into ``<name>.<format>`` in another.

    Meshes made of the same cloud with the same settings are kept where their hashes are right, so that an interrupted
    run goes on where it stopped. A frame that fails does not stop the others; it is in the report with its reason.
    ``formats`` are among ply, obj, glb, stl, off; ``frames`` names to mesh, or None for all. Raises `DataError` when
    there is nothing to mesh or a named frame is missing; `AvatarError` for another format, or without open3d.
    """
    unknown = [ending for ending in formats if f".{ending}" not in FORMATS]
    if unknown or not formats:
        raise AvatarError(f"formats: expected some of {' '.join(FORMATS)} without the dot, got {tuple(formats)}.")
    there = sorted(path.stem for path in predictions_dir.glob("*.ply"))
    names = there if frames is None else list(frames)
    missing = sorted(set(names) - set(there))
    if not names or missing:
        what = f"no point clouds named {', '.join(missing)}" if missing else "no point clouds (*.ply)"
        raise DataError(predictions_dir, f"{what} in this folder.", "Run tools/predict.py first.")
    done, skipped, failed, ledger = [], [], {}, Ledger(meshes_dir)
    settings = config or PoissonConfig()
    made = [settings.depth, settings.max_hole, settings.min_part]
    with PoissonMesher(settings) as mesher:
        for name in tracked(names, "mesh"):
            source = predictions_dir / f"{name}.ply"
            key = keyed(SOURCE, cloud=file_digest(source), formats=formats, poisson=made)
            if ledger.find(name, key):
                skipped.append(name)
                continue
            try:
                mesh = mesher.mesh(read_points(source))
            except (MeshingError, DataError) as error:
                failed[name] = str(error)
                continue
            targets = [meshes_dir / f"{name}.{ending}" for ending in formats]
            for target in targets:
                write_mesh(target, mesh)
            ledger.record(name, key, targets)
            done.append(name)
    return MeshingReport(tuple(done), tuple(skipped), failed)


def trim_surface(mesh: Mesh, cloud: PointCloud, max_hole: float, min_part: float) -> Mesh:
    """The part of a reconstructed surface that the points, with unit normals, support; without unused vertices.

    Gaps in the points up to ``max_hole`` metres wide stay closed, wider ones are opened; where points are so sparse
    that such gaps are everywhere, a gap must be a few times their spacing. Connected parts with less than the share
    ``min_part`` of the whole area are dropped. The mesh has no triangles when nothing is supported.
    """
    tree = build_tree(cloud.points)
    near, _ = tree.query(cloud.points, k=min(SPACING_NEIGHBOUR, len(cloud.points)))
    holes = np.maximum(max_hole, HOLE_SPACINGS * near[:, -1])
    distances, ids = tree.query(mesh.vertices, k=min(NEIGHBOURS, len(cloud.points)))
    holes = holes[ids[:, 0]]
    across = cloud.normals[ids[:, 0]]  # on a thin finger the centroid lies inside, which makes no boundary
    shifts = cloud.points[ids].mean(axis=1) - mesh.vertices
    shifts -= (shifts * across).sum(axis=1, keepdims=True) * across
    lengths = np.maximum(np.linalg.norm(shifts, axis=1), 1e-12)
    excess = lengths / np.maximum(distances[:, -1], 1e-12) / BOUNDARY_SHIFT - 1
    edge = np.flatnonzero(excess > 0)
    reach = holes[edge] / 2
    beyond, _ = tree.query(mesh.vertices[edge] - shifts[edge] / lengths[edge, None] * reach[:, None])
    excess[edge[beyond < LOOK_AHEAD * reach]] = -BARELY  # something follows: a gap, not a boundary
    excess = np.maximum(excess, distances[:, 0] / (holes / 2) - 1)
    excess = _forgive_small_holes(mesh, excess, holes)
    return drop_small_parts(cut_surface(mesh, excess), min_part)


def _forgive_small_holes(mesh: Mesh, excess: np.ndarray, holes: np.ndarray) -> np.ndarray:
    """Keeps unsupported patches smaller than a hole across: noise, fingertips, the tip of the nose."""
    outside = excess > 0
    labels = _vertex_parts(mesh.faces[outside[mesh.faces].all(axis=1)], len(mesh.vertices))
    count = labels.max() + 1
    low, high, allowed = np.full((count, 3), np.inf), np.full((count, 3), -np.inf), np.zeros(count)
    np.minimum.at(low, labels, mesh.vertices)
    np.maximum.at(high, labels, mesh.vertices)
    np.maximum.at(allowed, labels, holes)
    small = (np.linalg.norm(high - low, axis=1) < allowed)[labels]
    return np.where(outside & small, -BARELY, excess)


def cut_surface(mesh: Mesh, values: np.ndarray) -> Mesh:
    """The part of a mesh where values ``(V,)`` at its vertices, linear in between, are at most zero; without colours.

    Triangles that the zero line crosses are split along it, so the boundary is a line and not a row of teeth.
    """
    inside = values <= 0
    corners = inside[mesh.faces]
    kept = mesh.faces[corners.all(axis=1)]
    crossed = mesh.faces[corners.any(axis=1) & ~corners.all(axis=1)]
    alone = inside[crossed] == (inside[crossed].sum(axis=1) == 1)[:, None]  # the corner on its own side
    order = (alone.argmax(axis=1)[:, None] + np.arange(3)) % 3
    tip, left, right = np.take_along_axis(crossed, order, axis=1).T
    pairs = np.sort(np.concatenate([np.stack([tip, left], 1), np.stack([tip, right], 1)]), axis=1)
    edges, ids = np.unique(pairs, axis=0, return_inverse=True)
    ids = ids.reshape(-1) + len(mesh.vertices)
    to_left, to_right = ids[: len(tip)], ids[len(tip) :]
    start, end = mesh.vertices[edges].astype(np.float64).swapaxes(0, 1)
    first, second = values[edges].T
    along = (first / np.where(first == second, 1, first - second))[:, None]
    boundary = start + along * (end - start)
    single = inside[tip]
    pieces = [
        kept,
        np.stack([tip, to_left, to_right], axis=1)[single],
        np.stack([left, right, to_left], axis=1)[~single],
        np.stack([right, to_right, to_left], axis=1)[~single],
    ]
    return _compact(np.concatenate([mesh.vertices, boundary]), np.concatenate(pieces))


def drop_small_parts(mesh: Mesh, min_share: float) -> Mesh:
    """The mesh without connected parts whose share of the whole area is below ``min_share``."""
    if not len(mesh.faces):
        return mesh
    labels = _vertex_parts(mesh.faces, len(mesh.vertices))[mesh.faces[:, 0]]
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    areas = np.bincount(labels, np.linalg.norm(np.cross(b - a, c - a), axis=1))
    return _compact(mesh.vertices, mesh.faces[areas[labels] >= min_share * areas.sum()])


def _vertex_parts(faces: np.ndarray, count: int) -> np.ndarray:
    """Number of the connected part each of ``count`` vertices belongs to, joined by ``faces``."""
    starts, ends = faces[:, [0, 1]].reshape(-1), faces[:, [1, 2]].reshape(-1)
    links = coo_array((np.ones(len(starts), bool), (starts, ends)), shape=(count, count))
    return connected_components(links, directed=False)[1]


def _compact(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """A mesh with only the vertices that are used, in their order."""
    used, ids = np.unique(faces, return_inverse=True)
    return Mesh(vertices[used], ids.reshape(-1, 3))
