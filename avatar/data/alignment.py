"""Alignment of a scan with its body: overlap, points that are not the person, and scale, turn and shift between them.

Cloth lies close to the skin at head, hands and feet, whatever is worn, so scale, turn and shift are measured there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import permutations, product

import numpy as np
from scipy.ndimage import label
from scipy.spatial.transform import Rotation

from avatar.geometry.trees import Tree, build_tree
from avatar.records import Template

SKIN_SAMPLES = 3_000  # places on the body, spread by area
COVER_STRIDE = 6  # one in so many of them is looked at for coverage
SCAN_SAMPLES = 4_000
DEEP_SAMPLES = 500  # scan points whose side of the skin is looked at
NEAR = 0.10  # metres from skin to scan; a wide dress is farther from the legs, and near everywhere else
DEEP = 0.03  # metres under the skin, beyond what a good fit leaves
TIGHT_ROOTS = ("head", "left_wrist", "right_wrist", "left_ankle", "right_ankle")  # and the joints below them
TIGHT, FEWEST_TIGHT = 0.8, 60  # share of a place's skinning weights that these joints have; samples needed
TIGHT_CLIP = 0.15  # metres; no place counts for more
ALIGNED, CURE = 0.03, 0.5  # metres at which a correction fits, and the share of the distance that it may leave
CURED, CURED_BURIED = 0.9, 0.05  # share of the body that a suggestion must bring near the scan, and of scan buried
LARGER, SCALE_SHOWN, TURN_SHOWN = 0.1, 0.03, 4.0  # sizes tried, sizes and turns (degrees) mentioned
SIMPLER, ROUNDED = 2e-3, 1e-4  # metres that a suggestion with a move, or another one, must be nearer
ROUNDS, SAME_SIDE = 6, 0.3  # of the fit; cosine between the normals of body and scan
INSIDE_OUT, UNORIENTED = 0.25, 0.7  # shares of normals that point outward
CELL = 0.05  # metres; scan points are counted in cubes of this size
FAR = 0.60  # metres from the skin beyond which nothing is worn
JOINED = 0.15  # metres from the skin within which a piece of the scan belongs to the person
WORN = 0.45  # metres: the widest dress comes to 0.41
FLAT, FLAT_NORMALS, WIDE = 0.02, 0.9, 0.4  # metres thick, share of squared normals along one axis, metres: a floor


@dataclass(frozen=True)
class Skin:
    """Places on a posed body, evenly by area: ``places (S, 3)`` metres, unit ``normals (S, 3)``, float64.

    ``tight (S,)`` says where cloth lies close: head, hands and feet; everywhere, where these are not ``known``.
    """

    places: np.ndarray
    normals: np.ndarray
    tight: np.ndarray
    known: bool = True

    @cached_property
    def tree(self) -> Tree:
        """A KD-tree of the places."""
        return build_tree(self.places)

    @property
    def covered(self) -> np.ndarray:
        """The places that coverage is measured at."""
        return self.places[::COVER_STRIDE]


def sample_skin(vertices: np.ndarray, faces: np.ndarray, tight: np.ndarray | None = None) -> Skin:
    """Face centres at even steps of the area of a body ``(V, 3)`` with faces ``(F, 3)``; hands have many small faces.

    ``tight (V,)`` are weights in [0, 1] of `tight_weights`, or None.
    """
    areas = np.linalg.norm(_crosses(vertices, faces), axis=1).cumsum(dtype=np.float64)
    picked = np.searchsorted(areas, (np.arange(SKIN_SAMPLES) + 0.5) / SKIN_SAMPLES * areas[-1])
    faces = faces[picked.clip(max=len(faces) - 1)]
    corners = vertices[faces].astype(np.float64)
    crosses = _crosses(corners.reshape(-1, 3), np.arange(3 * SKIN_SAMPLES).reshape(-1, 3))
    close = np.zeros(SKIN_SAMPLES, bool) if tight is None else tight[faces].mean(axis=1) > TIGHT
    known = int(close.sum()) >= FEWEST_TIGHT
    lengths = np.linalg.norm(crosses, axis=1, keepdims=True)
    return Skin(corners.mean(axis=1), crosses / np.maximum(lengths, 1e-20), close | (not known), known)


def _crosses(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Cross products ``(F, 3)`` of two edges of each face."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a)


def tight_weights(template: Template) -> np.ndarray | None:
    """The share ``(V,)`` of skinning weights of head, hands and feet; None where the joints have other names."""
    names = template.joint_names
    chosen = np.zeros(len(names), np.float32)
    for joint, parent in enumerate(template.parents):
        chosen[joint] = names[joint] in TIGHT_ROOTS or (parent >= 0 and chosen[parent])
    return template.weights.numpy() @ chosen if set(TIGHT_ROOTS) <= set(names) else None


def thin(count: int, most: int) -> np.ndarray:
    """At most so many indices below a count, evenly."""
    return np.linspace(0, count - 1, min(count, most)).astype(np.int64)


@dataclass(frozen=True)
class Overlap:
    """Shares: of skin with a scan point near, of scan deep under the skin, of scan normals that point as it does; and
    the mean cosine between these and the skin's normals.
    """

    covered: float
    buried: float
    outward: float
    cosine: float


class ScanSamples:
    """Some of a scan's points ``(M, 3)`` and normals ``(M, 3)``, evenly, in a KD-tree."""

    def __init__(self, points: np.ndarray, normals: np.ndarray):
        some = thin(len(points), SCAN_SAMPLES)
        self.points, self.normals = points[some].astype(np.float64), normals[some].astype(np.float64)
        self.tree = build_tree(self.points)
        spacing = float(np.sqrt(2 / len(some)))  # of points on two square metres of person
        self.reach, self.inlier = max(NEAR, 2 * spacing), 1.5 * spacing
        self.grain = (
            max(spacing - float(np.sqrt(2 / SCAN_SAMPLES)), 0.0) / 2
        )  # metres farther that sparse points are from the skin

    def coverage(self, places: np.ndarray) -> float:
        """The share of places ``(S, 3)`` with a scan point within reach."""
        return float(np.isfinite(self.tree.query(places, distance_upper_bound=self.reach)[0]).mean())

    def distance(self, places: np.ndarray) -> float:
        """Mean distance of places ``(S, 3)`` to the scan, metres, each at most `TIGHT_CLIP`."""
        return float(np.minimum(self.tree.query(places, distance_upper_bound=TIGHT_CLIP)[0], TIGHT_CLIP).mean())

    def overlap(self, skin: Skin) -> Overlap:
        """How the scan lies over a body."""
        some = thin(len(self.points), DEEP_SAMPLES)
        _, below = skin.tree.query(self.points[some])
        outward = skin.normals[below]
        heights = ((self.points[some] - skin.places[below]) * outward).sum(axis=1)
        cosines = (self.normals[some] * outward).sum(axis=1)
        return Overlap(
            covered=self.coverage(skin.covered),
            buried=float((heights < -DEEP).mean()),
            outward=float((cosines > 0).mean()),
            cosine=float(cosines.mean()),
        )


