"""Metrics of predicted against scanned surfaces, each with its unit and printed definition (design.md 7).

Pure functions take float tensors of one frame, points ``(N, 3)`` in metres and unit normals ``(N, 3)``, and return
a 0-d tensor. `METRICS` names them for tables; a table metric takes a `Comparison`, which searches neighbours once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from avatar.checks import AvatarError
from avatar.evaluation.closest import closest_on_mesh
from avatar.evaluation.comparison import PENETRATION_POINTS, Comparison
from avatar.geometry.distances import normal_difference, point_to_plane, point_to_point
from avatar.geometry.neighbours import k_nearest

SKIN_TOLERANCE = 1e-3  # metres a point may lie under the bare body: uncovered skin is the body itself
SPREAD_NEIGHBOURS = 5
DISC_NEIGHBOURS = 8


def chamfer(points: Tensor, scan: Tensor, scan_of_point: Tensor, point_of_scan: Tensor) -> Tensor:
    """Mean squared distance to the nearest point, both ways, added (CloSET eq. 4). Square metres."""
    forth = point_to_point(points[None], scan[None, scan_of_point]).mean()
    return forth + point_to_point(scan[None], points[None, point_of_scan]).mean()


def chamfer_to_plane(
    points: Tensor, scan: Tensor, scan_normals: Tensor, scan_of_point: Tensor, point_of_scan: Tensor
) -> Tensor:
    """POP's Chamfer distance: scan to nearest point, squared; point to nearest scan point's plane. Square metres."""
    forth = point_to_plane(points[None], scan[None, scan_of_point], scan_normals[None, scan_of_point]).mean()
    return forth + point_to_point(scan[None], points[None, point_of_scan]).mean()


def normal_l1(normals: Tensor, scan_normals: Tensor, scan_of_point: Tensor) -> Tensor:
    """Mean L1 norm of the normals' difference, prediction to nearest scan point (CloSET eq. 5)."""
    return normal_difference(normals[None], scan_normals[None, scan_of_point]).mean()


def scan_to_discs(scan: Tensor, points: Tensor, normals: Tensor, point_of_scan: Tensor, radius: float) -> Tensor:
    """Mean distance from scan points to the disc at their nearest predicted point. Metres.

    A point cloud's surface for D_s2m: exact planes would hide holes (a plane runs on over them), bare points would
    count their own spacing as error.
    """
    away = scan - points[point_of_scan]
    height = (away * normals[point_of_scan]).sum(dim=-1)
    aside = (away.square().sum(dim=-1) - height.square()).clamp(min=0).sqrt()
    return torch.hypot(height, (aside - radius).clamp(min=0)).mean()


def scan_to_mesh(scan: Tensor, vertices: np.ndarray, faces: np.ndarray) -> Tensor:
    """Mean exact distance from scan points to a mesh (SCANimate's D_s2m). Metres."""
    hits = closest_on_mesh(scan.numpy(), vertices, faces)
    return torch.from_numpy(np.abs(hits.signed_distances)).mean()


def normal_l2(scan_normals: Tensor, normals: Tensor, point_of_scan: Tensor) -> Tensor:
    """Mean L2 norm of the normals' difference, scan to nearest predicted point or vertex (SCANimate's D_n)."""
    return (scan_normals - normals[point_of_scan]).norm(dim=-1).mean()


def f_score(to_scan: Tensor, to_points: Tensor, threshold: float) -> Tensor:
    """Harmonic mean of the shares of predicted and of scan points that have the other within a threshold.

    ``to_scan (N,)`` and ``to_points (M,)`` are distances to the nearest point of the other cloud, metres.
    """
    precision = (to_scan <= threshold).double().mean()
    recall = (to_points <= threshold).double().mean()
    return 2 * precision * recall / (precision + recall).clamp(min=1e-12)


def penetration_share(depths: Tensor, tolerance: float = SKIN_TOLERANCE) -> Tensor:
    """Share of points deeper under the body's surface than the tolerance. ``(N,)`` depths, positive inside."""
    return (depths > tolerance).double().mean()


def penetration_depth(depths: Tensor, tolerance: float = SKIN_TOLERANCE) -> Tensor:
    """Mean depth of the points deeper than the tolerance, zero if there are none. Metres."""
    inside = depths[depths > tolerance]
    return inside.mean() if len(inside) else depths.new_zeros(())


def neighbour_spread(points: Tensor, k: int = SPREAD_NEIGHBOURS) -> Tensor:
    """Unevenness of a cloud: standard deviation over mean of the points' mean distance to k neighbours."""
    distances = neighbour_distances(points, k).mean(dim=-1)
    return distances.std(correction=0) / distances.mean().clamp(min=1e-30)


def neighbour_distances(points: Tensor, k: int) -> Tensor:
    """Distances to the k nearest other points, ``(N, 3)`` to ``(N, k)``."""
    if len(points) <= k:
        raise AvatarError(f"points: expected more than {k} points to measure their spread, got {len(points)}.")
    ids = k_nearest(points[None], points[None], k + 1)[0]
    return (points[ids] - points[:, None]).norm(dim=-1).sort(dim=-1).values[:, 1:]


def mean_acceleration(sequence: Tensor) -> Tensor:
    """Mean length of second differences of corresponding points, ``(T, N, 3)`` with T >= 3. Metres a frame^2."""
    if sequence.ndim != 3 or len(sequence) < 3:
        raise AvatarError(f"sequence: expected at least 3 frames (T, N, 3), got {tuple(sequence.shape)}.")
    return (sequence[2:] - 2 * sequence[1:-1] + sequence[:-2]).norm(dim=-1).mean()


