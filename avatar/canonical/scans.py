"""Posed scans to learn skinning from, and inverse LBS of scans to the canonical pose (SCANimate 3.1, A.4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from avatar.body.skinning import skin_transforms
from avatar.canonical.fields import bounding_box
from avatar.checks import AvatarError, check_finite, check_range, check_shape
from avatar.geometry.neighbours import FixedPoints
from avatar.geometry.surface import face_areas, interpolate, sample_surface
from avatar.geometry.transforms import axis_angle_from_rotation, invert_affine, transform_points
from avatar.records import BodyFit, CanonicalScan, Frame, Scan, Template

CONCAVE = 20.0  # 1/m; the paper's 0.2 read per centimetre: grooves of less than 2.5 cm radius
CURVATURE_POINTS, CURVATURE_NEIGHBOURS = 10_000, 16  # on a clothed person, patches of 3 cm radius
EDGE_NEIGHBOURS = 6
STRETCH = 4.0  # longest that an edge may become, as a multiple of its length in the scan
TORN_SHARE = 0.5  # of a point's edges to its neighbours, beyond which a point scan loses it


def smooth_edges(scan: Scan, count: int, rng: np.random.Generator) -> np.ndarray:
    """At most ``count`` edges ``(E, 2)`` of a scan, of triangles or to nearest points, with no end in a concave region.

    Where body parts that touch run together in a scan it is concave: weights must not be smoothed across (SCANimate
    eq. 12, appendix A.4). A scan that is concave everywhere, such as one with normals turned inside, keeps its edges.
    """
    if scan.faces is None:
        edges = neighbour_edges(scan.points, rng.permutation(len(scan.points))[: -(-count // EDGE_NEIGHBOURS)])
    else:
        edges = np.stack([scan.faces, np.roll(scan.faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    concave = mean_curvature(scan.points, scan.normals) < -CONCAVE
    smooth = edges[~concave[edges].any(axis=1)]
    return rng.permutation(smooth if len(smooth) else edges)[:count]


def neighbour_edges(points: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Edges ``(S k, 2)`` from some of the points, given by index, to those nearest to each; they stand together."""
    count = min(EDGE_NEIGHBOURS, len(points) - 1)
    ids = nearest_ids(points, points[starts], count + 1)
    return np.stack([np.repeat(starts, count), ids[:, 1:].reshape(-1)], axis=1)


def nearest_ids(points: np.ndarray, queries: np.ndarray, count: int) -> np.ndarray:
    """Indices ``(Q, count)`` of the points nearest to queries, on all of torch's threads."""
    return FixedPoints(torch.as_tensor(points)).k_nearest(torch.as_tensor(queries), count).numpy()


