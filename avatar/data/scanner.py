"""The virtual scanner: dressed bodies to oriented points, as a scanner or a packed dataset would give them.

Raw scans as meshes are made in `fusion`.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from avatar.checks import AvatarError
from avatar.data.patterns import Pattern, paint
from avatar.geometry.surface import interpolate, sample_surface, vertex_normals
from avatar.geometry.trees import build_tree
from avatar.records import Scan

FACING = -0.3  # cosine between normals below which two surfaces look at each other


@dataclass
class ScanConfig:
    """What the scanner gives of each frame. The defaults are a perfect scanner; see `SCANNERS` for real ones."""

    points: int = 40_000  # a frame, before holes are cut; a mesh has the points its edges need
    noise: float = 0.0  # metres, standard deviation of each coordinate
    holes: int = 0  # patches a frame where nothing was seen
    hole_radius: float = 0.05  # metres
    merge: float = 0.0  # metres; surfaces facing each other closer than this run into one
    mesh: bool = False  # a fused triangle mesh instead of a point cloud
    edge: float = 0.012  # metres; longest edge of such a mesh
    pattern: Pattern = Pattern.none  # what the garments are coloured with; none gives scans without colours
    seed: int = 0

    def __post_init__(self):
        if self.points < 1 or self.holes < 0:
            raise AvatarError(f"points, holes: expected at least 1 and 0, got {self.points} and {self.holes}.")
        for name in ("noise", "hole_radius", "merge"):
            if not 0 <= getattr(self, name) <= 0.5:
                raise AvatarError(f"{name}: expected 0 to 0.5 metres, got {getattr(self, name)}.")
        if not 0.004 <= self.edge <= 0.5:
            raise AvatarError(f"edge: expected 0.004 to 0.5 metres, got {self.edge}.")


# perfect: nothing lost. raw: what a scanner's fused mesh has: holes, noise, touching parts run together; as points,
# and as the mesh itself, in which triangles bridge what touched.
SCANNERS = {
    "perfect": ScanConfig(),
    "raw": ScanConfig(noise=0.0015, holes=6, hole_radius=0.04, merge=0.012),
    "raw_mesh": ScanConfig(noise=0.0015, holes=6, hole_radius=0.04, merge=0.012, mesh=True),
}


@dataclass(frozen=True)
class DressedSurface:
    """Body and cloth of one frame as one mesh, and what can be seen of it.

    ``vertices (V, 3)`` and ``canonical (V, 3)`` posed and at rest, float32 tensors; ``faces (F, 3)``; ``visible
    (F,)`` bool; ``labels (V,)`` uint8, 0 skin, then one number a garment.
    """

    vertices: Tensor
    canonical: Tensor
    faces: Tensor
    visible: Tensor
    labels: Tensor


def scan_points(surface: DressedSurface, config: ScanConfig, frame: str) -> Scan:
    """Oriented points on what can be seen of a dressed body, spread evenly by area.

    Normals are the smooth ones of the whole mesh, pointing out of body and cloth. Depends on nothing but the
    surface, the configuration and the frame's name.

    Args:
        surface: the dressed body.
        config: number of points, noise, holes, merging, pattern, seed.
        frame: the frame's name, part of the random seed.

    Raises:
        AvatarError: when nothing can be seen, or holes have taken every point.
    """
    faces = surface.faces[surface.visible]
    if len(faces) == 0:
        raise AvatarError(f"visible: expected some visible faces in {frame}, got none.")
    seed = frame_seed(config.seed, frame)
    samples = sample_surface(surface.vertices, faces, config.points, torch.Generator().manual_seed(seed))
    normals = interpolate(vertex_normals(surface.vertices, surface.faces), samples)
    corner = samples.barycentric.argmax(dim=1, keepdim=True)
    nearest_corner = samples.vertex_ids.gather(1, corner).squeeze(1)
    scan = Scan(
        points=interpolate(surface.vertices, samples).numpy(),
        normals=torch.nn.functional.normalize(normals, dim=-1, eps=1e-20).numpy(),
        labels=surface.labels[nearest_corner].numpy(),
        canonical=interpolate(surface.canonical, samples).numpy(),
    )
    rng = np.random.default_rng(seed)
    if config.merge:
        scan = merge_contacts(scan, config.merge)
    if config.noise:
        shaken = scan.points + config.noise * rng.standard_normal(scan.points.shape, np.float32)
        scan = replace(scan, points=shaken)
    if config.holes:
        scan = keep_points(scan, outside_holes(scan.points, config.holes, config.hole_radius, rng))
    return paint(scan, config.pattern)


def scan_mesh(surface: DressedSurface) -> Scan:
    """What can be seen of a dressed body as a mesh: the scan's points are its vertices, without noise or holes."""
    faces = surface.faces[surface.visible]
    used, corners = torch.unique(faces, return_inverse=True)
    return Scan(
        points=surface.vertices[used].numpy(),
        normals=vertex_normals(surface.vertices, surface.faces)[used].numpy(),
        faces=corners.reshape(faces.shape).numpy(),
        labels=surface.labels[used].numpy(),
        canonical=surface.canonical[used].numpy(),
    )


