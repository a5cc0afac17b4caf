"""SMPL-family parameters of one scan, as files have them: pose, translation, shape and scale under all usual keys."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np

from avatar.body.inert_pickle import read_pickled_arrays
from avatar.body.model import SMPL_JOINTS, BodyModel
from avatar.body.smpl import hand_rotations, joint_tree
from avatar.checks import AvatarError, DataError, check_finite, check_suffix
from avatar.io.documents import read_json
from avatar.io.npz import naming, read_arrays

FINGERS = joint_tree("smplx")[0][25:]
FORMATS = (".npz", ".pkl", ".json")
NAMES = {  # the joints of a whole pose, by their number
    len(SMPL_JOINTS): tuple(SMPL_JOINTS),
    **{len(joint_tree(kind)[0]): joint_tree(kind)[0] for kind in ("smpl", "smplh", "smplx")},
}
SMPLX_NAMES = NAMES[55]
WHOLE = ("pose", "poses", "fullpose", "full_pose")
ROOT, BODY = ("global_orient", "root_orient", "root_pose"), ("body_pose", "pose_body")
PARTS = {  # parts of a pose, the joints of each, and its keys
    "jaw": (SMPLX_NAMES[22:23], ("jaw_pose", "pose_jaw")),
    "left eye": (SMPLX_NAMES[23:24], ("leye_pose",)),
    "right eye": (SMPLX_NAMES[24:25], ("reye_pose",)),
    "eyes": (SMPLX_NAMES[23:25], ("pose_eye",)),
    "left hand": (FINGERS[:15], ("left_hand_pose",)),
    "right hand": (FINGERS[15:], ("right_hand_pose",)),
    "hands": (FINGERS, ("pose_hand", "hand_pose")),
}
INNER, OUTER = ("transl",), ("translation", "trans")  # of the body, and of what scale has made of it
BETAS = ("betas", "shape", "beta")
KEYS = (*WHOLE, *ROOT, *BODY, *chain(*(keys for _, keys in PARTS.values())), *INNER, *OUTER, *BETAS, "scale")


@dataclass(frozen=True)
class SmplParameters:
    """One body: ``pose (J, 3)`` axis-angle of the joints ``names``, radians; a scan's points are ``scale (body + t)``.

    ``translation (3,)`` is t, in the body's own metres; ``betas (S,)`` are empty where the file has none. ``hands`` are
    left and right one as coefficients of principal components ``(C,)``, None where fingers are in the pose or nowhere.
    """

    names: tuple[str, ...]
    pose: np.ndarray
    translation: np.ndarray
    betas: np.ndarray
    scale: float = 1.0
    hands: tuple[np.ndarray, np.ndarray] | None = None

    def with_fingers(self, model: Path) -> SmplParameters:
        """The same with fingers as rotations, of the components in a converted model; errors as in `hand_rotations`."""
        if self.hands is None:
            return self
        turns = np.concatenate([self.pose, hand_rotations(model, *self.hands)])
        return replace(self, names=(*self.names, *FINGERS), pose=turns, hands=None)

    def pose_of(self, body: BodyModel, cut: bool = False) -> np.ndarray:
        """The pose ``(J, 3)`` float32 of a body's joints, by their names; those that the file lacks are at rest.

        Raises `AvatarError` where a joint is turned that the body lacks, unless such joints are ``cut``.
        """
        places = {name: place for place, name in enumerate(body.joint_names)}
        pose = np.zeros((len(places), 3), np.float32)
        for name, turn in zip(self.names, self.pose):
            if name in places:
                pose[places[name]] = turn
            elif np.any(turn) and not cut:
                hint = "Hint: take the kind of model that was fitted, or body.all_joints=false for hands at rest."
                raise AvatarError(f"pose: expected joints of the body, it turns {name}, which the body lacks. {hint}")
        return pose


def read_parameters(path: Path) -> SmplParameters:
    """The parameters of one scan from an ``.npz``, ``.pkl`` or ``.json`` file; pickled classes are never built.

    Poses are whole (66, 72, 156 or 165 numbers; ``pose``, ``poses``, ``fullpose``) or in parts (``global_orient`` and
    ``body_pose`` of 63 or 69, hands, jaw, eyes), flat or ``(J, 3)``, with an axis of one frame before them or not.
    Hands may be principal components instead. ``transl`` is scaled with the body, ``translation`` or ``trans`` is
    added behind ``scale``, as the fits of THuman and DeepFashion3D have it. Raises `DataError` naming the file and the
    key: missing, of several frames, matrices, degrees, not finite.
    """
    check_suffix(path, FORMATS, "body parameters")
    return parameters_of(path, _read_keys(path))


def parameters_of(path: Path, found: Mapping[str, np.ndarray]) -> SmplParameters:
    """The parameters that the arrays of a file hold; keys and errors as in `read_parameters`."""
    found = {key: _flat(path, key, array) for key, array in found.items() if key in KEYS}
    whole, root, body = (next((key for key in keys if key in found), None) for keys in (WHOLE, ROOT, BODY))
    turns: dict[str, np.ndarray] = {}
    if whole is None and root is None and body is not None and len(found[body]) in (66, 72):
        whole = body  # SkiRT's body_pose has the root as well
    if whole is not None:
        turns |= _turns(path, whole, found[whole], {3 * count: names for count, names in NAMES.items()})
    elif body is not None:
        turns |= _turns(path, body, found[body], {3 * len(names) - 3: names[1:] for names in (NAMES[22], NAMES[24])})
        if root is not None:
            turns |= _turns(path, root, found[root], {3: NAMES[22][:1]})
    else:
        keys = ", ".join(sorted(found)) or "none of them"
        raise DataError(path, f"expected pose, or global_orient and body_pose, found {keys}.")
    hands: list[np.ndarray] = []
    for names, keys in PARTS.values():
        for key in (key for key in keys if key in found):
            if "hand" in key and len(found[key]) != 3 * len(names):
                hands += np.array_split(found[key], 2) if len(names) == 30 else [found[key]]
            else:
                turns |= _turns(path, key, found[key], {3 * len(names): names})
    counts = [len(hand) for hand in hands]
    if hands and not (len(hands) == 2 and counts[0] == counts[1] <= 45):
        problem = f"expected as many principal components of both, at most 45, got {' and '.join(map(str, counts))}."
        raise DataError(path, f"hands: {problem}")
    pose = np.stack(list(turns.values()))
    if (largest := float(np.linalg.norm(pose, axis=1).max())) > 4 * np.pi:
        raise DataError(path, f"pose: expected radians, got turns of {largest:.0f}.", "Hint: convert degrees first.")
    scale = float(found.get("scale", np.ones(1))[0])
    if not scale > 0:
        raise DataError(path, f"scale: expected a number above 0, got {scale}.")
    inner, outer = (next((found[key] for key in keys if key in found), np.zeros(3)) for keys in (INNER, OUTER))
    if len(inner) != 3 or len(outer) != 3:
        raise DataError(path, f"transl: expected 3 numbers, got {max(len(inner), len(outer))}.")
    betas = next((found[key] for key in BETAS if key in found), np.zeros(0))
    return SmplParameters(tuple(turns), pose, inner + outer / scale, betas, scale, tuple(hands) or None)


def _read_keys(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a file under the known keys."""
    if path.suffix.lower() == ".npz":
        return read_arrays(path, {}, dict.fromkeys(KEYS, "number ..."))
    if path.suffix.lower() == ".pkl":
        return read_pickled_arrays(path, (), KEYS)
    found = {}
    for key, value in read_json(path).items():
        if key in KEYS:
            try:
                found[key] = np.asarray(value, np.float64)
            except (TypeError, ValueError) as error:
                raise DataError(path, f"{key}: expected numbers, got {str(value)[:40]!r}.") from error
    return found


def _flat(path: Path, key: str, array: np.ndarray) -> np.ndarray:
    """The numbers of one frame, float64."""
    if array.dtype.kind not in "fiu":
        raise DataError(path, f"{key}: expected numbers, got {array.dtype}.")
    with naming(path):
        check_finite(key, array)
    if array.shape[-2:] == (3, 3) and key not in INNER + OUTER + BETAS:
        hint = "Hint: scipy.spatial.transform.Rotation.from_matrix(...).as_rotvec() makes axis-angles of them."
        raise DataError(path, f"{key}: expected axis-angles, got rotation matrices {array.shape}.", hint)
    return np.asarray(array, np.float64).reshape(-1)


def _turns(path: Path, key: str, flat: np.ndarray, widths: dict[int, tuple[str, ...]]) -> dict[str, np.ndarray]:
    """Axis-angles by the names of their joints."""
    if len(flat) not in widths:
        expected = " or ".join(map(str, sorted(widths)))
        raise DataError(path, f"{key}: expected {expected} numbers of one frame, got {len(flat)}.")
    return dict(zip(widths[len(flat)], flat.reshape(-1, 3)))
