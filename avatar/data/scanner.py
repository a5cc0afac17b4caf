"""The virtual scanner: dressed bodies to oriented, maybe coloured points, or to raw scans as meshes."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
import torch
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components
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
FACING = -0.3  # cosine between normals below which two surfaces look at each other
CORNERS = np.arange(3)
SMALLEST_COMPONENT = 30  # faces; smaller pieces are what scanning software throws away
NEARBY = 64  # nearest vertices in which a boundary vertex looks for another surface
FAR_AT_REST = 4  # times the merging distance: vertices as far apart at rest are on different parts of a surface
NOISE_ROUNDS = 3  # times each vertex's noise is blended with its neighbours': fusion has averaged many depth images
CHILDREN = {  # number of split edges: triangles over corners 0 1 2 and the middles 3 4 5 of edges 01 12 20
    1: ((0, 3, 2), (3, 1, 2)),
    2: ((3, 1, 4), (0, 3, 4), (0, 4, 2)),
    3: ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)),
}


class Pattern(Enum):
    """What a garment is woven with."""

    none = "none"
    stripes = "stripes"  # level bands
    checks = "checks"
    dots = "dots"
    flowers = "flowers"  # four petals around a heart


def paint(scan: Scan, pattern: Pattern) -> Scan:
    """The scan with colours, none for `Pattern.none`; `AvatarError` without labels and canonical positions."""
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
    """Body and cloth of one frame as one mesh: ``vertices (V, 3)`` posed, ``canonical (V, 3)`` at rest, float32.

    ``faces (F, 3)``, ``visible (F,)`` bool; ``labels (V,)`` uint8, 0 skin, then one number a garment.
    """

    vertices: Tensor
    canonical: Tensor
    faces: Tensor
    visible: Tensor
    labels: Tensor


def scan_points(surface: DressedSurface, config: ScanConfig, frame: str) -> Scan:
    """Oriented points on what can be seen of a dressed body, spread evenly by area.

    Normals are the smooth ones of the whole mesh. Follows from surface, configuration and the frame's name alone.
    Raises `AvatarError` when nothing can be seen, or holes have taken every point.
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
    """Runs surfaces that face each other closer than ``distance`` into one sheet, as a fused scan shows them.

    Points move halfway to the other surface, normals turn to the blend of both; labels and canonical positions stay.
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
    """Some of a scan's points ``(M,)`` bool with all that is known of them, and the faces that keep all corners."""
    names = ("points", "normals", "labels", "canonical", "colors")
    values = {name: getattr(scan, name)[kept] for name in names if getattr(scan, name) is not None}
    if scan.faces is not None:
        values["faces"] = (np.cumsum(kept) - 1)[scan.faces[kept[scan.faces].all(axis=1)]]
    return replace(scan, **values)


def fuse_mesh(surface: DressedSurface, config: ScanConfig, frame: str) -> Scan:
    """What can be seen of a dressed body as a raw mesh: edges of the scanner's fineness, contacts, noise, holes.

    Where surfaces touch, a real fused mesh is one sheet, which learned canonicalization (SCANimate 3.1) has to cope
    with; its vertices keep the truth of one side, by lot. Follows from surface, configuration and name as
    `scan_points`.
    """
    rng = np.random.default_rng(frame_seed(config.seed, frame))
    scan = split_long_edges(scan_mesh(surface), config.edge)
    if config.merge:
        scan = weld_contacts(scan, config.merge, rng)
    if config.noise:
        scan = replace(scan, points=scan.points + fused_noise(scan, config.noise, rng))
    if config.holes:
        scan = keep_points(scan, outside_holes(scan.points, config.holes, config.hole_radius, rng))
        scan = drop_small_components(scan)
    return paint(replace(scan, normals=_face_normals(scan)), config.pattern)


def split_long_edges(scan: Scan, longest: float) -> Scan:
    """The same surface with every edge at most so long, halved until none is longer, without gaps.

    New vertices stand between their two, in truth too, and have the label of the first.
    """
    values = np.concatenate([scan.points, scan.normals, scan.canonical], axis=1)
    labels, faces = scan.labels, scan.faces
    while True:
        edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1), axis=-1).reshape(-1, 2)
        keys, which = np.unique(edges[:, 0] * len(values) + edges[:, 1], return_inverse=True)
        start, end = np.divmod(keys, len(values))
        long = np.linalg.norm(values[start, :3] - values[end, :3], axis=1) > longest
        if not long.any():
            break
        middles = np.where(long, len(values) + np.cumsum(long) - 1, -1)
        faces = split_faces(faces, middles[which].reshape(-1, 3))
        values = np.concatenate([values, (values[start[long]] + values[end[long]]) / 2])
        labels = np.concatenate([labels, labels[start[long]]])
    normals = values[:, 3:6] / np.maximum(np.linalg.norm(values[:, 3:6], axis=1, keepdims=True), 1e-12)
    return Scan(values[:, :3], normals, faces, labels, values[:, 6:])


