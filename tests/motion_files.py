"""Motion files of other programs, written from motions of ours."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from avatar.body.model import SMPL_JOINTS, SMPL_PARENTS
from avatar.body.open import open_body
from avatar.io.stance import joint_places
from avatar.records import Motion
from avatar.simulate.angles import authored_motion

Z_FROM_Y = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
LEFT_RIGHT = {
    "hip": "UpLeg",
    "knee": "Leg",
    "ankle": "Foot",
    "foot": "ToeBase",
    "collar": "Shoulder",
    "shoulder": "Arm",
    "elbow": "ForeArm",
    "wrist": "Hand",
}
MIXAMO = {"pelvis": "Hips", "spine1": "Spine", "spine2": "Spine1", "spine3": "Spine2", "neck": "Neck", "head": "Head"}
MIXAMO |= {f"{s}_{ours}": f"{s.title()}{theirs}" for s in ("left", "right") for ours, theirs in LEFT_RIGHT.items()}


def write_bvh(
    path, motion, frames=None, scale=100.0, prefix="mixamorig:", order="ZXY", basis=None, names=None, rest=None
):
    """A BVH file of a motion on the open body's skeleton.

    ``frames (J, 3, 3)`` turns each joint's own frame at rest (LAFAN has such); ``basis`` turns the whole world;
    ``rest (J, 3)`` are other joint positions.
    """
    rest = open_body("mean").template.joints.double().numpy() if rest is None else rest
    frames = np.tile(np.eye(3), (22, 1, 1)) if frames is None else frames
    basis = np.eye(3) if basis is None else basis
    names = MIXAMO if names is None else names
    count = len(motion.poses)
    world = np.zeros((count, 22, 3, 3))
    for joint, parent in enumerate(SMPL_PARENTS):
        own = Rotation.from_rotvec(motion.poses[:, joint]).as_matrix()
        world[:, joint] = own if parent < 0 else world[:, parent] @ own
    world = basis @ world @ basis.T @ frames
    lines, columns = ["HIERARCHY"], []

    def put(joint, depth):
        parent, tab = SMPL_PARENTS[joint], "  " * depth
        offset = np.zeros(3) if parent < 0 else frames[parent].T @ basis @ (rest[joint] - rest[parent])
        lines.extend([f"{tab}{'ROOT' if parent < 0 else 'JOINT'} {prefix}{names[SMPL_JOINTS[joint]]}", f"{tab}{{"])
        lines.append(f"{tab}OFFSET {' '.join(str(float(v * scale)) for v in offset)}")
        spin = " ".join(f"{axis}rotation" for axis in order)
        lines.append(f"{tab}CHANNELS " + (f"6 Xposition Yposition Zposition {spin}" if parent < 0 else f"3 {spin}"))
        if parent < 0:
            columns.append((motion.translations + rest[0]) @ basis.T * scale)
        local = world[:, joint] if parent < 0 else np.swapaxes(world[:, parent], 1, 2) @ world[:, joint]
        columns.append(Rotation.from_matrix(local).as_euler(order, degrees=True))
        children = [c for c, p in enumerate(SMPL_PARENTS) if p == joint]
        for child in children:
            put(child, depth + 1)
        if not children:
            lines.extend([f"{tab}End Site", f"{tab}{{", f"{tab}OFFSET 0 1 0", f"{tab}}}"])
        lines.append(f"{tab}}}")

    put(0, 0)
    lines += ["MOTION", f"Frames: {count}", f"Frame Time: {1 / motion.fps:.8f}"]
    lines += [" ".join(f"{value:.9f}" for value in row) for row in np.concatenate(columns, axis=1)]
    path.write_text("\n".join(lines) + "\n")
    return path


def smpl_arrays(motion: Motion, basis: np.ndarray = Z_FROM_Y) -> dict[str, np.ndarray]:
    """A y-up motion in a world turned by ``basis``: ``root (T, 3)``, ``body (T, 63)`` and ``trans (T, 3)``."""
    root = Rotation.from_matrix(basis @ Rotation.from_rotvec(motion.poses[:, 0]).as_matrix()).as_rotvec()
    body = motion.poses[:, 1:].reshape(len(root), 63).astype(np.float64)
    return {"root": root, "body": body, "trans": motion.translations @ basis.T}


def planted(motion: Motion, noise: float = 0.0) -> Motion:
    """A motion that travels as its feet say: the lower of them stands still; ``noise`` metres a frame."""
    rest = open_body("mean").template.joints.double().numpy()
    feet = joint_places(motion.poses, rest)[:, [7, 8, 10, 11]]
    lowest = (feet[1:, :, 1] + feet[:-1, :, 1]).argmin(axis=1)
    steps = -np.diff(feet, axis=0)[np.arange(len(lowest)), lowest]
    travel = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    travel += np.random.default_rng(0).normal(0, noise, travel.shape)
    return Motion(motion.poses, travel.astype(np.float32), motion.fps, motion.name)


def write_amass(path: Path, motion: Motion, extra: int = 90) -> Path:
    """An AMASS file of a y-up motion: z up, ``extra`` numbers for the hands, objects that nobody must touch."""
    poses = motion.poses.astype(np.float64).copy()
    poses[:, 0] = Rotation.from_matrix(Z_FROM_Y @ Rotation.from_rotvec(poses[:, 0]).as_matrix()).as_rotvec()
    flat = np.concatenate([poses.reshape(len(poses), 66), np.full((len(poses), extra), 0.3)], axis=1)
    arrays = {"poses": flat, "trans": motion.translations @ Z_FROM_Y.T, "mocap_framerate": np.array(motion.fps)}
    np.savez(path, gender=np.array("female"), labels=np.array([{"marker": 1}], dtype=object), **arrays)
    return path


def travelling_walk(seconds: float, ahead: float) -> Motion:
    """The authored walk at 30 frames a second, with a pelvis that goes ``ahead`` metres, aside and up a little."""
    motion = authored_motion("walk", fps=30, seconds=seconds)
    travel = np.linspace(0, 1, len(motion.poses))[:, None] * [0.1, 0.02, ahead]
    return Motion(motion.poses, travel.astype(np.float32), 30.0, "walk")


def assert_same_poses(found: np.ndarray, expected: np.ndarray, degrees: float = 0.01) -> None:
    """Axis-angles of the same rotations but for an angle."""
    turned = Rotation.from_rotvec(found.reshape(-1, 3)).inv() * Rotation.from_rotvec(expected.reshape(-1, 3))
    assert np.degrees(turned.magnitude()).max() < degrees
