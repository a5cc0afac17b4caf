"""Posed point clouds from a trained avatar: for the frames of a split or for a motion."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from avatar.checks import AvatarError, check_shape
from avatar.data.outfits import Outfit
from avatar.environment import prepared_process
from avatar.geometry.chunks import UNIT, in_chunks
from avatar.io.ledger import Ledger, digest_of, keyed
from avatar.io.points import write_points
from avatar.nn.methods import draw_samples
from avatar.progress import tracked
from avatar.records import Batch, BodyFit, Motion, PointCloud, Prediction, SurfaceSamples
from avatar.settings import settings_to_dict
from avatar.training.runs import TrainedAvatar

SOURCE = ("avatar.training.prediction",)  # what makes predictions, networks and readers of data included
MAX_POINTS = 400_000
CHUNK = 100_000  # points decoded at once, or fewer where memory runs out; the network is pointwise


def check_count(points: int) -> None:
    """Refuses a number of points that no frame is predicted with.

    Raises:
        AvatarError: for a count out of 1,000 to 400,000.
    """
    if not 1000 <= points <= MAX_POINTS:
        raise AvatarError(f"points: expected 1,000 to {MAX_POINTS:,}, got {points}.")


def template_samples(avatar: TrainedAvatar, points: int, seed: int = 0) -> SurfaceSamples:
    """The template points a prediction is made at: spread evenly by area, fixed by the seed, or the network's own.

    Raises:
        AvatarError: for a count out of 1,000 to 400,000.
    """
    check_count(points)
    template, generator = avatar.template, torch.Generator().manual_seed(seed)
    return draw_samples(avatar.model, template.vertices, template.faces, points, generator)


def body_batch(bodies: list[BodyFit], outfit: int, names: tuple[str, ...]) -> Batch:
    """Bodies without scans as a batch for prediction."""

    def stack(field: str) -> Tensor:
        return torch.stack([torch.as_tensor(getattr(body, field), dtype=torch.float32) for body in bodies])

    nothing = torch.zeros(len(bodies), 0, 3)
    return Batch(
        pose_vertices=stack("pose_vertices"),
        vertices=stack("vertices"),
        vertex_transforms=stack("vertex_transforms"),
        joint_transforms=stack("joint_transforms"),
        scan_points=nothing,
        scan_normals=nothing,
        outfit_ids=torch.full((len(bodies),), outfit),
        names=names,
    )


@torch.no_grad()
def predict(model: torch.nn.Module, batch: Batch, samples: SurfaceSamples, **switches: bool) -> PointCloud:
    """The dressed surface of one body (a batch of one) at any number of template points.

    ``switches`` go to the network, such as CloSET's ``wrinkles=False`` for the garment template alone.
    """
    check_shape("vertices", batch.vertices, "1 V 3")
    device = next(model.parameters()).device
    batch, count = batch.to(device), len(samples.face_ids)
    rows = torch.arange(-(-count // UNIT) * UNIT).clamp(max=count - 1)  # no leftover: each chunk encodes the body anew

    def decode(chunk: slice) -> Prediction:
        ids = rows[chunk]
        part = SurfaceSamples(samples.vertex_ids[ids], samples.barycentric[ids], samples.face_ids[ids])
        return model(batch, part.to(device), **switches)

    cloud = join_clouds(in_chunks(decode, len(rows), CHUNK))
    return PointCloud(cloud.points[:count], cloud.normals[:count])


def join_clouds(parts: list[Prediction]) -> PointCloud:
    """Chunks of one frame's prediction as one cloud."""
    points = torch.cat([part.points[0] for part in parts])
    normals = torch.cat([part.normals[0] for part in parts])
    return PointCloud(points.float().cpu().numpy(), normals.float().cpu().numpy())


