"""Distances between point sets. Unreduced; reduced and weighted in training and evaluation."""

from __future__ import annotations

from torch import Tensor

from avatar.checks import check_shape


def point_to_point(points: Tensor, anchors: Tensor) -> Tensor:
    """Squared distance of each point to its anchor (CloSET eq. 4). ``(B, N, 3)`` twice to ``(B, N)``, m^2."""
    dims = check_shape("points", points, "B N 3")
    check_shape("anchors", anchors, "B N 3", **dims)
    return (points - anchors).square().sum(dim=-1)


def point_to_plane(points: Tensor, anchors: Tensor, normals: Tensor) -> Tensor:
    """Squared distance of each point to the tangent plane at its anchor. ``(B, N, 3)`` thrice to ``(B, N)``, m^2.

    With nearest scan points as anchors this approximates squared point-to-surface distance and does not penalise
    sliding along the cloth (POP's prediction-to-scan term).
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
