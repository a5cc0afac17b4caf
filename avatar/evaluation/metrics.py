"""Metrics of predicted against scanned surfaces, each with its unit and printed definition (design.md 7)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from avatar.checks import AvatarError, check_finite, check_shape
from avatar.evaluation import shapes
from avatar.geometry.closest import closest_on_mesh
from avatar.geometry.neighbours import k_nearest, nearest, normal_difference, point_to_plane, point_to_point
from avatar.geometry.surface import vertex_normals
from avatar.records import Mesh, PointCloud, Scan

PENETRATION_POINTS = 5_000  # predicted points tested a frame: a share needs no more
EXACT_WITHIN = 0.01  # metres; beyond, depths on a body may be off by a millimetre, and come ten times cheaper
SKIN_TOLERANCE = 1e-3  # metres a point may lie under the bare body: uncovered skin is the body itself
SPREAD_NEIGHBOURS = 5
DISC_NEIGHBOURS = 8
HOLE = 0.01  # metres of the true surface to the predicted one from which on it counts as a hole


class Comparison:
    """What a metric sees of one frame: checked, in float64, neighbours searched once for all metrics. ``points (N, 3)``
    and ``normals (N, 3)`` of the prediction, ``scan (M, 3)`` and ``scan_normals (M, 3)``, float64 on the CPU, normals
    scaled to length one. ``mesh`` is the predicted mesh where there is one, ``body`` the posed bare body. Raises
    `AvatarError` on an empty cloud, wrong shapes, non-finite numbers or normals without direction.
    """

    def __init__(self, prediction: PointCloud, scan: Scan, body: Mesh | None = None, mesh: Mesh | None = None):
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
    def gaps(self) -> tuple[Tensor, Tensor]:
        """Distances of predicted ``(N,)`` and of scan points ``(M,)`` to the nearest of the other cloud, metres."""
        to_scan = (self.points - self.scan[self.scan_of_point]).norm(dim=-1)
        return to_scan, (self.scan - self.points[self.point_of_scan]).norm(dim=-1)

    @cached_property
    def spacing(self) -> float:
        """Typical mean distance of a scan point to its `DISC_NEIGHBOURS` nearest ones, metres."""
        return float(neighbour_distances(self.scan, DISC_NEIGHBOURS).mean(dim=-1).quantile(0.5))

    @property
    def even_spacing(self) -> float:
        """What `spacing` would be of as many points as predicted, spread evenly over the scan's surface, metres."""
        return self.spacing * (len(self.scan) / len(self.points)) ** 0.5

    @cached_property
    def normal_maps(self) -> tuple[Tensor, Tensor]:
        """Rendered normals of prediction and scan, discs as large as evenly spread points need (`render_normals`)."""
        place = shapes.view_frame(self.scan)
        return (
            shapes.render_normals(self.points, self.normals, self.even_spacing, *place),
            shapes.render_normals(self.scan, self.scan_normals, self.spacing, *place),
        )

    @cached_property
    def depths(self) -> Tensor:
        """How deep `PENETRATION_POINTS` or fewer predicted points, an even stride, lie under the bare body, metres."""
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


class Unit(NamedTuple):
    """A unit that values are kept in, and how they are shown: ``value * scale`` in ``shown_in``."""

    unit: str
    scale: float
    shown_in: str


AREA = Unit("m^2", 1e4, "1e-4 m²")
TENTHS = Unit("1", 10, "1e-1")
CENTIMETRES = Unit("cm", 1, "cm")
MILLIMETRES = Unit("m", 1e3, "mm")
DEGREES = Unit("degree", 1, "°")
PERCENT = Unit("1", 100, "%")
RATIO = Unit("1", 1, "1")
ACCELERATION = Unit("m/frame^2", 1e3, "mm/frame²")


