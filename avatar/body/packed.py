"""Bodies from a template file: vertices, faces, skinning weights and a kinematic tree, without any body model."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from avatar.body.model import BodyModel, check_bind
from avatar.body.skinning import blend_transforms, check_parents
from avatar.checks import AvatarError, DataError, check_shape
from avatar.geometry.transforms import invert_affine, invert_rigid, transform_points
from avatar.io.meshes import read_obj_atlas
from avatar.io.npz import npz_keys, read_arrays, write_arrays
from avatar.records import Template

REQUIRED_KEYS = {"vertices": "float V 3", "faces": "int F 3", "parents": "int J", "joint_names": "text J"}
BIND_KEYS = {"bind_vertices": "float V 3", "bind_joints": "float J 3", "zero_from_bind": "float J 4 4"}
OPTIONAL_KEYS = {
    "weights": "float V J",
    "weight_joints": "int V K",
    "weight_values": "number V K",
    "joints": "float J 3",
    "canonical_from_bind": "float J 4 4",
    "uv": "float U 2",
    "uv_faces": "int F 3",
    "pose_directions": "float V 3 P",
    **BIND_KEYS,
}


def sparse_weights(weights: np.ndarray, most: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Skinning weights ``(V, J)`` as joint indices and values ``(V, K)``, largest first, rows summing to 1.

    Keeps at most as many influences a vertex as asked for; None keeps all that are not zero, which loses nothing.
    """
    check_shape("weights", weights, "V J")
    count = int((weights > 0).sum(axis=1).max())
    ids = np.argsort(-weights, axis=1, kind="stable")[:, : min(count, most or count)]
    values = np.take_along_axis(weights, ids, axis=1)
    return ids.astype(np.uint16), (values / values.sum(axis=1, keepdims=True)).astype(np.float32)


def dense_weights(ids: np.ndarray, values: np.ndarray, joints: int) -> np.ndarray:
    """Skinning weights ``(V, J)`` float32 from `sparse_weights`, or from integers in proportion to the weights.

    Raises `AvatarError` for a joint index out of range, a negative value, or a vertex without any weight.
    """
    dims = check_shape("weight_joints", ids, "V K")
    check_shape("weight_values", values, "V K", **dims)
    ids, values = ids.astype(np.int64), values.astype(np.float32)
    if ids.size == 0 or ids.min() < 0 or ids.max() >= joints:
        raise AvatarError(f"weight_joints: expected indices of {joints} joints, got others.")
    totals = values.sum(axis=1, keepdims=True)
    if values.min() < 0 or totals.min() <= 0:
        raise AvatarError("weight_values: expected no negative value and at least one positive a vertex.")
    weights = np.zeros((len(ids), joints), np.float32)
    np.add.at(weights, (np.arange(len(ids))[:, None], ids), values / totals)
    return weights


def border_positions(vertices: np.ndarray, weights: np.ndarray, parents: tuple[int, ...]) -> np.ndarray:
    """Where each joint's subtree meets the rest of the body, ``(J, 3)`` float64; NaN where it shares no vertex with it.

    Vertices are averaged by ``s (1 - s)``, s being the sum of their weights over the subtree.
    """
    check_parents(parents)
    check_shape("weights", weights, "V J", V=len(vertices), J=len(parents))
    subtree = weights.astype(np.float64)
    for joint in range(len(parents) - 1, 0, -1):
        subtree[:, parents[joint]] += subtree[:, joint]
    border = subtree * np.clip(1 - subtree, 0, None)
    totals = border.sum(axis=0)[:, None]
    return np.where(totals < 1e-6, np.nan, border.T @ vertices / np.maximum(totals, 1e-12))


