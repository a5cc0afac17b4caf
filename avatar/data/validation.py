"""Checks of bodies, poses and frames when they are loaded: units, axes, overlap of scan and body, normals."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from avatar.checks import AvatarError, DataError, check_finite
from avatar.geometry.trees import Tree, build_tree
from avatar.records import Frame, Scan, Template

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


BODY_HEIGHT = (0.5, 2.5)  # metres, at rest
SIZE_RATIO = (0.25, 2.5)  # posed body to body at rest, and scan to posed body: beyond it units differ
FEWEST_POINTS = 100
FAR_OFF = 10.0  # metres between the middles of scan and body that only a translation in other units explains
# A valid frame covers 94% and more of the body, long dresses and raw scans included, and buries nothing.
LEAST_COVERED, MOST_BURIED = 0.6, 0.05  # each alone is a misfit
DOUBTFUL_COVERED, DOUBTFUL_BURIED, DOUBTFUL_OUTWARD = 0.85, 0.01, 0.8  # the first with one of the others
INSIDE_OUT, UNORIENTED = 0.25, 0.7  # shares of normals that point outward
ALONG = 0.7  # cosine to an axis from which on a direction runs along it
MOST_TURN = 2 * np.pi + 0.1  # radians; no joint turns farther, and degrees soon exceed it
AXES = (  # two joints, where the second lies from the first
    ("pelvis", "neck", "+y"),
    ("right_hip", "left_hip", "+x"),
)
TURNS = {  # where it should lie and where it does: what corrects it
    ("+y", "-y"): "Turn body and scans by 180 degrees about z: (x, y, z) to (-x, -y, z).",
    ("+y", "+z"): "Turn body and scans by -90 degrees about x: (x, y, z) to (x, z, -y).",
    ("+y", "-z"): "Turn body and scans by 90 degrees about x: (x, y, z) to (x, -z, y).",
    ("+y", "+x"): "Turn body and scans by 90 degrees about z: (x, y, z) to (-y, x, z).",
    ("+y", "-x"): "Turn body and scans by -90 degrees about z: (x, y, z) to (y, -x, z).",
    ("+x", "-x"): "Either it faces -z (turn body and scans by 180 degrees about y), or it is mirrored (negate x).",
    ("+x", "+z"): "Turn body and scans by 90 degrees about y: (x, y, z) to (z, y, -x).",
    ("+x", "-z"): "Turn body and scans by -90 degrees about y: (x, y, z) to (-z, y, x).",
}


def check_template(template: Template, path: Path) -> None:
    """Refuses a body at rest that does not stand upright in metres, y up, facing +z.

    Raises `DataError` with the turn, or the factor, that would correct it.
    """
    vertices = template.vertices.numpy()
    extents = np.ptp(vertices, axis=0)
    low, high = BODY_HEIGHT
    if low <= extents.max() <= high:
        _check_axes(template, path)
    if not low <= extents[1] <= high:
        problem = f"vertices: expected a body {low} to {high} m high, got {extents[1]:.4g} along y."
        raise DataError(path, problem, _unit_hint(float(extents[1])))


def check_frame(frame: Frame, template: Template, path: Path) -> None:
    """Refuses a frame whose body or scan is empty, in other units, not where the other is, or inside out.

    Raises `DataError` naming the file, what was expected and how to correct it.
    """
    points, body = frame.scan.points, frame.body.vertices
    if len(points) < FEWEST_POINTS:
        problem = f"scan: expected at least {FEWEST_POINTS} points, got {len(points)}."
        raise DataError(path, problem, "Leave the frame out or scan it again.")
    check_size(body, template, path)
    posed, scan = _diagonal(body), _diagonal(points)
    low, high = SIZE_RATIO
    if not low <= scan / posed <= high:
        problem = f"scan: expected about {posed:.2f} m across as the body, got {scan:.4g}."
        raise DataError(path, problem, _unit_hint(scan))
    lengths = np.linalg.norm(frame.scan.normals, axis=1)
    if (np.abs(lengths - 1) > 0.05).mean() > 0.01:
        problem = f"scan normals: expected unit length, got {lengths.min():.3g} to {lengths.max():.3g}."
        raise DataError(path, problem, "Normalise them, or compute them anew.")
    faces = template.faces.numpy()
    overlap = measure_overlap(points, frame.scan.normals, body, faces)
    _check_overlap(overlap, frame.scan, body, faces, path)
    _check_normals(overlap, frame.scan, path)


def check_size(body: np.ndarray, template: Template, path: Path) -> None:
    """Refuses a posed body ``(V, 3)`` in other units than its template. Raises `DataError` with the factor."""
    rest, posed = _diagonal(template.vertices.numpy()), _diagonal(body)
    low, high = SIZE_RATIO
    if not low <= posed / rest <= high:
        problem = f"body: expected about {rest:.2f} m across as at rest, got {posed:.4g}."
        raise DataError(path, problem, _unit_hint(posed))


def check_pose(pose: np.ndarray, joints: int) -> None:
    """Refuses a pose that is not ``(J, 3)`` axis-angle in radians: matrices, quaternions, flat vectors, degrees.

    Args:
        pose: what came.
        joints: J, of the body.

    Raises `AvatarError` with what it looks like and how to write it as expected.
    """
    shape = tuple(np.shape(pose))
    if shape != (joints, 3):
        problem = f"pose: expected shape ({joints}, 3), axis-angle in radians, got {shape}."
        raise AvatarError(f"{problem} {_pose_hint(shape, joints)}".strip())
    check_finite("pose", pose)
    turns = np.linalg.norm(np.asarray(pose, np.float64), axis=1)
    if turns.max() > MOST_TURN:
        raise AvatarError(
            f"pose: expected radians, joint {int(turns.argmax())} turns by {turns.max():.4g}, more than a full turn. "
            "That looks like degrees: multiply by pi / 180."
        )


def check_frame_count(names: Sequence[str], path: Path, what: str, least: int = 2) -> None:
    """Refuses fewer frames than something can be learned from.

    Raises `DataError` naming what needs more, and the frames there are.
    """
    if len(set(names)) < least:
        there = f"{len(set(names))} ({', '.join(sorted(set(names)))})" if names else "none"
        problem = f"{what} needs at least {least} frames in different poses, there is {there}."
        raise DataError(path, problem, "What moves with which joint shows only between poses: add scans.")


def _check_axes(template: Template, path: Path) -> None:
    """Refuses a body whose joints, or whose shape where they are unknown, do not stand upright facing +z."""
    places = dict(zip(template.joint_names, template.joints.numpy().astype(np.float64)))
    for start, end, wanted in AXES:
        if start in places and end in places and (found := _axis_along(places[end] - places[start])) != wanted:
            problem = f"joints: expected {end} towards {wanted} from {start}, it lies towards {found or 'no axis'}."
            hint = TURNS.get((wanted, found), "Turn body and scans so that y is up and the body faces +z.")
            raise DataError(path, problem, hint)
    _, height, depth = np.ptp(template.vertices.numpy(), axis=0)
    if height < depth / 2:
        problem = f"vertices: expected a body that stands along y, it is {height:.2f} m high and {depth:.2f} m deep."
        raise DataError(path, problem, TURNS["+y", "+z"])


def _axis_along(direction: np.ndarray) -> str:
    """The axis a direction runs along, as ``+y``; empty where it is along none."""
    unit = direction / max(float(np.linalg.norm(direction)), 1e-12)
    axis = int(np.abs(unit).argmax())
    return f"{'+' if unit[axis] > 0 else '-'}{'xyz'[axis]}" if abs(unit[axis]) > ALONG else ""


def _check_overlap(overlap: Overlap, scan: Scan, body: np.ndarray, faces: np.ndarray, path: Path) -> None:
    """Refuses a scan that does not lie over its body, with the move or turn that would lay it there."""
    inside_out = overlap.outward < INSIDE_OUT
    doubtful = overlap.covered < DOUBTFUL_COVERED and (
        overlap.buried > DOUBTFUL_BURIED or (overlap.outward < DOUBTFUL_OUTWARD and not inside_out)
    )
    if not (overlap.covered < LEAST_COVERED or overlap.buried > MOST_BURIED or doubtful):
        return
    problem = (
        f"scan: expected it over its body, {overlap.covered:.0%} of the body has a scan point within "
        f"{NEAR:.2f} m and {overlap.buried:.0%} of the scan lies deep inside."
    )
    shift = np.median(body, axis=0) - np.median(scan.points, axis=0)
    if np.abs(shift).max() > FAR_OFF:
        hint = f"Their middles differ by ({', '.join(f'{s:.1f}' for s in shift)}) m: is the translation in metres?"
    else:
        hint = suggest_hint(scan.points, scan.normals, body, faces)
    raise DataError(path, problem, hint)


def _check_normals(overlap: Overlap, scan: Scan, path: Path) -> None:
    """Refuses normals that point inward, or either way, and faces that are wound against them."""
    if overlap.outward < INSIDE_OUT:
        problem = f"scan normals: expected them to point outward, {1 - overlap.outward:.0%} point into the body."
        raise DataError(path, problem, "The scan is inside out: multiply its normals by -1.")
    if overlap.outward < UNORIENTED:
        problem = f"scan normals: expected them to point outward, only {overlap.outward:.0%} do."
        raise DataError(path, problem, "Orient them (MeshLab, Open3D), or compute them from the mesh.")
    if scan.faces is None or not len(scan.faces):
        return
    some = scan.faces[:: max(1, len(scan.faces) // 1000)]
    a, b, c = (scan.points[some[:, corner]] for corner in range(3))
    agree = float(((np.cross(b - a, c - a) * scan.normals[some[:, 0]]).sum(axis=1) > 0).mean())
    if agree < 0.5:
        problem = f"scan faces: expected them counter-clockwise from outside, {1 - agree:.0%} are not."
        raise DataError(path, problem, "Swap two columns of the faces.")


def _pose_hint(shape: tuple[int, ...], joints: int) -> str:
    """What a pose of another shape looks like, and how to write it as axis-angle."""
    if shape[-2:] == (3, 3) and len(shape) == 3:
        return "These are rotation matrices: scipy.spatial.transform.Rotation.from_matrix(pose).as_rotvec()."
    if len(shape) == 2 and shape[1] == 4:
        return "These are quaternions: scipy.spatial.transform.Rotation.from_quat(pose).as_rotvec(), x y z w."
    if shape == (joints, 6):
        return "These are 6D rotations: make matrices of them, then rotation vectors."
    if shape in ((joints * 3,), (1, joints * 3)):
        return f"It is flat: pose.reshape({joints}, 3)."
    total = int(np.prod(shape)) if shape else 0
    flat = len(shape) == 1 or shape[0] == 1
    if total % 3 == 0 and total > joints * 3 and (flat or (len(shape) == 2 and shape[1] == 3)):
        count = total // 3
        first = f"pose.reshape({count}, 3)[:{joints}]" if flat else f"pose[:{joints}]"
        return f"It has {count} joints; where the first {joints} are this body's, as for SMPL and SMPL-X: {first}."
    return "One rotation vector a joint, relative to its parent."


def _diagonal(points: np.ndarray) -> float:
    """Length of a cloud's bounding-box diagonal."""
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def _unit_hint(size: float) -> str:
    """What to do about a person of a wrong size."""
    for factor, unit in ((100, "centimetres"), (1000, "millimetres")):
        if BODY_HEIGHT[0] <= size / factor <= 2 * BODY_HEIGHT[1]:
            return f"That looks like {unit}: divide positions and translations by {factor} (multiply by {1 / factor})."
    if BODY_HEIGHT[0] <= size * 1000 <= 2 * BODY_HEIGHT[1]:
        return "That looks like kilometres, or metres scaled twice: multiply positions and translations by 1000."
    return "Positions must be in metres with y up."
