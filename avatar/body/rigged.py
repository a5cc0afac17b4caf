"""Bodies from rigged glTF files: any character with a skeleton of a person, on the joints of SMPL's names."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from avatar.body.model import SMPL_JOINTS, BodyModel
from avatar.body.open import number_corners, t_pose_from_bind
from avatar.body.packed import data_errors, template_of
from avatar.checks import AvatarError, DataError
from avatar.geometry.units import METRES, PERSON, possible_units
from avatar.io.joint_names import map_joints
from avatar.io.npz import naming
from avatar.io.rigs import Rig, read_rig
from avatar.records import Template

RIGID = 1e-3  # by which the entries of a joint's rotation may differ from one
SIDEWAYS = 15.0  # degrees from sideways up to which a skeleton's arms are those of a T-pose
ALONG = 0.9  # cosine to an axis of the file's from which on a person stands or faces along it
TINY = 1e-12  # volume that a unit cube is scaled to
NAMES_HINT = "Hint: rename its joints as Mixamo's, or as SMPL's (left_elbow), before it is exported."
log = logging.getLogger(__name__)


def rigged_body(path: Path) -> BodyModel:
    """The body of a skinned mesh in a GLB or glTF file: metres, y up, facing +z, float32.

    Its joints become those of SMPL's names that the skeleton has (`map_joints`); weights of others, such as fingers and
    twist bones, go to the nearest joint above. The pose that joints are stored in is the T-pose if the arms are within
    15 degrees of sideways; arms of an A-pose are stretched into it (`t_pose_from_bind`). A file whose height is no
    person's in metres is scaled if one other unit makes it so. Vertices keep the file's order; those that were split at
    texture seams are joined. Raises `DataError` naming the file: no skinned mesh, unknown joint names, scaled joints,
    a person who stands or faces along no axis, a height of no person.
    """
    path = Path(path)
    rig = read_rig(path)
    with naming(path, NAMES_HINT):
        joints = _own_joints(rig)
    with data_errors(path):
        return _body_of(path, rig, joints)


def _own_joints(rig: Rig) -> dict[str, int]:
    """The rig's joints by our names, in our order."""
    found = {SMPL_JOINTS[ours]: theirs for ours, theirs in map_joints(rig.names, rig.parents).items()}
    needed = [f"{side}_{joint}" for side in ("left", "right") for joint in ("shoulder", "elbow", "wrist")]
    if missing := [name for name in needed if name not in found]:
        raise AvatarError(f"joints: expected {', '.join(missing)}, found none among {', '.join(rig.names[:40])}.")
    if len(set(found.values())) < len(found):
        raise AvatarError("joints: expected a joint for each of SMPL's names, got one for two of them.")
    return found


def _body_of(path: Path, rig: Rig, joints: dict[str, int]) -> BodyModel:
    chosen = list(joints.values())
    places, motions = rig.places[chosen], rig.scene_from_bound[chosen]
    bound = motions[0]  # the pose in which weights were painted, as the root lies in the scene
    if not abs(np.linalg.det(bound[:3, :3])) > TINY:
        raise DataError(path, "expected a mesh with volume, got one that its skeleton flattens.")
    rest_from_bind = motions @ np.linalg.inv(bound)
    linear, rotations = rest_from_bind[:, :3, :3], _nearest_rotations(rest_from_bind[:, :3, :3])
    if not np.abs(linear - rotations).max() < RIGID:
        hint = "Hint: apply all transforms to armature and mesh before exporting."
        raise DataError(path, "expected joints that turn and move, got some with a scale.", hint)
    rest_from_bind[:, :3, :3] = rotations
    turn = _turn_upright(path, dict(zip(joints, places)))
    vertices = rig.vertices @ bound[:3, :3].T + bound[:3, 3]
    scale = _metres(path, float(np.ptp(vertices @ turn[1])))
    rest_from_bind[:, :3, :3] = turn @ rotations @ turn.T
    rest_from_bind[:, :3, 3] = scale * rest_from_bind[:, :3, 3] @ turn.T
    places, vertices = (scale * points @ turn.T for points in (places, vertices))
    owners = [_nearest_owner(joint, rig.parents, chosen) for joint in range(len(rig.names))]
    mirrored = np.linalg.det(bound[:3, :3]) < 0  # glTF 2.0, 3.7.4: turns the winding round
    weights = np.zeros((len(vertices), len(chosen)))
    np.add.at(weights.T, owners, rig.weights.T)
    above = [-1, *(_nearest_owner(rig.parents[joint], rig.parents, chosen) for joint in chosen[1:])]
    uv, uv_faces = (None, None) if rig.uv is None else number_corners(rig.faces, rig.uv_faces, rig.uv)
    step = -1 if mirrored else 1
    at_rest = template_of(
        above,
        joints,
        vertices=vertices,
        faces=rig.faces[:, ::step],
        weights=weights / weights.sum(axis=1, keepdims=True),
        joints=places,
        uv=uv,
        uv_faces=None if uv_faces is None else uv_faces[:, ::step],
    )
    rest = torch.from_numpy(rest_from_bind)
    bind_joints = np.einsum("jba,jb->ja", rest_from_bind[:, :3, :3], places - rest_from_bind[:, :3, 3])
    zero_from_bind = (_zero_from_rest(at_rest) @ rest).float()
    log.info("%s: %d joints of %d are used, %d vertices.", path, len(chosen), len(rig.names), len(vertices))
    return BodyModel(replace(at_rest, joints=torch.from_numpy(bind_joints).float()), zero_from_bind)