def joint_positions(vertices: np.ndarray, weights: np.ndarray, parents: tuple[int, ...]) -> np.ndarray:
    """Joint positions ``(J, 3)`` estimated from the skinning weights alone: see `border_positions`.

    The root has no such border and sits amid its children. Raises `AvatarError` for parents that are no tree, or naming
    the joint whose subtree shares no vertex with the rest.
    """
    joints = border_positions(vertices, weights, parents)
    alone = np.flatnonzero(np.isnan(joints[1:, 0])) + 1
    if len(alone):
        raise AvatarError(f"joints: joint {alone[0]} shares no vertex with its parent; store `joints (J, 3)` as well.")
    children = [joint for joint, parent in enumerate(parents) if parent == 0]
    joints[0] = joints[children].mean(axis=0) if children else vertices.mean(axis=0)
    return joints.astype(vertices.dtype)


def write_template(path: Path, template: Template, level: int = 9, **others: np.ndarray) -> None:
    """Writes a body at rest, and other arrays, as a ``template.npz``: weights without loss, and joint positions.

    ``level`` of deflating as in `write_arrays`.
    """
    ids, values = sparse_weights(template.weights.cpu().numpy())
    given = {name: getattr(template, name) for name in ("canonical_from_bind", "uv", "uv_faces", "vertices", "faces")}
    arrays = {name: value.cpu().numpy() for name, value in given.items() if value is not None}
    arrays |= {name: arrays[name].astype(np.int32) for name in ("uv_faces", "faces") if name in arrays}
    arrays |= {"weight_joints": ids, "weight_values": values, "joints": template.joints.cpu().numpy()}
    arrays |= {"parents": np.array(template.parents, np.int32), "joint_names": np.array(template.joint_names)}
    write_arrays(path, arrays | others, level)


def read_template(path: Path) -> Template:
    """The body at rest that a ``template.npz`` holds, float32; file and errors as in `packed_body`."""
    arrays = read_arrays(path, REQUIRED_KEYS, OPTIONAL_KEYS)
    with data_errors(path):
        template = _template(arrays, arrays["vertices"], arrays.get("joints"))
        check_bind(template)
        return replace(template, canonical_from_bind=float32_tensor(arrays.get("canonical_from_bind")))


def write_body(path: Path, body: BodyModel, level: int = 9) -> None:
    """Writes a body as a ``template.npz`` that `packed_body` poses exactly as it was.

    Beside the T-pose it keeps the pose in which the skinning weights were painted, and pose blendshapes; ``level`` of
    deflating as in `write_arrays`.
    """
    at_rest = body.with_canonical_pose(torch.zeros_like(body.canonical_pose)).template
    kept = {key: getattr(body, key) for key in (*BIND_KEYS, "pose_directions")}
    arrays = {key: value.cpu().numpy() for key, value in kept.items() if value is not None}
    write_template(path, at_rest, level, **arrays)


def packed_body(path: Path) -> BodyModel:
    """The body of a dataset's ``template.npz``, float32.

    The file holds ``vertices (V, 3)`` in the T-pose, ``faces (F, 3)``, ``parents (J,)``, ``joint_names (J,)``, the
    skinning weights as ``weights (V, J)`` or as ``weight_joints (V, K)`` and ``weight_values (V, K)``, and maybe
    ``joints (J, 3)``, which are estimated from the weights where they are missing. A body whose weights were painted in
    another pose has ``bind_vertices``, ``bind_joints`` and ``zero_from_bind (J, 4, 4)`` as well, or
    ``canonical_from_bind (J, 4, 4)`` alone, from which they follow; ``pose_directions (V, 3, 9 (J - 1))`` are pose
    blendshapes as `BodyModel` takes them. A UV atlas, which POP and SCALE need, is ``uv (U, 2)`` in [0, 1] and
    ``uv_faces (F, 3)``. Raises `DataError` for a missing or damaged file, missing keys, or arrays that do not make a
    body.
    """
    arrays = read_arrays(path, REQUIRED_KEYS, OPTIONAL_KEYS)
    bound = [key for key in BIND_KEYS if key in arrays]
    directions = float32_tensor(arrays.get("pose_directions"))
    with data_errors(path):
        if 0 < len(bound) < len(BIND_KEYS):
            raise AvatarError(f"bind pose: expected all of {', '.join(BIND_KEYS)} or none, got {', '.join(bound)}.")
        if bound:
            bind = _template(arrays, arrays["bind_vertices"], arrays["bind_joints"])
            return BodyModel(bind, float32_tensor(arrays["zero_from_bind"]), pose_directions=directions)
        at_rest = _template(arrays, arrays["vertices"], arrays.get("joints"))
        zero_from_bind = float32_tensor(arrays.get("canonical_from_bind"))
        return BodyModel(_bind_of(at_rest, zero_from_bind), zero_from_bind, pose_directions=directions)


