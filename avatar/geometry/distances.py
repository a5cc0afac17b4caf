"""Distances between point sets. Unreduced; reduced and weighted in training and evaluation."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from avatar.checks import check_shape
from avatar.geometry.neighbours import nearest_both_ways


@dataclass(frozen=True)
class Correspondences:
    """Nearest neighbours both ways: ``scan_of_point (B, N)`` and ``point_of_scan (B, M)``, int64, no gradient."""

    scan_of_point: Tensor
    point_of_scan: Tensor


def correspond(points: Tensor, scan: Tensor) -> Correspondences:
    """Nearest neighbours between predicted points ``(B, N, 3)`` and scan points ``(B, M, 3)``, both ways."""
    return Correspondences(*nearest_both_ways(points, scan))


def point_to_point(points: Tensor, anchors: Tensor) -> Tensor:
    """Squared distance of each point to its anchor (CloSET eq. 4). ``(B, N, 3)`` twice to ``(B, N)``, m^2."""
    dims = check_shape("points", points, "B N 3")
    check_shape("anchors", anchors, "B N 3", **dims)
    return (points - anchors).square().sum(dim=-1)


def point_to_plane(points: Tensor, anchors: Tensor, normals: Tensor) -> Tensor:
    """Squared distance from each point to the tangent plane at its anchor.

    With nearest scan points as anchors this approximates squared point-to-surface
    distance and does not penalise sliding along the cloth (POP's prediction-to-scan term).

    Args:
        points: ``(B, N, 3)`` predicted points, metres.
        anchors: ``(B, N, 3)`` one scan point per predicted point, metres.
        normals: ``(B, N, 3)`` unit normals at the anchors.

    Returns:
        ``(B, N)`` squared distances, square metres, not reduced.
    """
    dims = check_shape("points", points, "B N 3")
    check_shape("anchors", anchors, "B N 3", **dims)
    check_shape("normals", normals, "B N 3", **dims)
    return ((points - anchors) * normals).sum(dim=-1).square()


def normal_difference(normals: Tensor, anchor_normals: Tensor) -> Tensor:
    """L1 distance between unit normals (CloSET eq. 5). ``(B, N, 3)`` twice to ``(B, N)``, in [0, 2 sqrt 3]."""
    dims = check_shape("normals", normals, "B N 3")
    check_shape("anchor_normals", anchor_normals, "B N 3", **dims)
    return (normals - anchor_normals).abs().sum(dim=-1)
