"""Motions of foreign skeletons moved to the 22 body joints in SMPL order."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from avatar.body.model import SMPL_JOINTS, SMPL_PARENTS, BodyModel
from avatar.body.open import MEAN_SHAPE, open_body
from avatar.checks import AvatarError
from avatar.io.bvh import BvhMotion
from avatar.records import Motion

# Our joint: what Mixamo, CMU and LAFAN skeletons call it, lower case, without prefix, spaces or signs.
NAMES = {
    "pelvis": ("hips", "pelvis", "root"),
    "neck": ("neck",),
    "head": ("head",),
    **{
        ours.format(side=side): tuple(name.format(side=side, s=side[0]) for name in theirs)
        for side in ("left", "right")
        for ours, theirs in {
            "{side}_hip": ("{side}upleg", "{side}thigh", "{s}thigh", "{side}hip"),
            "{side}_knee": ("{side}leg", "{side}shin", "{s}shin", "{side}lowleg", "{side}knee"),
            "{side}_ankle": ("{side}foot", "{s}foot", "{side}ankle"),
            "{side}_foot": ("{side}toebase", "{side}toe", "{s}toe"),
            "{side}_collar": ("{side}shoulder", "{side}collar", "{s}clavicle", "{s}collar"),
            "{side}_shoulder": ("{side}arm", "{side}uparm", "{side}upperarm", "{s}upperarm"),
            "{side}_elbow": ("{side}forearm", "{side}lowarm", "{s}forearm", "{side}elbow"),
            "{side}_wrist": ("{side}hand", "{s}hand", "{side}wrist"),
        }.items()
    },
}
NEEDED = [f"{side}_{joint}" for side in ("left", "right") for joint in ("hip", "knee", "ankle", "shoulder", "elbow")]
LIMBS = [
    (SMPL_JOINTS.index(f"{side}_{joint}"), SMPL_JOINTS.index(f"{side}_{tip}"))
    for side in ("left", "right")
    for joint, tip in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
]
NEAR_T_POSE = 65.0  # degrees between a limb at rest and in the T-pose; A-poses pass
CALIBRATION_FRAMES = 200


def retarget(bvh: BvhMotion, name: str, rest: np.ndarray | None = None) -> Motion:
    """The motion of a y-up skeleton on our 22 joints.

    Joint rotations in the world are kept, after the difference between the skeleton's rest and the T-pose is taken
    off. Where the rest is nothing like a T-pose (LAFAN), that difference is what on average lies between the
    file's rotations and the shortest turns that point our bones along the file's. Joints the skeleton lacks move
    with their parents. Translations are scaled by the ratio of leg lengths, so the file's units do not matter.

    Args:
        bvh: the skeleton and its motion.
        name: of the motion.
        rest: ``(22, 3)`` joint positions in the T-pose of the body that is to move, metres; the open body's if None.

    Raises:
        AvatarError: naming the joints that were not found by any known name.
    """
    source = map_joints(bvh.names, bvh.parents)
    rest = open_body(MEAN_SHAPE).template.joints.double().numpy() if rest is None else rest
    offsets = _rest_positions(bvh)
    aligned = _aligned_rest(source, rest, offsets)
    if aligned is None:
        turns = _calibrated_turns(bvh, source, rest)
    else:
        turns = {joint: bvh.rotations[:, index] @ aligned[joint] for joint, index in source.items()}
    poses = _local_poses(turns, SMPL_PARENTS, len(bvh.positions))
    scale = _leg_length(rest, {j: j for j in source}) / _leg_length(offsets, source)
    translations = scale * bvh.positions[:, source[0]] - rest[0]
    return Motion(poses, translations.astype(np.float32), bvh.fps, name)


def move_body(motion: Motion, body: BodyModel) -> Motion:
    """A motion of our 22 joints as one of a body with other joints, of other names or in another order.

    A joint takes the world rotation of the joint of ours that it is named like (`map_joints`), as both are zero in the
    T-pose; joints like none of ours (fingers, face) stay at rest relative to their parents.

    Raises:
        AvatarError: for a body whose names are not known.
    """
    if body.joint_names == tuple(SMPL_JOINTS) and body.parents == SMPL_PARENTS:
        return motion
    own = Rotation.from_rotvec(motion.poses.reshape(-1, 3)).as_matrix().reshape(*motion.poses.shape, 3)
    for joint, parent in enumerate(SMPL_PARENTS[1:], start=1):
        own[:, joint] = own[:, parent] @ own[:, joint]
    turns = {theirs: own[:, joint] for joint, theirs in map_joints(body.joint_names, body.parents).items()}
    return replace(motion, poses=_local_poses(turns, body.parents, len(motion.poses)))


def rest_joints(body: BodyModel) -> np.ndarray:
    """Where our 22 joints are in a body's T-pose, ``(22, 3)`` metres; those it lacks lie at their parents."""
    theirs, places = map_joints(body.joint_names, body.parents), body.zero_joints.double().cpu().numpy()
    rest = np.zeros((len(SMPL_JOINTS), 3))
    for joint, parent in enumerate(SMPL_PARENTS):
        rest[joint] = places[theirs[joint]] if joint in theirs else rest[parent]
    return rest


