"""Posed scans prepared for learning skinning: points in the body's root frame and edges that may be smoothed over."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from avatar.body.skinning import skin_transforms
from avatar.canonical.fields import bounding_box
from avatar.checks import AvatarError, check_shape
from avatar.geometry.surface import face_areas, interpolate, sample_surface
from avatar.geometry.transforms import axis_angle_from_rotation, invert_affine, transform_points
from avatar.geometry.trees import build_tree
from avatar.records import BodyFit, Frame, Scan, Template, map_tensors

CONCAVE = 20.0  # 1/m; the paper's 0.2 read per centimetre: grooves of less than 2.5 cm radius
CURVATURE_POINTS, CURVATURE_NEIGHBOURS = 10_000, 16  # on a clothed person, patches of 3 cm radius
EDGE_NEIGHBOURS = 6


def smooth_edges(scan: Scan, count: int, rng: np.random.Generator) -> np.ndarray:
    """At most ``count`` edges ``(E, 2)`` of a scan with neither end in a concave region.

    Edges of the triangles of a mesh, or from points to a few of their nearest ones. Body parts that touch run together
    in a scan, and where they do the surface is concave: weights must not be smoothed across (SCANimate eq. 12 and
    appendix A.4). A scan that is concave everywhere, such as one with its normals turned inside, keeps its edges.
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
    _, ids = nearest_ids(points, points[starts], count + 1)
    return np.stack([np.repeat(starts, count), ids[:, 1:].reshape(-1)], axis=1)


def nearest_ids(points: np.ndarray, queries: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Distances and indices ``(Q, count)`` of the points nearest to queries, on all of torch's threads."""
    tree = build_tree(points)
    distances, ids = tree.query(queries, k=count, workers=torch.get_num_threads())
    return distances.reshape(len(queries), count), ids.reshape(len(queries), count)


def mean_curvature(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Mean curvature ``(N,)`` of the surface under oriented points, 1/m: positive where it bulges, negative in hollows.

    From how far the neighbours lie below the tangent plane; exact on spheres, and not troubled by a scanner's noise,
    because the neighbours are drawn from a thinned cloud and so lie centimetres away.
    """
    check_shape("normals", normals, "N 3", **check_shape("points", points, "N 3"))
    thinned = points[:: -(-len(points) // CURVATURE_POINTS)]
    _, ids = nearest_ids(thinned, points, min(CURVATURE_NEIGHBOURS, len(thinned)))
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

    def to(self, device: torch.device | str) -> ScanBatch:
        """The same batch on another device."""
        return map_tensors(self, lambda tensor: tensor.to(device))


@dataclass
class DrawConfig:
    """How many points of a frame a training step sees; the defaults are the paper's."""

    scan: int = 8000
    body: int = 6890  # body vertices; all of SMPL's
    edges: int = 5000
    pool: int = 50_000  # scan points, edges and body vertices of a frame kept in memory to draw from

    def __post_init__(self):
        wrong = {name: value for name, value in vars(self).items() if value < 1}
        if wrong:
            raise AvatarError(f"draw: expected at least 1 each, got {wrong}.")


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


def canonical_transforms(weights: Tensor, joint_transforms: Tensor, template: Template) -> Tensor:
    """Inverse LBS (SCANimate eq. 1): canonical_from_posed of points with weights ``(N, J)``, ``(N, 4, 4)``."""
    return invert_affine(skin_transforms(weights, joint_transforms[None], template.canonical_from_bind)[0])


def prepare_scan(frame: Frame, template: Template, pool: int, seed: int = 0) -> PosedScan:
    """A frame made ready to learn from: only its scan, joint transforms and posed body are used.

    Args:
        frame: a scan of points, or of a mesh, which is sampled evenly.
        template: the body at rest.
        pool: at most so many points and edges are kept.
        seed: of the choice.
    """
    body, transforms = to_root_frame(frame.body.vertices, frame.body), root_joint_transforms(frame.body)
    rng = np.random.default_rng(seed)
    points, edges = draw_surface(frame.scan, pool, rng), smooth_edges(frame.scan, pool, rng)
    _, nearest = nearest_ids(frame.body.vertices, points, 1)
    back = canonical_transforms(template.weights, transforms, template)
    return PosedScan(
        points=to_root_frame(points, frame.body),
        nearest=torch.from_numpy(nearest[:, 0]),
        edges=to_root_frame(frame.scan.points[edges].reshape(-1, 3), frame.body).reshape(-1, 2, 3),
        body=body,
        canonical_body=transform_points(back, body),
        vertices=torch.from_numpy(rng.choice(len(body), pool, p=area_shares(body, template.faces))),
        joint_transforms=transforms,
        pose=local_pose(transforms, template.parents),
        box=bounding_box(body),
    )


def area_shares(vertices: Tensor, faces: Tensor) -> np.ndarray:
    """Each vertex's share ``(V,)`` of a surface's area: a third of the triangles around it."""
    areas = face_areas(vertices, faces).double()
    shares = areas.new_zeros(len(vertices)).index_add(0, faces.reshape(-1), areas.repeat_interleave(3))
    return (shares / shares.sum()).numpy()


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
    """A training batch of some of the scans: points, edges and body vertices drawn anew from each.

    Args:
        scans: all scans learned from.
        frames: which of them, as indices.
        weights: ``(V, J)`` of the body.
        draw: how many points.
        generator: random state; the same state gives the same batch.
    """
    items = []
    for scan in (scans[frame] for frame in frames):
        point, edge, chosen = (
            torch.randint(len(pool), (count,), generator=generator)
            for pool, count in ((scan.points, draw.scan), (scan.edges, draw.edges), (scan.vertices, draw.body))
        )
        vertex = scan.vertices[chosen]
        items.append(
            {
                "points": scan.points[point],
                "nearest_weights": weights[scan.nearest[point]],
                "edges": scan.edges[edge],
                "body": scan.body[vertex],
                "canonical_body": scan.canonical_body[vertex],
                "body_weights": weights[vertex],
                "joint_transforms": scan.joint_transforms,
                "poses": scan.pose,
                "boxes": scan.box,
            }
        )
    stacked = {key: torch.stack([item[key] for item in items]) for key in items[0]}
    return ScanBatch(**stacked, frames=torch.as_tensor(list(frames)))