@dataclass(frozen=True)
class Metric:
    """A named number: values are kept in ``unit`` and shown as ``value * scale`` in ``shown_in``. ``measure`` takes a
    `Comparison`, or, for a ``sequential`` metric, corresponding points ``(T, N, 3)``.
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
    needs_mesh: bool = False

    @property
    def heading(self) -> str:
        """The name and the unit that it is shown in, where it has one."""
        return self.name if self.shown_in == "1" else f"{self.name} ({self.shown_in})"


METRIC_NAMES = (  # one literal, for settings are read without running the functions below (`avatar.declared`)
    *("cd_point", "cd_pop", "normal_l1", "normal_l1_mean", "s2m_cm", "normal_consistency", "f_score_5mm"),
    *("f_score_1cm", "cd_even", "normal_map", "silhouette", "holes", "penetration_share", "penetration_depth"),
    *("self_intersection", "uniformity", "jitter"),
)
METRICS: dict[str, Metric] = {}


def metric(name: str, unit: Unit, **properties: bool) -> Callable[[Callable], Callable]:
    """A decorator that adds a function to `METRICS`; its docstring is the definition that tables print."""

    def add(measure: Callable) -> Callable:
        definition = " ".join((measure.__doc__ or "").split())
        METRICS[name] = Metric(name, *unit, definition, measure, **properties)
        return measure

    return add


def find_metrics(names: Iterable[str], known: Mapping[str, Metric] = METRICS) -> list[Metric]:
    """The metrics of these names, in their order; an `AvatarError` names the unknown ones and all that there are."""
    names = list(names)
    if unknown := [name for name in names if name not in known]:
        raise AvatarError(f"metrics: unknown {', '.join(unknown)}; expected any of {', '.join(known)}.")
    return [known[name] for name in names]


@metric("cd_point", AREA)
def chamfer(c: Comparison) -> Tensor:
    """Chamfer distance, CloSET eq. 4: mean over predicted points of the squared distance to the nearest scan point,
    plus mean over scan points of the squared distance to the nearest predicted point.
    """
    return point_to_point(c.points[None], c.scan[None, c.scan_of_point]).mean() + _scan_to_points(c)


@metric("cd_pop", AREA)
def chamfer_to_plane(c: Comparison) -> Tensor:
    """Chamfer distance as POP computes it: mean over scan points of the squared distance to the nearest predicted
    point, plus mean over predicted points of the squared distance to the tangent plane at the nearest scan point.
    """
    ids = c.scan_of_point
    return point_to_plane(c.points[None], c.scan[None, ids], c.scan_normals[None, ids]).mean() + _scan_to_points(c)


def _scan_to_points(c: Comparison) -> Tensor:
    return point_to_point(c.scan[None], c.points[None, c.point_of_scan]).mean()


@metric("normal_l1", TENTHS)
def normal_l1(c: Comparison) -> Tensor:
    """Normal discrepancy, CloSET eq. 5: mean over predicted points of the L1 norm of the difference to the normal of
    the nearest scan point.
    """
    return normal_difference(c.normals[None], c.scan_normals[None, c.scan_of_point]).mean()


@metric("normal_l1_mean", TENTHS)
def normal_l1_mean(c: Comparison) -> Tensor:
    """A third of normal_l1: the mean over the three components, which POP's tables print."""
    return normal_l1(c) / 3


@metric("s2m_cm", CENTIMETRES)
def scan_to_surface(c: Comparison) -> Tensor:
    """Scan-to-surface distance, SCANimate D_s2m: mean over scan points of the distance to the predicted mesh; for a
    point cloud to the disc at the nearest predicted point, its radius the cloud's median distance to 8 neighbours.
    """
    if c.mesh is not None:
        hits = closest_on_mesh(c.scan.numpy(), c.mesh.vertices, c.mesh.faces)
        return 100 * torch.from_numpy(np.abs(hits.signed_distances)).mean()
    radius = float(neighbour_distances(c.points, DISC_NEIGHBOURS).mean(dim=-1).quantile(0.5))
    return 100 * scan_to_discs(c.scan, c.points, c.normals, c.point_of_scan, radius).mean()


def scan_to_discs(scan: Tensor, points: Tensor, normals: Tensor, point_of_scan: Tensor, radius: float) -> Tensor:
    """Distances from scan points to the disc at their nearest predicted point, ``(M,)`` metres. A point cloud's surface
    for D_s2m: planes would hide holes, bare points count their own spacing as error.
    """
    away = scan - points[point_of_scan]
    height = (away * normals[point_of_scan]).sum(dim=-1)
    aside = (away.square().sum(dim=-1) - height.square()).clamp(min=0).sqrt()
    return torch.hypot(height, (aside - radius).clamp(min=0))


@metric("normal_consistency", TENTHS)
def normal_consistency(c: Comparison) -> Tensor:
    """SCANimate D_n: mean over scan points of the L2 norm of the difference to the normal of the nearest predicted
    point (of the nearest vertex, for a mesh).
    """
    normals, ids = c.normals, c.point_of_scan
    if c.mesh is not None:
        vertices = _double(c.mesh.vertices)
        normals = vertex_normals(vertices, torch.from_numpy(np.asarray(c.mesh.faces, np.int64)))
        ids = nearest(c.scan[None], vertices[None])[0]
    return (c.scan_normals - normals[ids]).norm(dim=-1).mean()