def map_joints(names: Sequence[str], parents: Sequence[int]) -> dict[int, int]:
    """Our joint index to a skeleton's, by SMPL's names or other common ones.

    The joints between hips and neck are shared over the spine.

    Raises:
        AvatarError: naming the joints of ours that were not found.
    """
    exact = {SMPL_JOINTS.index(name): index for index, name in enumerate(names) if name in SMPL_JOINTS}
    if all(SMPL_JOINTS.index(joint) in exact for joint in NEEDED):
        return dict(sorted(exact.items()))
    plain = {re.sub(r"[^a-z0-9]", "", name.rpartition(":")[2].lower()): i for i, name in enumerate(names)}
    plain = {re.sub(r"^mixamorig\d*", "", name): index for name, index in plain.items()}
    found = {}
    for joint, known in NAMES.items():
        index = next((plain[name] for name in known if name in plain), None)
        if index is not None:
            found[SMPL_JOINTS.index(joint)] = index
    found.setdefault(0, 0)
    missing = [joint for joint in NEEDED if SMPL_JOINTS.index(joint) not in found]
    if missing:
        raise AvatarError(
            f"joints: expected the names of a SMPL, Mixamo, CMU or LAFAN skeleton, found none for {', '.join(missing)} "
            f"among {', '.join(names[:40])}."
        )
    upper = found.get(SMPL_JOINTS.index("neck"), found[SMPL_JOINTS.index("left_shoulder")])
    chain = []
    while (upper := parents[upper]) > found[0]:
        chain.insert(0, upper)
    chain = [index for index in chain if index not in found.values()]
    spine = {1: ("spine3",), 2: ("spine1", "spine3")}.get(len(chain), ("spine1", "spine2", "spine3"))
    found |= {SMPL_JOINTS.index(joint): index for joint, index in zip(reversed(spine), reversed(chain))}
    return dict(sorted(found.items()))


def _local_poses(turns: dict[int, np.ndarray], parents: Sequence[int], frames: int) -> np.ndarray:
    """Poses ``(T, J, 3)`` of world rotations ``(T, 3, 3)`` by joint; joints without one move with their parents."""
    poses = np.zeros((frames, len(parents), 3), np.float32)
    world = np.zeros((frames, len(parents), 3, 3))
    for joint, parent in enumerate(parents):
        above = world[:, parent] if parent >= 0 else np.broadcast_to(np.eye(3), world[:, 0].shape)
        world[:, joint] = turns.get(joint, above)
        poses[:, joint] = Rotation.from_matrix(np.swapaxes(above, 1, 2) @ world[:, joint]).as_rotvec()
    return poses


def _mapped_parent(joint: int, source: dict[int, int]) -> int:
    """The nearest joint above that the skeleton has too; -1 for the root."""
    parent = SMPL_PARENTS[joint]
    while parent >= 0 and parent not in source:
        parent = SMPL_PARENTS[parent]
    return parent


