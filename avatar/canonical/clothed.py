"""The clothed template: canonical scans of one outfit to one mesh of the body's own skin and a garment.

Four steps, each a function on arrays: `find_skin` (where scans lie on the body), `fuse_garment` (mean winding number,
open hems, even triangles), `weigh_garment` (skinning weights and their measure), `assemble` (skin and garment in one).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property

import numpy as np
import torch
import trimesh
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from torch import Tensor, nn

from avatar.body.skinning import skin_transforms
from avatar.canonical.clothed_weights import diffuse_weights, inpaint_weights, tidy_weights
from avatar.canonical.refinement import PosedPoints, RefineConfig, chamfer, refine
from avatar.canonical.scans import local_pose
from avatar.canonical.skin import SkinVote, body_offsets, label_points, vote_skin
from avatar.canonical.winding import Winding, area_vectors, grid_around
from avatar.checks import AvatarError, check_shape
from avatar.geometry.closest import closest_on_mesh
from avatar.geometry.laplacians import boundary_edges, mesh_parts, smooth_votes, vertex_areas
from avatar.geometry.remeshing import cut_at_level, even_triangles, manifold_faults, smooth_borders, used_vertices
from avatar.geometry.surface import vertex_normals
from avatar.geometry.transforms import transform_points
from avatar.geometry.trees import build_tree
from avatar.progress import tracked
from avatar.records import CanonicalScan, ClothedTemplate, Mesh, Template

FEWEST_POINTS = 500  # of a scan; with fewer its surface cannot be told from its noise
OUTLIERS = 5e-4  # share of a scan's points that the grid may leave out on every side
FEWEST_FUSED = 8  # scans; where there are fewer, all give the surface
FEW_SCANS = 4  # below this many, points are blurred by their own spacing
SKIN_SUPPORT = 0.1  # of a patch without garment, from which on it is skin or has skin going through it
THROUGH = 0.05  # metres from a patch in which the body is looked for on both sides of it
BORDER_ROUNDS = 10  # of smoothing of hems
CHUNK = 65_536  # points that a skinning field is asked at once
DEEP = 0.003  # metres below the body's surface from which on a vertex counts as penetrating


class WeightKind(Enum):
    """Source of the garment's skinning weights."""

    best = "best"  # of the three below, the one that poses the template closest to held-back scans
    learned = "learned"  # the canonicalizer's forward field
    inpainting = "inpainting"  # the body's where it is close and parallel, the smoothest continuation elsewhere
    diffusion = "diffusion"  # the body's, blended over the garment the farther it is


@dataclass
class ClothedConfig:
    """How canonical scans become a clothed template."""

    spacing: float = 0.008  # metres between nodes of the fusion's grid
    level: float = 0.3  # share of the scans that have a place inside, and a surface there
    edge: float = 0.018  # metres, edges of the garment's triangles
    smooth: float = 0.015  # metres over which votes for skin and for openings are smoothed
    smallest_skin: float = 0.01  # square metres; smaller islands of skin or cover on the body are overruled
    smallest_part: float = 0.01  # square metres; smaller separate parts of the garment are dropped and reported
    overlap: float = 0.05  # metres that skin goes on below the garment's edge; the two are not stitched
    clearance: float = 0.002  # metres that the garment keeps from the body at rest
    closest: float = 1.0  # share of the scans, those posed nearest to the canonical pose, that give the surface
    mirror: bool = False  # add every scan's mirror image across x, for clothes that are symmetric
    weights: WeightKind = WeightKind.best
    held_back: float = 0.1  # share of the scans kept for measuring weights and refinement
    refine: RefineConfig = field(default_factory=RefineConfig)

    def __post_init__(self):
        lengths = ("spacing", "edge", "smooth", "smallest_skin", "smallest_part", "overlap", "clearance")
        wrong = {name: getattr(self, name) for name in lengths if not 0 <= getattr(self, name) <= 0.5}
        if wrong or self.spacing < 0.002 or self.edge < 0.004:
            raise AvatarError(
                f"spacing, edge: expected 0.002 and 0.004 to 0.5 metres, other lengths 0 to 0.5, got "
                f"{wrong or {'spacing': self.spacing, 'edge': self.edge}}."
            )
        if not 0.1 <= self.level <= 0.9 or not 0 <= self.held_back <= 0.5 or not 0 < self.closest <= 1:
            raise AvatarError(
                f"level, held_back, closest: expected 0.1 to 0.9, 0 to 0.5 and up to 1, "
                f"got {self.level}, {self.held_back} and {self.closest}."
            )