def frame_seed(seed: int, frame: str) -> int:
    """A random seed for one frame: the same for the same numbers and name on every machine."""
    digest = hashlib.sha256(f"{seed}/{frame}".encode()).digest()
    return int.from_bytes(digest[:8], "little") >> 1


def merge_contacts(scan: Scan, distance: float) -> Scan:
    """Runs surfaces that face each other across a narrow gap into one sheet, as a fused scan shows them.

    A point whose nearest point on a surface facing it is closer than ``distance`` moves halfway to it, and its
    normal turns to the blend of both. Truth (labels and canonical positions) stays.
    """
    moving, partner = facing_partners(scan.points, scan.normals, distance)
    points, normals = scan.points.copy(), scan.normals.copy()
    points[moving] = (scan.points[moving] + scan.points[partner]) / 2
    blended = scan.normals[moving] + scan.normals[partner]
    length = np.linalg.norm(blended, axis=1, keepdims=True)
    normals[moving] = np.where(length > 1e-3, blended / np.maximum(length, 1e-3), scan.normals[moving])
    return replace(scan, points=points, normals=normals)


def facing_partners(points: np.ndarray, normals: np.ndarray, distance: float) -> tuple[np.ndarray, np.ndarray]:
    """Points that look at another surface across a gap narrower than ``distance``, and whom they look at.

    Returns:
        Two index arrays ``(K,)``: the points, and for each the nearest point ahead of it that faces it.
    """
    pairs = build_tree(points).query_pairs(distance, output_type="ndarray")
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    pairs = pairs[np.einsum("kc,kc->k", normals[pairs[:, 0]], normals[pairs[:, 1]]) < FACING]
    across = points[pairs[:, 1]] - points[pairs[:, 0]]
    gaps = np.linalg.norm(across, axis=1)
    ahead = np.einsum("kc,kc->k", across, normals[pairs[:, 0]]) > 0.5 * gaps
    pairs = pairs[ahead][np.argsort(gaps[ahead], kind="stable")]
    moving, first = np.unique(pairs[:, 0], return_index=True)
    return moving, pairs[first, 1]


def outside_holes(points: np.ndarray, holes: int, radius: float, rng: np.random.Generator) -> np.ndarray:
    """Which points ``(M,)`` lie beyond the radius of a few of the points, drawn at random."""
    centres = points[rng.integers(len(points), size=holes)]
    kept = build_tree(centres).query(points, distance_upper_bound=radius)[0] == np.inf
    if not kept.any():
        raise AvatarError(f"holes: expected some points to be left, {holes} holes of {radius} m took them all.")
    return kept


def keep_points(scan: Scan, kept: np.ndarray) -> Scan:
    """Some of a scan's points ``(M,)`` bool, in their order, with all that is known of them, and the faces over them.

    A face goes with any of its corners.
    """
    names = ("points", "normals", "labels", "canonical", "colors")
    values = {name: getattr(scan, name)[kept] for name in names if getattr(scan, name) is not None}
    if scan.faces is not None:
        renumbered = np.cumsum(kept) - 1
        values["faces"] = renumbered[scan.faces[kept[scan.faces].all(axis=1)]]
    return replace(scan, **values)