def _nearest_rotations(linear: np.ndarray) -> np.ndarray:
    """The rotations ``(J, 3, 3)`` nearest to linear maps ``(J, 3, 3)``."""
    left, _, right = np.linalg.svd(linear)
    left[:, :, -1] *= np.sign(np.linalg.det(left @ right))[:, None]
    return left @ right


def _turn_upright(path: Path, places: dict[str, np.ndarray]) -> np.ndarray:
    """The rotation ``(3, 3)`` by right angles that makes a person stand along y and face +z, from joints at rest."""
    left, right = ((places[f"{side}_hip"], places[f"{side}_shoulder"]) for side in ("left", "right"))
    up = (left[1] + right[1] - left[0] - right[0]) / 2
    across = left[0] + left[1] - right[0] - right[1]
    rows = np.zeros((3, 3))
    for row, direction, what in ((1, up, "stands"), (0, across, "is wide")):
        unit = direction / max(float(np.linalg.norm(direction)), 1e-12)
        axis = int(np.abs(unit).argmax())
        rows[row, axis] = np.sign(unit[axis])
        if abs(unit[axis]) < ALONG:
            problem = f"expected a person who {what} along an axis, got {np.round(unit, 2).tolist()} at rest."
            raise DataError(path, problem, "Hint: turn it before exporting.")
    rows[2] = np.cross(rows[0], rows[1])
    return rows


def _metres(path: Path, height: float) -> float:
    """Metres a unit of a file in which a person is so tall; glTF's own unit is the metre."""
    if PERSON[0] <= height <= PERSON[1]:
        return 1.0
    units = possible_units(height)
    if len(units) != 1:
        found = " or ".join(f"{height * METRES[unit]:.2f} m in {unit}" for unit in units) or "a person's in no unit"
        raise DataError(path, f"expected a person in metres, got a height of {height:.4g}: {found}.", "Hint: scale it.")
    log.warning("%s: height %.4g, which is taken for %s: scaled to metres.", path, height, units[0])
    return METRES[units[0]]


def _nearest_owner(joint: int, parents: tuple[int, ...], chosen: list[int]) -> int:
    """The place among the chosen joints of a joint or the nearest one above it; the root's where there is none."""
    while joint >= 0:
        if joint in chosen:
            return chosen.index(joint)
        joint = parents[joint]
    return 0


def _zero_from_rest(at_rest: Template) -> torch.Tensor:
    """Motions ``(J, 4, 4)`` float64 from the pose that joints are stored in to the T-pose."""
    places, names = at_rest.joints.double(), at_rest.joint_names
    angles = []
    for side, outward in (("left", 1.0), ("right", -1.0)):
        shoulder, elbow, wrist = (places[names.index(f"{side}_{joint}")] for joint in ("shoulder", "elbow", "wrist"))
        for bone in (elbow - shoulder, wrist - elbow):
            cosine = outward * float(bone[0] / bone.norm().clamp(min=1e-12))
            angles.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    if max(angles) <= SIDEWAYS:
        return torch.eye(4, dtype=torch.float64).expand(len(names), 4, 4)
    return t_pose_from_bind(replace(at_rest, joints=places))
