"""Canonicalizations scored and tabled: errors of canonical points, and the metrics made of them.

Metrics are named, have units and printed definitions as those of `metrics`, but compare a canonical scan with the
truth of its frame (`canonical_truth`), not a prediction with a scan.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from avatar.checks import AvatarError, check_shape
from avatar.data.outfits import Outfit
from avatar.evaluation.aggregate import method_key
from avatar.evaluation.canonical_truth import (
    APART,
    CONTACT,
    Canonicalized,
    FrameTruth,
    frame_truth,
    repose,
    unpose_truly,
)
from avatar.evaluation.metrics import CENTIMETRES, PERCENT, Metric
from avatar.evaluation.scores import FrameScore, Score, Scores
from avatar.evaluation.scoring import Label, mean_scores, remember
from avatar.evaluation.tables import Table, tabulate_metrics
from avatar.geometry.closest import closest_on_mesh
from avatar.io.ledger import Ledger
from avatar.progress import tracked
from avatar.records import Frame, Mesh, Template

# What a score is made by, beside the canonicalization: metrics and the readers of data sets.
SOURCE = ("avatar.evaluation.canonical_scores", "avatar.data.layouts")
TRUE = "true weights"
SURFACE_POINTS = 2_000  # canonical points a frame whose distance to the true surface is measured


class CanonicalComparison:
    """What a metric sees of one canonicalized frame: errors of its kept points, in metres, float64.

    ``surfaces`` are the true canonical surfaces, a mesh for each label; without them `off_surface` is not known.
    """

    def __init__(
        self,
        frame: Frame,
        truth: FrameTruth,
        result: Canonicalized,
        template: Template,
        surfaces: Mapping[int, Mesh] | None = None,
    ):
        """Checks that the canonical scan is one of the frame's.

        Raises:
            AvatarError: for wrong shapes, or indices into another scan.
        """
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
        self.surfaces = surfaces or {}

    @cached_property
    def off_truth(self) -> np.ndarray:
        """Distance of each canonical point to its true place, ``(N,)``."""
        scan = self.result.scan
        return np.linalg.norm(scan.points - self.truth.canonical[scan.source].astype(np.float64), axis=1)

    @cached_property
    def off_cycle(self) -> np.ndarray:
        """Distance of each point to itself when reposed with the weights of where it is, ``(N,)``; else empty."""
        scan, weights = self.result.scan, self.result.forward_weights
        if weights is None:
            return np.empty(0)
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
        scan = self.result.scan
        found = np.full(len(scan.points), np.nan)
        some = np.linspace(0, len(found) - 1, min(SURFACE_POINTS, len(found))).astype(np.int64)
        labels = self.frame.scan.labels[scan.source[some]]
        for label, mesh in self.surfaces.items():
            mine = some[labels == label]
            if len(mine):
                hits = closest_on_mesh(scan.points[mine], mesh.vertices, mesh.faces, exact_within=0.01)
                found[mine] = np.abs(hits.signed_distances)
        return found

    def part(self, name: str) -> np.ndarray:
        """Which kept points ``(N,)`` are ``all``, on a ``garment`` or in ``contact``."""
        chosen = {"all": np.ones_like(self.truth.garment), "garment": self.truth.garment, "contact": self.truth.contact}
        return chosen[name][self.result.scan.source]

    @property
    def lost(self) -> float:
        """Share of the scan's points that the canonical scan lacks."""
        return 1 - len(self.result.scan.source) / len(self.frame.scan.points)

    @property
    def cut(self) -> float:
        """Share of the scan's triangles that the canonical scan lacks; NaN for a scan of points."""
        before, after = self.frame.scan.faces, self.result.scan.faces
        return np.nan if before is None or after is None else 1 - len(after) / len(before)


PARTS = {
    "all": "all points",
    "garment": "points on garments",
    "contact": f"points where the scan touches itself: another point within {100 * CONTACT:g} cm that is more than "
    f"{100 * APART:g} cm away at rest",
}