@dataclass(frozen=True)
class ScanInPose:
    """A canonical scan with the body it was unposed from: ``joint_transforms (J, 4, 4)`` and ``body (V, 3)`` vertices
    posed, both in the root frame, metres."""

    scan: CanonicalScan
    joint_transforms: Tensor
    body: np.ndarray
    template: Template

    def __post_init__(self):
        count = check_shape("points", self.scan.points, "M 3")["M"]
        if count < FEWEST_POINTS:
            raise AvatarError(f"points: expected at least {FEWEST_POINTS} a canonical scan, got {count}.")
        check_shape("body", self.body, "V 3", V=len(self.template.vertices))

    @cached_property
    def posed(self) -> tuple[np.ndarray, np.ndarray]:
        """Points and unit normals ``(M, 3)`` in the scan's own pose, by the weights it was unposed with."""
        blend = torch.from_numpy(self.scan.weights)
        forth = skin_transforms(blend, self.joint_transforms[None], self.template.canonical_from_bind)[0]
        points = transform_points(forth, torch.from_numpy(np.asarray(self.scan.points, np.float32)))
        slopes = torch.from_numpy(np.asarray(self.scan.normals, np.float32))[..., None]
        normals = torch.linalg.solve(forth[:, :3, :3].transpose(-1, -2), slopes)[..., 0]
        return points.numpy(), torch.nn.functional.normalize(normals, dim=-1, eps=1e-20).numpy()

    @cached_property
    def body_normals(self) -> np.ndarray:
        """Unit normals ``(V, 3)`` of the posed body."""
        return vertex_normals(torch.from_numpy(np.asarray(self.body, np.float32)), self.template.faces).numpy()

    def garment_points(self, vote: SkinVote) -> np.ndarray:
        """Which points ``(M,)`` do not lie on bare skin."""
        return label_points(*self.posed, self.body, self.body_normals, vote)


def check_any(scans: Sequence) -> None:
    """Refuses to make a template of nothing. Raises `AvatarError`."""
    if not len(scans):
        raise AvatarError("scans: expected at least one canonical scan, got none. Hint: run tools/canonicalize.py.")


def find_skin(scans: Sequence[ScanInPose], template: Template, config: ClothedConfig) -> SkinVote:
    """Which body vertices are bare, by the vote of all scans in their own poses (`skin.vote_skin`).
    Raises `AvatarError` without scans, or when none comes near the body.
    """
    check_any(scans)
    rows = [body_offsets(*scan.posed, scan.body, scan.body_normals) for scan in tracked(scans, "skin", unit="scan")]
    return vote_skin(np.stack(rows), template, config.smooth, config.smallest_skin)


@dataclass(frozen=True)
class Garment:
    """The garment's mesh in the canonical pose, and what its making came upon: areas, square metres."""

    mesh: Mesh
    filled: list[float]  # holes that were closed
    dropped: list[float]  # small parts that were left out


def fuse_garment(scans: Sequence[ScanInPose], template: Template, vote: SkinVote, config: ClothedConfig) -> Garment:
    """The surface that scans agree on where they do not show skin: open at hems, of even triangles.
    Raises `AvatarError` without scans, when they agree on no inside, or need too fine a grid.
    """
    check_any(scans)
    fused = fuse_scans(scans, template, vote, config)
    surface = fused.surface(config.level)
    support = fused.support(surface.vertices)
    supported = support.sum(axis=1) > config.level
    garment = (supported & (support[:, 1] > support[:, 0])).astype(np.float64)
    share = smooth_votes(surface.vertices, surface.faces, garment, np.ones(len(garment)), config.smooth)
    share, filled = fill_holes(surface, np.nan_to_num(share), support, template)
    part = cut_at_level(surface.vertices, surface.faces, share, 0.5)
    part, dropped = drop_small_parts(part, config.smallest_part)
    if len(part.faces):
        part = even_triangles(part, surface, config.edge)
        part = Mesh(smooth_borders(part.vertices, part.faces, BORDER_ROUNDS), part.faces)
        part = Mesh(push_out(part.vertices, template, config.clearance), part.faces)
    return Garment(part, filled, dropped)


