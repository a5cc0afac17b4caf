"""Motion files (AMASS npz, BVH, our own npz) as 22 joints in SMPL order, axis-angle, metres, y up; other skeletons'."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from avatar.body.model import SMPL_JOINTS, SMPL_PARENTS, BodyModel
from avatar.body.open import MEAN_SHAPE, open_body
from avatar.checks import AvatarError, DataError, check_suffix, plain_name
from avatar.io.bvh import BvhMotion, read_bvh
from avatar.io.npz import naming, read_arrays, write_described
from avatar.records import Motion

log = logging.getLogger(__name__)

MOTION_FORMAT = "motion/1"
JOINTS = len(SMPL_JOINTS)
MOTION = {"poses": f"float T {JOINTS} 3", "translations": "float T 3", "fps": "number ", "name": "text "}
AMASS = {"poses": "float T P", "root_orient": "float T 3", "pose_body": "float T 63"}
AMASS_RATES = dict.fromkeys(("mocap_framerate", "mocap_frame_rate"), "number | 1")
FRAME_RATES = (1.0, 1000.0)
Y_FROM_Z = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # z up to y up, about x
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
INDEX = {name: index for index, name in enumerate(SMPL_JOINTS)}
LIMBS = [
    (INDEX[f"{side}_{joint}"], INDEX[f"{side}_{tip}"])
    for side in ("left", "right")
    for joint, tip in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
]
NEAR_T_POSE = 65.0  # degrees between a limb at rest and in the T-pose; A-poses pass
CALIBRATION_FRAMES = 200


def read_body_motion(path: Path, body: BodyModel, fps: float | None = None, up: str | None = None) -> Motion:
    """A motion file (`read_motion`) as poses of a body's own joints ``(T, J, 3)``.

    BVH skeletons are fitted to the body's proportions; translations of npz files (SMPL's ``trans``) are taken as they
    are. Raises `AvatarError` for a body whose joints have unknown names.
    """
    return move_body(read_motion(path, fps, up, rest_joints(body)), body)


def read_motion(path: Path, fps: float | None = None, up: str | None = None, rest: np.ndarray | None = None) -> Motion:
    """Reads a motion by its file's ending: ``.npz`` (AMASS SMPL, SMPL+H or SMPL-X, or our own) or ``.bvh``.

    AMASS files are z-up and BVH files y-up unless ``up`` says otherwise; all come out y-up, at ``fps`` if given. BVH
    skeletons are mapped by joint names and fitted in size to T-pose joints ``rest (22, 3)`` (the open body's if None).
    Raises `DataError` for an invalid file or people who lie down; `AvatarError` for a bad ``up`` or ``fps``.
    """
    path = Path(path)
    if up not in (None, "y", "z"):
        raise AvatarError(f"up: expected y, z or nothing, got {up!r}.")
    readers = {".npz": _read_npz, ".bvh": partial(_read_bvh, rest=rest)}
    motion = readers[check_suffix(path, readers, "a motion file")](path, up)
    low, high = FRAME_RATES
    if len(motion.poses) == 0:
        raise DataError(path, "expected at least one frame, got none.")
    if not low <= motion.fps <= high:
        raise DataError(path, f"expected {low:g} to {high:g} frames per second, got {motion.fps:g}.")
    motion = replace(motion, source=path, name=plain_name(motion.name, "motion"))  # frames are files of that name
    return motion if fps is None else resample_motion(motion, fps)


def write_motion(path: Path, motion: Motion) -> None:
    """Writes a motion of 22 joints as our own npz. Raises `AvatarError` on wrong shapes or non-finite numbers."""
    write_described(path, MOTION_FORMAT, MOTION, {key: getattr(motion, key) for key in MOTION})


def check_rate(fps: float) -> None:
    """Raises `AvatarError` for a frame rate outside 1 to 1000, NaN included."""
    low, high = FRAME_RATES
    if not low <= fps <= high:
        raise AvatarError(f"fps: expected {low:g} to {high:g} frames per second, got {fps}.")


def resample_motion(motion: Motion, fps: float) -> Motion:
    """A motion at another frame rate: rotations along the shortest arcs, translations along lines.

    The last frame is the last that lies within the motion. Raises `AvatarError` for a rate outside 1 to 1000.
    """
    check_rate(fps)
    last = len(motion.poses) - 1
    times = np.arange(int(np.floor(last * fps / motion.fps + 1e-6)) + 1) * motion.fps / fps
    before = np.minimum(times.astype(int), max(last - 1, 0))
    after = np.minimum(before + 1, last)
    share = np.clip(times - before, 0, 1)
    start = Rotation.from_rotvec(motion.poses[before].reshape(-1, 3))
    step = (start.inv() * Rotation.from_rotvec(motion.poses[after].reshape(-1, 3))).as_rotvec()
    joints = motion.poses.shape[1]
    poses = (start * Rotation.from_rotvec(step * np.repeat(share, joints)[:, None])).as_rotvec()
    a, b = motion.translations[before], motion.translations[after]
    return replace(
        motion,
        poses=poses.reshape(-1, joints, 3).astype(np.float32),
        translations=(a + (b - a) * share[:, None]).astype(np.float32),
        fps=float(fps),
    )


def turn_up(motion: Motion) -> Motion:
    """A z-up motion turned y-up. The body then stands where it stood, up to a constant shift of its pelvis."""
    root = Y_FROM_Z @ Rotation.from_rotvec(motion.poses[:, 0]).as_matrix()
    poses = motion.poses.copy()
    poses[:, 0] = Rotation.from_matrix(root).as_rotvec()
    return replace(motion, poses=poses, translations=(motion.translations @ Y_FROM_Z.T).astype(np.float32))


def _read_npz(path: Path, up: str | None) -> Motion:
    """Our own motion, y-up by default, or one of the AMASS family, z-up by default."""
    if "format" not in read_arrays(path, {}, {"format": "text "}):
        motion = _read_amass(path)
        return motion if up == "y" else turn_up(motion)
    stored = read_arrays(path, MOTION, version=MOTION_FORMAT)
    motion = Motion(stored["poses"], stored["translations"], float(stored["fps"]), str(stored["name"]))
    return turn_up(motion) if up == "z" else motion


def _read_amass(path: Path) -> Motion:
    """AMASS: ``poses (T, 3 joints)``, or ``root_orient`` and ``pose_body`` of the SMPL-X stage II files."""
    stored = read_arrays(path, {"trans": "float T 3"}, AMASS | AMASS_RATES)
    if "root_orient" in stored and "pose_body" in stored:
        poses = np.concatenate([stored["root_orient"], stored["pose_body"]], axis=1)
    elif "poses" in stored and stored["poses"].shape[1] >= 3 * JOINTS and stored["poses"].shape[1] % 3 == 0:
        poses = stored["poses"][:, : 3 * JOINTS]
    else:
        got = f"poses {stored['poses'].shape}" if "poses" in stored else "neither"
        raise DataError(path, f"expected poses (T, 66 or more), or root_orient and pose_body, got {got}.")
    rates = [stored[key] for key in AMASS_RATES if key in stored]
    if not rates:
        raise DataError(path, f"expected {' or '.join(AMASS_RATES)}, found neither.")
    poses = poses.reshape(len(poses), JOINTS, 3).astype(np.float32)
    largest = float(np.linalg.norm(poses, axis=-1).max(initial=0))
    if largest > 4 * np.pi:
        raise DataError(path, f"poses: expected radians, got turns of {largest:.0f}.", "Convert degrees first.")
    return Motion(poses, stored["trans"].astype(np.float32), float(rates[0].reshape(())), path.stem)


def _read_bvh(path: Path, up: str | None, rest: np.ndarray | None) -> Motion:
    """A BVH file on our joints; refuses people lying along another axis unless the caller says what is up."""
    bvh = read_bvh(path)
    if up == "z":
        moved = {name: getattr(bvh, name) @ Y_FROM_Z.T for name in ("offsets", "positions")}
        bvh = replace(bvh, rotations=Y_FROM_Z @ bvh.rotations @ Y_FROM_Z.T, **moved)
    with naming(path):
        source = map_joints(bvh.names, bvh.parents)
        if up is None:
            _check_upright(path, bvh, source)
        motion = retarget(bvh, source, path.stem, rest)
    log.info("%s: %d joints of %d mapped by name, size fitted to the body's legs.", path, len(source), len(bvh.names))
    return motion


def _check_upright(path: Path, bvh: BvhMotion, source: dict[int, int]) -> None:
    """Refuses a file whose people, on average, stretch along another axis than y."""
    legs = [source[INDEX[f"{side}_ankle"]] for side in ("left", "right")]
    upper = source[INDEX["left_shoulder"]]
    stretch = (bvh.positions[:, upper] - bvh.positions[:, legs].mean(axis=1)).mean(axis=0)
    share = stretch / max(np.linalg.norm(stretch), 1e-12)
    if share[1] < 0.5 and abs(share[2]) > 0.8:
        hint = "Give up=z, or up=y if people really lie down."
        raise DataError(path, "expected people upright along y, they are upright along z.", hint)


def retarget(bvh: BvhMotion, source: dict[int, int], name: str, rest: np.ndarray | None = None) -> Motion:
    """The motion of a y-up skeleton on our 22 joints, ``source`` of which it has (`map_joints`).

    Rotations in the world are kept but for the difference between its rest and the T-pose; where its rest is nothing
    like one (LAFAN), but for the mean between them and the shortest turns of our bones along its own. Joints it lacks
    move with their parents. Translations are scaled by leg lengths, so units do not matter.
    """
    rest = open_body(MEAN_SHAPE).template.joints.double().numpy() if rest is None else rest
    offsets = np.zeros_like(bvh.offsets)  # joint positions at rest, the root at the origin
    for joint, parent in enumerate(bvh.parents[1:], start=1):
        offsets[joint] = offsets[parent] + bvh.offsets[joint]
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

    A joint takes the world rotation of ours that it is named like (`map_joints`); others (fingers, face) stay at rest
    relative to their parents. Raises `AvatarError` for a body whose names are not known.
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
    """Our joint index to a skeleton's, by SMPL's names or other common ones; `AvatarError` names those not found.

    The joints between hips and neck are shared over the spine.
    """
    exact = {INDEX[name]: index for index, name in enumerate(names) if name in INDEX}
    if all(INDEX[joint] in exact for joint in NEEDED):
        return dict(sorted(exact.items()))
    plain = {re.sub(r"[^a-z0-9]", "", name.rpartition(":")[2].lower()): i for i, name in enumerate(names)}
    plain = {re.sub(r"^mixamorig\d*", "", name): index for name, index in plain.items()}
    there = {joint: [plain[name] for name in known if name in plain] for joint, known in NAMES.items()}
    found = {INDEX[joint]: indices[0] for joint, indices in there.items() if indices}
    found.setdefault(0, 0)
    missing = [joint for joint in NEEDED if INDEX[joint] not in found]
    if missing:
        problem = f"found none for {', '.join(missing)} among {', '.join(names[:40])}."
        raise AvatarError(f"joints: expected the names of a SMPL, Mixamo, CMU or LAFAN skeleton, {problem}")
    upper = found.get(INDEX["neck"], found[INDEX["left_shoulder"]])
    chain = []
    while (upper := parents[upper]) > found[0]:
        chain.insert(0, upper)
    chain = [index for index in chain if index not in found.values()]
    spine = {1: ("spine3",), 2: ("spine1", "spine3")}.get(len(chain), ("spine1", "spine2", "spine3"))
    found |= {INDEX[joint]: index for joint, index in zip(reversed(spine), reversed(chain))}
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


def _aligned_rest(source: dict[int, int], rest: np.ndarray, offsets: np.ndarray) -> dict[int, np.ndarray] | None:
    """Rotations ``(3, 3)`` from our T-pose to the skeleton's rest, None where that is nothing like one.

    All joints turn to where it faces, limbs and hands onto its own; where trunk and feet have joints says too little.
    """
    left, right = (offsets[source[INDEX[f"{side}_hip"]]] for side in ("left", "right"))
    across = left - right
    facing = Rotation.from_rotvec([0, np.arctan2(-across[2], across[0]), 0]).as_matrix()
    shoulders = [offsets[source[INDEX[f"{side}_shoulder"]]] for side in ("left", "right")]
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
    """The rotation ``(3, 3)`` nearest to turning our bones onto theirs; bones without length are left out."""
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
    turns, parents = {}, {}  # parents: the nearest joint above that the skeleton has too; -1 for the root
    for joint in source:
        parents[joint] = SMPL_PARENTS[joint]
        while parents[joint] >= 0 and parents[joint] not in source:
            parents[joint] = SMPL_PARENTS[parents[joint]]
    for joint, index in source.items():
        pointing[joint] = above = pointing[parents[joint]]
        children = [child for child in source if parents[child] == joint]
        if children:
            bones = positions[:, [source[child] for child in children]] - positions[:, index : index + 1]
            posed = np.einsum("tij,bj->tbi", above, rest[children] - rest[joint])
            pointing[joint] = np.stack([_align(c, b) for c, b in zip(posed, bones)]) @ above
        between = np.swapaxes(rotations[:, index], 1, 2) @ pointing[joint]
        turns[joint] = bvh.rotations[:, index] @ Rotation.from_matrix(between).mean().as_matrix()
    return turns


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    cosine = a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-12)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def _leg_length(places: np.ndarray, source: dict[int, int]) -> float:
    """Length of the left leg from hip to ankle, over joint positions at rest."""
    hip, knee, ankle = (places[source[INDEX[f"left_{joint}"]]] for joint in ("hip", "knee", "ankle"))
    length = float(np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee))
    if length < 1e-9:
        raise AvatarError("joints: expected a leg with some length, got none.")
    return length
