"""The virtual scanner: dressed bodies to oriented points, as a scanner or a packed dataset would give them."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from avatar.checks import AvatarError
from avatar.geometry.surface import interpolate, sample_surface, vertex_normals
from avatar.records import Scan

FACING = -0.3  # cosine between normals below which two surfaces look at each other


@dataclass
class ScanConfig:
    """What the scanner gives of each frame. The defaults are a perfect scanner; see `SCANNERS` for a real one."""

    points: int = 40_000  # a frame, before holes are cut
    noise: float = 0.0  # metres, standard deviation of each coordinate
    holes: int = 0  # patches a frame where nothing was seen
    hole_radius: float = 0.05  # metres
    merge: float = 0.0  # metres; surfaces facing each other closer than this run into one
    seed: int = 0

    def __post_init__(self):
        if self.points < 1 or self.holes < 0:
            raise AvatarError(f"points, holes: expected at least 1 and 0, got {self.points} and {self.holes}.")
        for name in ("noise", "hole_radius", "merge"):
            if not 0 <= getattr(self, name) <= 0.5:
                raise AvatarError(f"{name}: expected 0 to 0.5 metres, got {getattr(self, name)}.")


# perfect: nothing lost. raw: what a scanner's fused mesh has: holes, noise, touching parts run together.
SCANNERS = {
    "perfect": ScanConfig(),
    "raw": ScanConfig(noise=0.0015, holes=6, hole_radius=0.04, merge=0.012),
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
        config: number of points, noise, holes, merging, seed.
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
    return cut_holes(scan, config.holes, config.hole_radius, rng) if config.holes else scan


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
    reach = 64  # nearest points looked at; the facing surface is among them where the gap is narrow
    tree = cKDTree(scan.points)
    distances, ids = tree.query(scan.points, k=min(reach, len(scan.points)), distance_upper_bound=distance)
    known = np.isfinite(distances)
    ids = np.where(known, ids, 0)
    across = scan.points[ids] - scan.points[:, None]
    ahead = np.einsum("mkc,mc->mk", across, scan.normals) > 0.5 * np.where(known, distances, np.inf)
    facing = np.einsum("mkc,mc->mk", scan.normals[ids], scan.normals) < FACING
    met = known & ahead & facing
    moving = np.flatnonzero(met.any(axis=1))
    partner = ids[moving, met[moving].argmax(axis=1)]
    points, normals = scan.points.copy(), scan.normals.copy()
    points[moving] = (scan.points[moving] + scan.points[partner]) / 2
    blended = scan.normals[moving] + scan.normals[partner]
    length = np.linalg.norm(blended, axis=1, keepdims=True)
    normals[moving] = np.where(length > 1e-3, blended / np.maximum(length, 1e-3), scan.normals[moving])
    return replace(scan, points=points, normals=normals)


def cut_holes(scan: Scan, holes: int, radius: float, rng: np.random.Generator) -> Scan:
    """Takes away every point within the radius of a few of the scan's points, drawn at random."""
    centres = scan.points[rng.integers(len(scan.points), size=holes)]
    distances, _ = cKDTree(centres).query(scan.points, distance_upper_bound=radius)
    kept = ~np.isfinite(distances)
    if not kept.any():
        raise AvatarError(f"holes: expected some points to be left, {holes} holes of {radius} m took them all.")
    return replace(
        scan,
        points=scan.points[kept],
        normals=scan.normals[kept],
        labels=scan.labels[kept],
        canonical=scan.canonical[kept],
    )
