"""One predicted frame beside its scan: checked, in float64, neighbours searched once for all metrics."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from avatar.checks import AvatarError, check_finite, check_shape
from avatar.evaluation.closest import closest_on_mesh
from avatar.geometry.neighbours import nearest
from avatar.geometry.surface import vertex_normals
from avatar.records import Mesh, PointCloud, Scan

PENETRATION_POINTS = 5_000  # predicted points tested a frame: a share needs no more
EXACT_WITHIN = 0.01  # metres; beyond, depths on a body may be off by a millimetre, and come ten times cheaper


class Comparison:
    """What a metric sees of one frame.

    ``points (N, 3)`` and ``normals (N, 3)`` of the prediction, ``scan (M, 3)`` and ``scan_normals (M, 3)``, float64
    on the CPU, normals scaled to length one. ``mesh`` is the predicted mesh where there is one, ``body`` the posed
    bare body.
    """

    def __init__(self, prediction: PointCloud, scan: Scan, body: Mesh | None = None, mesh: Mesh | None = None):
        """Checks and converts one frame.

        Raises:
            AvatarError: on an empty cloud, wrong shapes, non-finite numbers or normals without direction.
        """
        self.points, self.normals = _oriented("prediction", prediction.points, prediction.normals)
        self.scan, self.scan_normals = _oriented("scan", scan.points, scan.normals)
        self.body, self.mesh = body, mesh

    @cached_property
    def scan_of_point(self) -> Tensor:
        """Index of the nearest scan point to each predicted point, ``(N,)``."""
        return nearest(self.points[None], self.scan[None])[0]

    @cached_property
    def point_of_scan(self) -> Tensor:
        """Index of the nearest predicted point to each scan point, ``(M,)``."""
        return nearest(self.scan[None], self.points[None])[0]

    @property
    def to_scan(self) -> Tensor:
        """Distance of each predicted point to the nearest scan point, ``(N,)`` metres."""
        return (self.points - self.scan[self.scan_of_point]).norm(dim=-1)

    @property
    def to_points(self) -> Tensor:
        """Distance of each scan point to the nearest predicted point, ``(M,)`` metres."""
        return (self.scan - self.points[self.point_of_scan]).norm(dim=-1)

    @cached_property
    def mesh_normals(self) -> Tensor:
        """Unit normals of the predicted mesh's vertices."""
        return vertex_normals(_double(self.mesh.vertices), torch.from_numpy(np.asarray(self.mesh.faces, np.int64)))

    @cached_property
    def mesh_vertex_of_scan(self) -> Tensor:
        """Index of the nearest vertex of the predicted mesh to each scan point, ``(M,)``."""
        return nearest(self.scan[None], _double(self.mesh.vertices)[None])[0]

    @cached_property
    def depths(self) -> Tensor:
        """How deep predicted points lie under the bare body, positive inside; at most `PENETRATION_POINTS` of them.

        The points are an even stride through the prediction.

        Raises:
            AvatarError: without a body.
        """
        if self.body is None:
            raise AvatarError(
                "body: penetration needs the posed bare body and its faces, and none was given; load frames from a "
                "dataset with a template, or leave the penetration metrics out."
            )
        chosen = self.points[:: -(-len(self.points) // PENETRATION_POINTS)].numpy()
        hits = closest_on_mesh(chosen, self.body.vertices, self.body.faces, EXACT_WITHIN)
        return torch.from_numpy(-hits.signed_distances)


def _double(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float64))


def _oriented(name: str, points: np.ndarray, normals: np.ndarray) -> tuple[Tensor, Tensor]:
    """Points and unit normals as float64 tensors."""
    dims = check_shape(f"{name} points", points, "N 3")
    check_shape(f"{name} normals", normals, "N 3", **dims)
    if dims["N"] == 0:
        raise AvatarError(f"{name}: expected points, got an empty cloud.")
    check_finite(f"{name} points", points)
    check_finite(f"{name} normals", normals)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    if lengths.min() < 1e-6:
        bad = int((lengths < 1e-6).sum())
        raise AvatarError(f"{name} normals: expected unit vectors, got {bad} of {len(normals)} without length.")
    return _double(points), _double(normals / lengths)
