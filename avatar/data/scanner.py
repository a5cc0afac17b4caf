"""The virtual scanner: dressed bodies to oriented, maybe coloured points; `data.fusion` makes raw scans as meshes."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
import torch
from torch import Tensor

from avatar.checks import AvatarError, check_shape
from avatar.geometry.surface import interpolate, sample_surface, vertex_normals
from avatar.geometry.trees import build_tree
from avatar.records import Scan

SKIN = (0.80, 0.60, 0.49)
PALETTES = (  # ground and figure of the first garment, the second, ...
    ((0.93, 0.89, 0.80), (0.72, 0.16, 0.20)),
    ((0.16, 0.24, 0.42), (0.85, 0.72, 0.38)),
    ((0.24, 0.42, 0.36), (0.93, 0.91, 0.84)),
)
HEART = (0.95, 0.74, 0.18)  # of a flower
STRIPE = 0.035  # metres, width of a stripe
CHECK = 0.05  # metres, side of a check
SPACING = 0.10  # metres between rows of dots and flowers
DOT, FLOWER, FLOWER_HEART = 0.022, 0.042, 0.011  # metres, radii


class Pattern(Enum):
    """What a garment is woven with."""

    none = "none"
    stripes = "stripes"  # level bands
    checks = "checks"
    dots = "dots"
    flowers = "flowers"  # four petals around a heart


def paint(scan: Scan, pattern: Pattern) -> Scan:
    """The scan with colours; as it is for `Pattern.none`.

    Raises `AvatarError` for a scan without labels and canonical positions, which only simulated data has.
    """
    if pattern is Pattern.none:
        return scan
    if scan.canonical is None or scan.labels is None:
        raise AvatarError(f"pattern: {pattern.value} needs labels and canonical positions, the scan has none.")
    return replace(scan, colors=pattern_colors(pattern, scan.canonical, scan.labels))


def pattern_colors(pattern: Pattern, canonical: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Colours ``(M, 3)`` float32 RGB in [0, 1] of points on skin (label 0) and garments, each with its own two colours.

    ``canonical (M, 3)`` are places on the garments at rest, metres; ``labels (M,)`` say which garment.
    """
    dims = check_shape("canonical", canonical, "M 3")
    check_shape("labels", labels, "M", **dims)
    away = _from_lattice(canonical)
    distance = np.linalg.norm(away, axis=1)
    # petals along the axes: whichever way the cloth cuts through, it shows four of them
    petals = np.abs(away).max(axis=1) / np.maximum(distance, 1e-9)
    on_figure = {
        Pattern.none: np.zeros(len(canonical), bool),
        Pattern.stripes: np.floor(canonical[:, 1] / STRIPE) % 2 == 1,
        Pattern.checks: np.floor(canonical / CHECK).sum(axis=1) % 2 == 1,
        Pattern.dots: distance < DOT,
        Pattern.flowers: distance < FLOWER * petals**4,
    }
    palettes = np.array(PALETTES)[(np.asarray(labels, np.int64) - 1) % len(PALETTES)]
    colors = np.where(on_figure[pattern][:, None], palettes[:, 1], palettes[:, 0])
    if pattern is Pattern.flowers:
        colors[distance < FLOWER_HEART] = HEART
    colors[np.asarray(labels) == 0] = SKIN
    return colors.astype(np.float32)


def _from_lattice(points: np.ndarray) -> np.ndarray:
    """From the nearest centre of a body-centred lattice to each point, ``(M, 3)``: staggered rows on all sides."""
    first = points - SPACING * np.rint(points / SPACING)
    shifted = points - SPACING / 2
    second = shifted - SPACING * np.rint(shifted / SPACING)
    nearer = np.linalg.norm(first, axis=1) < np.linalg.norm(second, axis=1)
    return np.where(nearer[:, None], first, second)


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

    Normals are the smooth ones of the whole mesh, pointing out of body and cloth. Depends on nothing but the surface,
    the configuration and the frame's name. Raises `AvatarError` when nothing can be seen, or holes have taken every
    point.
    """
    faces = surface.faces[surface.visible]
    if len(faces) == 0:
        raise AvatarError(f"visible: expected some visible faces in {frame}, got none.")
    seed = frame_seed(config.seed, frame)
    samples = sample_surface(surface.vertices, faces, config.points, torch.Generator().manual_seed(seed))
    normals = interpolate(vertex_normals(surface.vertices, surface.faces), samples)
    nearest_corner = samples.vertex_ids.gather(1, samples.barycentric.argmax(dim=1, keepdim=True)).squeeze(1)
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
        scan = replace(scan, points=scan.points + config.noise * rng.standard_normal(scan.points.shape, np.float32))
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
    """Points ``(K,)`` that look at another surface nearer than ``distance``, and the nearest ahead that faces each."""
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
        values["faces"] = (np.cumsum(kept) - 1)[scan.faces[kept[scan.faces].all(axis=1)]]
    return replace(scan, **values)
