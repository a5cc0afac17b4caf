"""Checks that the parts of a packed outfit say the same: joints and weights, poses, transforms and posed vertices."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from avatar.body.packed import border_positions
from avatar.checks import DataError
from avatar.records import Template

JOINT_GAP, JOINTS_GAP = 0.25, 0.12  # metres from a joint to its weights' border: one, median (open body: 0.13, 0.04)
APART, SHARE = (
    0.05,
    0.99,
)  # metres between posed bodies at that share of vertices: margin for lost blendshapes
EDGE_ERROR = 0.18  # of the edges' length: 0.03 to 0.10 where right (sample outfits), 0.27 and more for no rotation


def check_joints(template: Template, path: Path) -> None:
    """Refuses joints that do not lie where the skinning weights of their subtree end.

    A joint turns its subtree about itself, so it lies near the border at which the subtree's weights fade
    (`joint_positions`). Joints without such a border are not judged. Raises `DataError` with the largest gap and the
    likely cause.
    """
    vertices, weights = template.vertices.numpy(), template.weights.numpy()
    borders = border_positions(vertices, weights, template.parents)
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


def check_posed(posed: np.ndarray, vertices: np.ndarray, what: str, template: Template, path: Path) -> None:
    """Refuses posed vertices that are not where another part of the frame puts them.

    Args:
        posed: ``(V, 3)`` the template posed by ``what``, metres.
        vertices: ``(V, 3)`` the frame's body.
        what: the key that posed it, ``pose`` or ``joint_transforms``.
        template: the body at rest.
        path: the frame's file.

    Raises `DataError` with the distance between the two and the likely cause.
    """
    apart = _apart(posed, vertices)
    if apart <= APART:
        return
    middle, other = vertices.mean(axis=0), posed.mean(axis=0)
    turn, _ = Rotation.align_vectors(vertices - middle, posed - other)
    turned = turn.apply(posed - other) + middle
    if _apart(posed + middle - other, vertices) <= APART:
        hint = f"A move of ({', '.join(f'{s:.2f}' for s in middle - other)}) m would: is the translation right?"
    elif _apart(turned, vertices) <= APART:
        degrees = np.degrees(turn.magnitude())
        hint = f"Turning the whole body by {degrees:.0f} degrees would: is the root's rotation in both?"
    else:
        off = np.linalg.norm(turned - vertices, axis=1) > APART
        joint = template.joint_names[int(template.weights.numpy()[off].sum(axis=0).argmax())]
        hint = (
            f"Vertices of {joint} are off most. Is {what} this frame's, with joints in the template's order, not "
            "negated and not zeros, and are the template's shape (betas), weights and joints this person's?"
        )
    problem = f"{what}: expected it to put the template on the frame's body, it leaves {1 - SHARE:.0%} of the vertices"
    raise DataError(path, f"{problem} {apart:.3f} m or more away.", hint)


def check_vertex_transforms(transforms: np.ndarray, template: Template, vertices: np.ndarray, path: Path) -> None:
    """Refuses ``vtransf`` that does not turn the edges of the body at rest onto those of the posed body.

    Args:
        transforms: ``(V, 3, 3)`` or ``(V, 4, 4)``; what they move is not looked at.
        template: the body at rest.
        vertices: ``(V, 3)`` the frame's body.
        path: the frame's file.

    Raises `DataError` with the mean error in lengths of the edges and the likely cause.
    """
    linear = transforms[:, :3, :3].astype(np.float64)
    starts, ends = template.faces[:, :2].flatten().numpy(), template.faces[:, 1:].flatten().numpy()
    rest = template.vertices.numpy()[ends].astype(np.float64) - template.vertices.numpy()[starts]
    posed = vertices[ends].astype(np.float64) - vertices[starts]
    lengths = np.linalg.norm(rest, axis=1).sum()

    def pose_edges(linear: np.ndarray) -> np.ndarray:
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
    elif np.abs(linear - np.eye(3)).max() < 1e-3:
        hint = "It is the identity: bring this frame's transforms, or leave the key out where pose is there."
    else:
        hint = "Is it this frame's, from rest to pose, in the template's order of vertices?"
    problem = f"vtransf: expected it to turn the template's edges onto those of the body, it errs by {found:.0%}"
    raise DataError(path, f"{problem} of their length.", hint)


def _apart(a: np.ndarray, b: np.ndarray) -> float:
    """Distance between two posed bodies that all but a hundredth of the vertices keep, metres."""
    return float(np.quantile(np.linalg.norm(a - b, axis=1), SHARE))


def _joint_hint(joints: np.ndarray, borders: np.ndarray, names: list[str], fit: Callable[[np.ndarray], bool]) -> str:
    """What would lay joints ``(J, 3)`` on the borders of their weights ``(J, 3)``, so that they ``fit``."""
    for factor, unit in ((100, "centimetres"), (1000, "millimetres")):
        if fit(joints / factor):
            return f"They look like {unit}: divide joints by {factor}."
    other = [name.replace("left", "*").replace("right", "left").replace("*", "right") for name in names]
    if set(other) == set(names) and fit(joints[[names.index(name) for name in other]]):
        return "The weights of left and right look swapped: exchange their columns, or the joints' names."
    shift = np.median(borders - joints, axis=0)
    if fit(joints + shift):
        return f"Moving all joints by ({', '.join(f'{s:.2f}' for s in shift)}) m would lay them there."
    return "Are joints in the order of the weights' columns, at rest, in metres, in the vertices' coordinates?"