def mean_curvature(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Mean curvature ``(N,)`` of the surface under oriented points, 1/m: positive where it bulges, negative in hollows.

    From how far neighbours lie below the tangent plane; in a thinned cloud they are centimetres away, beyond noise.
    """
    check_shape("normals", normals, "N 3", **check_shape("points", points, "N 3"))
    thinned = points[:: -(-len(points) // CURVATURE_POINTS)]
    ids = nearest_ids(thinned, points, min(CURVATURE_NEIGHBOURS, len(thinned)))
    offsets = thinned[ids] - points[:, None]
    below = -np.einsum("nkc,nc->n", offsets, normals)
    return 2 * below / np.maximum(np.einsum("nkc,nkc->n", offsets, offsets), 1e-12)


@dataclass(frozen=True)
class PosedScan:
    """A scan and its body in the body's root frame: what canonicalization is learned from. Float32, metres.

    ``points (M, 3)``; ``nearest (M,)`` the body vertex nearest to each; ``edges (E, 2, 3)`` ends of the scan's edges
    outside concave regions; ``body (V, 3)``; ``canonical_body (V, 3)`` with the pose blendshapes of this pose, where
    the body has them; ``vertices (P,)`` indices of body vertices in proportion to their areas, for faces and fingers
    have more than their share; ``joint_transforms (J, 4, 4)`` posed_from_canonical; ``pose (3 (J - 1),)`` axis-angle
    without the root's; ``box (2, 3)`` around the posed body.
    """

    points: Tensor
    nearest: Tensor
    edges: Tensor
    body: Tensor
    canonical_body: Tensor
    vertices: Tensor
    joint_transforms: Tensor
    pose: Tensor
    box: Tensor


@dataclass(frozen=True)
class ScanBatch:
    """Points drawn from posed scans, stacked: K body vertices, M scan points and E edges a frame.

    ``points (B, M, 3)``, ``nearest_weights (B, M, J)`` of the nearest body vertices, ``edges (B, E, 2, 3)``, ``body``
    and ``canonical_body (B, K, 3)``, ``body_weights (B, K, J)``, ``joint_transforms (B, J, 4, 4)``, ``poses (B, P)``,
    ``boxes (B, 2, 3)``, ``frames (B,)`` int64 index of each frame among those learned from.
    """

    points: Tensor
    nearest_weights: Tensor
    edges: Tensor
    body: Tensor
    canonical_body: Tensor
    body_weights: Tensor
    joint_transforms: Tensor
    poses: Tensor
    boxes: Tensor
    frames: Tensor


@dataclass
class DrawConfig:
    """How many points of a frame a training step sees; the defaults are the paper's."""

    scan: int = 8000
    body: int = 6890  # body vertices; all of SMPL's
    edges: int = 5000
    pool: int = 50_000  # scan points, edges and body vertices of a frame kept in memory to draw from

    def __post_init__(self):
        check_range(self, *vars(self), low=1)


def root_joint_transforms(body: BodyFit) -> Tensor:
    """The body's joint transforms with global rotation and translation removed, ``(J, 4, 4)`` float32."""
    transforms = torch.as_tensor(body.joint_transforms, dtype=torch.float64)
    return (invert_affine(transforms[0]) @ transforms).float()


def to_root_frame(points: np.ndarray, body: BodyFit) -> Tensor:
    """World points ``(N, 3)`` in the body's root frame, float32."""
    root = invert_affine(torch.as_tensor(body.joint_transforms[0], dtype=torch.float64))
    return transform_points(root, torch.as_tensor(points, dtype=torch.float64)).float()


def local_pose(joint_transforms: Tensor, parents: tuple[int, ...]) -> Tensor:
    """Each joint's turn against its parent, but the root's: ``(J, 4, 4)`` to ``(3 (J - 1),)`` axis-angle, radians."""
    rotations = joint_transforms[:, :3, :3]
    relative = rotations[list(parents[1:])].transpose(-1, -2) @ rotations[1:]
    return axis_angle_from_rotation(relative).flatten()


def prepare_scan(frame: Frame, template: Template, pool: int, seed: int = 0) -> PosedScan:
    """A frame made ready to learn from: only its scan, joint transforms and posed body are used.

    At most ``pool`` points and edges of the scan are kept, points of a mesh sampled evenly; ``seed`` chooses them.
    """
    body, transforms = to_root_frame(frame.body.vertices, frame.body), root_joint_transforms(frame.body)
    rng = np.random.default_rng(seed)
    points, edges = draw_surface(frame.scan, pool, rng), smooth_edges(frame.scan, pool, rng)
    posed_from_canonical = skin_transforms(template.weights, transforms[None], template.canonical_from_bind)[0]
    areas = face_areas(body, template.faces).double()  # a vertex has a third of the triangles around it
    shares = areas.new_zeros(len(body)).index_add(0, template.faces.reshape(-1), areas.repeat_interleave(3))
    return PosedScan(
        points=to_root_frame(points, frame.body),
        nearest=torch.from_numpy(nearest_ids(frame.body.vertices, points, 1)[:, 0]),
        edges=to_root_frame(frame.scan.points[edges].reshape(-1, 3), frame.body).reshape(-1, 2, 3),
        body=body,
        canonical_body=transform_points(invert_affine(posed_from_canonical), body),
        vertices=torch.from_numpy(rng.choice(len(body), pool, p=(shares / shares.sum()).numpy())),
        joint_transforms=transforms,
        pose=local_pose(transforms, template.parents),
        box=bounding_box(body),
    )


def draw_surface(scan: Scan, count: int, rng: np.random.Generator) -> np.ndarray:
    """At most ``count`` points ``(N, 3)`` of a scan, spread evenly over a mesh and drawn from points."""
    if scan.faces is None:
        return scan.points[rng.permutation(len(scan.points))[:count]]
    generator = torch.Generator().manual_seed(int(rng.integers(1 << 62)))
    vertices, faces = torch.as_tensor(scan.points), torch.as_tensor(scan.faces).long()
    return interpolate(vertices, sample_surface(vertices, faces, count, generator)).numpy()


def draw_batch(
    scans: Sequence[PosedScan], frames: Sequence[int], weights: Tensor, draw: DrawConfig, generator: torch.Generator
) -> ScanBatch:
    """A training batch of some of the scans, given by index: points, edges and body vertices drawn anew from each.

    ``weights (V, J)`` are the body's. The same state of the ``generator`` gives the same batch.
    """
    items = []
    for scan in (scans[frame] for frame in frames):
        point, edge, chosen = (
            torch.randint(len(pool), (count,), generator=generator)
            for pool, count in ((scan.points, draw.scan), (scan.edges, draw.edges), (scan.vertices, draw.body))
        )
        vertex = scan.vertices[chosen]
        drawn = scan.points[point], weights[scan.nearest[point]], scan.edges[edge]
        body = scan.body[vertex], scan.canonical_body[vertex], weights[vertex]
        items.append((*drawn, *body, scan.joint_transforms, scan.pose, scan.box))  # in the order of ScanBatch
    return ScanBatch(*map(torch.stack, zip(*items)), frames=torch.as_tensor(list(frames)))


def canonicalize_scan(
    scan: Scan, body: BodyFit, weights: np.ndarray, template: Template, stretch: float = STRETCH
) -> CanonicalScan:
    """Inverse LBS of every point of a posed scan over its body (SCANimate eq. 1), then the cut of what was stretched.

    Edges between surfaces that touched are stretched when these part: triangles with an edge beyond ``stretch`` go, and
    points left without any; a scan of points loses those that parted from most of their neighbours. ``weights (M, J)``
    have rows summing to 1. Raises `AvatarError` for weights that do not fit, or when nothing is left of the scan.
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
    normals = normalize(normals, dim=-1, eps=1e-20).numpy()
    kept, faces = cut_stretched(scan, points, stretch)
    if not len(kept):
        raise AvatarError("weights: expected some of the scan to hold together in the canonical pose, nothing did.")
    colors = None if scan.colors is None else scan.colors[kept]
    return CanonicalScan(points[kept], normals[kept], weights[kept].astype(np.float32), kept, faces, colors)


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
