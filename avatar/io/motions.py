"""Motion files (AMASS npz, BVH, our own npz) as 22 joints in axis-angle, metres, y up."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from avatar.body.model import SMPL_JOINTS, BodyModel
from avatar.checks import AvatarError, DataError, check_finite, check_shape, check_suffix, plain_name
from avatar.io.bvh import BvhMotion, read_bvh
from avatar.io.npz import read_arrays, write_arrays
from avatar.io.retargeting import map_joints, move_body, rest_joints, retarget
from avatar.records import Motion

log = logging.getLogger(__name__)

MOTION_FORMAT = "motion/1"
FRAME_RATES = (1.0, 1000.0)
Y_FROM_Z = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # z up to y up, about x
JOINTS = len(SMPL_JOINTS)


def read_body_motion(path: Path, body: BodyModel, fps: float | None = None, up: str | None = None) -> Motion:
    """A motion file (`read_motion`) as poses of a body's own joints ``(T, J, 3)``.

    BVH skeletons are fitted to the body's own proportions. AMASS translations are SMPL's ``trans`` and are given to
    the body as they are, as are those of our own files.

    Raises:
        DataError: as `read_motion`.
        AvatarError: for a body whose joints have names that are not known.
    """
    return move_body(read_motion(path, fps, up, rest_joints(body)), body)


def read_motion(path: Path, fps: float | None = None, up: str | None = None, rest: np.ndarray | None = None) -> Motion:
    """Reads a motion by its file's ending: ``.npz`` (AMASS SMPL, SMPL+H or SMPL-X, or our own) or ``.bvh``.

    AMASS files are z-up and BVH files y-up unless ``up`` says otherwise; all come out y-up. BVH skeletons are
    mapped by joint names (Mixamo, CMU, LAFAN) and their size is fitted to ours, so their units do not matter.

    Args:
        path: the file.
        fps: frames per second to resample to; the file's own if None.
        up: ``y`` or ``z``, the axis that points up in the file; the format's own if None.
        rest: ``(22, 3)`` joints in the T-pose of the body that a BVH skeleton is fitted to; the open body's if None.

    Raises:
        DataError: for a missing or damaged file, one without a body's motion, or one whose people lie down because
            its up axis is another.
        AvatarError: for an ``up`` other than y and z, or a bad ``fps``.
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
    """Writes a motion as our own npz: ``poses (T, J, 3)``, ``translations (T, 3)``, ``fps``, ``name``.

    Raises:
        AvatarError: on wrong shapes or non-finite numbers.
    """
    dims = check_shape("poses", motion.poses, "T J 3")
    check_shape("translations", motion.translations, "T 3", T=dims["T"])
    for name in ("poses", "translations"):
        check_finite(name, getattr(motion, name))
    arrays = {
        "format": np.array(MOTION_FORMAT),
        "poses": np.asarray(motion.poses, np.float32),
        "translations": np.asarray(motion.translations, np.float32),
        "fps": np.array(motion.fps, np.float64),
        "name": np.array(motion.name),
    }
    write_arrays(path, arrays)


def resample_motion(motion: Motion, fps: float) -> Motion:
    """A motion at another frame rate: rotations along the shortest arcs, translations along lines.

    The first frame stays; the last is the last one that lies within the motion.

    Raises:
        AvatarError: for a frame rate outside 1 to 1000.
    """
    low, high = FRAME_RATES
    if not low <= fps <= high:
        raise AvatarError(f"fps: expected {low:g} to {high:g} frames per second, got {fps}.")
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
    """Our own motion or one of the AMASS family."""
    if "format" in read_arrays(path, {}, {"format": "text "}):
        keys = {"poses": f"float T {JOINTS} 3", "translations": "float T 3", "fps": "number ", "name": "text "}
        stored = read_arrays(path, keys, version=MOTION_FORMAT)
        motion = Motion(stored["poses"], stored["translations"], float(stored["fps"]), str(stored["name"]))
        return turn_up(motion) if up == "z" else motion
    motion = _read_amass(path)
    return motion if up == "y" else turn_up(motion)


def _read_amass(path: Path) -> Motion:
    """AMASS: ``poses (T, 3 joints)``, or ``root_orient`` and ``pose_body`` of the SMPL-X stage II files."""
    poses = {"poses": "float T P", "root_orient": "float T 3", "pose_body": "float T 63"}
    optional = poses | dict.fromkeys(("mocap_framerate", "mocap_frame_rate"), "number | 1")
    stored = read_arrays(path, {"trans": "float T 3"}, optional)
    if "root_orient" in stored and "pose_body" in stored:
        poses = np.concatenate([stored["root_orient"], stored["pose_body"]], axis=1)
    elif "poses" in stored and stored["poses"].shape[1] >= 3 * JOINTS and stored["poses"].shape[1] % 3 == 0:
        poses = stored["poses"][:, : 3 * JOINTS]
    else:
        got = f"poses {stored['poses'].shape}" if "poses" in stored else "neither"
        raise DataError(path, f"expected poses (T, 66 or more), or root_orient and pose_body, got {got}.")
    rates = [stored[key] for key in ("mocap_framerate", "mocap_frame_rate") if key in stored]
    if not rates:
        raise DataError(path, "expected mocap_framerate or mocap_frame_rate, found neither.")
    poses = poses.reshape(len(poses), JOINTS, 3).astype(np.float32)
    largest = float(np.linalg.norm(poses, axis=-1).max(initial=0))
    if largest > 4 * np.pi:
        raise DataError(path, f"poses: expected radians, got turns of {largest:.0f}.", "Convert degrees first.")
    return Motion(poses, stored["trans"].astype(np.float32), float(rates[0].reshape(())), path.stem)


def _read_bvh(path: Path, up: str | None, rest: np.ndarray | None) -> Motion:
    """A BVH file on our joints; refuses people lying along another axis unless the caller says what is up."""
    bvh = read_bvh(path)
    try:
        if up == "z":
            bvh = replace(
                bvh,
                offsets=bvh.offsets @ Y_FROM_Z.T,
                rotations=Y_FROM_Z @ bvh.rotations @ Y_FROM_Z.T,
                positions=bvh.positions @ Y_FROM_Z.T,
            )
        elif up is None:
            _check_upright(path, bvh)
        motion = retarget(bvh, path.stem, rest)
    except DataError:
        raise
    except AvatarError as error:
        raise DataError(path, str(error)) from error
    mapped = len(map_joints(bvh.names, bvh.parents))
    log.info("%s: %d joints of %d mapped by name, size fitted to the body's legs.", path, mapped, len(bvh.names))
    return motion


def _check_upright(path: Path, bvh: BvhMotion) -> None:
    """Refuses a file whose people, on average, stretch along another axis than y."""
    source = map_joints(bvh.names, bvh.parents)
    legs = [source[SMPL_JOINTS.index(f"{side}_ankle")] for side in ("left", "right")]
    upper = source[SMPL_JOINTS.index("left_shoulder")]
    stretch = (bvh.positions[:, upper] - bvh.positions[:, legs].mean(axis=1)).mean(axis=0)
    share = stretch / max(np.linalg.norm(stretch), 1e-12)
    if share[1] < 0.5 and abs(share[2]) > 0.8:
        hint = "Give up=z, or up=y if people really lie down."
        raise DataError(path, "expected people upright along y, they are upright along z.", hint)