@dataclass(frozen=True)
class Metric:
    """A named number: values are kept in ``unit`` and shown as ``value * scale`` in ``shown_in``.

    ``measure`` takes a `Comparison`, or, for a ``sequential`` metric, corresponding points ``(T, N, 3)``.
    """

    name: str
    unit: str
    scale: float
    shown_in: str
    definition: str
    measure: Callable[[Comparison], Tensor] | Callable[[Tensor], Tensor]
    higher_is_better: bool = False
    sequential: bool = False
    needs_body: bool = False

    @property
    def heading(self) -> str:
        """The name and the unit that it is shown in, where it has one."""
        return self.name if self.shown_in == "1" else f"{self.name} ({self.shown_in})"


def _surface_distance(c: Comparison) -> Tensor:
    if c.mesh is not None:
        return 100 * scan_to_mesh(c.scan, c.mesh.vertices, c.mesh.faces)
    radius = float(neighbour_distances(c.points, DISC_NEIGHBOURS).mean(dim=-1).quantile(0.5))
    return 100 * scan_to_discs(c.scan, c.points, c.normals, c.point_of_scan, radius)


def _normal_consistency(c: Comparison) -> Tensor:
    if c.mesh is not None:
        return normal_l2(c.scan_normals, c.mesh_normals, c.mesh_vertex_of_scan)
    return normal_l2(c.scan_normals, c.normals, c.point_of_scan)


METRICS: dict[str, Metric] = {
    metric.name: metric
    for metric in (
        Metric(
            "cd_point",
            "m^2",
            1e4,
            "1e-4 m²",
            "Chamfer distance, CloSET eq. 4: mean over predicted points of the squared distance to the nearest scan "
            "point, plus mean over scan points of the squared distance to the nearest predicted point.",
            lambda c: chamfer(c.points, c.scan, c.scan_of_point, c.point_of_scan),
        ),
        Metric(
            "cd_pop",
            "m^2",
            1e4,
            "1e-4 m²",
            "Chamfer distance as POP computes it: mean over scan points of the squared distance to the nearest "
            "predicted point, plus mean over predicted points of the squared distance to the tangent plane at the "
            "nearest scan point.",
            lambda c: chamfer_to_plane(c.points, c.scan, c.scan_normals, c.scan_of_point, c.point_of_scan),
        ),
        Metric(
            "normal_l1",
            "1",
            10,
            "1e-1",
            "Normal discrepancy, CloSET eq. 5: mean over predicted points of the L1 norm of the difference to the "
            "normal of the nearest scan point.",
            lambda c: normal_l1(c.normals, c.scan_normals, c.scan_of_point),
        ),
        Metric(
            "normal_l1_mean",
            "1",
            10,
            "1e-1",
            "A third of normal_l1: the mean over the three components, which POP's tables print.",
            lambda c: normal_l1(c.normals, c.scan_normals, c.scan_of_point) / 3,
        ),
        Metric(
            "s2m_cm",
            "cm",
            1,
            "cm",
            "Scan-to-surface distance, SCANimate D_s2m: mean over scan points of the distance to the predicted mesh; "
            "for a point cloud to the disc at the nearest predicted point, its radius the cloud's median distance to "
            f"{DISC_NEIGHBOURS} neighbours.",
            _surface_distance,
        ),
        Metric(
            "normal_consistency",
            "1",
            10,
            "1e-1",
            "SCANimate D_n: mean over scan points of the L2 norm of the difference to the normal of the nearest "
            "predicted point (of the nearest vertex, for a mesh).",
            _normal_consistency,
        ),
        Metric(
            "f_score_5mm",
            "1",
            100,
            "%",
            "F-score at 5 mm: harmonic mean of the share of predicted points within 5 mm of a scan point and the "
            "share of scan points within 5 mm of a predicted point. Higher is better.",
            lambda c: f_score(c.to_scan, c.to_points, 5e-3),
            higher_is_better=True,
        ),
        Metric(
            "f_score_1cm",
            "1",
            100,
            "%",
            "F-score at 1 cm: as f_score_5mm, within 1 cm. Higher is better.",
            lambda c: f_score(c.to_scan, c.to_points, 1e-2),
            higher_is_better=True,
        ),
        Metric(
            "penetration_share",
            "1",
            100,
            "%",
            f"Share of predicted points more than {1e3 * SKIN_TOLERANCE:g} mm under the posed bare body's surface "
            f"(at most {PENETRATION_POINTS:,} points a frame are tested).",
            lambda c: penetration_share(c.depths),
            needs_body=True,
        ),
        Metric(
            "penetration_depth",
            "m",
            1e3,
            "mm",
            "Mean depth under the bare body's surface of the points that penetration_share counts, 0 if none.",
            lambda c: penetration_depth(c.depths),
            needs_body=True,
        ),
        Metric(
            "uniformity",
            "1",
            1,
            "1",
            "Spread of the predicted points: standard deviation over mean of their mean distance to "
            f"{SPREAD_NEIGHBOURS} nearest neighbours. 0 is a regular grid; gaps and clumps raise it.",
            lambda c: neighbour_spread(c.points),
        ),
        Metric(
            "jitter",
            "m/frame^2",
            1e3,
            "mm/frame²",
            "Mean acceleration of corresponding predicted points over consecutive frames of a sequence (second "
            "difference of position). Only for predictions whose points keep their order.",
            mean_acceleration,
            sequential=True,
        ),
    )
}


def find_metrics(names: tuple[str, ...]) -> list[Metric]:
    """The metrics of these names, in their order.

    Raises:
        AvatarError: naming the unknown ones and all that there are.
    """
    unknown = [name for name in names if name not in METRICS]
    if unknown:
        raise AvatarError(f"metrics: unknown {', '.join(unknown)}; expected any of {', '.join(METRICS)}.")
    return [METRICS[name] for name in names]
