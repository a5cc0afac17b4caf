"""The truth of canonicalizations, which only a simulator knows: where on the garment every scan point really is.

What the cloth itself does between the two poses is in the error as well, the same for every method. A reference says
how much: each point unposed with the weights of the body under its true place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from avatar.body.skinning import skin_transforms
from avatar.checks import AvatarError
from avatar.geometry.transforms import invert_affine, transform_points
from avatar.geometry.trees import build_tree
from avatar.records import BodyFit, CanonicalScan, Frame, Scan, Template

CONTACT = 0.02  # metres between two points of a scan that touch
APART = 0.10  # metres between the same two at rest, from which on they are of different parts of body and clothes


@dataclass(frozen=True)
class Canonicalized:
    """What a method made of one frame: its canonical ``scan``, and the weights it gives to points where they are now.

    ``forward_weights (M, J)`` are evaluated at the canonical points (the forward field g^c, or the weights of the
    nearest vertices of the body at rest); they pose the scan again, and tell whether the cycle closes.
    """

    scan: CanonicalScan
    forward_weights: np.ndarray | None = None


@dataclass(frozen=True)
class FrameTruth:
    """What is known of the ``M`` points of one posed scan.

    ``canonical (M, 3)`` places at rest; ``weights (M, J)`` of the body under them; ``garment (M,)`` bool, on cloth;
    ``contact (M,)`` bool, where the scan touches itself (`contact_points`).
    """

    canonical: np.ndarray
    weights: np.ndarray
    garment: np.ndarray
    contact: np.ndarray


def check_truth(scan: Scan) -> None:
    """Refuses a scan that does not know where its points belong at rest.

    Raises:
        AvatarError: for a scan without labels and canonical positions.
    """
    if scan.canonical is None or scan.labels is None:
        raise AvatarError("scan: expected labels and canonical positions; only simulated data has the truth.")


def frame_truth(scan: Scan, template: Template) -> FrameTruth:
    """The truth of a simulated scan.

    Raises:
        AvatarError: for a scan without labels and canonical positions.
    """
    check_truth(scan)
    return FrameTruth(
        canonical=scan.canonical,
        weights=weights_under(scan.canonical, template),
        garment=scan.labels > 0,
        contact=contact_points(scan.points, scan.canonical),
    )


def contact_points(points: np.ndarray, canonical: np.ndarray) -> np.ndarray:
    """Points where a scan touches itself: another point is within 2 cm now and more than 10 cm away at rest.

    Args:
        points: ``(M, 3)`` posed.
        canonical: ``(M, 3)`` the same at rest.

    Returns:
        ``(M,)`` bool.
    """
    touching = np.zeros(len(points), bool)
    pairs = build_tree(points).query_pairs(CONTACT, output_type="ndarray")
    apart = np.linalg.norm(canonical[pairs[:, 0]] - canonical[pairs[:, 1]], axis=1) > APART
    touching[pairs[apart]] = True
    return touching


def weights_under(canonical: np.ndarray, template: Template) -> np.ndarray:
    """Skinning weights of the nearest vertex of the body at rest: points at rest ``(M, 3)`` to ``(M, J)``."""
    _, nearest = build_tree(template.vertices.numpy()).query(canonical)
    return template.weights.numpy()[nearest]


def repose(points: np.ndarray, weights: np.ndarray, body: BodyFit, template: Template) -> np.ndarray:
    """Canonical points ``(M, 3)`` with weights ``(M, J)`` skinned to a body's pose, ``(M, 3)``."""
    return transform_points(_posed_from_canonical(weights, body, template), torch.from_numpy(points)).numpy()


def unpose_with(weights: np.ndarray, frame: Frame, template: Template) -> CanonicalScan:
    """A frame's scan unposed to the canonical pose with given weights ``(M, J)`` of its points; nothing is cut."""
    scan, forth = frame.scan, _posed_from_canonical(weights, frame.body, template)
    points = transform_points(invert_affine(forth), torch.from_numpy(scan.points))
    normals = torch.einsum("nij,ni->nj", forth[:, :3, :3], torch.from_numpy(scan.normals))
    return CanonicalScan(
        points=points.numpy(),
        normals=torch.nn.functional.normalize(normals, dim=-1, eps=1e-20).numpy(),
        weights=weights,
        source=np.arange(len(scan.points)),
        faces=scan.faces,
        colors=scan.colors,
    )


def unpose_truly(frame: Frame, truth: FrameTruth, template: Template) -> Canonicalized:
    """The canonicalization with the weights of the body under each point's true place."""
    scan = unpose_with(truth.weights, frame, template)
    return Canonicalized(scan, weights_under(scan.points, template))


def _posed_from_canonical(weights: np.ndarray, body: BodyFit, template: Template) -> torch.Tensor:
    """Transforms ``(M, 4, 4)`` of points with weights ``(M, J)``, float32."""
    blend, joints = (torch.from_numpy(np.asarray(a, np.float32)) for a in (weights, body.joint_transforms))
    return skin_transforms(blend, joints[None], template.canonical_from_bind)[0]