@metric("f_score_5mm", PERCENT, higher_is_better=True)
def f_score_5mm(c: Comparison) -> Tensor:
    """F-score at 5 mm: harmonic mean of the share of predicted points within 5 mm of a scan point and the share of
    scan points within 5 mm of a predicted point. Higher is better.
    """
    return f_score(*c.gaps, 5e-3)


@metric("f_score_1cm", PERCENT, higher_is_better=True)
def f_score_1cm(c: Comparison) -> Tensor:
    """F-score at 1 cm: as f_score_5mm, within 1 cm. Higher is better."""
    return f_score(*c.gaps, 1e-2)


def f_score(to_scan: Tensor, to_points: Tensor, threshold: float) -> Tensor:
    """Harmonic mean of the shares of predicted ``(N,)`` and of scan ``(M,)`` distances within a threshold, metres."""
    precision = (to_scan <= threshold).double().mean()
    recall = (to_points <= threshold).double().mean()
    return 2 * precision * recall / (precision + recall).clamp(min=1e-12)


@metric("cd_even", AREA)
def even_chamfer(c: Comparison) -> Tensor:
    """cd_point after even resampling: predicted points count by the area they stand for, the square of their mean
    distance to 5 nearest neighbours, so that clumps do not outvote the surface between them.
    """
    areas = neighbour_distances(c.points, SPREAD_NEIGHBOURS).mean(dim=-1).square()
    to_scan = point_to_point(c.points[None], c.scan[None, c.scan_of_point])[0]
    return (areas * to_scan).sum() / areas.sum().clamp(min=1e-30) + _scan_to_points(c)


@metric("normal_map", DEGREES)
def normal_maps_apart(c: Comparison) -> Tensor:
    """Mean angle between rendered normal maps of prediction and scan where both are seen, six views 60° apart from 20°
    above the horizon, 192 x 192 pixels; points are discs as wide as evenly spread ones need to close.
    """
    mine, theirs = c.normal_maps
    both = mine.any(dim=-1) & theirs.any(dim=-1)
    if not both.any():
        return mine.new_tensor(180.0)
    return torch.rad2deg((mine[both] * theirs[both]).sum(dim=-1).clamp(-1, 1).acos()).mean()


@metric("silhouette", PERCENT, higher_is_better=True)
def silhouettes_shared(c: Comparison) -> Tensor:
    """Silhouette overlap in the views of normal_map: intersection over union, all views together. Higher is better."""
    mine, theirs = (maps.any(dim=-1) for maps in c.normal_maps)
    return (mine & theirs).sum().double() / (mine | theirs).sum().clamp(min=1)


@metric("holes", PERCENT)
def holes(c: Comparison) -> Tensor:
    """Share of scan points more than 1 cm from the predicted surface: from the disc at the nearest predicted point, as
    wide as evenly spread points need to close.
    """
    return (scan_to_discs(c.scan, c.points, c.normals, c.point_of_scan, c.even_spacing) > HOLE).double().mean()


@metric("penetration_share", PERCENT, needs_body=True)
def penetration_share(c: Comparison) -> Tensor:
    """Share of predicted points more than 1 mm under the posed bare body's surface (at most 5,000 points a frame are
    tested).
    """
    return (c.depths > SKIN_TOLERANCE).double().mean()


@metric("penetration_depth", MILLIMETRES, needs_body=True)
def penetration_depth(c: Comparison) -> Tensor:
    """Mean depth under the bare body's surface of the points that penetration_share counts, 0 if none."""
    inside = c.depths[c.depths > SKIN_TOLERANCE]
    return inside.mean() if len(inside) else c.depths.new_zeros(())


@metric("self_intersection", PERCENT, needs_mesh=True)
def self_intersection(c: Comparison) -> Tensor:
    """Share of the predicted mesh's faces that cross another face with which they share no vertex; meshes only."""
    return torch.from_numpy(shapes.crossing_faces(c.mesh.vertices, c.mesh.faces)).double().mean()


@metric("uniformity", RATIO)
def uniformity(c: Comparison) -> Tensor:
    """Spread of the predicted points: standard deviation over mean of their mean distance to 5 nearest neighbours. 0
    is a regular grid; gaps and clumps raise it.
    """
    return neighbour_spread(c.points)


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


@metric("jitter", ACCELERATION, sequential=True)
def mean_acceleration(sequence: Tensor) -> Tensor:
    """Mean acceleration of corresponding predicted points over consecutive frames of a sequence (second difference of
    position). Only for predictions whose points keep their order.
    """
    if sequence.ndim != 3 or len(sequence) < 3:
        raise AvatarError(f"sequence: expected at least 3 frames (T, N, 3), got {tuple(sequence.shape)}.")
    return (sequence[2:] - 2 * sequence[1:-1] + sequence[:-2]).norm(dim=-1).mean()
