"""Body parameters of SMPL under all their keys: AMASS, SMPL-X exports, smplx's arguments, EasyMocap's."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from avatar.body.inert_pickle import read_pickled_arrays
from avatar.body.model import SMPL_JOINTS
from avatar.checks import AvatarError, DataError, check_finite
from avatar.io.documents import read_json_record
from avatar.io.npz import naming, read_arrays

log = logging.getLogger(__name__)

JOINTS = len(SMPL_JOINTS)
ANY_SHAPE = "A | A B | A B C | A B C D"
WHOLE = ("poses", "fullpose", "pose")  # all joints, the root first
PARTS = (("root_orient", "pose_body"), ("global_orient", "body_pose"), ("Rh", "poses"))  # root, others
TRANSLATIONS = ("trans", "transl", "Th")
RATES = ("mocap_framerate", "mocap_frame_rate", "fps", "framerate", "frame_rate")
HANDS = ("left_hand_pose", "right_hand_pose", "hand_pose", "pose_hand", "jaw_pose", "pose_jaw")
SHAPES = ("betas", "shapes", "shape", "beta")
KEYS = tuple(dict.fromkeys((*WHOLE, *sum(PARTS, ()), *TRANSLATIONS)))
UNIT_TOLERANCE = 1e-2  # of the lengths of quaternions and of rows of matrices
WIDTHS = (66, 72, 75, 78, 90, 99, 156, 159, 165)  # SMPL's 22 and 24 joints; with PCA hands; SMPL-H's; SMPL-X's


@dataclass(frozen=True)
class SmplArrays:
    """What a file holds, in its own axes and unit: ``poses (T, J, 3)`` radians, ``translations (T, 3)``."""

    poses: np.ndarray
    translations: np.ndarray
    usual_up: str | None  # the axis that is up by convention; None for keys without one


def read_smpl_arrays(path: Path, pelvis: np.ndarray, joints: int = JOINTS) -> SmplArrays:
    """Reads body poses under any of the known keys, of an npz, a JSON file or a pickled dictionary, which runs nothing.

    Axis-angles are ``(T, 3 J)`` or ``(T, J, 3)`` of at least 22 joints, flat for one frame, numbers of any kind. Hands
    and face are left out, but for a file whose poses have just so many ``joints``. ``pelvis (3,)`` is the T-pose's,
    about which EasyMocap does not turn. Raises `DataError` naming file and key for what is missing, of other shapes, in
    degrees or pickled within an npz, and for a JSON file of several people.
    """
    found = _read_keys(path, KEYS)
    moves = next((key for key in TRANSLATIONS if key in found), None)
    if moves is None:
        keys = ", ".join(sorted(found)) or "none of poses"
        raise DataError(path, f"expected the keys trans (or {', '.join(TRANSLATIONS[1:])}), found only: {keys}.")
    translations = _frames(path, moves, found[moves])
    if translations.shape[1:] != (3,):
        raise DataError(path, f"{moves}: expected shape (T, 3), got {found[moves].shape}.")
    root = next((parts for parts in reversed(PARTS) if all(part in found for part in parts)), None)
    if "Rh" in found and root == ("Rh", "poses"):
        poses, translations = _easymocap(path, found, translations, pelvis)
    elif root:
        first, others = (_frames(path, key, found[key]) for key in root)
        if first.shape[1:] != (3,) or others.shape[1] < 3 * (JOINTS - 1) or others.shape[1] % 3:
            shapes = " and ".join(f"{key} {found[key].shape}" for key in root)
            raise DataError(path, f"expected {root[0]} (T, 3) and {root[1]} (T, 63 or more), got {shapes}.")
        _same_count(path, root[1], others, first, root[0])
        poses = np.concatenate([first, others], axis=1)
    else:
        poses = _whole_poses(path, found)
    _same_count(path, root[1] if root else "poses", poses, translations, moves)
    kept = joints if poses.shape[1] == 3 * joints else JOINTS
    poses = poses[:, : 3 * kept].reshape(len(poses), kept, 3).astype(np.float32)
    largest = float(np.linalg.norm(poses, axis=-1).max(initial=0))
    if largest > 4 * np.pi:
        raise DataError(path, f"poses: expected radians, got turns of {largest:.0f}.", "Convert degrees first.")
    usual = "z" if moves == "trans" else None
    return SmplArrays(poses, translations.astype(np.float32), usual)


def read_betas(path: Path) -> np.ndarray | None:
    """Shape coefficients ``(T, B)`` or ``(1, B)`` in a file of `read_smpl_arrays`; None where it has none."""
    found = _read_keys(path, SHAPES)
    return next((_frames(path, key, array) for key, array in found.items()), None)


def poses_hands(path: Path) -> bool:
    """Whether a file of `read_smpl_arrays` turns hands or face under keys of their own, which that does not read."""
    return any(np.any(array) for array in _read_keys(path, HANDS).values())


def _read_keys(path: Path, keys: Sequence[str]) -> dict[str, np.ndarray]:
    """Arrays of numbers under the keys that are there."""
    suffix = path.suffix.lower()
    if suffix not in (".json", ".pkl"):
        return read_arrays(path, {}, {key: f"number {_private(key)}" for key in keys})
    record, found = read_json_record(path) if suffix == ".json" else read_pickled_arrays(path, (), keys), {}
    for key in (key for key in keys if key in record):
        try:
            found[key] = np.array(record[key], np.float64)
        except (TypeError, ValueError, OverflowError) as error:
            raise DataError(path, f"{key}: expected numbers in lists, got others ({error!s:.100}).") from error
        with naming(path):
            check_finite(key, found[key])
    return found


def _private(key: str) -> str:
    """Any shape, with sizes of its own."""
    return " ".join(part if part == "|" else f"{key}_{part}" for part in ANY_SHAPE.split())


def _frames(path: Path, key: str, array: np.ndarray) -> np.ndarray:
    """An array as ``(T, P)``: one frame where it is flat, its joints beside each other where it is ``(T, J, 3)``."""
    if array.ndim == 3 and (array.shape[2] == 3 or array.shape[1] == 1):
        array = array.reshape(len(array), array.shape[1] * array.shape[2])
    if array.ndim == 1:
        array = array[None]
    if array.ndim != 2:
        hint = "Convert rotation matrices to axis-angles first." if array.shape[-2:] == (3, 3) else ""
        raise DataError(path, f"{key}: expected shape (T, P) or (T, J, 3), got {array.shape}.", hint)
    return array.astype(np.float64)


def _same_count(path: Path, key: str, array: np.ndarray, other: np.ndarray, name: str) -> None:
    if len(array) != len(other):
        expected = f"expected shape (T, P) with T={len(other)} as {name} has"
        raise DataError(path, f"{key}: {expected}, got {array.shape}.")


def _whole_poses(path: Path, found: dict[str, np.ndarray]) -> np.ndarray:
    key = next((key for key in WHOLE if key in found), None)
    known = ", or ".join(f"{root} and {others}" for root, others in PARTS)
    if key is None:
        raise DataError(path, f"expected poses (T, 66 or more), or {known}, got neither.")
    poses = _frames(path, key, found[key])
    _check_rotations(path, key, poses)
    if poses.shape[1] < 3 * JOINTS or poses.shape[1] % 3:
        raise DataError(path, f"expected {key} (T, 66 or more), or {known}, got {key} {found[key].shape}.")
    if poses.shape[1] not in WIDTHS:
        log.warning(
            "%s: %s has %d numbers a frame, which none of SMPL's bodies has (%s): the first %d are read as its joints.",
            *(path, key, poses.shape[1], ", ".join(map(str, WIDTHS)), 3 * JOINTS),
        )
    return poses


def _check_rotations(path: Path, key: str, poses: np.ndarray) -> None:
    """Refuses rotations ``(T, P)`` in other forms than axis-angle, which unit lengths give away."""
    for size, form, row in ((9, "rotation matrices", 3), (6, "6D rotations", 3), (4, "quaternions", 4)):
        if poses.shape[1] % size == 0 and poses.size:
            lengths = np.linalg.norm(poses.reshape(-1, row), axis=1)
            if np.abs(lengths - 1).max() < UNIT_TOLERANCE:
                problem = f"{key}: expected axis-angles of at least 22 joints, got {poses.shape[1]} numbers a frame."
                raise DataError(path, problem, f"These are {form} of {poses.shape[1] // size} joints: convert them.")


def _easymocap(
    path: Path, found: dict[str, np.ndarray], translations: np.ndarray, pelvis: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """EasyMocap's poses and translations as SMPL's: its ``Rh`` turns the body about the origin, not the pelvis."""
    turn, others = _frames(path, "Rh", found["Rh"]), _frames(path, "poses", found["poses"])
    _same_count(path, "Rh", turn, translations, "Th")
    _same_count(path, "poses", others, turn, "Rh")
    if turn.shape[1:] != (3,) or others.shape[1] < 3 * (JOINTS - 1) or others.shape[1] % 3:
        raise DataError(path, f"expected Rh (T, 3) and poses (T, 63 or more), got {turn.shape} and {others.shape}.")
    turns = Rotation.from_rotvec(turn)
    if others.shape[1] not in (63, 69):  # these lack the root, which is zero in the others
        turns, others = turns * Rotation.from_rotvec(others[:, :3]), others[:, 3:]
    shift = Rotation.from_rotvec(turn).apply(pelvis) - pelvis
    return np.concatenate([turns.as_rotvec(), others], axis=1), translations + shift


def read_rate(path: Path, fps: float | None) -> float:
    """Frames a second of an npz: the file's own, as a number or text of one, else ``fps``; `DataError` without any."""
    trouble = ""
    for key in RATES:
        try:
            stored = read_arrays(path, {}, {key: "scalar  | 1 | 1 1"}).get(key)
            if stored is not None:
                return float(stored.reshape(()).item())
        except (AvatarError, ValueError) as error:
            trouble = str(error)
    if fps is not None:
        log.warning("%s: says no frame rate; its frames are taken as %g a second, as fps= says.", path, fps)
        return float(fps)
    names = f"expected {' or '.join(RATES[:2])} (or {', '.join(RATES[2:])}), found none that can be read."
    raise DataError(path, f"{names} {trouble}".strip(), "Give fps= the frames a second of the file.")
