"""Frames, posed or canonical, to training batches, in an order that follows from seed, epoch and frame alone."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from avatar.checks import AvatarError
from avatar.data.outfits import Outfit
from avatar.data.scanner import frame_seed
from avatar.geometry.neighbours import nearest
from avatar.geometry.surface import interpolate, sample_surface
from avatar.records import Batch, Frame, Template, map_tensors

MAX_BYTES = 1 << 30  # bytes of one sequence's items kept in memory: with torch and a network's work below 2 GiB
POOL = 40_000  # points a canonical scan that is a mesh is turned into, once; every step draws from them
BODY_FIELDS = ("pose_vertices", "vertices", "vertex_transforms", "joint_transforms")
MIRROR_TOLERANCE = 0.005  # metres: nearly all vertices must have a mirror image this near
SIDES = {"left": "right", "right": "left"}
ACROSS = torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0]))  # left and right are x
Item = TypeVar("Item")
Record = TypeVar("Record")


class LruSequence(Sequence[Item]):
    """A sequence in bounded memory of what ``read`` gives by index alone; the least recently used items leave first."""

    def __init__(self, read: Callable[[int], Item], count: int, max_bytes: int = MAX_BYTES):
        self.read, self.count, self.left = read, count, max(max_bytes, 0)
        self.kept: OrderedDict[int, Item] = OrderedDict()

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Item:
        if not 0 <= index < self.count:
            raise IndexError(f"index: expected 0 to {self.count - 1}, got {index}.")
        if index in self.kept:
            self.kept.move_to_end(index)
            return self.kept[index]
        item = self.kept[index] = self.read(index)
        self.left -= bytes_of(item)
        while self.left < 0:
            self.left += bytes_of(self.kept.popitem(last=False)[1])
        return item


def bytes_of(value: Any) -> int:
    """Memory that the arrays and tensors of a dataclass, or of dataclasses within it, take."""
    if is_dataclass(value):
        return sum(bytes_of(getattr(value, part.name)) for part in fields(value))
    return getattr(value, "nbytes", 0)


@dataclass(frozen=True)
class FrameName:
    """Where a frame is: ``outfit`` is the index into a run's outfits."""

    outfit: int
    split: str
    name: str


def name_frames(outfits: Sequence[Outfit], split: str, names: Sequence[Sequence[str]]) -> tuple[FrameName, ...]:
    """Frame names of several outfits, one list an outfit, as `FrameDataset` takes them."""
    return tuple(FrameName(i, split, name) for i, _ in enumerate(outfits) for name in names[i])


class FrameDataset:
    """Frames of one or more outfits of one body topology; `FrameName.outfit` points into them.

    Stateless, so that runs resume: an epoch's frames come in the permutation f(seed, epoch), a frame's scan points are
    the subset f(seed, epoch, frame), repeated where a scan has fewer. Raises `AvatarError` for several topologies.
    """

    def __init__(
        self,
        outfits: Sequence[Outfit],
        names: Sequence[FrameName],
        points: int,
        seed: int = 0,
        cache_bytes: int = MAX_BYTES,
    ):
        check_drawn(names, points)
        first = outfits[0].template
        for outfit in outfits[1:]:
            if not torch.equal(outfit.template.faces, first.faces):
                problem = f"{outfit.name} has another than {outfits[0].name}."
                raise AvatarError(f"outfits: expected one body topology in a run, {problem}")
        self.outfits, self.names, self.points, self.seed = tuple(outfits), tuple(names), points, seed
        self.frames = LruSequence(self._read, len(self.names), cache_bytes)

    def __len__(self) -> int:
        return len(self.names)

    def item(self, epoch: int, index: int) -> Batch:
        """A frame with its scan points for an epoch, float32, as a batch of one."""
        where, frame = self.names[index], self.frame(index)
        rng = np.random.default_rng(frame_seed(self.seed, f"{epoch}/{where.outfit}/{where.split}/{where.name}"))
        chosen = draw_points(len(frame.scan.points), self.points, rng)
        body = {name: getattr(frame.body, name) for name in BODY_FIELDS}
        arrays = body | {"scan_points": frame.scan.points[chosen], "scan_normals": frame.scan.normals[chosen]}
        tensors = {key: torch.from_numpy(np.ascontiguousarray(a, np.float32))[None] for key, a in arrays.items()}
        ids = {"outfit_ids": torch.tensor([where.outfit]), "frame_ids": torch.tensor([index])}
        return Batch(**tensors, **ids, names=(where.name,))

    def frame(self, index: int) -> Frame:
        """A frame, from memory where it is kept."""
        return self.frames[index]

    def _read(self, index: int) -> Frame:
        where = self.names[index]
        return self.outfits[where.outfit].load(where.split, where.name)

    def batch_at(self, step: int, size: int) -> Batch:
        """The batch of a training step: epochs follow each other without a gap, so every batch is full."""
        return collate([self.item(epoch, index) for epoch, index in step_frames(self.seed, step, size, len(self))])

    def ordered_batches(self, size: int) -> Iterator[Batch]:
        """All frames once in the order of ``names``, always with the same scan points: for validation."""
        for start in range(0, len(self), size):
            yield collate([self.item(0, index) for index in range(start, min(start + size, len(self)))])


