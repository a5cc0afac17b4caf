"""Independent judges of what readers give: they share nothing with the readers, and say what is unsound."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from avatar.records import CanonicalScan, Mesh, Motion, PointCloud
from avatar.settings import settings_to_dict
from avatar.training.runs import RunConfig


def judge_mesh(mesh: Mesh) -> str:
    """A mesh by its own numbers: finite, indices in range, some triangle with area (by Gram's determinant)."""
    vertices, faces = mesh.vertices.astype(np.longdouble), mesh.faces
    if not len(faces) or not np.isfinite(vertices).all():
        return "empty or not finite"
    if faces.dtype.kind not in "iu" or not ((faces >= 0) & (faces < len(vertices))).all():
        return "indices out of range"
    a, b = vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]]
    gram = (a * a).sum(axis=1) * (b * b).sum(axis=1) - (a * b).sum(axis=1) ** 2
    return "" if (gram > 0).any() else "no area"


def judge_points(points: PointCloud) -> str:
    """Points by their own numbers: finite, as many normals, all of unit length; colours in [0, 1]."""
    if not len(points.points) or points.points.shape != points.normals.shape:
        return "empty or uneven"
    lengths = (points.normals.astype(np.float64) ** 2).sum(axis=1)
    if not np.isfinite(points.points).all() or not (np.abs(lengths - 1) < 1e-3).all():
        return "not finite or not unit"
    sound = points.colors is None or ((points.colors >= 0) & (points.colors <= 1)).all()
    return "" if sound else "colours out of range"


def judge_body(body: Any) -> str:
    """A body by its own numbers: finite, faces in range, rows of weights that sum to 1, a tree."""
    template = body.template
    floats = (template.vertices, template.joints, template.weights)
    if not all(bool(torch.isfinite(value).all()) for value in floats):
        return "not finite"
    if bool((template.faces < 0).any()) or bool((template.faces >= len(template.vertices)).any()):
        return "faces out of range"
    if bool(((template.weights.double().sum(dim=1) - 1).abs() > 1e-3).any()):
        return "weights do not sum to 1"
    tree = all(-1 < parent < joint for joint, parent in enumerate(template.parents) if joint)
    return "" if tree and template.parents[0] == -1 else "no tree"


def judge_motion(motion: Motion) -> str:
    """A motion: finite, 22 joints, frames, a frame rate, a name that can be a file's."""
    frames = len(motion.poses)
    if motion.poses.shape != (frames, 22, 3) or motion.translations.shape != (frames, 3) or not frames:
        return "wrong shapes"
    if not (np.isfinite(motion.poses).all() and np.isfinite(motion.translations).all() and 1 <= motion.fps <= 1000):
        return "not finite"
    return "" if motion.name and not set(motion.name) & set("/\\\0~ ") and motion.name[0] != "." else "unsafe name"


def judge_arrays(record: Any) -> str:
    """Any record of arrays: those of floats finite."""
    arrays = [value for value in vars(record).values() if isinstance(value, np.ndarray)]
    return "" if all(np.isfinite(array).all() for array in arrays if array.dtype.kind == "f") else "not finite"


def judge_frame(frame: Any) -> str:
    """A frame of the open dataset: finite and within reach of the quantised cloth."""
    wild = np.abs(frame.cloth - frame.cloth.mean(axis=0)).max(initial=0) > 4
    return judge_arrays(frame) or ("cloth metres apart" if wild else "")


def judge_garment(garment: Any) -> str:
    """A garment: finite, faces and labels in range."""
    faces = garment.faces
    if not len(faces) or faces.min() < 0 or faces.max() >= len(garment.canonical):
        return "faces out of range"
    return judge_arrays(garment) or ("" if set(garment.labels) <= set(range(1, len(garment.names) + 1)) else "labels")


