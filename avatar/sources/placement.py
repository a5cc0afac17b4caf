"""Units and axes of an outfit's scans and body fits: what brings both to metres, y up, in one coordinate frame."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from avatar.body.open import MEAN_SHAPE, open_body
from avatar.body.solving import posed_vertices
from avatar.checks import DataError
from avatar.data.alignment import measure_overlap, suggest_hint
from avatar.geometry.trees import Tree, build_tree
from avatar.geometry.units import METRES, possible_units
from avatar.io.stance import UPRIGHT, Y_FROM

TURNS = Y_FROM | {  # rotations that turn a world, upright along an axis, to y up
    "x": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "-x": np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
}
TAIL = 0.5  # percent of a scan's points that may stick out on each side: stray points
CLEAR, CLEAR_BURIED = 0.9, 0.02  # covered and buried shares from which on nothing else is tried
COVERED, BURIED = 0.8, 0.05  # of the units and axes that are taken
APART = 0.05  # by which they must cover more of the body than any others
FIGURES = {"arms sideways": 0.0, "arms out": 40.0, "arms down": 70.0}  # degrees from the T-pose
YAWS = 8
FIGURE_POINTS, SCAN_POINTS = 400, 800
FARTHEST = 0.3  # of the size: farther points count as so far
RARE = {"y": 1.0, "z": 1.0, "-y": 1.1, "-z": 1.1, "x": 1.1, "-x": 1.1}  # factors of distances: few programs use those
MARGIN = 1.04  # by which standing figures must lie nearer to scans with one axis up than with any other
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FittedSample:
    """A posed body as its file has it: ``fixed + unit * free``, both ``(V, 3)``, the former in metres.

    Of body parameters the body about the origin is in metres, and the translation in the file's unit.
    """

    fixed: np.ndarray
    free: np.ndarray

    def vertices(self, unit: str) -> np.ndarray:
        """The posed body ``(V, 3)`` in metres, in the file's axes."""
        return self.fixed + METRES[unit] * self.free


@dataclass(frozen=True)
class StandingBody:
    """What is known of a body whatever its pose: ``faces (F, 3)``; weights ``(V,)`` of its ankles and its shoulders."""

    faces: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def upright(self, vertices: np.ndarray) -> np.ndarray:
        """The unit vector ``(3,)`` from ankles to shoulders of a posed body."""
        bone = self.high @ vertices - self.low @ vertices
        return bone / max(float(np.linalg.norm(bone)), 1e-12)


