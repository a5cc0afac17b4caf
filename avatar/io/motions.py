"""Motion files (AMASS npz, BVH, our own npz) as 22 joints in SMPL order, axis-angle, metres, y up; other skeletons."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from avatar.body.model import SMPL_JOINTS, SMPL_PARENTS, BodyModel
from avatar.body.open import MEAN_SHAPE, open_body
from avatar.checks import AvatarError, DataError, check_suffix, plain_name
from avatar.geometry.units import METRES
from avatar.io.amass import read_rate, read_smpl_arrays
from avatar.io.bvh import BvhMotion, read_bvh
from avatar.io.joint_names import INDEX, MAP_HINT, map_joints, read_joint_map
from avatar.io.npz import naming, read_arrays, write_described
from avatar.io.stance import (
    FRAMES,
    Y_FROM,
    check_joint_order,
    check_order,
    check_sides,
    check_travel,
    check_units,
    check_up,
    joint_places,
    settle_up,
)
from avatar.records import Motion

log = logging.getLogger(__name__)

MOTION_FORMAT = "motion/1"
JOINTS = len(SMPL_JOINTS)
MOTION = {"poses": f"float T {JOINTS} 3", "translations": "float T 3", "fps": "number ", "name": "text "}
FRAME_RATES = (1.0, 1000.0)
LIMBS = [
    (INDEX[f"{side}_{joint}"], INDEX[f"{side}_{tip}"])
    for side in ("left", "right")
    for joint, tip in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
]
NEAR_T_POSE = 65.0  # degrees between a limb at rest and in the T-pose; A-poses pass
CALIBRATION_FRAMES = 200
LEG = 0.8  # m from hip to ankle, by which a skeleton's unit is named
ALL = slice(None)
BLENDER = "Import it in Blender (File > Import; an add-on for ASF/AMC) and export as BVH."
PICKLED = "Save its arrays by numpy.savez with the keys poses, trans and mocap_framerate: pickles are not read."
OTHER_ENDINGS = {
    **dict.fromkeys((".asf", ".amc", ".fbx", ".c3d", ".glb", ".gltf", ".dae", ".trc", ".usd", ".abc"), BLENDER),
    **dict.fromkeys((".pkl", ".pickle", ".npy", ".json", ".pt", ".pth"), PICKLED),
}


@dataclass
class MotionConfig:
    """A motion file, and what it does not say itself."""

    motion: Path | None = None  # AMASS .npz, BVH or one of our own: predicted instead of a split, exported as tracks
    up: str | None = None  # y, z, -y, -z: the file's axis that points up; auto: as people stand; its format's if null
    units: str | None = None  # m, cm, mm or in, of the translations of an .npz; metres if null, refused if feet say no
    start: int = 0  # first frame of the file that is taken
    stop: int | None = None  # frame of the file before which to stop; its end if null
    step: int = 1  # every so many frames of the file; not resampled to 30 a second then
    joints: Path | None = None  # YAML of SMPL's joint names to those of a BVH skeleton with other names

    def __post_init__(self):
        check_up(self.up)
        check_units(self.units)
        if self.start < 0 or self.step < 1 or (self.stop is not None and self.stop <= self.start):
            got = f"start={self.start} stop={self.stop} step={self.step}"
            raise AvatarError(f"start, stop, step: expected 0 <= start < stop and step of at least 1, got {got}.")

    def read_motion(self, body: BodyModel, fps: float | None = None) -> Motion:
        """The motion as poses of a body's own joints, see `read_body_motion`."""
        if self.motion is None:
            raise AvatarError("motion: expected a file, got none.")
        frames = slice(self.start, self.stop, self.step)
        return read_body_motion(self.motion, body, fps, self.up, self.units, frames, self.joints)