def fuse_scans(scans: Sequence[ScanInPose], template: Template, vote: SkinVote, config: ClothedConfig) -> Winding:
    """The mean winding number of the scans nearest to the canonical pose, told apart by skin and garment."""
    body = template.vertices.numpy()
    low, high, spacings = body.min(axis=0), body.max(axis=0), []
    chosen = near_canonical(scans, template, config.closest)
    for index in chosen:
        points = scans[index].scan.points
        low = np.minimum(low, np.quantile(points, OUTLIERS, axis=0))
        high = np.maximum(high, np.quantile(points, 1 - OUTLIERS, axis=0))
    if config.mirror:
        low[0], high[0] = min(low[0], -high[0]), max(high[0], -low[0])
    grid = grid_around(low, high, config.spacing)
    across = np.array([-1.0, 1.0, 1.0])
    for index in tracked(chosen, "fusion", unit="scan"):
        scan = scans[index]
        vectors, garment = area_vectors(scan.scan), scan.garment_points(vote)
        spacings.append(float(np.sqrt(np.median(np.linalg.norm(vectors, axis=1)))))
        grid.add(scan.scan.points, vectors, garment)
        if config.mirror:
            grid.add(scan.scan.points * across, vectors * across, garment)
    few = grid.scans < FEW_SCANS
    return grid.solve(max(config.spacing, 1.5 * float(np.median(spacings)) if few else 0.0))


def near_canonical(scans: Sequence[ScanInPose], template: Template, share: float) -> list[int]:
    """Indices, ascending, of the share of the scans whose poses are nearest to the canonical one; eight at least.

    What unposing gets wrong grows with the turn of the joints: a skirt over bent knees comes back with its hem drawn
    up. By the mean square of the joints' turns against their parents.
    """
    count = min(len(scans), max(FEWEST_FUSED, round(share * len(scans))))
    if count == len(scans):
        return list(range(count))
    turns = [float(local_pose(scan.joint_transforms, template.parents).square().mean()) for scan in scans]
    return sorted(np.argsort(turns, kind="stable")[:count].tolist())


def fill_holes(
    surface: Mesh, share: np.ndarray, support: np.ndarray, template: Template
) -> tuple[np.ndarray, list[float]]:
    """Garment shares ``(V,)`` with holes of the scans closed, and the areas of those.

    A patch that no scan supports is an opening where skin is part of it or the body goes through it, and where it is
    surrounded by cloth alone and the body stays on one side of it, a hole in all scans.
    """
    share, areas, filled = share.copy(), vertex_areas(surface.vertices, surface.faces), []
    removed = share <= 0.5
    part = mesh_parts(surface.faces[removed[surface.faces].all(axis=1)], len(share))
    normals = vertex_normals(torch.from_numpy(surface.vertices), torch.from_numpy(surface.faces)).numpy()
    body = template.vertices.numpy()
    for label in np.unique(part[removed]):
        inside = np.flatnonzero(removed & (part == label))
        if np.average(support[inside, 0], weights=np.maximum(areas[inside], 1e-12)) > SKIN_SUPPORT:
            continue
        distances, nearest = build_tree(surface.vertices[inside]).query(body, distance_upper_bound=THROUGH)
        near = np.isfinite(distances)
        ids = inside[nearest[near]]
        sides = np.einsum("nc,nc->n", body[near] - surface.vertices[ids], normals[ids])
        if near.any() and sides.max() > 0 and sides.min() < 0:
            continue
        share[inside] = 1
        filled.append(float(areas[inside].sum()))
    return share, filled


def drop_small_parts(mesh: Mesh, smallest: float) -> tuple[Mesh, list[float]]:
    """The mesh without connected parts below an area, square metres, and the areas of those."""
    if not len(mesh.faces):
        return mesh, []
    part = mesh_parts(mesh.faces, len(mesh.vertices))
    sizes = np.bincount(part, vertex_areas(mesh.vertices, mesh.faces))
    kept = sizes[part[mesh.faces[:, 0]]] >= smallest
    used, faces = used_vertices(mesh.vertices, mesh.faces[kept])
    return Mesh(mesh.vertices[used], faces), sizes[(sizes < smallest) & (sizes > 0)].tolist()