@contextmanager
def data_errors(path: Path, hint: str = "") -> Iterator[None]:
    """Errors within the block become `DataError` of a file; transforms that cannot be inverted are among them."""
    try:
        yield
    except (AvatarError, torch.linalg.LinAlgError) as error:
        raise DataError(path, str(error).removeprefix(f"{path}: "), hint) from error


def holds_template(path: Path) -> bool:
    """Whether a file looks like a ``template.npz``, valid or not."""
    return {"vertices", "parents"} <= npz_keys(path)


def add_atlas(source: Path, target: Path, uv: Path) -> None:
    """Copies a ``template.npz`` with the UV atlas that an OBJ file has for its mesh; errors as in `atlas_arrays`."""
    packed_body(source)
    arrays = read_arrays(source, REQUIRED_KEYS, OPTIONAL_KEYS)
    write_arrays(target, arrays | atlas_arrays(uv, arrays["faces"], len(arrays["vertices"])))


def atlas_arrays(uv: Path, faces: np.ndarray, vertices: int) -> dict[str, np.ndarray]:
    """The UV atlas of an OBJ file as a body's arrays; `DataError` without texture coordinates or of another mesh."""
    atlas = read_obj_atlas(uv, faces, vertices)
    if atlas is None:
        raise DataError(uv, "it has no texture coordinates.", "Export it with UVs (lines that begin with vt).")
    return {"uv": atlas.uv, "uv_faces": atlas.uv_faces.astype(np.int32)}


def _bind_of(at_rest: Template, zero_from_bind: Tensor | None) -> Template:
    """The bind pose of a body whose T-pose is given, which is the T-pose itself where ``zero_from_bind`` is None."""
    if zero_from_bind is None:
        return at_rest
    check_bind(at_rest)
    vertex_bind_from_zero = invert_affine(blend_transforms(at_rest.weights, zero_from_bind[None])[0])
    return replace(
        at_rest,
        vertices=transform_points(vertex_bind_from_zero, at_rest.vertices),
        joints=transform_points(invert_rigid(zero_from_bind), at_rest.joints),
    )


def _template(arrays: dict[str, np.ndarray], vertices: np.ndarray, joints: np.ndarray | None) -> Template:
    """A template of a file's arrays, with the vertices and joints of one of its poses."""
    parents = tuple(int(parent) for parent in arrays["parents"])
    if "weights" in arrays:
        weights = arrays["weights"].astype(np.float32)
    elif "weight_joints" in arrays and "weight_values" in arrays:
        weights = dense_weights(arrays["weight_joints"], arrays["weight_values"], len(parents))
    else:
        raise AvatarError("weights: expected `weights`, or `weight_joints` and `weight_values`, got neither.")
    if joints is None:
        joints = joint_positions(vertices, weights, parents)
    kept = {key: arrays.get(key) for key in ("joint_names", "faces", "uv", "uv_faces")}
    return template_of(parents, vertices=vertices, weights=weights, joints=joints, **kept)


def template_of(parents: Iterable[int], joint_names: Iterable[str], **arrays: np.ndarray | None) -> Template:
    """A template of arrays by the names of its fields, float32."""
    whole = {name: arrays.pop(name) for name in ("faces", "uv_faces")}
    tensors = {name: ids if ids is None else torch.from_numpy(ids.astype(np.int64)) for name, ids in whole.items()}
    tensors |= {name: float32_tensor(array) for name, array in arrays.items()}
    return Template(parents=tuple(map(int, parents)), joint_names=tuple(map(str, joint_names)), **tensors)


def float32_tensor(array: np.ndarray | None) -> Tensor | None:
    """A float32 tensor of an array, or None."""
    return None if array is None else torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))
