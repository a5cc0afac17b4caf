"""Canonicalizations scored against the truth, which only a simulator knows: where a scan point is at rest.

What the cloth does between the poses is in the error as well; the reference of true weights says how much.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
import torch

from avatar.body.skinning import skin_transforms
from avatar.checks import AvatarError, check_shape
from avatar.data.outfits import Outfit
from avatar.evaluation.aggregate import method_key
from avatar.evaluation.metrics import CENTIMETRES, PERCENT, Metric, find_metrics
from avatar.evaluation.scores import Score, Scores
from avatar.evaluation.scoring import Contender, Label, Memory, score_frames
from avatar.evaluation.tables import Table, tabulate_metrics
from avatar.geometry.closest import closest_on_mesh
from avatar.geometry.transforms import invert_affine, transform_points
from avatar.geometry.trees import build_tree
from avatar.io.ledger import Ledger
from avatar.records import BodyFit, CanonicalScan, Frame, Mesh, Scan, Template

# What a score is made by, beside the canonicalization: metrics and the readers of data sets.
SOURCE = ("avatar.evaluation.canonical", "avatar.data.layouts")
TRUE = "true weights"
CONTACT = 0.02  # metres between two points of a scan that touch
APART = 0.10  # metres between the same two at rest, from which on they are of different parts of body and clothes
SURFACE_POINTS = 2_000  # canonical points a frame whose distance to the true surface is measured


@dataclass(frozen=True)
class Canonicalized:
    """A frame's canonical ``scan``, and ``forward_weights (M, J)`` at its points, which pose it again: does it close?
    They are the forward field g^c, or the weights of the nearest vertices of the body at rest.
    """

    scan: CanonicalScan
    forward_weights: np.ndarray


@dataclass(frozen=True)
class FrameTruth:
    """The points of a posed scan at rest ``(M, 3)``, the body's weights under them ``(M, J)``, which are on garments,
    and which touch another part (`contact_points`), both ``(M,)`` bool.
    """

    canonical: np.ndarray
    weights: np.ndarray
    garment: np.ndarray
    contact: np.ndarray


def check_truth(scan: Scan) -> None:
    """Refuses, by an `AvatarError`, a scan that does not know where its points belong at rest."""
    if scan.canonical is None or scan.labels is None:
        raise AvatarError("scan: expected labels and canonical positions; only simulated data has the truth.")


def frame_truth(scan: Scan, template: Template) -> FrameTruth:
    """The truth of a simulated scan; others are refused (`check_truth`)."""
    check_truth(scan)
    weights = weights_under(scan.canonical, template)
    return FrameTruth(scan.canonical, weights, scan.labels > 0, contact_points(scan.points, scan.canonical))


def contact_points(points: np.ndarray, canonical: np.ndarray) -> np.ndarray:
    """Which points ``(M, 3)`` are within 2 cm of one that is over 10 cm away at rest ``(M, 3)``, ``(M,)`` bool."""
    touching = np.zeros(len(points), bool)
    pairs = build_tree(points).query_pairs(CONTACT, output_type="ndarray")
    apart = np.linalg.norm(canonical[pairs[:, 0]] - canonical[pairs[:, 1]], axis=1) > APART
    touching[pairs[apart]] = True
    return touching


def weights_under(canonical: np.ndarray, template: Template) -> np.ndarray:
    """Skinning weights of the nearest vertex of the body at rest: points at rest ``(M, 3)`` to ``(M, J)``."""
    return template.weights.numpy()[build_tree(template.vertices.numpy()).query(canonical)[1]]


def repose(points: np.ndarray, weights: np.ndarray, body: BodyFit, template: Template) -> np.ndarray:
    """Canonical points ``(M, 3)`` with weights ``(M, J)`` skinned to a body's pose, ``(M, 3)``."""
    return transform_points(_posed_from_canonical(weights, body, template), torch.from_numpy(points)).numpy()


def unpose_with(weights: np.ndarray, frame: Frame, template: Template) -> CanonicalScan:
    """A frame's scan unposed to the canonical pose with given weights ``(M, J)`` of its points; nothing is cut."""
    scan, forth = frame.scan, _posed_from_canonical(weights, frame.body, template)
    points = transform_points(invert_affine(forth), torch.from_numpy(scan.points)).numpy()
    normals = torch.einsum("nij,ni->nj", forth[:, :3, :3], torch.from_numpy(scan.normals))
    normals = torch.nn.functional.normalize(normals, dim=-1, eps=1e-20).numpy()
    source = np.arange(len(scan.points))
    return CanonicalScan(points, normals, weights=weights, source=source, faces=scan.faces, colors=scan.colors)


def unpose_truly(frame: Frame, truth: FrameTruth, template: Template) -> Canonicalized:
    """The canonicalization with the weights of the body under each point's true place."""
    scan = unpose_with(truth.weights, frame, template)
    return Canonicalized(scan, weights_under(scan.points, template))