@dataclass(frozen=True)
class Stray:
    """Points of a scan that are not the person: ``count`` of them, the ``farthest`` from the skin, metres, and whether
    they lie on a plane, as a floor or wall. ``spread`` is what they add to a Chamfer distance, square metres.

    Of the points that are joined to the person, ``facing`` is the share of the scan that lies beside the body and looks
    at it, as another person's side does, ``beyond`` the share of it that lies `WORN` or more from the skin.
    """

    count: int = 0
    farthest: float = 0.0
    flat: bool = False
    spread: float = 0.0
    facing: float = 0.0
    beyond: float = 0.0


def find_stray(points: np.ndarray, normals: np.ndarray, skin: Skin) -> Stray:
    """Scan points ``(M, 3)`` beyond `FAR` from the skin, in pieces that come nowhere near it, or on a plane beside it.

    Points are counted in cubes of 5 cm (larger in sparse scans), so distances are right to about that size.
    """
    low, high = skin.places.min(axis=0) - FAR, skin.places.max(axis=0) + FAR
    cell = max(CELL, 3 * float(np.sqrt(2 / len(points))))
    shape = np.ceil((high - low) / cell).astype(np.int64)
    cells, inside = np.zeros(len(points), np.int64), np.ones(len(points), bool)
    for axis, size in enumerate(shape):
        steps = (points[:, axis] - low[axis]) / cell
        inside &= (steps >= 0) & (steps < size)
        cells = cells * size + np.clip(steps, 0, size - 1).astype(np.int64)
    counts = np.bincount(cells[inside], minlength=int(shape.prod()))
    places = np.flatnonzero(counts)
    centres = low + (np.stack(np.unravel_index(places, shape), axis=1) + 0.5) * cell
    gaps, _ = skin.tree.query(centres)
    beside, stray, flat, facing = gaps > max(JOINED, cell), gaps > FAR, False, 0.0
    if beside.any():
        pieces = label(counts.reshape(shape) > 0, np.ones((3, 3, 3), bool))[0].reshape(-1)[places]
        stray |= ~np.isin(pieces, np.unique(pieces[~beside]))
        loose = np.zeros(counts.size, bool)
        loose[places[beside]] = True
        loose = np.flatnonzero(inside & loose[cells])
        flat = len(loose) > len(points) / 100 and is_flat(points[loose], normals[loose])
        stray |= beside & flat
        facing = _facing(points[loose], normals[loose], skin) * len(loose) / len(points)
    outside = points[~inside]
    away = skin.tree.query(outside[thin(len(outside), SCAN_SAMPLES)])[0]
    square = (counts[places[stray]] * gaps[stray] ** 2).sum() + (away**2).sum() * len(outside) / max(len(away), 1)
    count = len(outside) + int(counts[places[stray]].sum())
    farthest = max(gaps[stray].max(initial=0.0), away.max(initial=0.0))
    beyond = counts[places[gaps > WORN]].sum() / len(points)
    return Stray(count, float(farthest), flat, float(square) / len(points), facing, float(beyond))


