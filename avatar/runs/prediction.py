"""Predictions of a trained avatar on disk: points, and meshes where the method has them, of a split or a motion."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from avatar.checks import check_shape
from avatar.data.outfits import Outfit
from avatar.environment import prepared_process
from avatar.implicit.extraction import ExtractionConfig
from avatar.io.ledger import Ledger, digest_of, keyed
from avatar.io.meshes import write_mesh
from avatar.io.points import write_points
from avatar.methods.base import TrainedAvatar
from avatar.progress import tracked
from avatar.records import BodyFit, Motion
from avatar.settings import settings_to_dict

SOURCE = ("avatar.runs.prediction",)  # what makes predictions, beside the method's own module


@dataclass(frozen=True)
class Pose:
    """One frame to predict: its name, a function that makes its body, and a hash of all that the body depends on."""

    name: str
    body: Callable[[], BodyFit]
    digest: str


@prepared_process()
def predict_frames(
    avatar: TrainedAvatar,
    outfit: Outfit,
    frames: str | Motion,
    folder: Path,
    meshes: Path,
    points: int,
    surface: ExtractionConfig | None = None,
) -> list[Path]:
    """Writes ``<folder>/<frame>.ply`` for all frames of a split, or of a motion; gives the files in order.

    ``outfit`` is one of those the avatar was trained on, ``points`` a frame are 1,000 to 400,000; those of a point
    method keep their order over time. A method with a surface, of the resolution ``surface``, writes that to
    ``<meshes>/<frame>.ply``. Predictions of the same avatar and bodies whose hashes are still right stay.
    """
    surface = surface or ExtractionConfig()
    dress = avatar.method.predictor(avatar, outfit.name, points, surface)
    made = {"avatar": avatar_digest(avatar), **avatar.method.prediction_settings(points, surface)}
    source = (*SOURCE, *avatar.method.sources)
    poses = motion_poses(outfit, frames) if isinstance(frames, Motion) else split_poses(outfit, frames)
    written, done = [], Ledger(folder)
    for pose in tracked(poses, f"predict {outfit.name}"):
        path, key = folder / f"{pose.name}.ply", keyed(source, **made, body=pose.digest)
        written.append(path)
        if done.find(pose.name, key):
            continue
        dressed, files = dress(pose.body()), [path]
        if dressed.mesh is not None:
            files.append(meshes / f"{pose.name}.ply")
            write_mesh(files[-1], dressed.mesh)
        write_points(path, dressed.cloud)
        done.record(pose.name, key, files)
    return written


def split_poses(outfit: Outfit, split: str) -> list[Pose]:
    """The poses of a split's frames."""
    return [
        Pose(name, lambda name=name: outfit.load(split, name).body, outfit.digest(split, name))
        for name in outfit.frames(split)
    ]


def motion_poses(outfit: Outfit, motion: Motion) -> list[Pose]:
    """The poses of a motion's frames, which are named ``<motion>.<frame>``."""
    dims = check_shape("poses", motion.poses, "T J 3", J=len(outfit.posable_body().parents))
    check_shape("translations", motion.translations, "T 3", T=dims["T"])
    return [
        Pose(
            f"{motion.name}.{frame:05d}",
            lambda pose=pose, translation=translation: outfit.fit_pose(pose, translation),
            digest_of([pose.tolist(), translation.tolist(), outfit.shared_digest]),
        )
        for frame, (pose, translation) in enumerate(zip(motion.poses, motion.translations))
    ]


def avatar_digest(avatar: TrainedAvatar) -> str:
    """One hash over all that a trained avatar's predictions depend on: weights, template and settings."""
    total = hashlib.sha256(digest_of(settings_to_dict(avatar.config.method)).encode())
    for name, value in avatar.model.state_dict().items():
        total.update(f"{name} {tuple(value.shape)}".encode() + value.detach().cpu().contiguous().numpy().tobytes())
    return total.hexdigest()
