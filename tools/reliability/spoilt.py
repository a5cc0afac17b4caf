"""Valid data of a small person, and one fault in it: what is spoilt, what must come of it, the cause to be named."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from avatar.body.model import SMPL_JOINTS, BodyModel
from avatar.data.layouts import find_outfit, open_outfit_folder
from avatar.data.scanner import ScanConfig, scan_mesh
from avatar.io.stance import joint_places
from avatar.simulate.angles import authored_motion

READ, WARNED, REFUSED = "read", "warned", "refused"
CELL = 0.02  # metres: vertices of the body in one cell become one, so that the trial is fast
POINTS = 4_000  # of a scan
FRAME = "train/walk.00000.npz"  # the frame that is spoilt
Arrays = dict[str, np.ndarray]


@dataclass(frozen=True)
class Spoilt:
    """One way to spoil data: ``part`` of it, in ``words``, the ``wanted`` outcome and a pattern of its ``cause``."""

    part: str
    words: str
    wanted: str
    cause: str
    spoil: Callable


@dataclass(frozen=True)
class Result:
    """What came of one: the ``outcome`` and its ``message``, and an error's type where it is none of ours."""

    spoilt: Spoilt
    outcome: str
    message: str
    untyped: str = ""

    @property
    def silent(self) -> bool:
        """Whether it was read without a word although it should not have been."""
        return self.outcome == READ != self.spoilt.wanted

    @property
    def met(self) -> bool:
        """Whether the outcome is the wanted one, with its cause."""
        right = self.outcome == self.spoilt.wanted and not self.untyped
        return right and re.search(self.spoilt.cause, self.message, re.DOTALL) is not None


class Base:
    """A valid outfit of three training and two test frames in memory: ``body``, ``frames`` by path, a ``motion``."""

    def __init__(self, folder: Path):
        sample = find_outfit(Path(), "sample", "tee", ScanConfig(points=POINTS))
        self.body, names = coarse_body(sample.body), {}
        names |= {f"train/walk.{i:05d}.npz": ("train", name) for i, name in enumerate(sample.frames("train")[1:4])}
        names |= {f"test/walk.{i:05d}.npz": ("test", name) for i, name in enumerate(sample.frames("test")[:2], 3)}
        save(folder / "template.npz", self.body)
        own = open_outfit_folder(folder)
        self.frames: dict[str, Arrays] = {}
        for path, place in names.items():
            frame = sample.load(*place)
            fit = own.fit_pose(frame.body.pose, frame.body.translation)
            arrays = {"scan_pc": frame.scan.points, "scan_n": frame.scan.normals, "pose": fit.pose}
            arrays |= {"translation": fit.translation, "body_verts": fit.vertices, "vtransf": fit.vertex_transforms}
            self.frames[path] = arrays
            if path == FRAME:
                self.joints = fit.joint_transforms
                mesh = scan_mesh(sample.load_surface(*place))
                self.mesh = {"scan_pc": mesh.points, "scan_n": mesh.normals, "scan_faces": mesh.faces}
        motion = authored_motion("walk", fps=30, seconds=2.0)
        places = joint_places(motion.poses, self.body["joints"])
        feet = places[:, [SMPL_JOINTS.index(f"{side}_foot") for side in ("left", "right")]]
        lowest = (feet[1:, :, 1] + feet[:-1, :, 1]).argmin(axis=1)
        steps = -np.diff(feet, axis=0)[np.arange(len(lowest)), lowest]  # the foot that stands stays where it is
        travel = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
        poses = np.zeros((len(motion.poses), 52, 3))
        poses[:, : len(SMPL_JOINTS)] = motion.poses
        turn = Rotation.from_euler("x", 90, degrees=True)  # AMASS has z up
        poses[:, 0] = (turn * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
        self.motion = {"poses": poses.reshape(len(poses), -1), "trans": turn.apply(travel)}
        self.motion["mocap_framerate"] = np.array(30.0)

    def copy(self, arrays: Arrays) -> Arrays:
        """The arrays, to be changed."""
        return {key: np.array(value) for key, value in arrays.items()}


def coarse_body(body: BodyModel) -> Arrays:
    """The arrays of a ``template.npz`` in the T-pose: a body with fewer vertices."""
    template = body.with_canonical_pose(torch.zeros_like(body.canonical_pose)).template
    vertices, faces = template.vertices.numpy(), template.faces.numpy()
    _, owners, ids = np.unique(np.floor(vertices / CELL), axis=0, return_index=True, return_inverse=True)
    corners = ids.reshape(-1)[faces]
    corners = corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]
    arrays = {"vertices": vertices[owners], "faces": corners.astype(np.int32)}
    arrays |= {"weights": template.weights.numpy()[owners], "joints": template.joints.numpy()}
    return arrays | {"parents": np.array(template.parents), "joint_names": np.array(template.joint_names)}


def save(path: Path, arrays: Arrays) -> None:
    """Writes an npz as numpy does."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **arrays)


def turn(axis: str, degrees: float) -> np.ndarray:
    """The matrix of a turn about an axis."""
    return Rotation.from_euler(axis, degrees, degrees=True).as_matrix()


def put(key: str, index: int, value: object) -> Callable:
    """One row of an array set to a value."""

    def spoil(frame: Arrays, base: Base) -> Arrays:
        frame[key][index] = value
        return frame

    return spoil


def swapped() -> list[int]:
    """The index of each of SMPL's joints' partner on the other side."""
    names = [n.replace("left", "*").replace("right", "left").replace("*", "right") for n in SMPL_JOINTS]
    return [SMPL_JOINTS.index(name) for name in names]