@dataclass(frozen=True)
class Placement:
    """Scale and rotation ``(3, 3)`` of scans and of body fits to metres, y up; ``decided`` says it in words."""

    scan_scale: float
    scan_turn: np.ndarray
    fit_scale: float
    fit_turn: np.ndarray
    decided: dict[str, str]

    def scan(self, points: np.ndarray) -> np.ndarray:
        """Scan points ``(M, 3)`` in metres, y up, float32."""
        return (self.scan_scale * (points.astype(np.float64) @ self.scan_turn.T)).astype(np.float32)

    def normals(self, normals: np.ndarray) -> np.ndarray:
        """Scan normals ``(M, 3)``, y up."""
        return (normals.astype(np.float64) @ self.scan_turn.T).astype(np.float32)

    def fit(self, vertices: np.ndarray) -> np.ndarray:
        """A fitted mesh's vertices ``(V, 3)`` in metres, y up, float32."""
        return (self.fit_scale * (vertices.astype(np.float64) @ self.fit_turn.T)).astype(np.float32)

    def pose(self, pose: np.ndarray, translation: np.ndarray, pelvis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pose ``(J, 3)`` and translation ``(3,)`` of the turned body, whose root joint is at ``pelvis`` at rest."""
        turned = pose.astype(np.float64)
        turned[0] = (Rotation.from_matrix(self.fit_turn) * Rotation.from_rotvec(turned[0])).as_rotvec()
        moved = self.fit_turn @ (self.fit_scale * translation + pelvis) - pelvis
        return turned.astype(np.float32), moved.astype(np.float32)


def robust_height(points: np.ndarray) -> float:
    """Longest side of the box around points ``(M, 3)`` but the outermost half percent on each side."""
    low, high = np.percentile(points, [TAIL, 100 - TAIL], axis=0)
    return float((high - low).max())


def find_placement(
    path: Path,
    scans: Sequence[np.ndarray],
    units: str,
    up: str,
    fits: Sequence[FittedSample] = (),
    body: StandingBody | None = None,
) -> Placement:
    """Units and up axis of an outfit of which some ``scans (M, 3)`` are given, and body ``fits`` of the same frames.

    ``units`` and ``up`` are taken as they are but for "auto". With fits those units and axes are taken under which
    scans lie over their bodies (`measure_overlap`), as they are where that suffices; up is where the bodies stand
    along. Without, the unit is that of a person's height, and up the axis along which standing figures lie nearest.
    Raises `DataError` with the measured figures where nothing fits, or two answers do.
    """
    height = float(np.median([robust_height(scan) for scan in scans]))
    found = (units,) if units != "auto" else possible_units(height)
    if not found:
        problem = (
            f"expected scans of people, got a height of {height:.4g} (median of {len(scans)}), a person's in no unit."
        )
        raise DataError(path, problem, "Hint: give units=m, cm, mm or in if it is right, or remove what is no person.")
    if fits and body is not None:
        placement = _fitted_placement(path, scans, found, up, fits, body)
    elif len(found) > 1:
        raise DataError(
            path, f"expected one unit, a height of {height:.4g} is {_both_heights(height, found)}.", UNITS_HINT
        )
    else:
        axis = up if up != "auto" else _standing_axis(path, scans, METRES[found[0]])
        scale, turn = METRES[found[0]], TURNS[axis]
        placement = Placement(scale, turn, scale, turn, {"units": found[0], "up": axis})
    words = ", ".join(f"{key} {value}" for key, value in placement.decided.items())
    log.info("%s: %s; height %.4g, median of %d scans. Give units=, up= if wrong.", path, words, height, len(scans))
    return placement


UNITS_HINT = "Hint: give units=."


def _both_heights(height: float, units: Sequence[str]) -> str:
    return " and ".join(f"{height * METRES[unit]:.2f} m in {unit}" for unit in units)


@dataclass(frozen=True)
class _Reading:
    """Units and up axes of scans and fits, and how scans lie over their bodies if so read."""

    scan_unit: str
    scan_up: str
    fit_unit: str
    fit_up: str
    covered: float
    buried: float

    def __str__(self) -> str:
        read = f"scans in {self.scan_unit} with {self.scan_up} up, fits in {self.fit_unit} with {self.fit_up} up"
        return f"{self.covered:.0%} of the body covered with {read}"


def _fitted_placement(
    path: Path,
    scans: Sequence[np.ndarray],
    scan_units: Sequence[str],
    up: str,
    fits: Sequence[FittedSample],
    body: StandingBody,
) -> Placement:
    """The placement under which scans lie over their fitted bodies."""
    mean = np.mean([body.upright(fit.vertices("m")) for fit in fits], axis=0)  # whatever the unit
    shares = {axis: float(mean @ turn[1]) for axis, turn in TURNS.items()}
    stands = max(shares, key=shares.get)
    figure = f"bodies stand along {stands} ({shares[stands]:.2f} of 1 from ankles to shoulders, over the frames)"
    if up == "auto" and shares[stands] < UPRIGHT:
        raise DataError(path, f"expected bodies upright along an axis, at most {figure}.", "Hint: give up=.")
    if up == "auto":
        ups = [(axis, stands) for axis in dict.fromkeys((stands, *TURNS))]
    else:
        ups = list(dict.fromkeys([(up, up), (up, stands)]))
    best = _find_reading(path, scans, scan_units, ups, fits, body)
    if shares[best.fit_up] < UPRIGHT:
        log.warning("%s: up=%s as it was given, but %s.", path, up, figure)
    if (best.scan_unit, best.scan_up) != (best.fit_unit, best.fit_up):
        log.warning("%s: scans and fits differ: %s.", path, best)
    decided = {"units": best.scan_unit, "up": best.scan_up, "fit units": best.fit_unit, "fit up": best.fit_up}
    turns = TURNS[best.scan_up], TURNS[best.fit_up]
    return Placement(METRES[best.scan_unit], turns[0], METRES[best.fit_unit], turns[1], decided)


def _find_reading(
    path: Path,
    scans: Sequence[np.ndarray],
    scan_units: Sequence[str],
    ups: Sequence[tuple[str, str]],
    fits: Sequence[FittedSample],
    body: StandingBody,
) -> _Reading:
    """The units, and the up axes among pairs, under which scans cover most of their bodies; the first pair is that of
    one frame for both. `DataError` where none does, or two do.
    """
    meshes = not any(fit.fixed.any() for fit in fits)
    fit_units: tuple[str, ...] = ()
    if meshes:
        height = float(np.median([robust_height(fit.free) for fit in fits]))
        if not (fit_units := possible_units(height)):
            problem = f"expected fitted bodies of people, got a height of {height:.4g}."
            raise DataError(path, problem, "Hint: scale them.")
    found: list[_Reading] = []
    for (scan_up, fit_up), scan_unit in product(ups, scan_units):
        for fit_unit in fit_units or dict.fromkeys(("m", scan_unit)):
            reading = _measure(scans, fits, body, _Reading(scan_unit, scan_up, fit_unit, fit_up, 0, 0))
            if reading.covered >= CLEAR and reading.buried <= CLEAR_BURIED:
                return reading
            found.append(reading)
    as_is, *_ = found
    best, *others = sorted(found, key=lambda reading: reading.buried - reading.covered)
    near = [other for other in others if other.covered - other.buried > best.covered - best.buried - APART]
    if best.covered < COVERED or best.buried > BURIED:
        problem = f"expected scans over their fitted bodies, got {as_is}; at best {best}."
        points = METRES[as_is.scan_unit] * (scans[0].astype(np.float64) @ TURNS[as_is.scan_up].T)
        vertices = fits[0].vertices(as_is.fit_unit) @ TURNS[as_is.fit_up].T
        raise DataError(path, problem, suggest_hint(points, np.zeros_like(points), vertices, body.faces))
    if near:
        problem = f"expected one reading of units and axes, got two: {best}; {near[0]}."
        raise DataError(path, problem, "Hint: give units= and up=.")
    return best


def _measure(
    scans: Sequence[np.ndarray], fits: Sequence[FittedSample], body: StandingBody, reading: _Reading
) -> _Reading:
    """The reading with how scans lie over their bodies, the mean over the frames."""
    overlaps = []
    for scan, fit in zip(scans, fits):
        points = METRES[reading.scan_unit] * (scan.astype(np.float64) @ TURNS[reading.scan_up].T)
        vertices = fit.vertices(reading.fit_unit) @ TURNS[reading.fit_up].T
        overlaps.append(measure_overlap(points, np.zeros_like(points), vertices, body.faces))
    covered, buried = (float(np.mean([getattr(o, key) for o in overlaps])) for key in ("covered", "buried"))
    return replace(reading, covered=covered, buried=buried)


def _standing_axis(path: Path, scans: Sequence[np.ndarray], scale: float) -> str:
    """The axis along which standing figures lie nearest to scans; `DataError` where two axes are as near."""
    figures, sums = _standing_figures(), dict.fromkeys(TURNS, 0.0)
    for scan in scans:
        points, size = _normalised(scan, SCAN_POINTS)
        for axis, turn in TURNS.items():
            sums[axis] += RARE[axis] * scale * size * _figure_distance(points @ turn.T, figures)
    best, second = sorted(sums, key=sums.get)[:2]
    if sums[second] < MARGIN * sums[best]:
        near = " and ".join(f"{sums[axis] / RARE[axis] / len(scans):.3f} m with {axis} up" for axis in (best, second))
        problem = f"expected people who stand along one axis, standing figures lie {near} from {len(scans)} scans."
        raise DataError(path, problem, "Hint: give up=y, z, -y, -z, x or -x.")
    return best


def _standing_figures() -> list[tuple[np.ndarray, Tree]]:
    """Points ``(N, 3)`` of the open body with arms raised and lowered, turned about y, of size 1, and trees of them."""
    body, figures = open_body(MEAN_SHAPE), []
    for degrees in FIGURES.values():
        pose = np.zeros((len(body.parents), 3))
        for side, sign in (("left", -1), ("right", 1)):
            pose[body.joint_names.index(f"{side}_shoulder"), 2] = sign * np.radians(degrees)
        points, _ = _normalised(posed_vertices(body, pose), FIGURE_POINTS)
        for yaw in range(YAWS):
            turned = points @ Rotation.from_euler("y", 360 * yaw / YAWS, degrees=True).as_matrix().T
            figures.append((turned, build_tree(turned)))
    return figures


def _normalised(points: np.ndarray, most: int) -> tuple[np.ndarray, float]:
    """At most so many of points ``(M, 3)`` about their mean, in root mean square distances from it, and that size."""
    some = points[np.linspace(0, len(points) - 1, min(len(points), most)).astype(int)].astype(np.float64)
    some -= some.mean(axis=0)
    size = max(float(np.sqrt(np.square(some).sum(axis=1).mean())), 1e-12)
    return some / size, size


def _figure_distance(points: np.ndarray, figures: Sequence[tuple[np.ndarray, Tree]]) -> float:
    """Mean distance between points ``(M, 3)`` and the nearest of standing figures, both ways, in sizes."""
    tree = build_tree(points)
    return min(
        float(
            np.minimum(own.query(points, distance_upper_bound=FARTHEST)[0], FARTHEST).mean()
            + np.minimum(tree.query(figure, distance_upper_bound=FARTHEST)[0], FARTHEST).mean()
        )
        / 2
        for figure, own in figures
    )