def read_body_motion(
    path: Path,
    body: BodyModel,
    fps: float | None = None,
    up: str | None = None,
    units: str | None = None,
    frames: slice = ALL,
    joints: Path | None = None,
) -> Motion:
    """A motion file (`read_motion`) as poses of a body's own joints ``(T, J, 3)``.

    BVH skeletons are fitted to the body's proportions; translations of npz files (SMPL's ``trans``) are taken as they
    are. Raises `AvatarError` for a body whose joints have unknown names.
    """
    return move_body(read_motion(path, fps, up, rest_joints(body), units, frames, joints), body)


def read_motion(
    path: Path,
    fps: float | None = None,
    up: str | None = None,
    rest: np.ndarray | None = None,
    units: str | None = None,
    frames: slice = ALL,
    joints: Path | None = None,
) -> Motion:
    """Reads a motion by its file's ending: ``.npz`` (AMASS SMPL, SMPL+H or SMPL-X, or our own) or ``.bvh``.

    AMASS files are z-up and BVH files y-up unless ``up`` says otherwise ("auto": as people stand); all come out y-up.
    The file's ``frames`` are taken, then resampled to ``fps``, at which they are if the file has no rate. BVH skeletons
    are mapped by joint names, or those of a file ``joints`` (`read_joint_map`), and fitted in size to T-pose joints
    ``rest (22, 3)`` (the open body's if None). Raises `DataError` for an invalid file, people who lie down or
    translations that are not in metres or the given ``units``; `AvatarError` for a bad ``up``, ``units`` or ``fps``.
    """
    path = Path(path)
    check_up(up)
    check_units(units)
    if fps is not None:
        check_rate(fps)
    _check_ending(path)
    rest = open_body(MEAN_SHAPE).template.joints.double().numpy() if rest is None else rest
    if path.suffix.lower() == ".bvh":
        if units is not None:
            raise AvatarError(f"units: expected none for {path}, BVH files are scaled by the skeleton's legs.")
        motion = _read_bvh(path, up, rest, joints)
    else:
        if joints is not None:
            raise AvatarError(f"joints: expected none for {path}, .npz files have SMPL's joints.")
        motion = _read_npz(path, up, rest, fps and fps * (frames.step or 1), units)
    motion = _take(motion, path, frames)
    _check_own_rate(path, motion.fps)
    motion = replace(motion, source=path, name=plain_name(motion.name, "motion"))  # frames are files of that name
    return motion if fps is None else resample_motion(motion, fps)


def _check_ending(path: Path) -> None:
    """Refuses other files than .npz and .bvh, with the way to get one from others."""
    if (ending := path.suffix.lower()) in OTHER_ENDINGS:
        raise DataError(path, f"expected a motion file ending in .npz or .bvh, got {ending!r}.", OTHER_ENDINGS[ending])
    check_suffix(path, (".npz", ".bvh"), "a motion file")


def _check_own_rate(path: Path, fps: float) -> None:
    low, high = FRAME_RATES
    if not low <= fps <= high:
        raise DataError(path, f"expected {low:g} to {high:g} frames per second, got {fps:g}.")


def _take(motion: Motion, path: Path, frames: slice) -> Motion:
    """The frames of a motion that a slice names; at least one."""
    count = len(motion.poses)
    if count == 0:
        raise DataError(path, "expected at least one frame, got none.")
    poses, translations = motion.poses[frames], motion.translations[frames]
    if len(poses) == 0:
        raise DataError(path, f"start, stop: expected frames of the {count} there, got {frames.start}:{frames.stop}.")
    return replace(motion, poses=poses, translations=translations, fps=motion.fps / (frames.step or 1))


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


def turn_up(motion: Motion, up: str = "z") -> Motion:
    """A motion turned from another axis to y-up. Bodies stand where they stood, up to a shift of the pelvis."""
    if up == "y":
        return motion
    poses = motion.poses.copy()
    poses[:, 0] = Rotation.from_matrix(Y_FROM[up] @ Rotation.from_rotvec(poses[:, 0]).as_matrix()).as_rotvec()
    return replace(motion, poses=poses, translations=(motion.translations @ Y_FROM[up].T).astype(np.float32))


