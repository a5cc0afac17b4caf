"""Surfaces as files hold them: mesh or points, normals, colours and reading notes; polygons into triangles."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from avatar.checks import DataError
from avatar.records import Mesh, PointCloud

TINY = 1e-20  # normals shorter than this have no direction
UNIT_TOLERANCE = 1e-2  # normals further from unit length than this are noted
NORMALS_HINT = "Hint: estimate oriented normals first (MeshLab: Compute normals for point sets)."


@dataclass(frozen=True)
class RawSurface:
    """A mesh, or points, of one file, in the file's own unit, axes and vertex order.

    ``vertices (V, 3)`` float32, ``faces (F, 3)`` int64 or None for points, ``normals (V, 3)`` unit float32 or None,
    ``colors (V, 3)`` float32 in [0, 1] or None; ``notes`` are sentences on what was changed or left out in reading.
    """

    path: Path
    vertices: np.ndarray
    faces: np.ndarray | None = None
    normals: np.ndarray | None = None
    colors: np.ndarray | None = None
    notes: tuple[str, ...] = ()

    @property
    def extents(self) -> np.ndarray:
        """Sides ``(3,)`` of the axis-aligned bounding box, in the file's unit."""
        return np.ptp(self.vertices.astype(np.float64), axis=0)

    @property
    def height(self) -> float:
        """Longest side of the bounding box, in the file's unit: a standing person's height, whichever axis is up."""
        return float(self.extents.max())

    @property
    def mesh(self) -> Mesh:
        """The triangle mesh; raises `DataError` for points."""
        if self.faces is None:
            problem = f"expected triangles, got a point cloud of {len(self.vertices)} points."
            hint = "Hint: reconstruct a surface first (MeshLab: Screened Poisson), or give it where points are read."
            raise DataError(self.path, problem, hint)
        return Mesh(self.vertices, self.faces, self.colors)

    @property
    def cloud(self) -> PointCloud:
        """The oriented points, of a mesh its vertices; raises `DataError` where the file has no normals."""
        if self.normals is None:
            count = len(self.vertices)
            problem = f"expected unit normals, got {count} points without."
            raise DataError(self.path, " ".join([problem, *self.notes]), NORMALS_HINT)
        return PointCloud(self.vertices, self.normals, self.colors)

    def noted(self, *notes: str) -> RawSurface:
        """The same surface with further notes; empty ones are left out."""
        return replace(self, notes=(*self.notes, *filter(None, notes)))


def fan_triangles(corners: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Triangles ``(F, 3)`` of polygons as fans around their first corners, in the polygons' order.

    ``corners (C,)`` are vertex indices polygon after polygon, ``lengths (P,)`` their numbers of corners; polygons of
    fewer than three corners have no triangles.
    """
    lengths = np.asarray(lengths, np.int64)
    starts = np.cumsum(lengths) - lengths
    triangles = np.maximum(lengths - 2, 0)
    first = np.repeat(starts, triangles)
    inner = np.arange(len(first)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    places = np.stack([first, first + inner + 1, first + inner + 2], axis=1)
    return np.asarray(corners, np.int64)[places]


def strip_triangles(corners: np.ndarray) -> np.ndarray:
    """Triangles ``(F, 3)`` of one strip of vertex indices ``(C,)``, all wound as the first one."""
    corners = np.asarray(corners, np.int64)
    if len(corners) < 3:
        return np.empty((0, 3), np.int64)
    triangles = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
    triangles[1::2] = triangles[1::2][:, [1, 0, 2]]
    return triangles


def scale_colors(path: Path, colors: np.ndarray) -> tuple[np.ndarray, str]:
    """Colours ``(V, 3)`` as float32 in [0, 1], and a note where floats went to 255.

    Whole numbers are divided by the largest of their type. Raises `DataError` for values below 0, beyond 255 or NaN.
    """
    if colors.dtype.kind in "iu":
        if colors.dtype.kind == "i" and colors.size and colors.min() < 0:
            raise DataError(path, f"expected colours of at least 0, got {colors.min()}.", "Hint: store them as uint8.")
        return (colors / np.float64(np.iinfo(colors.dtype).max)).astype(np.float32), ""
    low, high = (float(colors.min()), float(colors.max())) if colors.size else (0.0, 0.0)
    if not (low >= 0 and high <= 255):
        problem = f"expected colours from 0 to 1 or to 255, got {low:.4g} to {high:.4g}."
        raise DataError(path, problem, "Hint: store them as uint8.")
    if high > 1:
        return (colors / 255).astype(np.float32), "Colours are taken to go from 0 to 255."
    return colors.astype(np.float32), ""


def unit_normals(
    normals: np.ndarray, vertices: np.ndarray, faces: np.ndarray | None
) -> tuple[np.ndarray | None, list[str]]:
    """Normals ``(V, 3)`` of unit length, float32, or None, and notes.

    Those of length 0, NaN or infinity become the mean of their faces' normals weighted by area; where no face gives
    one, all normals are left out.
    """
    normals, notes = np.asarray(normals, np.float64), []
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.linalg.norm(normals, axis=1)
    missing = ~(np.isfinite(lengths) & (lengths > TINY))
    if (~missing).any():
        low, high = lengths[~missing].min(), lengths[~missing].max()
        if max(1 - low, high - 1) > UNIT_TOLERANCE:
            notes.append(f"Normals had lengths from {low:.4g} to {high:.4g} and were normalised.")
    normals = np.where(missing[:, None], 0, normals)
    if missing.any() and faces is not None:
        computed = vertex_normals(vertices, faces)
        replaced = missing & computed.any(axis=1)
        normals[replaced] = computed[replaced]
        if replaced.any():
            notes.append(f"{replaced.sum()} of {len(normals)} normals had no direction: recomputed from the faces.")
        missing &= ~replaced
    if missing.any():
        return None, [f"{missing.sum()} of {len(normals)} normals have no direction: the normals are left out."]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals.astype(np.float32), notes


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals ``(V, 3)``, the mean of the faces' weighted by area; 0 for vertices of no face with area."""
    a, b, c = (vertices[faces[:, corner]].astype(np.float64) for corner in range(3))
    with np.errstate(over="ignore", invalid="ignore"):
        crosses = np.cross(b - a, c - a)
    total = np.stack(
        [np.bincount(faces.reshape(-1), np.repeat(crosses[:, axis], 3), len(vertices)) for axis in range(3)], axis=1
    )
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.linalg.norm(total, axis=1, keepdims=True)
        return np.where(np.isfinite(lengths) & (lengths > TINY), total / np.maximum(lengths, TINY), 0)
