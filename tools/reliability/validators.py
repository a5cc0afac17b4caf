"""Validators of what readers return: independent of the readers' code, each returns what is invalid, or nothing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from avatar.methods.settings import RunConfig
from avatar.records import CanonicalScan, Mesh, Motion, PointCloud
from avatar.settings import settings_to_dict


def validate_mesh(mesh: Mesh) -> str:
    """Mesh: finite, indices in range, some triangle with area (by Gram's determinant)."""
    vertices, faces = mesh.vertices.astype(np.longdouble), mesh.faces
    if not len(faces) or not np.isfinite(vertices).all():
        return "empty or not finite"
    if faces.dtype.kind not in "iu" or not ((faces >= 0) & (faces < len(vertices))).all():
        return "indices out of range"
    a, b = vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]]
    gram = (a * a).sum(axis=1) * (b * b).sum(axis=1) - (a * b).sum(axis=1) ** 2
    return "" if (gram > 0).any() else "no area"


def validate_points(points: PointCloud) -> str:
    """Points: finite, as many normals, all of unit length; colours in [0, 1]."""
    if not len(points.points) or points.points.shape != points.normals.shape:
        return "empty or uneven"
    lengths = (points.normals.astype(np.float64) ** 2).sum(axis=1)
    if not np.isfinite(points.points).all() or not (np.abs(lengths - 1) < 1e-3).all():
        return "not finite or not unit"
    valid = points.colors is None or ((points.colors >= 0) & (points.colors <= 1)).all()
    return "" if valid else "colours out of range"


def validate_body(body: Any) -> str:
    """Body: finite, faces in range, rows of weights that sum to 1, a tree of joints."""
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


def validate_motion(motion: Motion) -> str:
    """Motion: finite, 22 joints, frames, a frame rate, a valid file name."""
    frames = len(motion.poses)
    if motion.poses.shape != (frames, 22, 3) or motion.translations.shape != (frames, 3) or not frames:
        return "wrong shapes"
    if not (np.isfinite(motion.poses).all() and np.isfinite(motion.translations).all() and 1 <= motion.fps <= 1000):
        return "not finite"
    return "" if motion.name and not set(motion.name) & set("/\\\0~ ") and motion.name[0] != "." else "unsafe name"


def validate_arrays(record: Any) -> str:
    """Record of arrays: those of floats finite."""
    arrays = [value for value in vars(record).values() if isinstance(value, np.ndarray)]
    return "" if all(np.isfinite(array).all() for array in arrays if array.dtype.kind == "f") else "not finite"


def validate_frame(frame: Any) -> str:
    """Frame of the open dataset: finite, and within the range of quantised cloth."""
    wild = np.abs(frame.cloth - frame.cloth.mean(axis=0)).max(initial=0) > 4
    return validate_arrays(frame) or ("cloth metres apart" if wild else "")


def validate_garment(garment: Any) -> str:
    """Garment: finite, faces and labels in range."""
    faces = garment.faces
    if not len(faces) or faces.min() < 0 or faces.max() >= len(garment.canonical):
        return "faces out of range"
    return validate_arrays(garment) or (
        "" if set(garment.labels) <= set(range(1, len(garment.names) + 1)) else "labels"
    )


def validate_scan(scan: CanonicalScan) -> str:
    """Canonical scan: points and normals as of a point cloud, weights that sum to 1, faces in range."""
    fault = validate_points(PointCloud(scan.points, scan.normals))
    if fault:
        return fault
    weights = scan.weights.astype(np.float64)
    if (weights < 0).any() or not (np.abs(weights.sum(axis=1) - 1) < 1e-2).all():
        return "weights do not sum to 1"
    if scan.faces is not None and not ((scan.faces >= 0) & (scan.faces < len(scan.points))).all():
        return "faces out of range"
    return validate_arrays(scan)


def validate_bvh(motion: Any) -> str:
    """BVH motion: finite positions, rotation matrices that are rotations."""
    if not (np.isfinite(motion.positions).all() and np.isfinite(motion.rotations).all()):
        return "not finite"
    squares = motion.rotations @ np.swapaxes(motion.rotations, -1, -2)
    rotations = np.abs(squares - np.eye(3)).max(initial=0) < 1e-6 and (np.linalg.det(motion.rotations) > 0).all()
    return "" if rotations else "no rotations"


def leaves(value: Any, name: str = "") -> dict[str, Any]:
    """Tensors and plain values in nested dicts and lists, by their path."""
    if isinstance(value, (dict, list, tuple)) and value:
        items = value.items() if isinstance(value, dict) else enumerate(value)
        return {place: leaf for key, item in items for place, leaf in leaves(item, f"{name}/{key!r}").items()}
    return {name: value}


def bits(value: Any) -> dict[str, tuple]:
    """Leaves of a value for comparison bit for bit: type, shape and bytes of tensors, type and digits of others."""
    return {
        place: (str(leaf.dtype), tuple(leaf.shape), leaf.detach().cpu().contiguous().numpy().tobytes())
        if isinstance(leaf, torch.Tensor)
        else (type(leaf).__name__, repr(leaf))
        for place, leaf in leaves(value).items()
    }


def difference(found: Any, saved: Any) -> str:
    """Path of the first difference between two states, bit for bit; empty where there is none."""
    one, other = bits(found), bits(saved)
    return next((place for place in sorted(one.keys() | other.keys()) if one.get(place) != other.get(place)), "")


def validate_state(state: Any, saved: Sequence[dict[str, Any]]) -> str:
    """Checkpoint: every tensor finite; where its step is that of a ``saved`` state, equal to it bit for bit.

    That includes model, optimiser, random state and plain values. A state of another step with a valid hash cannot be
    told from a checkpoint of another run.
    """
    if not isinstance(state, dict):
        return "no state"
    tensors = [leaf for leaf in leaves(state).values() if isinstance(leaf, torch.Tensor)]
    if not all(bool(torch.isfinite(tensor).all()) for tensor in tensors):
        return "not finite"
    same_step = [each for each in saved if each["step"] == state.get("step")]
    wrong = difference(state, same_step[0]) if same_step else ""
    return f"not what was saved: {wrong}" if wrong else ""


def validate_weights(read: tuple[dict[str, torch.Tensor], dict[str, Any]], saved: dict[str, torch.Tensor]) -> str:
    """Weights: equal bit for bit to those ``saved``, which are finite."""
    wrong = difference(read[0], saved)
    return f"not what was saved: {wrong}" if wrong else ""


def validate_config(config: RunConfig) -> str:
    """Settings: plain names, finite numbers, and sizes of the declared types and in range."""
    for name, value in leaves(settings_to_dict(config)).items():
        if isinstance(value, float) and not np.isfinite(value):
            return f"not finite: {name}"
    names = [config.name, config.dataset, config.method.variant, config.canonical, *config.outfit]
    if any(type(name) is not str or not name or name[0] == "." or set(name) & set("/\\\0~ \n") for name in names):
        return "unsafe name"
    train = config.train
    sizes = (train.steps, train.batch, train.points, train.scan_points, train.seed)
    if not all(type(value) is int for value in sizes):
        return "wrong types"
    return "" if min(sizes[:4]) >= 1 and train.lr > 0 else "out of range"
