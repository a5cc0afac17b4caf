"""Checks of scans against their bodies: the person alone, over the body and as large, normals that point outward."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from avatar.checks import DataError
from avatar.data.alignment import (
    FAR,
    INSIDE_OUT,
    NEAR,
    UNORIENTED,
    WORN,
    Overlap,
    ScanSamples,
    Similarity,
    Skin,
    find_stray,
    fit_similarity,
    sample_skin,
    show_vector,
    suggest_hint,
    thin,
    tight_weights,
)
from avatar.data.validation import DIFFERENT_SIZE, check_ratio, check_size
from avatar.records import Frame, Scan, Template

FEWEST_POINTS = 100
FAR_OFF = 10.0  # metres between the middles of scan and body that only a translation in other units explains
# Valid frames (sample, dress, skirt, jacket; perfect and raw scans, all poses) cover 92% and more of the body and bury
# 0.2% at most; 93% of their normals point outward, with a mean cosine of 0.71 to the skin's.
LEAST_COVERED, LEAST_OF_PERSON, MOST_BURIED = 0.6, 0.7, 0.05  # each alone is a misfit
DOUBTFUL_COVERED, DOUBTFUL_BURIED, DOUBTFUL_OUTWARD = 0.85, 0.01, 0.8  # the first with one of the others
ACROSS = 0.5  # mean cosine between normals of scan and skin; 0.4 for normals turned by 90 degrees
WOUND, CLEARLY = (0.1, 0.25), 0.5  # shares of faces wound against their normals by that cosine: doubtful, refused
# At head, hands and feet valid scans lie within 1.4 cm on average (2.1 cm with hair and shoes added), and have 0.1%
# (2.7%) of another size, 0.3 (0.8) degrees of turn and 0.2 cm (0.8 cm) of shift. Beyond the first number is a doubt,
# beyond the second an error.
TURN, SHIFT = (4.0, 10.0), (0.03, 0.045)  # degrees, metres
APART = (0.023, 0.10)  # metres of mean distance
NEARBY = 0.05  # metres of it from which on scale, turn and shift are searched farther than they can be fitted
ROUGH = 0.004  # metres that the scan lies off an even layer there: 1.6 mm, and 4 mm and more with 1 cm of noise
MAJORITY, NEARLY_ALL = 0.5, 0.8  # shares of the places there on the scan: a gown may hide the feet
STRAY, STRAY_SPREAD = 2e-3, 2e-5  # share of points, or square metres that they add to a Chamfer distance: refused
FACING, BEYOND = (0.02, 0.04), 0.005  # shares of the scan; 0.017 of a wide dress face the body, none is beyond
REPEATED = 0.02  # share of points at one place
NOISY = 0.15  # share of the scan deep inside the body that noise explains
NOISE = "That is noise, or a poor fit."


def check_frame(frame: Frame, template: Template, path: Path, measured: bool = True) -> dict[str, str]:
    """Refuses a frame whose body or scan is empty, in other units, not where the other is, or inside out.

    A ``measured`` scan must hold nothing but the person and lie close to head, hands and feet; one that a network has
    unposed may be off. Gives what is doubtful and read all the same, as messages by kind. Raises `DataError` with the
    figure and the likely cause.
    """
    scan = frame.scan
    if len(scan.points) < FEWEST_POINTS:
        problem = f"scan: expected at least {FEWEST_POINTS} points, got {len(scan.points)}."
        raise DataError(path, problem, "Leave the frame out or scan it again.")
    check_size(frame.body.vertices, template, path)
    lengths = np.sqrt(np.einsum("mi,mi->m", scan.normals, scan.normals))
    if lengths.min() < 0.5 or (np.abs(lengths - 1) > 0.05).mean() > 0.01:
        problem = f"scan normals: expected unit length, got {lengths.min():.3g} to {lengths.max():.3g}."
        raise DataError(path, problem, "Normalise them, or compute them anew.")
    placed = _PlacedScan(scan, frame.body.vertices, template, path, tight_weights(template) if measured else None)
    there = placed.overlap.covered >= DOUBTFUL_COVERED  # the person; what else there is says nothing of units and fit
    doubts = placed.check_stray() if measured and there else {}
    if not there:
        ends = np.quantile(placed.samples.points, [0.02, 0.98], axis=0)  # whatever a few stray points say
        check_ratio("scan", ends, frame.body.vertices, "the body", path)
    doubts |= placed.check_place()
    doubts |= placed.check_stray() if measured and not there else {}
    return doubts | _check_normals(placed.overlap, scan, path)


@dataclass(frozen=True)
class _PlacedScan:
    """A scan with the posed body ``(V, 3)`` under it; ``tight (V,)`` are weights of head, hands and feet, or None."""

    scan: Scan
    body: np.ndarray
    template: Template
    path: Path
    tight: np.ndarray | None

    @cached_property
    def samples(self) -> ScanSamples:
        return ScanSamples(self.scan.points, self.scan.normals)

    @cached_property
    def skin(self) -> Skin:
        return sample_skin(self.body, self.template.faces.numpy(), self.tight)

    @cached_property
    def overlap(self) -> Overlap:
        return self.samples.overlap(self.skin)

    @cached_property
    def fit(self) -> Similarity:
        outward = self.overlap.outward
        return fit_similarity(self.samples, self.skin, -1 if outward < INSIDE_OUT else int(outward >= UNORIENTED))

    def check_stray(self) -> dict[str, str]:
        """Refuses a scan with much that is not the person; little of it is a doubt."""
        stray, total = find_stray(self.scan.points, self.scan.normals, self.skin), len(self.scan.points)
        share, alone = stray.count / total, "scan: expected the person alone"
        problem = (
            f"{alone}, {stray.count} of {total} points ({share:.2%}) lie apart from the body"
            f"{' on a plane' if stray.flat else ''}, up to {stray.farthest:.3g} m from it."
        )
        if stray.flat:
            hint = "That looks like a floor or wall: cut it off."
        elif share > 0.02:
            hint = f"That looks like another person or furniture: keep what lies within {FAR:.1f} m of the body."
        else:
            hint = "Those look like stray points: remove small pieces that are not joined to the person."
        if share >= STRAY or stray.spread >= STRAY_SPREAD:
            raise DataError(self.path, problem, hint)
        facing = f"{alone}, {stray.facing:.1%} of the scan lie beside the body and look at it."
        other = "That looks like another person or furniture touching this one: cut it off."
        if stray.facing > FACING[1] + self.samples.grain:
            raise DataError(self.path, facing, other)
        doubts = {"stray": f"{problem} {hint}"} if stray.count else {}
        if stray.facing > FACING[0] + self.samples.grain:
            doubts["facing"] = f"{facing} {other}"
        if stray.beyond > BEYOND:
            width = f"{alone}, {stray.beyond:.1%} of the scan lie more than {WORN:.2f} m from the body"
            doubts["wide"] = f"{width}. Is something else than cloth among it?"
        return doubts | self._check_repeats()

    def _check_repeats(self) -> dict[str, str]:
        """Refuses scans with many points at one place, such as pixels without depth; few at the origin are a doubt."""
        points = self.scan.points
        some = np.ascontiguousarray(points[thin(len(points), 1000)])
        repeated = np.unique(some.view(np.dtype((np.void, some.itemsize * 3))), return_counts=True)[1].max() / len(some)
        zeros = int((points == 0).all(axis=1).sum())
        share = max(float(repeated), zeros / len(points))
        hint = "Those look like pixels without depth: remove them."
        if share > REPEATED:
            problem = f"scan: expected points of a surface, {share:.0%} of them lie at one and the same place."
            raise DataError(self.path, problem, hint)
        return {"zeros": f"scan: {zeros} points lie exactly at the origin. {hint}"} if zeros > 1 else {}

    def check_place(self) -> dict[str, str]:
        """Refuses a scan that does not lie over its body, with the move, turn or scale that would lay it there."""
        overlap, fit, grain, known = self.overlap, self.fit, self.samples.grain, self.skin.known
        self._check_far_off()
        fitted = known and fit.share > MAJORITY
        precise = known and fit.share > NEARLY_ALL and fit.after < APART[0] + grain
        words = _misfit(fit, 1, grain) if precise else ()
        if words and fit.before < NEARBY + grain:
            raise DataError(self.path, f"{self._problem} There {words[0]}", words[1])
        apart = known and fit.before > APART[0] + grain
        if words or self._misplaced or (apart and not precise and (not fitted or _misfit(fit, 0, grain))):
            hint = suggest_hint(self.scan.points, self.scan.normals, self.body, self.template.faces.numpy(), self.tight)
            if words and not hint:
                raise DataError(self.path, f"{self._problem} There {words[0]}", words[1])
            if hint or self._misplaced or fit.before > APART[1] + grain:
                rough = fitted and not apart and fit.roughness > ROUGH + grain and overlap.buried < NOISY
                raise DataError(self.path, self._problem, hint or (NOISE if rough else self._no_correction()))
        if precise and (words := _misfit(fit, 0, grain)):
            return {"fit": f"{self._problem} There {words[0]} {words[1]}"}
        if apart or overlap.covered < DOUBTFUL_COVERED:
            return {"apart": f"{self._problem} Is the fit right, and nobody's head, hand or foot missing or covered?"}
        if fitted and fit.roughness > ROUGH + grain:
            scatter = f"it lies {1000 * fit.roughness:.1f} mm (median) off an even layer over head, hands and feet"
            return {"rough": f"scan: expected a surface, {scatter}. {NOISE}"}
        return {}

    @property
    def _misplaced(self) -> bool:
        """Whether so much of the body is bare, or of the scan deep inside, that one is not the other's."""
        overlap, least = self.overlap, LEAST_OF_PERSON if self.skin.known else LEAST_COVERED
        inward = INSIDE_OUT <= overlap.outward < DOUBTFUL_OUTWARD
        doubtful = overlap.covered < DOUBTFUL_COVERED and (overlap.buried > DOUBTFUL_BURIED or inward)
        return overlap.covered < least or overlap.buried > MOST_BURIED or doubtful

    @property
    def _problem(self) -> str:
        """How the scan lies, in words."""
        reached = "" if not self.skin.known else f" head, hands and feet lie {100 * self.fit.before:.1f} cm from it"
        return (
            f"scan: expected it over its body, {self.overlap.covered:.0%} of the body has a scan point within "
            f"{NEAR:.2f} m,{reached} and {self.overlap.buried:.0%} of the scan lies deep inside."
        )

    def _check_far_off(self) -> None:
        """Refuses a scan so far away that the translation must be in other units."""
        shift = np.median(self.body, axis=0) - np.median(self.scan.points, axis=0)
        if np.abs(shift).max() > FAR_OFF:
            hint = f"Their middles differ by {show_vector(shift, 1)} m: is the translation in metres?"
            raise DataError(self.path, self._problem, hint)

    def _no_correction(self) -> str:
        """The likely cause where no move, turn, mirror or scale lays the scan over its body."""
        gaps, overlap = self.skin.tree.query(self.samples.points)[0], self.overlap
        if overlap.buried <= MOST_BURIED and np.quantile(gaps, 0.9) < NEAR and overlap.covered < DOUBTFUL_COVERED:
            return "What there is of the scan lies on the body: is part of the person missing from it?"
        corrections = "a move, a turn by right angles, a mirror nor a scale"
        return f"Neither {corrections} corrects it: is the fit of another frame or person?"