def _rest_positions(bvh: BvhMotion) -> np.ndarray:
    """Joint positions at rest, the root at the origin."""
    places = np.zeros_like(bvh.offsets)
    for joint, parent in enumerate(bvh.parents[1:], start=1):
        places[joint] = places[parent] + bvh.offsets[joint]
    return places


def _aligned_rest(source: dict[int, int], rest: np.ndarray, offsets: np.ndarray) -> dict[int, np.ndarray] | None:
    """Rotations ``(3, 3)`` from our T-pose to the skeleton's rest, or None where that is nothing like a T-pose.

    All joints turn to where the skeleton faces. Limbs turn further onto its arms and legs, and hands with them;
    other bones do not, because where trunk and feet have their joints differs more than how they are held.
    """
    left, right = (offsets[source[SMPL_JOINTS.index(f"{side}_hip")]] for side in ("left", "right"))
    across = left - right
    facing = Rotation.from_rotvec([0, np.arctan2(-across[2], across[0]), 0]).as_matrix()
    shoulders = [offsets[source[SMPL_JOINTS.index(f"{side}_shoulder")]] for side in ("left", "right")]
    if _angle(np.mean(shoulders, axis=0) - (left + right) / 2, np.array([0.0, 1.0, 0.0])) > NEAR_T_POSE:
        return None
    aligned = dict.fromkeys(source, facing)
    for joint, tip in LIMBS:
        if tip not in source:
            aligned[joint] = aligned[SMPL_PARENTS[joint]]
            continue
        ours, theirs = facing @ (rest[tip] - rest[joint]), offsets[source[tip]] - offsets[source[joint]]
        if _angle(ours, theirs) > NEAR_T_POSE:
            return None
        aligned[joint] = _align(ours[None], theirs[None]) @ facing
        if SMPL_JOINTS[tip].endswith("wrist"):
            aligned[tip] = aligned[joint]
    return aligned


def _align(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """The rotation ``(3, 3)`` from our bones to theirs: the shortest for one bone, the best fit for several.

    Bones without length (joints at one place) say nothing and are left out.
    """
    lengths = np.linalg.norm(theirs, axis=1)
    known = lengths > 1e-6 * max(lengths.max(), 1e-12)
    ours, theirs = (b[known] / np.linalg.norm(b[known], axis=1, keepdims=True) for b in (ours, theirs))
    if len(ours) == 0:
        return np.eye(3)
    return Rotation.align_vectors(theirs, ours)[0].as_matrix()


def _calibrated_turns(bvh: BvhMotion, source: dict[int, int], rest: np.ndarray) -> dict[int, np.ndarray]:
    """World rotations of our joints for a skeleton without a T-pose, from where its joints are."""
    some = np.unique(np.linspace(0, len(bvh.positions) - 1, CALIBRATION_FRAMES).astype(int))
    rotations, positions = bvh.rotations[some], bvh.positions[some]
    pointing: dict[int, np.ndarray] = {-1: np.tile(np.eye(3), (len(some), 1, 1))}
    turns = {}
    for joint, index in source.items():
        pointing[joint] = above = pointing[_mapped_parent(joint, source)]
        children = [child for child in source if _mapped_parent(child, source) == joint]
        if children:
            bones = positions[:, [source[child] for child in children]] - positions[:, index : index + 1]
            posed = np.einsum("tij,bj->tbi", above, rest[children] - rest[joint])
            pointing[joint] = np.stack([_align(c, b) for c, b in zip(posed, bones)]) @ above
        between = np.swapaxes(rotations[:, index], 1, 2) @ pointing[joint]
        turns[joint] = bvh.rotations[:, index] @ Rotation.from_matrix(between).mean().as_matrix()
    return turns


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    """Degrees between two directions."""
    cosine = a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-12)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def _leg_length(places: np.ndarray, source: dict[int, int]) -> float:
    """Length of the left leg from hip to ankle, over joint positions at rest."""
    hip, knee, ankle = (places[source[SMPL_JOINTS.index(f"left_{joint}")]] for joint in ("hip", "knee", "ankle"))
    length = float(np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee))
    if length < 1e-9:
        raise AvatarError("joints: expected a leg with some length, got none.")
    return length
