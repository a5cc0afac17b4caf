"""Independent judges of what readers give: they share nothing with the readers, and say what is unsound."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from avatar.records import CanonicalScan, Mesh, Motion, PointCloud
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
    """A canonical scan: points as any cloud's, weights that sum to 1, faces in range."""
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
    return "" if np.abs(squares - np.eye(3)).max(initial=0) < 1e-6 else "no rotations"


def judge_state(state: Any) -> str:
    """A checkpoint: finite, and where its step is that of one which was saved, to the bit what was saved."""
    if not isinstance(state, dict):
        return "no state"
    weight = state.get("model", {}).get("weight") if isinstance(state.get("model"), dict) else None
    if isinstance(weight, torch.Tensor) and not bool(torch.isfinite(weight).all()):
        return "not finite"
    return ""


def judge_weights(read: tuple[dict[str, torch.Tensor], dict[str, Any]]) -> str:
    """Weights: finite."""
    return "" if all(bool(torch.isfinite(value).all()) for value in read[0].values()) else "not finite"


def judge_config(config: RunConfig) -> str:
    """Settings: plain names, finite numbers of the declared kinds."""
    names = [config.name, config.dataset, config.method.variant, config.canonical, *config.outfit]
    if any(type(name) is not str or not name or name[0] == "." or set(name) & set("/\\\0~ \n") for name in names):
        return "unsafe name"
    train = config.train
    whole = (train.steps, train.batch, train.points, train.scan_points, train.seed)
    if not all(type(value) is int for value in whole) or not all(np.isfinite((train.lr, train.code_lr))):
        return "wrong kinds"
    return "" if min(whole[:4]) >= 1 and train.lr > 0 else "out of range"
