"""Canonical scans to training batches, in an order that follows from seed and step, so that runs resume."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from avatar.checks import AvatarError
from avatar.data.batches import draw_points
from avatar.data.mirroring import ACROSS, MirrorMap, mirror_coins
from avatar.data.scanner import frame_seed
from avatar.geometry.surface import interpolate, sample_surface
from avatar.records import Frame, map_tensors

POOL = 40_000  # points a scan that is a mesh is turned into, once; every step draws from them


@dataclass(frozen=True)
class CanonicalFrame:
    """A canonical scan as points on its surface and the pose it was taken in; float32 tensors.

    ``points``, ``normals (M, 3)``, ``colors (M, 3)`` or None, ``joint_transforms (J, 4, 4)`` posed_from_canonical.
    """

    name: str
    points: Tensor
    normals: Tensor
    colors: Tensor | None
    joint_transforms: Tensor


def canonical_frame(frame: Frame) -> CanonicalFrame:
    """A frame of a `CanonicalOutfit` to train on; the triangles of a mesh become points spread evenly over them."""
    scan = frame.scan
    points, normals = torch.from_numpy(scan.points).float(), torch.from_numpy(scan.normals).float()
    colors = None if scan.colors is None else torch.from_numpy(scan.colors).float()
    if scan.faces is not None:
        generator = torch.Generator().manual_seed(frame_seed(0, frame.name))
        samples = sample_surface(points, torch.from_numpy(scan.faces).long(), POOL, generator)
        normals = normalize(interpolate(normals, samples), dim=-1, eps=1e-20)
        points, colors = interpolate(points, samples), None if colors is None else interpolate(colors, samples)
    joint_transforms = torch.from_numpy(np.asarray(frame.body.joint_transforms, np.float32))
    return CanonicalFrame(frame.name, points, normals, colors, joint_transforms)


@dataclass(frozen=True)
class CanonicalBatch:
    """Frames of one step: ``points``, ``normals``, ``colors (B, S, 3)``, ``joint_transforms (B, J, 4, 4)``, names."""

    points: Tensor
    normals: Tensor
    colors: Tensor | None
    joint_transforms: Tensor
    names: tuple[str, ...]

    def to(self, device: torch.device | str) -> CanonicalBatch:
        """The same batch on another device."""
        return map_tensors(self, lambda tensor: tensor.to(device))


class CanonicalFrames:
    """Frames and the batches they make. Nothing here has a state that a resumed run would have to restore."""

    def __init__(self, frames: Sequence[CanonicalFrame], points: int, seed: int, symmetry: MirrorMap | None = None):
        """Takes the frames.

        Args:
            frames: at least one.
            points: drawn of each frame, anew every epoch; a scan with fewer gives some of them more than once.
            seed: of the order, the points and the mirror.
            symmetry: shows half of the frames in a mirror, with another half every time.
        """
        if not frames or points < 1:
            raise AvatarError(f"frames, points: expected at least 1 each, got {len(frames)} and {points}.")
        self.frames, self.points, self.seed, self.symmetry = frames, points, seed, symmetry

    def __len__(self) -> int:
        return len(self.frames)

    def item(self, index: int, epoch: str) -> CanonicalBatch:
        """One frame with its points for an epoch, as a batch of one."""
        frame = self.frames[index]
        rng = np.random.default_rng(frame_seed(self.seed, f"{epoch}/{frame.name}"))
        chosen = torch.from_numpy(draw_points(len(frame.points), self.points, rng))
        return CanonicalBatch(
            points=frame.points[chosen][None],
            normals=frame.normals[chosen][None],
            colors=None if frame.colors is None else frame.colors[chosen][None],
            joint_transforms=frame.joint_transforms[None],
            names=(frame.name,),
        )

    def batch_at(self, step: int, size: int) -> CanonicalBatch:
        """The batch of a training step: epochs follow each other without a gap, so every batch is full."""
        items = []
        for place in range(step * size, (step + 1) * size):
            epoch, offset = divmod(place, len(self))
            order = np.random.default_rng(frame_seed(self.seed, f"order/{epoch}")).permutation(len(self))
            items.append(self.item(int(order[offset]), str(epoch)))
        batch = join_batches(items)
        return batch if self.symmetry is None else mirror(batch, mirror_coins(self.seed, step, size), self.symmetry)

    def ordered(self) -> list[CanonicalBatch]:
        """All frames once, one by one, always with the same points and none in a mirror: for validation."""
        return [self.item(index, "validation") for index in range(len(self))]


def join_batches(items: Sequence[CanonicalBatch]) -> CanonicalBatch:
    """Batches of one point count as one."""
    names = ("points", "normals", "joint_transforms")
    joined = {name: torch.cat([getattr(item, name) for item in items]) for name in names}
    colors = None if items[0].colors is None else torch.cat([item.colors for item in items])
    return CanonicalBatch(**joined, colors=colors, names=tuple(name for item in items for name in item.names))


def mirror(batch: CanonicalBatch, chosen: Tensor, symmetry: MirrorMap) -> CanonicalBatch:
    """The batch with the chosen frames ``(B,)`` bool seen in a mirror, scans and poses alike."""
    flip = torch.where(chosen[:, None], ACROSS.diagonal()[:3], torch.ones(3))[:, None]
    turned = ACROSS @ batch.joint_transforms[:, symmetry.joints] @ ACROSS
    poses = torch.where(chosen[:, None, None, None], turned, batch.joint_transforms)
    return replace(batch, points=batch.points * flip, normals=batch.normals * flip, joint_transforms=poses)
