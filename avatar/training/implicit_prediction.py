"""Posed surfaces and points from a trained implicit avatar: for the frames of a split or for a motion."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from avatar.checks import AvatarError, check_shape
from avatar.data.outfits import Outfit
from avatar.environment import prepared_process
from avatar.implicit.avatar import sample_mesh
from avatar.implicit.extraction import ExtractionConfig
from avatar.io.ledger import Ledger, keyed
from avatar.io.meshes import write_mesh
from avatar.io.points import write_points
from avatar.progress import tracked
from avatar.records import BodyFit, Motion
from avatar.settings import settings_to_dict
from avatar.training.prediction import avatar_digest, check_count, pose_digest
from avatar.training.runs import TrainedAvatar

SOURCE = ("avatar.training.implicit_prediction",)  # what makes predictions, the fields and readers of data included


def write_frame(
    avatar: TrainedAvatar,
    body: BodyFit,
    name: str,
    clouds: Path,
    meshes: Path,
    points: int,
    config: ExtractionConfig | None = None,
) -> Path:
    """Writes ``<clouds>/<name>.ply``, points spread over the posed surface, and the surface ``<meshes>/<name>.ply``.

    Raises:
        AvatarError: for a count of points out of 1,000 to 400,000, or when the field has no surface.
    """
    check_count(points)
    joint_transforms = torch.from_numpy(np.asarray(body.joint_transforms, np.float32))
    mesh = avatar.model.posed_mesh(joint_transforms, config)
    write_mesh(meshes / f"{name}.ply", mesh)
    write_points(clouds / f"{name}.ply", sample_mesh(mesh, points))
    return clouds / f"{name}.ply"


@prepared_process()
def predict_implicit_frames(
    avatar: TrainedAvatar,
    outfit: Outfit,
    split: str,
    clouds: Path,
    meshes: Path,
    points: int,
    keep: Callable[[str], bool] = bool,
    config: ExtractionConfig | None = None,
) -> list[Path]:
    """Writes points and surfaces for the frames of a split; gives the files of points in order.

    Args:
        avatar: a trained avatar.
        outfit: the outfit it was trained on.
        split: train or test.
        clouds: where ``<frame>.ply`` with points and normals go.
        meshes: where ``<frame>.ply`` with the posed surfaces go.
        points: points a frame, 1,000 to 400,000.
        keep: which frames, by name; all of them by default.
        config: resolution of the surface.
    """
    check_outfit(avatar, outfit)
    names = [name for name in outfit.frames(split) if keep(name)]
    written, done, made_by = [], Ledger(clouds), avatar_digest(avatar)
    for name in tracked(names, f"predict {outfit.name}"):
        written.append(clouds / f"{name}.ply")
        made = {"points": points, "surface": settings_to_dict(config), "body": outfit.digest(split, name)}
        key = keyed(SOURCE, avatar=made_by, **made)
        if not done.find(name, key):
            write_frame(avatar, outfit.load(split, name).body, name, clouds, meshes, points, config)
            done.record(name, key, [written[-1], meshes / f"{name}.ply"])
    return written


@prepared_process()
def predict_implicit_motion(
    avatar: TrainedAvatar,
    outfit: Outfit,
    motion: Motion,
    clouds: Path,
    meshes: Path,
    points: int,
    config: ExtractionConfig | None = None,
) -> list[Path]:
    """Writes ``<motion>.<frame>.ply``, points and surfaces, for every frame of a motion; gives those of points."""
    check_outfit(avatar, outfit)
    check_shape("poses", motion.poses, "T J 3", J=len(outfit.posable_body().parents))
    written, done, made_by = [], Ledger(clouds), avatar_digest(avatar)
    for frame in tracked(range(len(motion.poses)), f"predict {motion.name}"):
        name = f"{motion.name}.{frame:05d}"
        written.append(clouds / f"{name}.ply")
        made = {"points": points, "surface": settings_to_dict(config), "body": pose_digest(outfit, motion, frame)}
        key = keyed(SOURCE, avatar=made_by, **made)
        if not done.find(name, key):
            body = outfit.fit_pose(motion.poses[frame], motion.translations[frame])
            write_frame(avatar, body, name, clouds, meshes, points, config)
            done.record(name, key, [written[-1], meshes / f"{name}.ply"])
    return written


def check_outfit(avatar: TrainedAvatar, outfit: Outfit) -> None:
    """Refuses an outfit that an avatar was not trained on."""
    if outfit.name not in avatar.config.outfit:
        raise AvatarError(f"outfit: this avatar was trained on {avatar.config.outfit[0]}, not on {outfit.name!r}.")