def check_drawn(frames: Sequence, points: int) -> None:
    """Refuses no frames, and no points of each."""
    if not frames or points < 1:
        raise AvatarError(f"frames, points: expected at least 1 each, got {len(frames)} and {points}.")


def step_frames(seed: int, step: int, size: int, count: int) -> Iterator[tuple[int, int]]:
    """Epoch and index of the frames of a training step; each epoch is a permutation of ``count`` frames."""
    for place in range(step * size, (step + 1) * size):
        epoch, offset = divmod(place, count)
        order = np.random.default_rng(frame_seed(seed, f"order/{epoch}")).permutation(count)
        yield epoch, int(order[offset])


def draw_points(available: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """``count`` random indices below ``available``: each at most once, or as evenly often as can be."""
    rounds = [rng.permutation(available) for _ in range(-(-count // available))]
    return np.concatenate(rounds)[:count]


def collate(parts: Sequence[Record]) -> Record:
    """Batches of one shape as one: tensors and names follow each other, what is neither is the first one's."""
    columns = {field.name: [getattr(part, field.name) for part in parts] for field in fields(parts[0])}
    tensors = {name: torch.cat(values) for name, values in columns.items() if isinstance(values[0], Tensor)}
    return replace(parts[0], **tensors, names=sum(columns["names"], ()))


@dataclass(frozen=True)
class CanonicalFrame:
    """A canonical scan as points ``(M, 3)`` on its surface, and the pose it was taken in ``(J, 4, 4)``; float32."""

    name: str
    points: Tensor
    normals: Tensor
    colors: Tensor | None
    joint_transforms: Tensor


def canonical_frame(frame: Frame) -> CanonicalFrame:
    """A frame of a `CanonicalOutfit` to train on; the triangles of a mesh become points spread evenly over them."""
    scan = frame.scan
    values = {name: getattr(scan, name) for name in ("points", "normals", "colors")}
    values = {name: None if value is None else torch.from_numpy(value).float() for name, value in values.items()}
    if scan.faces is not None:
        generator = torch.Generator().manual_seed(frame_seed(0, frame.name))
        samples = sample_surface(values["points"], torch.from_numpy(scan.faces).long(), POOL, generator)
        values = {name: None if value is None else interpolate(value, samples) for name, value in values.items()}
        values["normals"] = normalize(values["normals"], dim=-1, eps=1e-20)
    joint_transforms = torch.from_numpy(np.asarray(frame.body.joint_transforms, np.float32))
    return CanonicalFrame(frame.name, **values, joint_transforms=joint_transforms)


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
    """Canonical frames and the batches they make, as stateless as `FrameDataset`.

    A ``symmetry`` shows half of the frames in a mirror, with another half every time.
    """

    def __init__(self, frames: Sequence[CanonicalFrame], points: int, seed: int, symmetry: MirrorMap | None = None):
        check_drawn(frames, points)
        self.frames, self.points, self.seed, self.symmetry = frames, points, seed, symmetry

    def __len__(self) -> int:
        return len(self.frames)

    def item(self, index: int, epoch: str) -> CanonicalBatch:
        """One frame with its points for an epoch, as a batch of one."""
        frame = self.frames[index]
        rng = np.random.default_rng(frame_seed(self.seed, f"{epoch}/{frame.name}"))
        chosen = torch.from_numpy(draw_points(len(frame.points), self.points, rng))
        parts = (frame.points, frame.normals, frame.colors)
        drawn = [None if part is None else part[chosen][None] for part in parts]
        return CanonicalBatch(*drawn, frame.joint_transforms[None], (frame.name,))

    def batch_at(self, step: int, size: int) -> CanonicalBatch:
        """The batch of a training step: epochs follow each other without a gap, so every batch is full."""
        places = step_frames(self.seed, step, size, len(self))
        batch = collate([self.item(index, str(epoch)) for epoch, index in places])
        if self.symmetry is None:
            return batch
        joints, flip = self.symmetry.joints, ACROSS.diagonal()[:3]
        images = {name: lambda seen: seen * flip for name in ("points", "normals")}
        images["joint_transforms"] = lambda seen: ACROSS @ seen[:, joints] @ ACROSS
        return change_rows(batch, mirror_coins(self.seed, step, size), images)

    def ordered(self) -> list[CanonicalBatch]:
        """All frames once, one by one, always with the same points and none in a mirror: for validation."""
        return [self.item(index, "validation") for index in range(len(self))]


@dataclass(frozen=True)
class MirrorMap:
    """Which vertex, and which joint, is whose mirror image: ``vertices (V,)``, ``joints (J,)``."""

    vertices: Tensor
    joints: Tensor


def mirror_map(template: Template) -> MirrorMap:
    """The left-right symmetry of a template in a symmetric canonical pose; `AvatarError` where 1% of it has none."""
    mirrored = template.vertices * ACROSS.diagonal()[:3]
    ids = nearest(mirrored[None], template.vertices[None])[0]
    off = (template.vertices[ids] - mirrored).norm(dim=-1) > MIRROR_TOLERANCE
    if off.float().mean() > 0.01:
        problem = f"{int(off.sum())} of {len(off)} vertices have no mirror image within 5 mm."
        hint = "Train without mirroring (train.mirror=false)."
        raise AvatarError(f"mirror: expected a symmetric template, {problem} {hint}")
    names, swapped = list(template.joint_names), [swap_side(name) for name in template.joint_names]
    missing = [name for name in swapped if name not in names]
    if missing:
        raise AvatarError(f"mirror: expected joints in left and right pairs, there is no {missing[0]}.")
    return MirrorMap(ids, torch.tensor([names.index(name) for name in swapped]))


def swap_side(name: str) -> str:
    """``left_knee`` for ``right_knee`` and the other way round; a joint in the middle stays."""
    side, _, joint = name.partition("_")
    return f"{SIDES[side]}_{joint}" if side in SIDES and joint else name


def mirror_batch(batch: Batch, chosen: Tensor, symmetry: MirrorMap) -> Batch:
    """The batch with the chosen frames ``(B,)`` bool seen in a mirror: bodies, transforms and scans alike."""
    flip = ACROSS.diagonal()[:3]
    turned = torch.outer(ACROSS.diagonal(), ACROSS.diagonal())  # signs of ACROSS @ T @ ACROSS
    images = dict.fromkeys(("scan_points", "scan_normals"), lambda seen: seen * flip)
    images |= dict.fromkeys(("pose_vertices", "vertices"), lambda seen: seen[:, symmetry.vertices] * flip)
    images["vertex_transforms"] = lambda seen: seen[:, symmetry.vertices] * turned
    images["joint_transforms"] = lambda seen: seen[:, symmetry.joints] * turned
    return change_rows(batch, chosen, images)


def change_rows(batch: Record, chosen: Tensor, changes: dict[str, Callable[[Tensor], Tensor]]) -> Record:
    """The batch with the chosen frames ``(B,)`` bool of some fields changed, each by its function."""
    rows = chosen.nonzero()[:, 0]
    changed = {name: getattr(batch, name).clone() for name in changes}
    for name, change in changes.items():
        changed[name][rows] = change(changed[name][rows])
    return replace(batch, **changed)


def mirror_coins(seed: int, step: int, frames: int) -> Tensor:
    """Which frames of a step's batch are mirrored, ``(B,)`` bool: half of them, from the seed and the step alone."""
    generator = torch.Generator().manual_seed(seed * 1_000_003 + step)
    return torch.rand(frames, generator=generator) < 0.5
