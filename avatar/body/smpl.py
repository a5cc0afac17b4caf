"""SMPL, SMPL-H and SMPL-X: conversion of downloaded model files to plain npz files, and bodies from those."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from avatar.body.inert_pickle import read_pickled_arrays
from avatar.body.model import SMPL_JOINTS, SMPL_PARENTS, BodyModel
from avatar.body.packed import (
    add_atlas,
    atlas_arrays,
    data_errors,
    float32_tensor,
    holds_template,
    template_of,
    write_body,
)
from avatar.body.rigged import rigged_body
from avatar.checks import AvatarError, DataError, check_finite, check_shape
from avatar.geometry.uv import check_atlas
from avatar.io.npz import read_arrays, write_arrays
from avatar.io.rigs import RIG_SUFFIXES

WRISTS = {"left": SMPL_JOINTS.index("left_wrist"), "right": SMPL_JOINTS.index("right_wrist")}
HEAD = SMPL_JOINTS.index("head")
FINGERS = ("index", "middle", "pinky", "ring", "thumb")
FACE = dict.fromkeys(("jaw", "left_eye", "right_eye"), HEAD)
DOWNLOAD_PAGES = {
    "smpl": "https://smpl.is.tue.mpg.de",
    "smplh": "https://mano.is.tue.mpg.de",
    "smplx": "https://smpl-x.is.tue.mpg.de",
}
MODEL_SHAPES = {"v_template": "V 3", "shapedirs": "V 3 B", "J_regressor": "J V", "weights": "V J"}
REQUIRED_KEYS = {
    **{key: f"float {shape}" for key, shape in MODEL_SHAPES.items()},
    **{"faces": "int F 3", "kind": "text 1", "parents": "int J", "joint_names": "text J"},
}
OPTIONAL_KEYS = {"posedirs": "float V 3 P", "uv": "float U 2", "uv_faces": "int F 3"}
HAND_KEYS = {"hand_means": "float 2 45", "hand_components": "float 2 45 45"}  # left, right


def _hands(first: int) -> dict[str, int]:
    """Finger joints of both hands and their parents, the first being joint number ``first``."""
    joints: dict[str, int] = {}
    for (side, wrist), finger, knuckle in product(WRISTS.items(), FINGERS, (1, 2, 3)):
        joints[f"{side}_{finger}{knuckle}"] = wrist if knuckle == 1 else first + len(joints) - 1
    return joints


EXTRA_JOINTS = {
    "smpl": {f"{side}_hand": wrist for side, wrist in WRISTS.items()},
    "smplh": _hands(22),
    "smplx": {**FACE, **_hands(25)},
}


def joint_tree(kind: str) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Names and parents of all joints of a kind of model: 24 for smpl, 52 for smplh, 55 for smplx.

    The first 22 are the body joints that every body has.
    """
    extra = EXTRA_JOINTS[kind]
    return (*SMPL_JOINTS, *extra), (*SMPL_PARENTS, *extra.values())


def smpl_body(
    path: Path,
    betas: Sequence[float] = (),
    all_joints: bool = False,
    canonical_pose: Tensor | None = None,
    kind: str | None = None,
    vertices: np.ndarray | None = None,
) -> BodyModel:
    """A body of the SMPL family from a file of tools/convert_body.py, float32, with pose blendshapes where it has them.

    Shape coefficients ``betas`` are standard deviations, at most as many as the file has. Without ``all_joints`` the
    skinning weights of hands and face go to wrists and head: exactly the model with fingers and face in their zero
    pose. ``kind`` is what the file must hold (smpl, smplh, smplx), any if None. ``vertices (V, 3)``, metres, are this
    person's own body in the T-pose, in place of the shape of ``betas``: its joints follow from the file's regressor.
    Raises `DataError` for a missing or damaged file or one of another kind, with the way to a good one; `AvatarError`
    for too many betas or another number of vertices.
    """
    model = _read_model(path, kind)
    components = model["shapedirs"].shape[-1]
    if len(betas) > components:
        raise AvatarError(f"betas: expected at most {components} numbers for {path}, got {len(betas)}.")
    if vertices is None:
        vertices = model["v_template"] + model["shapedirs"][..., : len(betas)] @ np.asarray(betas, np.float64)
    check_shape("vertices", vertices, "V 3", V=len(model["v_template"]))
    joints, weights, posedirs = model["J_regressor"] @ vertices, model["weights"], model.get("posedirs")
    parents, names = model["parents"], model["joint_names"]
    if not all_joints:
        count = len(SMPL_JOINTS)
        weights, joints = merge_weights(weights, parents, count), joints[:count]
        parents, names = parents[:count], names[:count]
        posedirs = None if posedirs is None else posedirs[..., : 9 * (count - 1)]
    bind = template_of(
        parents,
        names,
        vertices=vertices,
        faces=model["faces"],
        weights=weights / weights.sum(axis=1, keepdims=True),
        joints=joints,
        uv=model.get("uv"),
        uv_faces=model.get("uv_faces"),
    )
    with data_errors(path):
        return BodyModel(bind, None, canonical_pose, float32_tensor(posedirs))