def _misfit(fit: Similarity, level: int, grain: float) -> tuple[str, str] | tuple[()]:
    """What of a similarity is beyond the limits of a level, 0 doubtful or 1 refused, and the hint; empty if nothing.

    The limits are wider by ``grain``, metres, where scan points lie farther apart (`ScanSamples`).
    """
    if abs(fit.scale - 1) > DIFFERENT_SIZE[level] + grain:
        hint = f"Divide its positions by {fit.scale:.2f}, or the body has another person's shape (betas) or size."
        return f"it has {fit.scale:.2f} times the body's size.", hint
    parts = []
    if fit.degrees > TURN[level] + np.degrees(grain):
        axis = show_vector(fit.turn / np.linalg.norm(fit.turn), 1)
        parts.append(f"is turned by {fit.degrees:.0f} degrees about {axis}")
    if np.linalg.norm(fit.shift) > SHIFT[level] + 2 * grain:
        parts.append(f"lies {show_vector(fit.shift)} m from it")
    return (f"it {' and '.join(parts)}.", "Undo that to the scan, or do it to the fit.") if parts else ()


def _check_normals(overlap: Overlap, scan: Scan, path: Path) -> dict[str, str]:
    """Refuses normals that point inward, or either way, and faces that are wound against them."""
    doubts = {}
    if overlap.outward < INSIDE_OUT:
        problem = f"scan normals: expected them to point outward, {1 - overlap.outward:.0%} point into the body."
        raise DataError(path, problem, "The scan is inside out: multiply its normals by -1.")
    if overlap.outward >= UNORIENTED and overlap.cosine < ACROSS:
        found = f"their mean cosine to the body's is {overlap.cosine:.2f}"
        problem = f"scan normals: expected them to stand on the surface, {found}."
        raise DataError(path, problem, "Were points and normals turned alike? Else compute them anew.")
    if overlap.outward < DOUBTFUL_OUTWARD:
        problem = f"scan normals: expected them to point outward, only {overlap.outward:.0%} do."
        hint = "Orient them (MeshLab, Open3D), or compute them from the mesh."
        if overlap.outward < UNORIENTED:
            raise DataError(path, problem, hint)
        doubts["normals"] = f"{problem} {hint}"
    if scan.faces is None:
        return doubts
    some = scan.faces[thin(len(scan.faces), 1000)]
    a, b, c = (scan.points[some[:, corner]] for corner in range(3))
    crosses = np.cross(b - a, c - a)
    normals = scan.normals[some].sum(axis=1)
    lengths = np.linalg.norm(crosses, axis=1) * np.linalg.norm(normals, axis=1)
    against = float(((crosses * normals).sum(axis=1) < -CLEARLY * lengths).mean())
    if against > WOUND[0]:
        problem = f"scan faces: expected them counter-clockwise from outside, {against:.0%} are not."
        hint = "Are they this scan's, all wound one way?"
        if against > 1 - INSIDE_OUT:
            hint = (
                "Either the scan is mirrored (compare left and right with a picture; negate one coordinate of points "
                "and normals), or its faces are wound inward (swap two of their columns)."
            )
        if against > WOUND[1]:
            raise DataError(path, problem, hint)
        doubts["faces"] = f"{problem} {hint}"
    return doubts
