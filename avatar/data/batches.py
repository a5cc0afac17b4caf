"""Frames to training batches, in an order that follows from seed, epoch and frame, so that runs resume."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from avatar.checks import AvatarError
from avatar.data.outfits import Outfit
from avatar.data.scanner import frame_seed
from avatar.records import Batch, Frame

MAX_BYTES = 1 << 30  # bytes of one sequence's items kept in memory: with torch and a network's work below 2 GiB
Item = TypeVar("Item")


class LruSequence(Sequence[Item]):
    """A sequence of any length in bounded memory; the least recently used items leave first.

    What an item is must follow from its index alone, for it may be read again.
    """

    def __init__(self, read: Callable[[int], Item], count: int, max_bytes: int = MAX_BYTES):
        """Prepares a sequence of ``count`` items; none is read yet.

        Args:
            read: gives an item, a dataclass of arrays or tensors, by its index.
            count: how many there are.
            max_bytes: bytes that items may be kept in.
        """
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
        item = self.read(index)
        self.kept[index] = item
        self.left -= bytes_of(item)
        while self.left < 0:
            _, leaving = self.kept.popitem(last=False)
            self.left += bytes_of(leaving)
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


@dataclass(frozen=True)
class FrameItem:
    """One frame as float32 tensors with a subset of its scan points; the fields are those of `Batch`."""

    pose_vertices: Tensor
    vertices: Tensor
    vertex_transforms: Tensor
    joint_transforms: Tensor
    scan_points: Tensor
    scan_normals: Tensor
    outfit: int
    name: str


class FrameDataset(Dataset):
    """Frames of one or more outfits of one body topology.

    Nothing here has a state that a resumed run would have to restore: the frames of an epoch come in the
    permutation f(seed, epoch), the scan points of a frame are the subset f(seed, epoch, frame).
    """

    def __init__(
        self,
        outfits: Sequence[Outfit],
        names: Sequence[FrameName],
        points: int,
        seed: int = 0,
        cache_bytes: int = MAX_BYTES,
    ):
        """Prepares frames; none is read yet.

        Args:
            outfits: the run's outfits; `FrameName.outfit` points into them.
            names: the frames, at least one.
            points: scan points a frame. A scan with fewer gives some of them more than once.
            seed: of the order and of the subsets.
            cache_bytes: memory that frames may be kept in; the least recently used leave first.

        Raises `AvatarError` without frames, or for outfits whose bodies are not of one topology.
        """
        if not names or points < 1:
            raise AvatarError(f"names, points: expected at least 1 each, got {len(names)} and {points}.")
        first = outfits[0].template
        for outfit in outfits[1:]:
            if not torch.equal(outfit.template.faces, first.faces):
                raise AvatarError(
                    f"outfits: expected one body topology in a run, {outfit.name} has another than {outfits[0].name}."
                )
        self.outfits, self.names, self.points, self.seed = tuple(outfits), tuple(names), points, seed
        self.epoch = 0  # the epoch that plain indexing draws scan points for
        self.frames = LruSequence(self._read, len(self.names), cache_bytes)

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> FrameItem:
        return self.item(self.epoch, index)

    def item(self, epoch: int, index: int) -> FrameItem:
        """A frame with its scan points for an epoch."""
        where = self.names[index]
        frame = self.frame(index)
        rng = np.random.default_rng(frame_seed(self.seed, f"{epoch}/{where.outfit}/{where.split}/{where.name}"))
        chosen = draw_points(len(frame.scan.points), self.points, rng)
        arrays = {
            "pose_vertices": frame.body.pose_vertices,
            "vertices": frame.body.vertices,
            "vertex_transforms": frame.body.vertex_transforms,
            "joint_transforms": frame.body.joint_transforms,
            "scan_points": frame.scan.points[chosen],
            "scan_normals": frame.scan.normals[chosen],
        }
        tensors = {key: torch.from_numpy(np.ascontiguousarray(a, np.float32)) for key, a in arrays.items()}
        return FrameItem(**tensors, outfit=where.outfit, name=where.name)

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


def name_frames(outfits: Sequence[Outfit], split: str, names: Sequence[Sequence[str]]) -> tuple[FrameName, ...]:
    """Frame names of several outfits, one list an outfit, as `FrameDataset` takes them."""
    return tuple(FrameName(i, split, name) for i, _ in enumerate(outfits) for name in names[i])


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


def collate(items: Sequence[FrameItem]) -> Batch:
    """Frames of one topology and one point count as a batch."""
    stacked = [f.name for f in fields(FrameItem) if f.name not in ("outfit", "name")]
    return Batch(
        **{name: torch.stack([getattr(item, name) for item in items]) for name in stacked},
        outfit_ids=torch.tensor([item.outfit for item in items]),
        names=tuple(item.name for item in items),
    )