def _posed_from_canonical(weights: np.ndarray, body: BodyFit, template: Template) -> torch.Tensor:
    """Transforms ``(M, 4, 4)`` of points with weights ``(M, J)``, float32."""
    blend, joints = (torch.from_numpy(np.asarray(a, np.float32)) for a in (weights, body.joint_transforms))
    return skin_transforms(blend, joints[None], template.canonical_from_bind)[0]


class CanonicalComparison:
    """What a metric sees of one canonicalized frame: errors of its kept points, in metres, float64. ``surfaces`` are
    the true ones at rest, a mesh a label. Indices into another scan than the frame's are refused.
    """

    def __init__(
        self,
        frame: Frame,
        truth: FrameTruth,
        result: Canonicalized,
        template: Template,
        surfaces: Mapping[int, Mesh] | None = None,
    ):
        scan, count = result.scan, len(frame.scan.points)
        dims = check_shape("canonical points", scan.points, "N 3")
        check_shape("source", scan.source, "N", **dims)
        check_shape("weights", scan.weights, "N J", **dims, J=len(template.parents))
        if not len(scan.source) or scan.source.min() < 0 or scan.source.max() >= count:
            raise AvatarError(
                f"source: expected indices below the scan's {count} points, got {len(scan.source)} up to "
                f"{scan.source.max(initial=0)}. Score it against the scan it was made of (same scanner options)."
            )
        self.frame, self.truth, self.result, self.template = frame, truth, result, template
        self.points, self.surfaces = scan.points, surfaces or {}

    @cached_property
    def off_truth(self) -> np.ndarray:
        """Distance of each canonical point to its true place, ``(N,)``."""
        true = self.truth.canonical[self.result.scan.source].astype(np.float64)
        return np.linalg.norm(self.points - true, axis=1)

    @cached_property
    def off_cycle(self) -> np.ndarray:
        """Distance of each point to itself when reposed with the weights of where it is, ``(N,)``."""
        scan, weights = self.result.scan, self.result.forward_weights
        check_shape("forward_weights", weights, "N J", N=len(scan.points), J=len(self.template.parents))
        back = repose(scan.points, weights, self.frame.body, self.template)
        return np.linalg.norm(back - self.frame.scan.points[scan.source].astype(np.float64), axis=1)

    @cached_property
    def off_weights(self) -> np.ndarray:
        """Share of each point's weights that lies on wrong joints, ``(N,)`` in [0, 1]."""
        scan = self.result.scan
        return np.abs(scan.weights - self.truth.weights[scan.source].astype(np.float64)).sum(axis=1) / 2

    @cached_property
    def off_surface(self) -> np.ndarray:
        """Distance of some points to the surface at rest that they belong to, ``(N,)``, NaN for the others."""
        found = np.full(len(self.points), np.nan)
        some = np.linspace(0, len(found) - 1, min(SURFACE_POINTS, len(found))).astype(np.int64)
        labels = self.frame.scan.labels[self.result.scan.source[some]]
        for label, mesh in self.surfaces.items():
            mine = some[labels == label]
            if len(mine):
                hits = closest_on_mesh(self.points[mine], mesh.vertices, mesh.faces, exact_within=0.01)
                found[mine] = np.abs(hits.signed_distances)
        return found

    @property
    def lost(self) -> float:
        """Share of the scan's points that the canonical scan lacks."""
        return 1 - len(self.result.scan.source) / len(self.frame.scan.points)

    @property
    def cut(self) -> float:
        """Share of the scan's triangles that the canonical scan lacks; NaN for a scan of points."""
        before, after = self.frame.scan.faces, self.result.scan.faces
        return np.nan if before is None or after is None else 1 - len(after) / len(before)


def _over(part: str, errors: str, reduce: Callable[[np.ndarray], float], scale: float, c: CanonicalComparison) -> float:
    """One of a comparison's errors, where it is known, over one part of its points; NaN without any."""
    values = getattr(c, errors)
    if part != "all":
        values = values[getattr(c.truth, part)[c.result.scan.source]]
    values = values[np.isfinite(values)]
    return scale * float(reduce(values)) if len(values) else np.nan