def push_out(vertices: np.ndarray, template: Template, clearance: float) -> np.ndarray:
    """Garment vertices ``(V, 3)`` at least a clearance outside the body at rest, moved along the way to its surface."""
    body, faces = template.vertices.numpy(), template.faces.numpy()
    hits = closest_on_mesh(vertices, body, faces)
    normals = trimesh.triangles.cross(body[faces[hits.face_ids]].astype(np.float64))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
    close = hits.signed_distances < clearance
    return np.where(close[:, None], hits.points + clearance * normals, vertices)


@dataclass(frozen=True)
class WeighedGarment:
    """The garment with its weights ``(V, J)``, their ``kind``, and Chamfer distances (m^2, squared, both ways added).

    ``errors`` of each kind of weights before refinement and, as ``refined``, after it; on held-back scans where
    ``held_back`` of them there are, else on all.
    """

    mesh: Mesh
    weights: np.ndarray
    kind: str
    errors: dict[str, float]
    held_back: int
    refined: bool


def weigh_garment(
    garment: Mesh,
    template: Template,
    forward_field: nn.Module | None,
    learned: Sequence[PosedPoints],
    held_back: Sequence[PosedPoints],
    config: ClothedConfig,
) -> WeighedGarment:
    """Skinning weights of the canonical garment by three sources, measured, and both refined by the better one.

    ``forward_field`` is the canonicalizer's, ``(1, N, 3)`` to ``(1, N, J)``; None leaves the learned weights out.
    Refinement sees the garment points of the scans in ``learned``; what is measured are those in ``held_back``, and
    ``learned`` where there are none.
    """
    found = {}
    if forward_field is not None:
        found["learned"] = tidy_weights(field_weights(forward_field, garment.vertices))
    found["inpainting"], found["diffusion"] = inpaint_weights(garment, template), diffuse_weights(garment, template)
    measured = held_back or learned
    bind, samples = template.canonical_from_bind, config.refine.samples
    errors = {kind: chamfer(garment, weights, measured, bind, samples) for kind, weights in found.items()}
    kind = min(errors, key=errors.__getitem__) if config.weights is WeightKind.best else config.weights.value
    if kind not in found:
        raise AvatarError(
            f"weights: expected a run with learned weights for {kind}, this one has none. Hint: weights=best."
        )
    mesh, weights, refined = garment, found[kind], False
    if config.refine.steps:
        better = refine(mesh, weights, learned, bind, config.refine)
        pushed = replace(better.mesh, vertices=push_out(better.mesh.vertices, template, config.clearance))
        tidy = tidy_weights(better.weights)
        errors["refined"] = chamfer(pushed, tidy, measured, bind, samples)
        refined = errors["refined"] < errors[kind]
        mesh, weights = (pushed, tidy) if refined else (mesh, weights)
    return WeighedGarment(mesh, weights, kind, errors, len(held_back), refined)


@torch.no_grad()
def field_weights(field: nn.Module, points: np.ndarray) -> np.ndarray:
    """Weights ``(N, J)`` that a skinning field gives to canonical points ``(N, 3)``."""
    places = torch.as_tensor(np.asarray(points, np.float32))
    return torch.cat([field(chunk[None])[0] for chunk in places.split(CHUNK)]).cpu().numpy()


def skin_faces(template: Template, bare: np.ndarray, overlap: float) -> np.ndarray:
    """Faces ``(S, 3)`` of the body that are bare or within ``overlap`` metres, along the body, of bare vertices."""
    faces, vertices = template.faces.numpy(), template.vertices.numpy().astype(np.float64)
    if bare.all() or not bare.any():
        return faces[bare[faces].any(axis=1)]
    start, end = faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)
    lengths = np.maximum(np.linalg.norm(vertices[start] - vertices[end], axis=1), 1e-9)
    links = csr_matrix((lengths, (start, end)), shape=(len(vertices),) * 2)
    away = dijkstra(links, directed=False, indices=np.flatnonzero(bare), min_only=True, limit=overlap)
    near = np.isfinite(away)
    return faces[bare[faces].any(axis=1) | near[faces].all(axis=1)]


