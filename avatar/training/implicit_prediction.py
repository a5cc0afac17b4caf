"""Posed surfaces and points from a trained implicit avatar: for the frames of a split or for a motion."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from avatar.checks import AvatarError, check_shape
from avatar.data.open_layout import OpenOutfit
from avatar.data.outfits import Outfit
from avatar.environment import prepared_process
from avatar.implicit.avatar import sample_mesh
from avatar.implicit.extraction import ExtractionConfig
from avatar.io.ledger import Ledger, keyed
from avatar.io.meshes import write_mesh
from avatar.io.points import write_points
from avatar.records import BodyFit, Motion
from avatar.settings import settings_to_dict
from avatar.training.prediction import MAX_POINTS, avatar_digest, pose_digest
from avatar.training.runs import TrainedAvatar


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
    if not 1000 <= points <= MAX_POINTS:
        raise AvatarError(f"points: expected 1,000 to {MAX_POINTS:,}, got {points}.")
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
    for name in tqdm(names, f"predict {outfit.name}", disable=None):
        written.append(clouds / f"{name}.ply")
        made = {"points": points, "surface": settings_to_dict(config), "body": outfit.digest(split, name)}
        key = keyed(avatar=made_by, **made)
        if not done.find(name, key):
            write_frame(avatar, outfit.load(split, name).body, name, clouds, meshes, points, config)
            done.record(name, key, [written[-1], meshes / f"{name}.ply"])
    return written


@prepared_process()
def predict_implicit_motion(
    avatar: TrainedAvatar,
    outfit: OpenOutfit,
    motion: Motion,
    clouds: Path,
    meshes: Path,
    points: int,
    config: ExtractionConfig | None = None,
) -> list[Path]:
    """Writes ``<motion>.<frame>.ply``, points and surfaces, for every frame of a motion; gives those of points."""
    check_outfit(avatar, outfit)
    check_shape("poses", motion.poses, "T J 3", J=len(avatar.template.parents))
    written, done, made_by = [], Ledger(clouds), avatar_digest(avatar)
    for frame in tqdm(range(len(motion.poses)), desc=f"predict {motion.name}", disable=None):
        name = f"{motion.name}.{frame:05d}"
        written.append(clouds / f"{name}.ply")
        made = {"points": points, "surface": settings_to_dict(config), "body": pose_digest(outfit, motion, frame)}
        key = keyed(avatar=made_by, **made)
        if not done.find(name, key):
            body = outfit.fit_pose(motion.poses[frame], motion.translations[frame])
            write_frame(avatar, body, name, clouds, meshes, points, config)
            done.record(name, key, [written[-1], meshes / f"{name}.ply"])
    return written


def check_outfit(avatar: TrainedAvatar, outfit: Outfit) -> None:
    """Refuses an outfit that an avatar was not trained on."""
    if outfit.name not in avatar.config.outfit:
        raise AvatarError(f"outfit: this avatar was trained on {avatar.config.outfit[0]}, not on {outfit.name!r}.")
