"""Whether a scan lies over its body, and if not, which simple mistake would explain it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from avatar.geometry.trees import Tree, build_tree

SKIN_SAMPLES = 500  # places on the body, spread by area
SCAN_SAMPLES = 4_000
DEEP_SAMPLES = 500  # scan points whose side of the skin is looked at
NEAR = 0.10  # metres from skin to scan; a wide dress is farther from the legs, and near everywhere else
DEEP = 0.03  # metres under the skin, beyond what a good fit leaves
CURED, CURED_BURIED = 0.9, 0.05  # share of the body that a suggestion must bring near the scan, and of scan buried
MIRRORED = {"x": (-1, 1, 1), "y": (1, -1, 1), "z": (1, 1, -1)}


@dataclass(frozen=True)
class Overlap:
    """How a scan lies over a body.

    ``covered`` share of the body's skin with a scan point near, ``buried`` share of scan points deep under the skin,
    ``outward`` share of scan normals that point the way the skin below them does.
    """

    covered: float
    buried: float
    outward: float


def measure_overlap(points: np.ndarray, normals: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> Overlap:
    """How scan points ``(M, 3)`` lie over a body ``(V, 3)`` with faces ``(F, 3)``; looks at some of each, in 10 ms."""
    centres, outward, areas = _face_frames(vertices, faces)
    skin = centres[_spread(areas, SKIN_SAMPLES)]
    some = _thin(len(points), DEEP_SAMPLES)
    _, below = build_tree(centres).query(points[some])
    heights = ((points[some] - centres[below]) * outward[below]).sum(axis=1)
    return Overlap(
        covered=_covered(skin, *_scan_tree(points)),
        buried=float((heights < -DEEP).mean()),
        outward=float(((normals[some] * outward[below]).sum(axis=1) > 0).mean()),
    )


def suggest_hint(points: np.ndarray, normals: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> str:
    """What would lay a scan over its body: a move, a turn by right angles, a mirror; or that none of them does."""
    centres, _, areas = _face_frames(vertices, faces)
    skin = centres[_spread(areas, SKIN_SAMPLES)]
    tree, reach = _scan_tree(points)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    best, words, corrected = 0.0, "", points
    for name, linear in _mistakes():
        moved = skin @ linear  # the inverse of an orthogonal matrix is its transpose: the body goes to the scan
        if name and (share := _covered(moved, tree, reach)) > best:
            best, words, corrected = share, name, points @ linear.T
        shift = middle - (moved.min(axis=0) + moved.max(axis=0)) / 2
        share = _covered(moved + shift, tree, reach)
        if share > best + 0.02:  # a suggestion without a move is the simpler one
            back = -linear @ shift
            numbers = ", ".join(f"{step:.2f}" for step in back)
            words = f"{name} and moving it by ({numbers}) m" if name else f"Moving it by ({numbers}) m"
            best, corrected = share, points @ linear.T + back
    if best < CURED or measure_overlap(corrected, normals, vertices, faces).buried > CURED_BURIED:
        return "Neither a move, a turn by right angles nor a mirror corrects it: is the fit of another frame or person?"
    return f"{words} would lay it over the body; or do the reverse to the fit."


def _mistakes() -> Iterator[tuple[str, np.ndarray]]:
    """What may have to be done to a scan, in words and as an orthogonal matrix; the first is nothing."""
    yield "", np.eye(3)
    for axis in "xyz":
        for angle in (-90, 90, 180):
            turn = Rotation.from_euler(axis, angle, degrees=True).as_matrix()
            yield f"Turning the scan by {angle} degrees about {axis}", turn
    for axis, signs in MIRRORED.items():
        yield f"Mirroring the scan ({axis} to -{axis})", np.diag(signs).astype(float)
    yield "Swapping y and z of the scan", np.eye(3)[[0, 2, 1]]


def _face_frames(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres ``(F, 3)``, unit normals ``(F, 3)`` and areas ``(F,)`` of faces, in float64."""
    a, b, c = (vertices[faces[:, corner]].astype(np.float64) for corner in range(3))
    crosses = np.cross(b - a, c - a)
    lengths = np.linalg.norm(crosses, axis=1)
    return (a + b + c) / 3, crosses / np.maximum(lengths, 1e-20)[:, None], lengths / 2


def _spread(areas: np.ndarray, count: int) -> np.ndarray:
    """Faces at even steps of the area, ``(count,)``: hands are a small part of it, and a large one of the faces."""
    cumulative = areas.cumsum()
    return np.searchsorted(cumulative, (np.arange(count) + 0.5) / count * cumulative[-1]).clip(max=len(areas) - 1)


def _thin(count: int, most: int) -> np.ndarray:
    """At most so many indices below a count, evenly."""
    return np.linspace(0, count - 1, min(count, most)).astype(np.int64)


def _scan_tree(points: np.ndarray) -> tuple[Tree, float]:
    """Some of a scan's points to search, and how far from skin one of them must be found, metres."""
    some = points[_thin(len(points), SCAN_SAMPLES)]
    spacing = np.sqrt(2 / len(some))  # of points on two square metres of person
    return build_tree(some), max(NEAR, 2 * spacing)


def _covered(skin: np.ndarray, tree: Tree, reach: float) -> float:
    """Share of places on the skin with a scan point within reach."""
    return float(np.isfinite(tree.query(skin, distance_upper_bound=reach)[0]).mean())
