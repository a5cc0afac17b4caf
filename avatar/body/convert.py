"""Body-model files of others (SMPL, SMPL-H, SMPL-X; npz or pkl) turned into plain npz files of our own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from avatar.body.inert_pickle import read_pickled_arrays
from avatar.body.packed import add_atlas, atlas_arrays, holds_template
from avatar.body.smpl import EXTRA_JOINTS, joint_tree
from avatar.checks import AvatarError, DataError, check_finite, check_shape
from avatar.geometry.uv import check_atlas
from avatar.io.npz import read_arrays, write_arrays

SHAPE_COMPONENTS = {20: 10, 400: 300}  # SMPL-X stores expression blendshapes behind those of shape
REQUIRED_KEYS = {
    "v_template": "number V 3",
    "shapedirs": "number V 3 B",
    "J_regressor": "number J V",
    "weights": "number V J",
    "f": "int F 3",
    "kintree_table": "int 2 J",
}
OPTIONAL_KEYS = {"posedirs": "number V 3 P", "vt": "number U 2", "ft": "number F 3"}  # vt and ft are SMPL-X's atlas


def convert_body_model(source: Path, target: Path, uv: Path | None = None) -> str:
    """Converts a downloaded SMPL, SMPL-H or SMPL-X file to the plain npz that `avatar.body.smpl` reads.

    A UV atlas, which POP and SCALE need, comes from the file where it has one (SMPL-X does), or from an OBJ file of
    the same mesh with texture coordinates. With such an OBJ a ``template.npz`` of our own may be the source as well:
    any body then gets an atlas.

    Args:
        source: the model file, ``.npz`` or ``.pkl``. Code and object arrays in it are never touched.
        target: the ``.npz`` to write.
        uv: the OBJ file, if any; it comes before what the source has.

    Returns:
        The kind of model it is: smpl, smplh, smplx or packed (a ``template.npz``).

    Raises:
        DataError: naming the file, for a damaged or hostile one, missing keys, or shapes that do not fit.
        AvatarError: when the target is not an npz.
    """
    source, target = Path(source), Path(target)
    if target.suffix != ".npz":
        raise AvatarError(f"target: expected a .npz file to write, got {target}.")
    if source.suffix not in (".npz", ".pkl"):
        raise DataError(source, f"expected a .npz or .pkl body model, got {source.suffix or 'no suffix'}.")
    if uv is not None and source.suffix == ".npz" and holds_template(source):
        add_atlas(source, target, uv)
        return "packed"
    if source.suffix == ".npz":
        arrays = read_arrays(source, REQUIRED_KEYS, OPTIONAL_KEYS)
    else:
        arrays = read_pickled_arrays(source, REQUIRED_KEYS, OPTIONAL_KEYS)
    try:
        plain = _plain_model(arrays if uv is None else {k: v for k, v in arrays.items() if k not in ("vt", "ft")})
    except AvatarError as error:
        raise DataError(source, str(error)) from error
    if uv is not None:
        plain |= atlas_arrays(uv, plain["faces"], len(plain["v_template"]))
    write_arrays(target, plain)
    return str(plain["kind"][0])


def _plain_model(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of our own file, after checks of shapes, numbers and joints."""
    dims: dict[str, int] = {}
    for key, array in arrays.items():
        kind, _, pattern = {**REQUIRED_KEYS, **OPTIONAL_KEYS}[key].partition(" ")
        dims = check_shape(key, array, pattern, **dims)
        if kind == "int" and array.dtype.kind not in "iu":
            raise AvatarError(f"{key}: expected whole numbers, got {array.dtype}.")
    parents = (-1, *(int(parent) for parent in arrays["kintree_table"][0, 1:]))  # the root's is 2^32 - 1
    kinds = [kind for kind in EXTRA_JOINTS if joint_tree(kind)[1] == parents]
    if not kinds:
        raise AvatarError(
            f"kintree_table: expected the joints of smpl (24), smplh (52) or smplx (55), got {len(parents)} joints."
        )
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
    if "vt" in arrays and "ft" in arrays:
        if not np.array_equal(arrays["ft"], np.rint(arrays["ft"])):  # some files keep whole numbers as floats
            raise AvatarError("ft: expected whole numbers, got others.")
        plain |= {"uv": arrays["vt"].astype(np.float32), "uv_faces": arrays["ft"].astype(np.int32)}
        check_atlas(torch.from_numpy(plain["uv"]), torch.from_numpy(plain["uv_faces"]), dims["F"])
    plain["parents"] = np.array(parents, np.int32)
    plain["joint_names"] = np.array(joint_tree(kinds[0])[0])
    plain["kind"] = np.array(kinds)
    return plain