def _over(part: str, errors: str, reduce: Callable[[np.ndarray], float], scale: float) -> Callable:
    """A measure: one of the comparison's errors, where it is known, over one part of the points; NaN without any."""

    def measure(comparison: CanonicalComparison) -> float:
        values = getattr(comparison, errors)
        values = values[comparison.part(part)] if len(values) else values
        values = values[np.isfinite(values)]
        return scale * float(reduce(values)) if len(values) else np.nan

    return measure


def _part_metrics(part: str) -> list[Metric]:
    """The metrics of one part of the points."""
    end, whom = "" if part == "all" else f"_{part}", PARTS[part]
    truth = f"distance of canonical points to their true places on the clothes and skin at rest, {whom}."
    cycle = f"distance of points to themselves when reposed with the weights at their canonical places, {whom}."
    distances = (
        ("truth", "off_truth", f"Mean {truth}", np.mean),
        ("truth_median", "off_truth", f"Median {truth}", np.median),
        ("truth_p95", "off_truth", f"95th percentile of the {truth}", lambda values: np.quantile(values, 0.95)),
        ("cycle", "off_cycle", f"Cycle error: mean {cycle}", np.mean),
        ("surface", "off_surface", f"Mean distance to the true surface of the same label, {whom}.", np.mean),
    )
    metrics = [
        Metric(f"{name}{end}_cm", *CENTIMETRES, definition, _over(part, errors, reduce, 100))
        for name, errors, definition, reduce in distances
    ]
    share = f"Share of skinning weight on other than the true joints, {whom}."
    return [*metrics, Metric(f"weights{end}", *PERCENT, share, _over(part, "off_weights", np.mean, 1))]


OVERVIEW = ("cycle_cm", "cycle_garment_cm", "truth_garment_cm", "truth_contact_cm", "triangles_cut")
CONTACT_SHARE = "Share of scan points in contact, of the scan as it came."
CANONICAL_METRICS: dict[str, Metric] = {
    metric.name: metric
    for metric in (
        *(metric for part in PARTS for metric in _part_metrics(part)),
        Metric("points_lost", *PERCENT, "Share of scan points that were cut away.", lambda c: c.lost),
        Metric("triangles_cut", *PERCENT, "Share of triangles that were cut as stretched.", lambda c: c.cut),
        Metric("contact_share", *PERCENT, CONTACT_SHARE, lambda c: c.truth.contact.mean()),
    )
}


def score_canonicalization(
    outfit: Outfit,
    split: str,
    names: Sequence[str],
    methods: Mapping[Label, Callable[[Frame], Canonicalized]],
    ledger: Ledger | None = None,
    made_by: Mapping[Label, str] | None = None,
) -> Scores:
    """Every metric of every frame for several canonicalizations, and for the true weights beside them.

    The truth of a frame is found once for all methods. Metrics that a frame does not have (no contact, no triangles)
    are left out of the means.

    Args:
        outfit: simulated, with ``template``; `surface` needs its ``load_surface`` too.
        split: train or test.
        names: frames of the split.
        methods: for each its label and what it makes of a frame as the outfit loads it.
        ledger: where values are kept, so that only new or changed ones are measured; None measures all.
        made_by: with a ledger, a hash of all that each method's canonical scans depend on but the data.

    Raises:
        AvatarError: naming the frame, for data without truth or a canonical scan that is not the frame's.
    """
    if not methods or not names:
        raise AvatarError(f"methods, names: expected at least one each, got {len(methods)} and {len(names)}.")
    first = next(iter(methods))
    shared = first.variant if len({label.variant for label in methods}) == 1 else ""
    true = Label(TRUE, table=first.table, variant=shared, commit=first.commit)
    labels, made_by = [true, *methods], {true: "", **(made_by or {})}
    memories = {
        label: remember(ledger, f"canonical {label.method}", outfit, split, SOURCE, made_by=ledger and made_by[label])
        for label in labels
    }
    surfaces = canonical_surfaces(outfit, split, names[0])
    frames: list[FrameScore] = []
    found: dict[Label, list[FrameScore]] = {label: [] for label in labels}
    counts: dict[Label, list[int]] = {label: [] for label in labels}
    for name in tracked(names, f"score canonical scans of {outfit.name}"):
        known = {label: memory.recall(name, CANONICAL_METRICS) for label, memory in memories.items()}
        missing = {label: methods.get(label) for label in labels if len(known[label][0]) < len(CANONICAL_METRICS)}
        try:
            new = _measure_frame(outfit.load(split, name), outfit.template, surfaces, missing) if missing else {}
        except AvatarError as error:
            raise AvatarError(f"outfit {outfit.name}, frame {name}: {error}") from error
        for label, measured in new.items():
            memories[label].note(name, *measured)
        for label, (values, points) in (known | new).items():
            counts[label].append(points)
            where = (outfit.name, label.method, label.variant, label.seed, name)
            mine = [FrameScore(*where, metric, value) for metric, value in values.items() if np.isfinite(value)]
            found[label] += mine
            frames += mine
    rows = []
    for label, mine in found.items():
        rows += mean_scores(mine, CANONICAL_METRICS.values(), label, "", round(float(np.mean(counts[label]))))
    return Scores(rows, frames)


