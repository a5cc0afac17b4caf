"""Skinning weights of the nearest body, and inverse LBS of scans to the canonical pose (SCANimate 3.1, 4.1, A.4)."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch

from avatar.body.skinning import skin_transforms
from avatar.canonical.posed import nearest_ids, neighbour_edges, root_joint_transforms, to_root_frame
from avatar.checks import AvatarError, check_finite, check_shape
from avatar.geometry.transforms import invert_affine, transform_points
from avatar.records import BodyFit, CanonicalScan, Frame, Scan, Template

KNN = 6  # the paper's number of neighbours


class SkinningSource(Protocol):
    """What gives posed points their skinning weights."""

    def weights_of(self, points: np.ndarray, frame: Frame) -> np.ndarray:
        """Weights ``(M, J)``, rows summing to 1, of posed points ``(M, 3)`` in the frame's world, metres."""
        ...


class NearestBody:
    """Weights of the nearest posed body vertices, by inverse distance; of the nearest alone for one neighbour."""

    def __init__(self, template: Template, neighbours: int = 1):
        """Takes the body's weights. Raises `AvatarError` for fewer than one neighbour or more than vertices."""
        if not 1 <= neighbours <= len(template.vertices):
            raise AvatarError(f"neighbours: expected 1 to {len(template.vertices)}, got {neighbours}.")
        self.template, self.weights, self.neighbours = template, template.weights.numpy(), neighbours

    def weights_of(self, points: np.ndarray, frame: Frame) -> np.ndarray:
        """Weights ``(M, J)`` of posed points ``(M, 3)`` in the frame's world, metres."""
        return self.blend_weights(points, frame.body.vertices)

    def blend_weights(self, points: np.ndarray, vertices: np.ndarray) -> np.ndarray:
        """Weights ``(M, J)`` of points ``(M, 3)`` beside the body at ``vertices (V, 3)``, posed or at rest, metres."""
        check_shape("points", points, "M 3")
        distances, ids = nearest_ids(vertices, points, self.neighbours)
        closeness = 1 / np.maximum(distances, 1e-9)
        closeness /= closeness.sum(axis=1, keepdims=True)
        return np.einsum("mk,mkj->mj", closeness, self.weights[ids]).astype(np.float32)


STRETCH = 4.0  # longest that an edge may become, as a multiple of its length in the scan
TORN_SHARE = 0.5  # of a point's edges to its neighbours, beyond which a point scan loses it


def canonicalize_scan(
    scan: Scan, body: BodyFit, weights: np.ndarray, template: Template, stretch: float = STRETCH
) -> CanonicalScan:
    """Inverse LBS of every point of a scan, then the cut of what was stretched.

    Where surfaces touched in the scan, edges run from one to the other and are stretched when they part: triangles
    with an edge beyond ``stretch`` go, and points left without a triangle. A scan of points loses those that
    parted from most of their neighbours.

    Args:
        scan: posed points with normals, and faces or colours where it has them.
        body: the body under it.
        weights: ``(M, J)`` skinning weights of the scan's points, rows summing to 1.
        template: the body at rest in its canonical pose.
        stretch: see above; infinity keeps everything.

    Raises `AvatarError` for weights that do not fit, or when nothing is left of the scan.
    """
    check_shape("weights", weights, "M J", M=len(scan.points), J=len(template.parents))
    check_finite("weights", weights)
    joint_transforms = root_joint_transforms(body)
    blend = torch.from_numpy(np.ascontiguousarray(weights, np.float32))
    posed = skin_transforms(blend, joint_transforms[None], template.canonical_from_bind)[0]
    points = transform_points(invert_affine(posed), to_root_frame(scan.points, body)).numpy()
    root = torch.from_numpy(np.asarray(body.joint_transforms[0, :3, :3], np.float32))
    turned = torch.from_numpy(np.asarray(scan.normals, np.float32)) @ root  # rows times the inverse rotation
    normals = torch.einsum("nij,ni->nj", posed[:, :3, :3], turned)  # the transposed inverse of the inverse
    normals = torch.nn.functional.normalize(normals, dim=-1, eps=1e-20).numpy()
    kept, faces = cut_stretched(scan, points, stretch)
    if not len(kept):
        raise AvatarError("weights: expected some of the scan to hold together in the canonical pose, nothing did.")
    return CanonicalScan(
        points=points[kept],
        normals=normals[kept],
        weights=weights[kept].astype(np.float32),
        source=kept,
        faces=faces,
        colors=None if scan.colors is None else scan.colors[kept],
    )


def cut_stretched(scan: Scan, points: np.ndarray, stretch: float) -> tuple[np.ndarray, np.ndarray | None]:
    """Which points ``(N,)`` of a scan are kept when they move to ``points (M, 3)``, and the faces among those kept."""
    if scan.faces is None:
        edges = neighbour_edges(scan.points, np.arange(len(points)))
        torn = edge_stretch(edges, scan.points, points).reshape(len(points), -1) > stretch
        return np.flatnonzero(torn.mean(axis=1) <= TORN_SHARE), None
    corners = np.stack([scan.faces, np.roll(scan.faces, -1, axis=1)], axis=-1)
    whole = scan.faces[(edge_stretch(corners, scan.points, points) <= stretch).all(axis=1)]
    kept, faces = np.unique(whole, return_inverse=True)
    return kept, faces.reshape(-1, 3)


def edge_stretch(edges: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """How many times longer edges ``(..., 2)`` are after than before, ``(...)``; 1 for edges of no length at all."""
    lengths = [np.linalg.norm(ends[edges[..., 0]] - ends[edges[..., 1]], axis=-1) for ends in (before, after)]
    return (lengths[1] + 1e-9) / (lengths[0] + 1e-9)