def judge_scan(scan: CanonicalScan) -> str:
    """A canonical scan: points and normals as any cloud's, weights that sum to 1, faces in range."""
    fault = judge_points(PointCloud(scan.points, scan.normals))
    if fault:
        return fault
    weights = scan.weights.astype(np.float64)
    if (weights < 0).any() or not (np.abs(weights.sum(axis=1) - 1) < 1e-2).all():
        return "weights do not sum to 1"
    if scan.faces is not None and not ((scan.faces >= 0) & (scan.faces < len(scan.points))).all():
        return "faces out of range"
    return judge_arrays(scan)


def judge_bvh(motion: Any) -> str:
    """A BVH motion: finite positions, rotations that are rotations."""
    if not (np.isfinite(motion.positions).all() and np.isfinite(motion.rotations).all()):
        return "not finite"
    squares = motion.rotations @ np.swapaxes(motion.rotations, -1, -2)
    turned = np.abs(squares - np.eye(3)).max(initial=0) < 1e-6 and (np.linalg.det(motion.rotations) > 0).all()
    return "" if turned else "no rotations"


def leaves(value: Any, name: str = "") -> dict[str, Any]:
    """All that nested dicts and lists hold, tensors and plain values, by its place."""
    if isinstance(value, (dict, list, tuple)) and value:
        items = value.items() if isinstance(value, dict) else enumerate(value)
        return {place: leaf for key, item in items for place, leaf in leaves(item, f"{name}/{key!r}").items()}
    return {name: value}


def bits(value: Any) -> dict[str, tuple]:
    """The leaves of a value to be compared to the bit: type, shape and bytes of tensors, type and digits of others."""
    return {
        place: (str(leaf.dtype), tuple(leaf.shape), leaf.detach().cpu().contiguous().numpy().tobytes())
        if isinstance(leaf, torch.Tensor)
        else (type(leaf).__name__, repr(leaf))
        for place, leaf in leaves(value).items()
    }


def difference(found: Any, saved: Any) -> str:
    """The first place where two states are not equal to the bit; nothing where they are."""
    one, other = bits(found), bits(saved)
    return next((place for place in sorted(one.keys() | other.keys()) if one.get(place) != other.get(place)), "")


def judge_state(state: Any, saved: Sequence[dict[str, Any]]) -> str:
    """A checkpoint: every tensor finite; where its step is that of one which was ``saved``, to the bit what was saved.

    That is all of it: model, optimiser, random state and plain values. A state of another step is a forgery with its
    right hash, which nobody can tell from a checkpoint of another run.
    """
    if not isinstance(state, dict):
        return "no state"
    tensors = [leaf for leaf in leaves(state).values() if isinstance(leaf, torch.Tensor)]
    if not all(bool(torch.isfinite(tensor).all()) for tensor in tensors):
        return "not finite"
    twins = [each for each in saved if each["step"] == state.get("step")]
    wrong = difference(state, twins[0]) if twins else ""
    return f"not what was saved: {wrong}" if wrong else ""


def judge_weights(read: tuple[dict[str, torch.Tensor], dict[str, Any]], saved: dict[str, torch.Tensor]) -> str:
    """Weights: to the bit what was ``saved``, which is finite."""
    wrong = difference(read[0], saved)
    return f"not what was saved: {wrong}" if wrong else ""


def judge_config(config: RunConfig) -> str:
    """Settings: plain names, finite numbers, and those that size the work of the declared kinds and in range."""
    for name, value in leaves(settings_to_dict(config)).items():
        if isinstance(value, float) and not np.isfinite(value):
            return f"not finite: {name}"
    names = [config.name, config.dataset, config.method.variant, config.canonical, *config.outfit]
    if any(type(name) is not str or not name or name[0] == "." or set(name) & set("/\\\0~ \n") for name in names):
        return "unsafe name"
    train = config.train
    whole = (train.steps, train.batch, train.points, train.scan_points, train.seed)
    if not all(type(value) is int for value in whole):
        return "wrong kinds"
    return "" if min(whole[:4]) >= 1 and train.lr > 0 else "out of range"