def canonical_surfaces(outfit: Outfit, split: str, name: str) -> dict[int, Mesh]:
    """Skin and garments at rest by label, as any frame of a simulated outfit knows them; nothing for other outfits."""
    load = getattr(outfit, "load_surface", None)
    if load is None:
        return {}
    whole = load(split, name)
    labels, faces = whole.labels.numpy(), whole.faces.numpy()
    return {int(i): Mesh(whole.canonical.numpy(), faces[labels[faces[:, 0]] == i]) for i in np.unique(labels)}


def _measure_frame(
    frame: Frame,
    template: Template,
    surfaces: Mapping[int, Mesh],
    methods: Mapping[Label, Callable[[Frame], Canonicalized] | None],
) -> dict[Label, tuple[dict[str, float], int]]:
    """Every metric of a frame, NaN where it does not have one, and the point count, for each method; None is `TRUE`."""
    truth, found = frame_truth(frame.scan, template), {}
    for label, canonicalize in methods.items():
        result = unpose_truly(frame, truth, template) if canonicalize is None else canonicalize(frame)
        comparison = CanonicalComparison(frame, truth, result, template, surfaces)
        values = {name: float(metric.measure(comparison)) for name, metric in CANONICAL_METRICS.items()}
        found[label] = values, len(result.scan.points)
    return found


def canonical_table(rows: Sequence[Score], outfit: str, metrics: Sequence[str] = tuple(CANONICAL_METRICS)) -> Table:
    """Canonicalization metrics by methods for one outfit, true weights first, with every definition in the notes.

    Raises:
        AvatarError: for unknown metrics, or an outfit that nobody scored.
    """
    if unknown := [name for name in metrics if name not in CANONICAL_METRICS]:
        raise AvatarError(f"metrics: unknown {', '.join(unknown)}; there are {', '.join(CANONICAL_METRICS)}.")
    last = {(row.outfit, method_key(row), row.metric): row for row in rows}  # several runs score the same baselines
    table = tabulate_metrics(list(last.values()), outfit, [CANONICAL_METRICS[name] for name in metrics], TRUE)
    return replace(table, notes=(*table.notes, TRUE_NOTE))


def canonical_overview(rows: Sequence[Score], metrics: Sequence[str] = OVERVIEW) -> Table:
    """A few canonicalization metrics of several outfits in one table, a line each, methods across as in
    `canonical_table`.
    """
    outfits = list(dict.fromkeys(row.outfit for row in rows))
    tables = [canonical_table(rows, outfit, metrics) for outfit in outfits]
    body = tuple(
        replace(line, label=f"{outfit}, {line.label}") for outfit, table in zip(outfits, tables) for line in table.rows
    )
    return replace(tables[0], title="", corner="outfit, metric", rows=body)


TRUE_NOTE = (
    f"{TRUE}: every point posed with the weights of the body under its true place. What is left is the cloth's own "
    "motion over the body. Means are over the points a method kept (see points_lost)."
)
