"""Checks of bodies and fits: units, axes, faces, joints, and that a frame's pose, transforms and vertices agree."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from avatar.body.model import SMPL_JOINTS, SMPL_PARENTS
from avatar.body.packed import border_positions
from avatar.checks import AvatarError, DataError, check_finite
from avatar.data.alignment import show_vector, thin
from avatar.records import Template

BODY_HEIGHT = (0.5, 2.5)  # metres, at rest
SIZE_RATIO = (0.25, 2.5)  # posed body to body at rest, and scan to posed body: beyond it units differ
ROUNDED = 5e-4  # metres that a body's vertices may be rounded by
LONG_EDGE, SAME_WAY = 0.15, 0.05  # median edge to size of a body; share of directed edges that two faces have
UNITS = {"centimetres": 0.01, "millimetres": 0.001, "inches": 0.0254, "feet": 0.3048, "decimetres": 0.1}  # metres
UNITS["kilometres, or metres scaled twice"] = 1000.0
LIKE = 1.5  # times larger or smaller than a unit would make it, and still taken for it
DIFFERENT_SIZE = (0.04, 0.08)  # share that a body or scan is larger or smaller than it should be: doubtful, refused
ALONG = 0.7  # cosine to an axis from which on a direction runs along it
MOST_TURN = 2 * np.pi + 0.1  # radians; no joint turns farther, and degrees soon exceed it
FOLLOWED = 0.1  # skinning weight of a joint's own vertices
JOINT_GAP, JOINTS_GAP = 0.25, 0.12  # metres from a joint to its weights' border: one, median (open body: 0.13, 0.04)
APART, SHARE = 0.05, 0.99  # metres between posed bodies at that share of vertices: margin for lost blendshapes
EDGE_ERROR = 0.18  # of the edges' length: 0.03 to 0.10 where right (sample outfits), 0.27 and more for no rotation
AXES = (("pelvis", "neck", "+y"), ("right_hip", "left_hip", "+x"))  # two joints, where the second lies from the first
TURNS = {  # where it should lie and where it does: what corrects it
    ("+y", "-y"): "Turn body and scans by 180 degrees about z: (x, y, z) to (-x, -y, z).",
    ("+y", "+z"): "Turn body and scans by -90 degrees about x: (x, y, z) to (x, z, -y).",
    ("+y", "-z"): "Turn body and scans by 90 degrees about x: (x, y, z) to (x, -z, y).",
    ("+y", "+x"): "Turn body and scans by 90 degrees about z: (x, y, z) to (-y, x, z).",
    ("+y", "-x"): "Turn body and scans by -90 degrees about z: (x, y, z) to (y, -x, z).",
    (
        "+x",
        "-x",
    ): "It faces -z (turn body and scans by 180 degrees about y), is mirrored (negate x), or joint_names have "
    "left and right exchanged.",
    ("+x", "+z"): "Turn body and scans by 90 degrees about y: (x, y, z) to (z, y, -x).",
    ("+x", "-z"): "Turn body and scans by -90 degrees about y: (x, y, z) to (-z, y, x).",
}


def check_template(template: Template, path: Path) -> None:
    """Refuses a body at rest that does not stand upright in metres, y up, facing +z.

    Raises `DataError` with the turn or the factor that would correct it.
    """
    extents = np.ptp(template.vertices.numpy(), axis=0)
    low, high = BODY_HEIGHT
    middle = float(template.vertices.median(dim=0).values.abs().max())
    if (step := float(np.spacing(np.float32(middle)))) > ROUNDED:
        problem = f"vertices: expected a body near the origin, float32 rounds those at {middle:.4g} m to {step:.2g} m."
        raise DataError(path, problem, "Move vertices, joints and frames to the origin.")
    _check_edges(template, path)
    if low <= extents.max() <= high:
        _check_axes(template, path)
    if not low <= extents[1] <= high:
        problem = f"vertices: expected a body {low} to {high} m high, got {extents[1]:.4g} along y."
        raise DataError(path, problem, _unit_hint(float(extents[1]), low, high))


def _check_axes(template: Template, path: Path) -> None:
    """Refuses a body whose joints, or whose shape where they are unknown, do not stand upright facing +z."""
    plain = {name.strip().lower().replace(" ", "_").replace("-", "_"): name for name in template.joint_names}
    if set(SMPL_JOINTS) <= plain.keys() and (other := [joint for joint in SMPL_JOINTS if plain[joint] != joint]):
        problem = f"joint_names: expected SMPL's, such as {other[0]!r}, got {plain[other[0]]!r}."
        raise DataError(path, problem, "Write them in lower case with underscores, without blanks.")
    width, height, depth = np.ptp(template.vertices.numpy(), axis=0)
    upright = height > 2 * depth and height > width / 2
    places = dict(zip(template.joint_names, template.joints.numpy().astype(np.float64)))
    for start, end, wanted in AXES:
        if start in places and end in places and (found := _axis_along(places[end] - places[start])) != wanted:
            problem = f"joints: expected {end} towards {wanted} from {start}, it lies towards {found or 'no axis'}."
            hint = TURNS.get((wanted, found), "Turn body and scans so that y is up and the body faces +z.")
            hint += " Or joint_names are in another order than joints." if wanted == "+y" and upright else ""
            raise DataError(path, problem, hint)
    vertices, faces = template.vertices.double(), template.faces
    a, b, c = (vertices[faces[:, corner]] - vertices.mean(dim=0) for corner in range(3))
    if (volume := float((a * b.cross(c, dim=1)).sum()) / 6) < 0:
        problem = f"faces: expected them counter-clockwise from outside, they enclose {volume:.3f} m³: wound inward."
        hint = "Swap two columns of the faces; or, if the body is mirrored as well, negate x of the vertices instead."
        raise DataError(path, problem, hint)
    if height < depth / 2:
        problem = f"vertices: expected a body that stands along y, it is {height:.2f} m high and {depth:.2f} m deep."
        raise DataError(path, problem, TURNS["+y", "+z"])


def _check_edges(template: Template, path: Path) -> None:
    """Refuses faces that are not those of the vertices, or not wound one way."""
    vertices, faces = template.vertices.numpy(), template.faces.numpy()
    starts, ends = faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)
    length = float(np.median(np.linalg.norm(vertices[ends] - vertices[starts], axis=1)))
    size = float(np.ptp(vertices, axis=0).max())
    if length > LONG_EDGE * size:
        problem = f"faces: expected edges that are short against the body, half of them are {length / size:.0%} of it."
        raise DataError(path, problem, "Are the faces those of these vertices, in their order?")
    if (repeated := len(faces) - len(np.unique(np.sort(faces, axis=1), axis=0))) > SAME_WAY * len(faces):
        problem = f"faces: expected each once, {repeated} of {len(faces)} are there once more."
        raise DataError(path, problem, "Leave them out.")
    _, counts = np.unique(starts * len(vertices) + ends, return_counts=True)
    if (share := float((counts > 1).mean())) > SAME_WAY:
        problem = f"faces: expected neighbours to run along their edge either way, on {share:.0%} of edges they do not."
        raise DataError(path, problem, "They are not wound one way: recompute their orientation (MeshLab, Blender).")


def _axis_along(direction: np.ndarray) -> str:
    """The axis a direction runs along, as ``+y``; empty where it is along none."""
    unit = direction / max(float(np.linalg.norm(direction)), 1e-12)
    axis = int(np.abs(unit).argmax())
    return f"{'+' if unit[axis] > 0 else '-'}{'xyz'[axis]}" if abs(unit[axis]) > ALONG else ""


def check_joints(template: Template, path: Path) -> None:
    """Refuses joints that do not lie near the borders at which the skinning weights of their subtrees fade.

    Joints without a border (`joint_positions`) are not judged. Raises `DataError` with the largest gap and its cause.
    """
    names = template.joint_names
    for joint, parent in zip(SMPL_JOINTS[1:], (SMPL_JOINTS[parent] for parent in SMPL_PARENTS[1:])):
        if joint in names and parent in names and parent not in (above := _ancestors(template, names.index(joint))):
            problem = f"parents: expected {parent} above {joint}, there are {', '.join(above) or 'no joints'}."
            raise DataError(path, problem, "Are parents in the order of the joints' names?")
    strongest = template.weights.amax(dim=0)
    moved = [joint for joint in SMPL_JOINTS if joint in names]
    still = [joint for joint in moved if strongest[names.index(joint)] < FOLLOWED]
    if len(still) > len(moved) / 2:
        problem = f"weights: expected vertices that follow each joint, none follows {', '.join(still[:4])}."
        raise DataError(path, problem, "Are the columns of weights in the order of the joints, and those of this body?")
    vertices = template.vertices.numpy()
    borders = border_positions(vertices, template.weights.numpy(), template.parents)
    judged = np.isfinite(borders[:, 0]) & (np.arange(len(borders)) > 0)
    if not judged.any():
        return
    joints, borders = template.joints.numpy().astype(np.float64)[judged], borders[judged]
    scale = max(float(np.ptp(vertices[:, 1])), 1e-6) / 1.7  # limits are those of a person of 1.7 m

    def fit(places: np.ndarray) -> bool:
        gaps = np.linalg.norm(places - borders, axis=1) / scale
        return gaps.max() <= JOINT_GAP and np.median(gaps) <= JOINTS_GAP

    if fit(joints):
        return
    names = [name for name, known in zip(template.joint_names, judged) if known]
    gaps = np.linalg.norm(joints - borders, axis=1)
    problem = (
        f"joints: expected each where the weights of its subtree end, {names[gaps.argmax()]} lies {gaps.max():.2f} m "
        f"from there and half of them lie {np.median(gaps):.2f} m or more."
    )
    raise DataError(path, problem, _joint_hint(joints, borders, names, fit))


def _ancestors(template: Template, joint: int) -> list[str]:
    """Names of the joints above a joint, the nearest first."""
    found = []
    while (joint := template.parents[joint]) >= 0:
        found.append(template.joint_names[joint])
    return found


def _joint_hint(joints: np.ndarray, borders: np.ndarray, names: list[str], fit: Callable[[np.ndarray], bool]) -> str:
    """What would lay joints ``(J, 3)`` on the borders of their weights ``(J, 3)``, so that they ``fit``."""
    for unit, metres in UNITS.items():
        if fit(joints * metres):
            return f"They look like {unit}: divide joints by {1 / metres:.5g}."
    other = [name.replace("left", "*").replace("right", "left").replace("*", "right") for name in names]
    if set(other) == set(names) and fit(joints[[names.index(name) for name in other]]):
        return "The weights of left and right look swapped: exchange their columns, or the joints' names."
    shift = np.median(borders - joints, axis=0)
    if fit(joints + shift):
        return f"Moving all joints by {show_vector(shift)} m would lay them there."
    return "Are joints in the order of the weights' columns, at rest, in metres, in the vertices' coordinates?"


def check_size(body: np.ndarray, template: Template, path: Path) -> str:
    """Refuses a posed body ``(V, 3)`` in other units than its template, or of another person; gives a doubt, or "".

    Raises `DataError` with the factor: of the bounding boxes, or the median of the edges' lengths, which poses keep.
    """
    check_ratio("body", body, template.vertices.numpy(), "at rest", path)
    edges = template.faces[:, :2].numpy()[thin(len(template.faces), 2000)]
    lengths = [
        np.linalg.norm(np.diff(v[edges].astype(np.float64), axis=1)[:, 0], axis=1)
        for v in (body, template.vertices.numpy())
    ]
    ratio = float(np.median(lengths[0] / np.maximum(lengths[1], 1e-9)))
    if abs(ratio - 1) <= DIFFERENT_SIZE[0]:
        return ""
    problem = f"body: expected it to be as large as at rest, its edges are {ratio:.2f} times as long."
    hint = "Is it the body of this person, of the same shape (betas) as the template?"
    if abs(ratio - 1) > DIFFERENT_SIZE[1]:
        raise DataError(path, problem, hint)
    return f"{problem} {hint}"


def check_ratio(what: str, points: np.ndarray, like: np.ndarray, words: str, path: Path) -> None:
    """Refuses points of another size than those they should be like, by the diagonals of their bounding boxes."""
    size, expected = (float(np.linalg.norm(np.ptp(cloud, axis=0))) for cloud in (points, like))
    low, high = SIZE_RATIO
    if not low <= size / expected <= high:
        problem = f"{what}: expected about {expected:.2f} m across as {words}, got {size:.4g}."
        raise DataError(path, problem, _unit_hint(size, expected / LIKE, expected * LIKE))


def _unit_hint(size: float, low: float, high: float) -> str:
    """What to do with positions of a ``size`` that should be ``low`` to ``high`` metres."""
    usual = np.sqrt(low * high)
    found = [unit for unit, metres in UNITS.items() if low <= size * metres <= high]
    if not found:
        return "Positions must be in metres with y up, and a scan must hold nothing but the person."
    found.sort(key=lambda unit: abs(np.log(size * UNITS[unit] / usual)))
    metres = UNITS[found[0]]
    todo = f"divide positions and translations by {1 / metres:.5g} (multiply by {metres:g})"
    todo = todo if metres < 1 else f"multiply positions and translations by {metres:g}"
    return f"That looks like {' or '.join(found)}: {todo}."


def check_posed(
    posed: np.ndarray,
    vertices: np.ndarray,
    what: str,
    template: Template,
    path: Path,
    others: Mapping[str, Callable[[], np.ndarray]] | None = None,
) -> None:
    """Refuses ``vertices (V, 3)`` that ``posed (V, 3)``, the template posed by the frame's ``what``, does not meet.

    ``others`` give the template posed otherwise, by words for it, to find out what was mistaken. Raises `DataError`
    with the distance, metres, and the likely cause.
    """

    def distance(moved: np.ndarray) -> float:  # that all but a hundredth of the vertices keep
        return float(np.quantile(np.linalg.norm(moved - vertices, axis=1), SHARE))

    if (apart := distance(posed)) <= APART:
        return
    middle, other = vertices.mean(axis=0), posed.mean(axis=0)
    turn, _ = Rotation.align_vectors(vertices - middle, posed - other)
    turned = turn.apply(posed - other) + middle
    if distance(posed + middle - other) <= APART:
        hint = f"A move of {show_vector(middle - other)} m would: is the translation right?"
    elif distance(turned) <= APART:
        degrees = np.degrees(turn.magnitude())
        hint = f"Turning the whole body by {degrees:.0f} degrees would: is the root's rotation in both?"
    else:
        off = np.linalg.norm(turned - vertices, axis=1) > APART
        joint = template.joint_names[int(template.weights.numpy()[off].sum(axis=0).argmax())]
        words = next((words for words, pose in (others or {}).items() if distance(pose()) <= APART), "")
        hint = f"Vertices of {joint} are off most. " + (
            f"{words} it does: correct {what}."
            if words
            else f"Is {what} this frame's, with joints in the template's order, not negated and not zeros, and are the "
            "template's shape (betas), weights and joints this person's?"
        )
    problem = f"{what}: expected it to put the template on the frame's body, it leaves {1 - SHARE:.0%} of the vertices"
    raise DataError(path, f"{problem} {apart:.3f} m or more away.", hint)


def check_vertex_transforms(transforms: np.ndarray, template: Template, vertices: np.ndarray, path: Path) -> None:
    """Refuses ``vtransf (V, 4, 4)`` that does not turn the template's edges onto those of ``vertices (V, 3)``.

    Raises `DataError` with the mean error in lengths of the edges and the likely cause.
    """
    linear = transforms[:, :3, :3].astype(np.float64)
    starts, ends = template.faces[:, :2].flatten().numpy(), template.faces[:, 1:].flatten().numpy()
    rest = template.vertices.numpy()[ends].astype(np.float64) - template.vertices.numpy()[starts]
    posed = vertices[ends].astype(np.float64) - vertices[starts]
    lengths = np.linalg.norm(rest, axis=1).sum()

    if (volume := float(np.median(np.linalg.det(linear)))) < 0:
        problem = f"vtransf: expected rotations, their determinants are {volume:.2f}: they mirror."
        raise DataError(path, problem, "Negate one coordinate of scan and body, and make the transforms anew.")

    def pose_edges(linear: np.ndarray, rest: np.ndarray = rest) -> np.ndarray:
        return np.einsum("eij,ej->ei", (linear[starts] + linear[ends]) / 2, rest)

    def error(edges: np.ndarray) -> float:
        return float(np.linalg.norm(edges - posed, axis=1).sum() / lengths)

    skinned = pose_edges(linear)
    found, transposed = error(skinned), error(pose_edges(np.swapaxes(linear, 1, 2)))
    backwards = transposed < found / 2
    if found <= (EDGE_ERROR / 2 if backwards else EDGE_ERROR):
        return
    turn, _ = Rotation.align_vectors(posed, skinned)
    if backwards:
        hint = "Transposed it does: store posed_from_rest, not its inverse, in matrices that multiply columns."
    elif error(turn.apply(skinned)) <= EDGE_ERROR:
        degrees = np.degrees(turn.magnitude())
        hint = f"Turned by {degrees:.0f} degrees as a whole it does: is the root's rotation in both?"
    elif error(pose_edges(linear, rest * [-1, 1, 1])) <= EDGE_ERROR:
        hint = "With the template mirrored it does: negate x of body and scan, or of the template and its faces' order."
    elif np.abs(linear - np.eye(3)).max() < 1e-3:
        hint = "It is the identity: bring this frame's transforms, or leave the key out where pose is there."
    else:
        hint = "Is it this frame's, from rest to pose, in the template's order of vertices?"
    problem = f"vtransf: expected it to turn the template's edges onto those of the body, it errs by {found:.0%}"
    raise DataError(path, f"{problem} of their length.", hint)


def check_pose(pose: np.ndarray, joints: int) -> None:
    """Refuses a pose that is not ``(J, 3)`` axis-angle in radians; `AvatarError` says what it looks like instead."""
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


def _pose_hint(shape: tuple[int, ...], joints: int) -> str:
    total, flat = int(np.prod(shape)) if shape else 0, len(shape) == 1 or shape[:1] == (1,)
    count = total // 3
    first = f"pose.reshape({count}, 3)[:{joints}]" if flat else f"pose[:{joints}]"
    longer = total % 3 == 0 and count > joints and (flat or (len(shape) == 2 and shape[1] == 3))
    rotation = "scipy.spatial.transform.Rotation"
    hints = {
        f"These are rotation matrices: {rotation}.from_matrix(pose).as_rotvec().": shape[1:] == (3, 3),
        f"These are quaternions: {rotation}.from_quat(pose).as_rotvec(), x y z w.": shape[1:] == (4,),
        "These are 6D rotations: make matrices of them, then rotation vectors.": shape == (joints, 6),
        f"It is flat: pose.reshape({joints}, 3).": flat and total == joints * 3,
        f"It has {count} joints; where the first {joints} are this body's, as for SMPL and SMPL-X: {first}.": longer,
        "One rotation vector a joint, relative to its parent.": True,
    }
    return next(hint for hint, fits in hints.items() if fits)


def check_frame_count(names: Sequence[str], path: Path, what: str, least: int = 2) -> None:
    """Refuses fewer frames than can be learned from; `DataError` names what needs more and those there are."""
    if len(set(names)) < least:
        there = f"{len(set(names))} ({', '.join(sorted(set(names)))})" if names else "none"
        problem = f"{what} needs at least {least} frames in different poses, there is {there}."
        raise DataError(path, problem, "What moves with which joint shows only between poses: add scans.")