def _facing(points: np.ndarray, normals: np.ndarray, skin: Skin) -> float:
    """The share of points ``(M, 3)`` whose normals point at the skin nearest to them."""
    some = thin(len(points), SCAN_SAMPLES // 4)
    gaps, near = skin.tree.query(points[some])
    cosines = ((points[some] - skin.places[near]) * normals[some]).sum(axis=1) / np.maximum(gaps, 1e-9)
    return float((cosines < -SAME_SIDE).mean())


def is_flat(points: np.ndarray, normals: np.ndarray) -> bool:
    """Whether most of some points ``(M, 3)`` lie on one plane with their normals ``(M, 3)`` across it."""
    some = thin(len(points), DEEP_SAMPLES)
    points, normals = points[some].astype(np.float64), normals[some].astype(np.float64)
    shares, axes = np.linalg.eigh(normals.T @ normals / len(normals))
    heights = points @ axes[:, -1]
    thickness = np.abs(heights - np.median(heights))
    extents = np.ptp(points @ axes[:, :2], axis=0)
    return bool(shares[-1] > FLAT_NORMALS and np.quantile(thickness, 0.9) < FLAT and extents.min() > WIDE)


@dataclass(frozen=True)
class Similarity:
    """Where a scan lies against its body: scan = ``scale`` times turned body, plus a shift.

    ``turn`` is a rotation vector, radians; ``shift (3,)`` moves the middle of head, hands and feet, metres; ``before``
    and ``after`` are their mean distances to the scan as it is and with the similarity undone, metres; ``share`` is
    that of their places which come to lie on the scan, ``roughness`` the median distance of the scan from an even layer
    over them, metres.
    """

    scale: float
    turn: np.ndarray
    shift: np.ndarray
    before: float
    after: float
    share: float
    roughness: float

    @property
    def degrees(self) -> float:
        """The angle of the turn."""
        return float(np.degrees(np.linalg.norm(self.turn)))


def fit_similarity(
    scan: ScanSamples, skin: Skin, sign: float = 1.0, start: np.ndarray | None = None, shift: np.ndarray | None = None
) -> Similarity:
    """Fits scale, turn and shift of a scan against head, hands and feet, from a linear map ``start (3, 3)`` and shift.

    Iterated closest points with distances to tangent planes; the ease of cloth is an unknown of its own, so that an
    even layer is not taken for scale. ``sign`` is -1 for normals that point inward, 0 for normals that are no help.
    """
    places, normals = skin.places[skin.tight], skin.normals[skin.tight]
    middle = places.mean(axis=0)
    linear = np.eye(3) if start is None else start
    shift, first = np.zeros(3) if shift is None else shift, linear
    body, roughness = places - middle, 0.0
    for _ in range(ROUNDS):
        moved = body @ linear.T + shift
        facing = normals @ (linear / np.cbrt(abs(np.linalg.det(linear)))).T
        gaps, near = scan.tree.query(moved + middle)
        cosine = (scan.normals[near] * facing).sum(axis=1)
        kept = ((sign * cosine if sign else np.abs(cosine)) > SAME_SIDE) & (
            gaps < max(3 * np.median(gaps), scan.inlier)
        )
        if kept.sum() < FEWEST_TIGHT // 2:
            break
        heights = ((scan.points[near] - middle - moved) * facing).sum(axis=1)
        ones = np.ones((len(moved), 1))
        system = np.concatenate([(moved * facing).sum(axis=1)[:, None], np.cross(moved, facing), facing, ones], axis=1)
        step = np.linalg.lstsq(system[kept], heights[kept], rcond=None)[0]
        roughness = float(np.median(np.abs(heights - system @ step)[kept]))
        turn = (1 + step[0]) * Rotation.from_rotvec(step[1:4]).as_matrix()
        linear, shift = turn @ linear, turn @ shift + step[4:7]
        if not 0.1 < abs(np.linalg.det(linear)) < 10:
            break
        if np.abs(step[:7]).max() < 1e-3:
            break
    scale = float(np.cbrt(abs(np.linalg.det(linear))))
    turn = linear @ np.linalg.inv(first)
    turned = Rotation.from_matrix(turn / np.cbrt(np.linalg.det(turn)))
    gaps = scan.tree.query(body @ linear.T + shift + middle, distance_upper_bound=TIGHT_CLIP)[0]
    after, share = float(np.minimum(gaps, TIGHT_CLIP).mean()), float((gaps < scan.inlier).mean())
    return Similarity(scale, turned.as_rotvec(), shift, scan.distance(places), after, share, roughness)


def measure_overlap(points: np.ndarray, normals: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> Overlap:
    """How scan points ``(M, 3)`` lie over a body ``(V, 3)`` with faces ``(F, 3)``; looks at some of each."""
    return ScanSamples(points, normals).overlap(sample_skin(vertices, faces))


def suggest_hint(
    points: np.ndarray,
    normals: np.ndarray,
    vertices: np.ndarray,
    faces: np.ndarray,
    tight: np.ndarray | None = None,
) -> str:
    """What would lay a scan over its body: a move, a turn by right angles, a mirror, a scale; empty if none would."""
    scan, skin = ScanSamples(points, normals), sample_skin(vertices, faces, tight)
    places = skin.places[skin.tight]
    low, high = np.quantile(scan.points, [0.002, 0.998], axis=0)
    before = best = scan.distance(places)
    name, linear, scale, step = "", np.eye(3), 1.0, np.zeros(3)
    for words, matrix in _mistakes():
        size = float(np.linalg.norm(high - low) / np.linalg.norm(np.ptp(skin.covered @ matrix, axis=0)))
        for factor in (1.0, size) if abs(size - 1) > LARGER else (1.0,):
            moved = factor * places @ matrix  # the inverse of an orthogonal matrix is its transpose: body to scan
            whole = factor * skin.covered @ matrix
            shift = (low + high - whole.min(axis=0) - whole.max(axis=0)) / 2
            for move in (np.zeros(3), shift) if factor == 1 else (shift,):
                distance = scan.distance(moved + move)
                if distance < best - (SIMPLER if move.any() else ROUNDED):
                    best, name, linear, scale, step = distance, words, matrix, factor, move
    middle, start = places.mean(axis=0), scale * linear.T
    moved = start @ middle + step - middle
    fit = fit_similarity(scan, skin, 1.0, start, moved)
    improved = fit.after < best
    scale = fit.scale if abs(fit.scale - 1) > SCALE_SHOWN else 1.0
    if improved and fit.degrees > TURN_SHOWN:
        linear = linear @ Rotation.from_rotvec(fit.turn).as_matrix().T
        name = (
            _turn_words(linear)
            if np.linalg.det(linear) > 0
            else f"{name}, then turning it by {fit.degrees:.0f} degrees"
        )
    back = middle - linear @ (middle + (fit.shift if improved else moved)) / scale
    after, overlap = (
        min(fit.after, best),
        ScanSamples(points @ linear.T / scale + back, normals @ linear.T).overlap(skin),
    )
    cured = overlap.covered >= CURED if not skin.known else after < ALIGNED + scan.grain
    if after > CURE * before or not cured or overlap.buried > CURED_BURIED:
        return ""
    parts = [name] if name else []
    if scale != 1:
        parts.append(f"{'d' if parts else 'D'}ividing its positions by {scale:.2f}")
    if np.abs(back).max() > 0.02:
        parts.append(f"{'m' if parts else 'M'}oving it by {show_vector(back)} m")
    return f"{' and '.join(parts)} would lay it over the body; or do the reverse to the fit." if parts else ""


def _turn_words(linear: np.ndarray) -> str:
    turn = Rotation.from_matrix(linear).as_rotvec()
    angle = float(np.linalg.norm(turn))
    return f"Turning the scan by {np.degrees(angle):.0f} degrees about {show_vector(turn / angle, 1)}"


def _mistakes() -> Iterator[tuple[str, np.ndarray]]:
    """What may have to be done to a scan, in words and as an orthogonal matrix; the first is nothing."""
    yield "", np.eye(3)
    for axis in "xyz":
        for angle in (-90, 90, 180):
            turn = Rotation.from_euler(axis, angle, degrees=True).as_matrix()
            yield f"Turning the scan by {angle} degrees about {axis}", turn
    for axis, row in zip("xyz", np.eye(3)):
        yield f"Mirroring the scan ({axis} to -{axis})", np.diag(1 - 2 * row)
    yield "Swapping y and z of the scan", np.eye(3)[[0, 2, 1]]
    for axis, angles in (("x", (-25, 25)), ("y", (-135, -45, 45, 135)), ("z", (-25, 25))):
        for angle in angles:
            linear = Rotation.from_euler(axis, angle, degrees=True).as_matrix()
            yield _turn_words(linear), linear
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            axes = ", ".join(f"{'-' if sign < 0 else ''}{'xyz'[axis]}" for axis, sign in zip(order, signs))
            yield f"Taking ({axes}) for (x, y, z) of the scan", np.diag(signs) @ np.eye(3)[list(order)]


def show_vector(steps: np.ndarray, digits: int = 2) -> str:
    """A vector as ``(x, y, z)`` with so many digits."""
    return f"({', '.join(f'{step:.{digits}f}' for step in steps)})"
