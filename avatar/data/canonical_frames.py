"""Outfits in their canonical space: frames with the canonicalizer's T-pose scans, and training batches of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from avatar.body.model import BodyModel
from avatar.checks import AvatarError, DataError
from avatar.data.batches import draw_points, step_frames
from avatar.data.mirroring import ACROSS, MirrorMap, mirror_coins
from avatar.data.outfits import Outfit
from avatar.data.scanner import frame_seed
from avatar.geometry.surface import interpolate, sample_surface
from avatar.io.canonical_scans import read_canonical_scan
from avatar.records import Frame, Scan, Template, map_tensors


class CanonicalOutfit(Outfit):
    """The frames of an outfit in its canonical space (SCANimate 3.1), for training there.

    A frame's scan is the canonical one and its body stands under it: the template's vertices, identity vertex
    transforms. What tells the pose stays that of the posed frame: ``pose_vertices``, ``joint_transforms``, ``pose``.
    """

    def __init__(self, posed: Outfit, scans: Path):
        """Takes an outfit and the folder of its canonical scans, ``<scans>/<split>/<frame>.npz``."""
        super().__init__(posed.path, posed.dataset)
        self.posed, self.scans = posed, Path(scans)

    @property
    def body(self) -> BodyModel | None:
        """The subject's body."""
        return self.posed.body

    @property
    def mean_body(self) -> BodyModel | None:
        """The body a pose encoder sees."""
        return self.posed.mean_body

    def frame_path(self, split: str, name: str) -> Path:
        """The canonical scan of one of the outfit's frames. Raises `AvatarError` for a name that is not among them."""
        return self.scans / split / super().frame_path(split, name).name

    @cached_property
    def _still(self) -> np.ndarray:
        """A vertex transform that moves nothing for each vertex, ``(V, 4, 4)``; one array for all frames."""
        return np.tile(np.eye(4, dtype=np.float32), (len(self.template.vertices), 1, 1))

    def _read_template(self) -> Template:
        return self.posed.template

    def _read_frame(self, path: Path, split: str, name: str) -> Frame:
        if not path.is_file():
            raise DataError(path, "no canonical scan of this frame.", "Run tools/canonicalize.py to its end.")
        stored, posed = read_canonical_scan(path), self.posed.load(split, name)
        body = replace(posed.body, vertices=self.template.vertices.numpy(), vertex_transforms=self._still)
        return replace(posed, body=body, scan=Scan(stored.points, stored.normals, stored.faces, colors=stored.colors))


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
        places = step_frames(self.seed, step, size, len(self))
        batch = join_batches([self.item(index, str(epoch)) for epoch, index in places])
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