def _read_npz(path: Path, up: str | None, rest: np.ndarray, fps: float | None, units: str | None) -> Motion:
    """Our own motion, y-up by default, or one of the AMASS family, z-up by default."""
    if "format" in read_arrays(path, {}, {"format": "text "}):
        stored, usual = read_arrays(path, MOTION, version=MOTION_FORMAT), "y"
        motion = Motion(stored["poses"], stored["translations"], float(stored["fps"]), str(stored["name"]))
    else:
        arrays = read_smpl_arrays(path, rest[0])
        motion = Motion(arrays.poses, arrays.translations, read_rate(path, fps), path.stem)
        usual = arrays.usual_up
    _check_own_rate(path, motion.fps)
    if len(motion.poses) == 0:
        return motion
    motion = replace(motion, translations=np.float32(METRES[units or "m"]) * motion.translations)
    places = joint_places(motion.poses[:FRAMES], rest)
    low, high = (places[:, _both(joint)].mean(axis=1) for joint in ("ankle", "shoulder"))
    up = settle_up(path, low, high, up, usual)
    check_joint_order(path, motion.poses[:FRAMES])
    check_order(path, motion.poses[:FRAMES])
    motion = turn_up(motion, up)
    check_travel(path, places @ Y_FROM[up].T, motion.translations[:FRAMES], motion.fps, units)
    return motion


def _both(joint: str) -> list[int]:
    return [INDEX[f"{side}_{joint}"] for side in ("left", "right")]


def _read_bvh(path: Path, up: str | None, rest: np.ndarray, joints: Path | None) -> Motion:
    """A BVH file on our joints, turned y-up."""
    bvh, given = read_bvh(path), read_joint_map(joints)
    with naming(path, MAP_HINT):
        source = map_joints(bvh.names, bvh.parents, given)
    with naming(path):
        low, high = (bvh.positions[:, [source[j] for j in _both(name)]].mean(axis=1) for name in ("ankle", "shoulder"))
        turn = Y_FROM[settle_up(path, low, high, up, "y")]
        moved = {name: getattr(bvh, name) @ turn.T for name in ("offsets", "positions")}
        bvh = replace(bvh, rotations=turn @ bvh.rotations @ turn.T, **moved)
        check_sides(path, bvh.positions, source)
        motion = retarget(bvh, source, path.stem, rest)
        leg = _leg_length(_rest_places(bvh), source)
    unit = min(METRES, key=lambda name: abs(np.log(METRES[name] * leg / LEG)))
    message = (
        "%s: %d joints of %d mapped by name, size fitted to the body's legs: one of %.3g here, which is likely in %s."
    )
    log.info(message, path, len(source), len(bvh.names), leg, unit)
    return motion


def retarget(bvh: BvhMotion, source: dict[int, int], name: str, rest: np.ndarray | None = None) -> Motion:
    """The motion of a y-up skeleton on our 22 joints, ``source`` of which it has (`map_joints`).

    Rotations in the world are kept but for the difference between its rest and the T-pose; where its rest is nothing
    like one (LAFAN), but for the mean between them and the shortest turns of our bones along its own. Joints it lacks
    move with their parents. Translations are scaled by leg lengths, so units do not matter.
    """
    rest = open_body(MEAN_SHAPE).template.joints.double().numpy() if rest is None else rest
    offsets = _rest_places(bvh)
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


def _rest_places(bvh: BvhMotion) -> np.ndarray:
    """Joint positions ``(J, 3)`` at rest, the root at the origin."""
    places = np.zeros_like(bvh.offsets)
    for joint, parent in enumerate(bvh.parents[1:], start=1):
        places[joint] = places[parent] + bvh.offsets[joint]
    return places


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