def smpl_shapes(path: Path, components: int) -> tuple[np.ndarray, np.ndarray]:
    """The first shape components of a converted model: displacements of vertices ``(C, V, 3)`` and of the 22 joints
    ``(C, 22, 3)``, metres a standard deviation, float32; fewer where the file has fewer. Errors as in `smpl_body`.
    """
    model = _read_model(path, None)
    directions = np.moveaxis(model["shapedirs"][..., :components].astype(np.float64), -1, 0)
    joints = np.einsum("jv,cvx->cjx", model["J_regressor"][: len(SMPL_JOINTS)], directions)
    return directions.astype(np.float32), joints.astype(np.float32)


def merge_weights(weights: np.ndarray, parents: Sequence[int], count: int) -> np.ndarray:
    """Skinning weights ``(V, J)`` of the first ``count`` joints, each later one's added to its nearest ancestor."""
    merged = weights.copy()
    for joint in range(len(parents) - 1, count - 1, -1):
        merged[:, parents[joint]] += merged[:, joint]
    return merged[:, :count]


def hand_rotations(path: Path, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Rotations of the finger joints ``(30, 3)``, left before right, of principal components ``(C,)`` of each hand.

    As smplx reads them: the model's mean hand and the sum of its first C components. Raises `DataError` for a converted
    model without components, which only SMPL-H and SMPL-X files have.
    """
    stored = read_arrays(path, {}, HAND_KEYS)
    if len(stored) < len(HAND_KEYS):
        hint = "Hint: convert the SMPL-X or SMPL-H file again; earlier conversions left them out."
        raise DataError(path, "expected principal components of hands, there are none.", hint)
    sides = zip((left, right), stored["hand_means"], stored["hand_components"])
    return np.concatenate([mean + values @ parts[: len(values)] for values, mean, parts in sides]).reshape(30, 3)


def way_to_file(kind: str, path: Path | None = None) -> str:
    """Where a model is to be had, and the command that makes our file of it."""
    line = f"python tools/convert_body.py <downloaded file> {shlex.quote(str(path)) if path else '<file.npz>'}"
    return f"Download the {kind} model from {DOWNLOAD_PAGES[kind]} (its licence applies), then run: {line}"


def converted_kind(path: Path) -> str:
    """The kind of model (smpl, smplh, smplx) that a file of tools/convert_body.py holds; `DataError` for any other."""
    line = f"python tools/convert_body.py <downloaded file> {shlex.quote(str(path))}"
    with data_errors(path, f"Convert your own SMPL, SMPL-H or SMPL-X file: {line}"):
        return str(read_arrays(path, {"kind": "text 1"})["kind"][0])


def _read_model(path: Path, kind: str | None) -> dict[str, np.ndarray]:
    """The arrays of a converted model, or an error that says how to come by one."""
    hint = way_to_file(kind or "smplx", path)
    if not Path(path).is_file():
        raise DataError(path, f"expected a converted {kind or 'SMPL-family'} body model, there is no such file.", hint)
    with data_errors(path, hint):
        model = read_arrays(path, REQUIRED_KEYS, OPTIONAL_KEYS)
    stored = str(model["kind"][0])
    if kind not in (None, stored):
        raise DataError(path, f"expected a {kind} body model, got {stored}.", hint)
    if stored not in EXTRA_JOINTS or tuple(model["parents"]) != joint_tree(stored)[1]:
        raise DataError(path, f"expected the joints of smpl, smplh or smplx, got {stored} with others.", hint)
    return model


SHAPE_COMPONENTS = {20: 10, 400: 300}  # SMPL-X stores expression blendshapes behind those of shape
SOURCE_KEYS = {key: f"number {shape}" for key, shape in MODEL_SHAPES.items()}
SOURCE_KEYS |= {"f": "int F 3", "kintree_table": "int 2 J"}
OPTIONAL_SOURCE_KEYS = {"posedirs": "number V 3 P", "vt": "number U 2", "ft": "number F 3"}  # vt, ft: an atlas
SOURCE_HANDS = {
    f"hands_{key}{side}": f"number {shape}" for key, shape in (("mean", "45"), ("components", "45 45")) for side in "lr"
}
OPTIONAL_SOURCE_KEYS |= SOURCE_HANDS


def convert_body_model(source: Path, target: Path, uv: Path | None = None) -> str:
    """Converts a downloaded SMPL, SMPL-H or SMPL-X file, ``.npz`` or ``.pkl``, to the npz that `smpl_body` reads, and a
    rigged GLB or glTF file to a ``template.npz`` (`rigged_body`).

    Code and object arrays in it are never touched. A UV atlas, which POP and SCALE need, comes from the OBJ file ``uv``
    of the same mesh, or from the file where it has one (SMPL-X does). With such an OBJ a ``template.npz`` of our own
    may be the source as well: any body then gets an atlas. Gives the kind of model: smpl, smplh, smplx, rigged or
    packed (a ``template.npz``). Raises `DataError` naming the file, for a damaged or hostile one, missing keys, or
    shapes that do not fit; `AvatarError` when the target is not an npz.
    """
    source, target = Path(source), Path(target)
    if target.suffix != ".npz":
        raise AvatarError(f"target: expected a .npz file to write, got {target}.")
    if source.suffix not in (".npz", ".pkl", *RIG_SUFFIXES):
        got = source.suffix or "no suffix"
        raise DataError(source, f"expected a .npz or .pkl body model or a rigged .glb, got {got}.")
    if source.suffix in RIG_SUFFIXES:
        if uv is not None:
            raise AvatarError(f"uv: expected none for {source}, a rigged file has its own.")
        write_body(target, rigged_body(source))
        return "rigged"
    if uv is not None and source.suffix == ".npz" and holds_template(source):
        add_atlas(source, target, uv)
        return "packed"
    read = read_arrays if source.suffix == ".npz" else read_pickled_arrays
    arrays = read(source, SOURCE_KEYS, OPTIONAL_SOURCE_KEYS)
    with data_errors(source):
        plain = _plain_model(arrays if uv is None else {k: v for k, v in arrays.items() if k not in ("vt", "ft")})
    if uv is not None:
        plain |= atlas_arrays(uv, plain["faces"], len(plain["v_template"]))
    write_arrays(target, plain)
    return str(plain["kind"][0])


def _plain_model(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of our own file, after checks of shapes, numbers and joints."""
    dims: dict[str, int] = {}
    for key, array in arrays.items():
        kind, _, pattern = {**SOURCE_KEYS, **OPTIONAL_SOURCE_KEYS}[key].partition(" ")
        dims = check_shape(key, array, pattern, **dims)
        if kind == "int" and array.dtype.kind not in "iu":
            raise AvatarError(f"{key}: expected whole numbers, got {array.dtype}.")
    parents = (-1, *(int(parent) for parent in arrays["kintree_table"][0, 1:]))  # the root's is 2^32 - 1
    kinds = [kind for kind in EXTRA_JOINTS if joint_tree(kind)[1] == parents]
    if not kinds:
        known = "smpl (24), smplh (52) or smplx (55)"
        raise AvatarError(f"kintree_table: expected the joints of {known}, got {len(parents)} joints.")
    if "posedirs" in arrays:
        check_shape("posedirs", arrays["posedirs"], "V 3 P", V=dims["V"], P=9 * (dims["J"] - 1))
    components = SHAPE_COMPONENTS.get(dims["B"], dims["B"]) if kinds[0] == "smplx" else dims["B"]
    floats = {key: arrays[key] for key in ("v_template", "J_regressor", "weights", "posedirs") if key in arrays}
    floats["shapedirs"] = arrays["shapedirs"][..., :components]
    with np.errstate(over="ignore"):  # what is too large becomes infinite, and is refused as such
        plain = {key: array.astype(np.float32) for key, array in floats.items()}
    for key, array in plain.items():
        check_finite(key, array)
    plain["faces"] = arrays["f"].astype(np.int32)
    if SOURCE_HANDS.keys() <= arrays.keys():
        for key, parts in zip(HAND_KEYS, ("hands_meanl hands_meanr", "hands_componentsl hands_componentsr")):
            plain[key] = np.stack([arrays[part].astype(np.float32) for part in parts.split()])
            check_finite(key, plain[key])
    if "vt" in arrays and "ft" in arrays:
        if not np.array_equal(arrays["ft"], np.rint(arrays["ft"])):  # some files keep whole numbers as floats
            raise AvatarError("ft: expected whole numbers, got others.")
        plain |= {"uv": arrays["vt"].astype(np.float32), "uv_faces": arrays["ft"].astype(np.int32)}
        check_atlas(torch.from_numpy(plain["uv"]), torch.from_numpy(plain["uv_faces"]), dims["F"])
    plain["parents"] = np.array(parents, np.int32)
    plain["joint_names"] = np.array(joint_tree(kinds[0])[0])
    plain["kind"] = np.array(kinds)
    return plain