TRUTH = "distance of canonical points to their true places on the clothes and skin at rest"
CYCLE = "distance of points to themselves when reposed with the weights at their canonical places"
MEASURES = (  # over one part of the points: name, errors, how they are reduced, definition, scale and unit
    ("truth{}_cm", "off_truth", np.mean, f"Mean {TRUTH}", 100, CENTIMETRES),
    ("truth_median{}_cm", "off_truth", np.median, f"Median {TRUTH}", 100, CENTIMETRES),
    ("truth_p95{}_cm", "off_truth", partial(np.quantile, q=0.95), f"95th percentile of the {TRUTH}", 100, CENTIMETRES),
    ("cycle{}_cm", "off_cycle", np.mean, f"Cycle error: mean {CYCLE}", 100, CENTIMETRES),
    ("surface{}_cm", "off_surface", np.mean, "Mean distance to the true surface of the same label", 100, CENTIMETRES),
    ("weights{}", "off_weights", np.mean, "Share of skinning weight on other than the true joints", 1, PERCENT),
)
PARTS = {
    "all": "all points",
    "garment": "points on garments",
    "contact": f"points where the scan touches itself: another point within {100 * CONTACT:g} cm that is more than "
    f"{100 * APART:g} cm away at rest",
}
_OF_PARTS = [
    Metric(
        name.format("" if part == "all" else f"_{part}"),
        *unit,
        f"{definition}, {whom}.",
        partial(_over, part, errors, reduce, scale),
    )
    for part, whom in PARTS.items()
    for name, errors, reduce, definition, scale, unit in MEASURES
]
CONTACT_SHARE = "Share of scan points in contact, of the scan as it came."
_OF_SCANS = [
    Metric("points_lost", *PERCENT, "Share of scan points that were cut away.", lambda c: c.lost),
    Metric("triangles_cut", *PERCENT, "Share of triangles that were cut as stretched.", lambda c: c.cut),
    Metric("contact_share", *PERCENT, CONTACT_SHARE, lambda c: c.truth.contact.mean()),
]
CANONICAL_METRICS: dict[str, Metric] = {metric.name: metric for metric in (*_OF_PARTS, *_OF_SCANS)}
OVERVIEW = ("cycle_cm", "cycle_garment_cm", "truth_garment_cm", "truth_contact_cm", "triangles_cut")
TRUE_NOTE = (
    f"{TRUE}: every point posed with the weights of the body under its true place. What is left is the cloth's own "
    "motion over the body. Means are over the points a method kept (see points_lost)."
)


def score_canonicalization(
    outfit: Outfit,
    split: str,
    names: Sequence[str],
    methods: Mapping[Label, Callable[[Frame], Canonicalized]],
    ledger: Ledger | None = None,
    made_by: Mapping[Label, str] | None = None,
) -> Scores:
    """Every metric of some frames for several canonicalizations, and for the true weights beside them. ``methods`` are
    labels and what each makes of a frame as the simulated outfit loads it. With a ledger only new or changed values are
    measured; ``made_by`` is a hash of all that each method's scans depend on but the data. Raises `AvatarError` naming
    the frame, for data without truth or a scan that is not the frame's.
    """
    surfaces, truths = canonical_surfaces(outfit, split, names[0]), {}
    first = next(iter(methods))
    shared = first.variant if len({label.variant for label in methods}) == 1 else ""
    true = Label(TRUE, table=first.table, variant=shared, commit=first.commit)

    def compare(canonicalize: Callable[[Frame], Canonicalized] | None, frame: Frame) -> CanonicalComparison:
        if frame.name not in truths:
            truths.clear()
            truths[frame.name] = frame_truth(frame.scan, outfit.template)
        truth = truths[frame.name]
        result = canonicalize(frame) if canonicalize else unpose_truly(frame, truth, outfit.template)
        return CanonicalComparison(frame, truth, result, outfit.template, surfaces)

    contenders = []
    for label, method in {true: None, **methods}.items():
        made = {"made_by": ledger and {true: "", **(made_by or {})}[label]}
        memory = Memory(ledger, f"canonical {label.method}", outfit, split, SOURCE, **made)
        contenders.append(Contender(label, partial(compare, method), memory))
    return score_frames(outfit, split, names, list(CANONICAL_METRICS.values()), contenders, partial=True)


def canonical_surfaces(outfit: Outfit, split: str, name: str) -> dict[int, Mesh]:
    """Skin and garments at rest by label, as any frame of a simulated outfit knows them; nothing for other outfits."""
    load = getattr(outfit, "load_surface", None)
    if load is None:
        return {}
    whole = load(split, name)
    labels, faces = whole.labels.numpy(), whole.faces.numpy()
    return {int(i): Mesh(whole.canonical.numpy(), faces[labels[faces[:, 0]] == i]) for i in np.unique(labels)}


def canonical_table(
    rows: Sequence[Score], outfits: Sequence[str], metrics: Sequence[str] = tuple(CANONICAL_METRICS)
) -> Table:
    """Canonicalization metrics of some outfits by methods, true weights first, with the definitions."""
    known = {metric.name: metric for metric in find_metrics(metrics, CANONICAL_METRICS)}
    last = {(row.outfit, method_key(row), row.metric): row for row in rows}  # several runs score the same baselines
    table = tabulate_metrics(list(last.values()), outfits, known, TRUE)
    return replace(table, notes=(*table.notes, TRUE_NOTE))