@prepared_process()
def predict_frames(
    avatar: TrainedAvatar, outfit: Outfit, split: str, folder: Path, points: int, keep: Callable[[str], bool] = bool
) -> list[Path]:
    """Writes ``<folder>/<frame>.ply`` for the frames of a split; gives the files in order.

    Those that an earlier call made of the same avatar and bodies, and whose hashes are still right, are left alone.

    Args:
        avatar: a trained avatar.
        outfit: one of the outfits it was trained on.
        split: train or test.
        folder: where the point clouds go.
        points: template points a frame.
        keep: which frames, by name; all of them by default.
    """
    index = outfit_index(avatar, outfit.name)
    samples = template_samples(avatar, points)
    written, done, made_by = [], Ledger(folder), avatar_digest(avatar)
    for name in tracked([n for n in outfit.frames(split) if keep(n)], f"predict {outfit.name}"):
        written.append(folder / f"{name}.ply")
        key = keyed(SOURCE, avatar=made_by, points=points, body=outfit.digest(split, name))
        if not done.find(name, key):
            batch = body_batch([outfit.load(split, name).body], index, (name,))
            write_points(written[-1], predict(avatar.model, batch, samples))
            done.record(name, key, written[-1:])
    return written


def avatar_digest(avatar: TrainedAvatar) -> str:
    """One hash over all that a trained avatar's predictions depend on: weights, template and settings."""
    total = hashlib.sha256(digest_of(settings_to_dict(avatar.config.method)).encode())
    for name, value in avatar.model.state_dict().items():
        total.update(f"{name} {tuple(value.shape)}".encode() + value.detach().cpu().contiguous().numpy().tobytes())
    return total.hexdigest()


def pose_digest(outfit: Outfit, motion: Motion, frame: int) -> str:
    """One hash over all that the body of a motion's frame depends on: pose, place, and the outfit's shared files."""
    return digest_of([motion.poses[frame].tolist(), motion.translations[frame].tolist(), outfit.shared_digest])


def outfit_index(avatar: TrainedAvatar, name: str) -> int:
    """Which of the avatar's garment codes an outfit has.

    Raises:
        AvatarError: for an outfit it was not trained on, naming those it was.
    """
    if name not in avatar.config.outfit:
        raise AvatarError(f"outfit: this avatar was trained on {', '.join(avatar.config.outfit)}, not on {name!r}.")
    return avatar.config.outfit.index(name)


@prepared_process()
def predict_motion(avatar: TrainedAvatar, outfit: Outfit, motion: Motion, folder: Path, points: int) -> list[Path]:
    """Writes ``<folder>/<motion>.<frame>.ply`` for every frame of a motion; points keep their order over time."""
    index = outfit_index(avatar, outfit.name)
    samples = template_samples(avatar, points)
    check_shape("poses", motion.poses, "T J 3", J=len(outfit.posable_body().parents))
    written, done, made_by = [], Ledger(folder), avatar_digest(avatar)
    for frame in tracked(range(len(motion.poses)), f"predict {motion.name}"):
        name = f"{motion.name}.{frame:05d}"
        written.append(folder / f"{name}.ply")
        key = keyed(SOURCE, avatar=made_by, points=points, body=pose_digest(outfit, motion, frame))
        if not done.find(name, key):
            body = outfit.fit_pose(motion.poses[frame], motion.translations[frame])
            write_points(written[-1], predict(avatar.model, body_batch([body], index, (name,)), samples))
            done.record(name, key, written[-1:])
    return written


def garment_template_cloud(avatar: TrainedAvatar, outfit: str, points: int) -> PointCloud:
    """The explicit garment template of an outfit in the canonical pose.

    Raises:
        AvatarError: for a method without an explicit template.
    """
    if not hasattr(avatar.model, "garment_template"):
        raise AvatarError(f"method: {avatar.config.method.name} has no explicit garment template.")
    device = next(avatar.model.parameters()).device
    samples = template_samples(avatar, points).to(device)
    decoded = avatar.model.garment_template(outfit_index(avatar, outfit), samples)
    return join_clouds([Prediction(decoded.offsets, decoded.normals, decoded.offsets)])