def assemble(
    template: Template, vote: SkinVote, garment: WeighedGarment | None, config: ClothedConfig
) -> ClothedTemplate:
    """Skin and garment in one mesh: the body's own vertices first, then the garment's; ``garment`` None for none."""
    bare = np.ones_like(vote.bare) if garment is None else vote.bare
    ids, faces = used_vertices(template.vertices.numpy(), skin_faces(template, bare, config.overlap))
    skin = template.vertices.numpy()[ids], template.weights.numpy()[ids]
    if garment is None:
        return ClothedTemplate(skin[0], faces, skin[1], ids, np.zeros(len(ids), bool))
    return ClothedTemplate(
        vertices=np.concatenate([skin[0], garment.mesh.vertices]).astype(np.float32),
        faces=np.concatenate([faces, garment.mesh.faces + len(ids)]),
        weights=np.concatenate([skin[1], garment.weights]).astype(np.float32),
        body_vertex=np.concatenate([ids, np.full(len(garment.mesh.vertices), -1)]),
        covered=np.concatenate([~bare[ids], np.zeros(len(garment.mesh.vertices), bool)]),
    )


def template_facts(clothed: ClothedTemplate, template: Template) -> dict[str, float]:
    """Numbers that tell whether a clothed template is whole: counts, parts, hems, triangles, penetration."""
    faces = clothed.faces[clothed.garment_faces]
    used, faces = used_vertices(clothed.vertices, faces)
    vertices = clothed.vertices[used].astype(np.float64)
    facts = {
        "vertices": len(clothed.vertices),
        "faces": len(clothed.faces),
        "skin_vertices": int((clothed.body_vertex >= 0).sum()),
        "garment_vertices": len(vertices),
        "garment_area_m2": float(trimesh.triangles.area(vertices[faces]).sum()),
    }
    if not len(faces):
        return facts
    lengths = trimesh.Trimesh(vertices, faces, process=False).edges_unique_length
    corners = vertices[faces]
    sides = np.square(corners - np.roll(corners, -1, axis=1)).sum(axis=(1, 2))
    qualities = 4 * np.sqrt(3) * trimesh.triangles.area(corners) / np.maximum(sides, 1e-20)
    hits = closest_on_mesh(vertices, template.vertices.numpy(), template.faces.numpy())
    around = boundary_edges(faces)
    loops = mesh_parts(np.concatenate([around, around[:, 1:]], axis=1), len(vertices))
    return facts | {
        "garment_parts": len(np.unique(mesh_parts(faces, len(vertices)))),
        "hems": len(np.unique(loops[around[:, 0]])),
        "manifold_faults": manifold_faults(faces),
        "edge_median_m": float(np.median(lengths)),
        "edge_1_percent_m": float(np.quantile(lengths, 0.01)),
        "edge_99_percent_m": float(np.quantile(lengths, 0.99)),
        "triangle_quality_1_percent": float(np.quantile(qualities, 0.01)),
        "penetrating_share": float((hits.signed_distances < -DEEP).mean()),
    }


def find_faults(
    facts: dict[str, float], scans: int, vote: SkinVote, garment: Garment | None, weighed: WeighedGarment | None
) -> list[str]:
    """What a user should look at, a sentence each; none where all is well."""
    faults = []
    if scans < FEW_SCANS:
        faults.append(f"{scans} scans: holes and hems of single scans are taken for the outfit's.")
    if (unseen := float((vote.seen == 0).mean())) > 0.05:
        faults.append(f"{unseen:.0%} of the body's vertices are in no scan; they go with those around them.")
    if vote.noise > 0.01:
        faults.append(f"scans lie {vote.noise * 1000:.0f} mm off the body on bare skin: thin clothes count as skin.")
    if weighed is None:
        faults.append("no garment was found: all that the scans show lies on the body; the template is the body.")
        return faults
    if garment.filled:
        faults.append(
            f"{len(garment.filled)} patches that no scan supports were closed, {sum(garment.filled):.3f} m^2."
        )
    if garment.dropped:
        faults.append(f"{len(garment.dropped)} small parts were dropped, {sum(garment.dropped):.4f} m^2.")
    if facts["manifold_faults"]:
        faults.append(f"the garment is no manifold at {facts['manifold_faults']} places. Hint: a smaller clothed.edge.")
    if facts["hems"] == 0:
        faults.append("the garment has no opening.")
    if facts["penetrating_share"] > 0.02:
        faults.append(f"{facts['penetrating_share']:.1%} of the garment lies more than 3 mm inside the body at rest.")
    if not weighed.held_back:
        faults.append("no scan was held back: weights and refinement were measured on what they were made from.")
    if "refined" in weighed.errors and not weighed.refined:
        faults.append("refinement did not bring the template closer to held-back scans and was left out.")
    return faults