def split_faces(faces: np.ndarray, middles: np.ndarray) -> np.ndarray:
    """Triangles split at the middles of their edges 01, 12, 20: ``(F, 3)`` vertex ids, -1 where an edge stays."""
    marked = middles >= 0
    count = marked.sum(axis=1)
    parts = [faces[count == 0]]
    for number, children in CHILDREN.items():
        some = count == number
        # turned so that the split edges come first
        first = np.where(number == 2, marked[some].argmin(axis=1) + 1, marked[some].argmax(axis=1))
        turn = (first[:, None] + CORNERS) % 3
        corners = np.take_along_axis(faces[some], turn, axis=1)
        between = np.take_along_axis(middles[some], turn, axis=1)
        parts.append(np.concatenate([corners, between], axis=1)[:, children].reshape(-1, 3))
    return np.concatenate(parts)


def weld_contacts(scan: Scan, distance: float, rng: np.random.Generator) -> Scan:
    """Joins surfaces closer than a distance into one sheet, as fusion does.

    Faces between surfaces that face each other are dropped; what is left there, and open boundaries near another
    surface, is joined: vertices and those they face become one in their middle, so that triangles of both share them.
    """
    facing = facing_partners(scan.points, scan.normals, distance)
    inside = np.zeros(len(scan.points), bool)
    inside[np.concatenate(facing)] = True
    faces = scan.faces[~inside[scan.faces].all(axis=1)]
    borders = boundary_partners(scan, distance)
    pairs = np.concatenate([facing, borders], axis=1)  # vertices that become one
    links = coo_matrix((np.ones(pairs.shape[1], bool), tuple(pairs)), shape=(len(inside),) * 2)
    count, group = connected_components(links, directed=False)
    kept_of = np.empty(count, np.int64)  # whose truth a group keeps: the last one in a random order
    order = rng.permutation(len(inside))
    kept_of[group[order]] = order
    sums = np.stack([np.bincount(group, column, count) for column in scan.points.T.astype(np.float64)], axis=1)
    middles = sums / np.bincount(group, minlength=count)[:, None]
    faces = group[faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    truth = {name: getattr(scan, name)[kept_of] for name in ("normals", "labels", "canonical")}
    return drop_small_components(Scan(middles.astype(np.float32), faces=faces, **truth))


def boundary_partners(scan: Scan, distance: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices ``(K,)`` on open boundaries near another surface, and the nearest vertex of that.

    Another surface is another garment, the skin, or a part of the same that is far away at rest.
    """
    links = _links(scan)
    boundary = np.flatnonzero(np.abs(links - links.T).sum(axis=1))  # edges that no face runs along the other way
    nearby = min(NEARBY, len(scan.points))
    distances, ids = build_tree(scan.points).query(scan.points[boundary], k=nearby, distance_upper_bound=distance)
    known = np.isfinite(distances)
    ids = np.where(known, ids, 0)
    apart = np.linalg.norm(scan.canonical[ids] - scan.canonical[boundary, None], axis=-1) > FAR_AT_REST * distance
    other = known & (apart | (scan.labels[ids] != scan.labels[boundary, None]))
    near = other.any(axis=1)
    return boundary[near], ids[near, other[near].argmax(axis=1)]


def fused_noise(scan: Scan, noise: float, rng: np.random.Generator) -> np.ndarray:
    """Noise of a fused mesh ``(M, 3)``: alike at neighbouring vertices, of a standard deviation in metres."""
    links = _links(scan)
    links = links + links.T
    degree = np.asarray(links.sum(axis=1)).reshape(-1, 1)
    waves = rng.standard_normal(scan.points.shape)
    for _ in range(NOISE_ROUNDS):
        waves = (waves + links @ waves / degree) / 2
    return (noise * waves / waves.std()).astype(np.float32)


def drop_small_components(scan: Scan) -> Scan:
    """The mesh without its smallest pieces, and without vertices that no face uses."""
    _, piece = connected_components(_links(scan), directed=False)
    faces_of = np.bincount(piece[scan.faces[:, 0]], minlength=piece.max() + 1)
    kept = (faces_of >= min(SMALLEST_COMPONENT, faces_of.max()))[piece]
    return keep_points(scan, kept)


def _links(scan: Scan) -> csr_matrix:
    """How many faces run along each edge in its direction, ``(M, M)``."""
    start, end = scan.faces.reshape(-1), np.roll(scan.faces, -1, axis=1).reshape(-1)
    return coo_matrix((np.ones(len(start)), (start, end)), shape=(len(scan.points),) * 2).tocsr()


def _face_normals(scan: Scan) -> np.ndarray:
    """Normals of the mesh as it is, not of the surface it was scanned from; that one's where faces cancel out."""
    normals = vertex_normals(torch.from_numpy(scan.points), torch.from_numpy(scan.faces)).numpy()
    return np.where(np.linalg.norm(normals, axis=1, keepdims=True) > 0.5, normals, scan.normals)
