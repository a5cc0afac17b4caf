"""Which training frames train and which validate. Test frames are never touched."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from avatar.checks import AvatarError
from avatar.data.folders import SPLITS
from avatar.data.outfits import Outfit
from avatar.io.npz import member_checksums

log = logging.getLogger(__name__)

Name = TypeVar("Name")
NO_CONTENT = ("scan_name", "format")  # arrays that differ between copies of a frame
SEVERAL_SEQUENCES = 4  # from here on whole sequences are held back, below it frames


@dataclass
class SplitConfig:
    """How the training frames of an outfit are shared out."""

    validation_share: float = 0.1  # held back from training to choose among checkpoints
    train_fraction: float = 1.0  # of what is left; 0.125 is the "1/8" of the papers

    def __post_init__(self):
        if not 0 <= self.validation_share < 1 or not 0 < self.train_fraction <= 1:
            expected = "validation_share: expected at least 0 and below 1; train_fraction: above 0 and at most 1"
            raise AvatarError(f"{expected}; got {self.validation_share} and {self.train_fraction}.")


@dataclass(frozen=True)
class Split:
    """Frame names to train on and to validate on, both out of the train folder."""

    train: tuple[str, ...]
    validation: tuple[str, ...]


def split_outfit(outfit: Outfit, config: SplitConfig | None = None) -> Split:
    """The split of an outfit's training frames, after a check that no test frame is among them (`check_leakage`,
    `check_copies`).
    """
    train = outfit.frames("train")
    for split in SPLITS[1:]:
        check_leakage(train, outfit.frames(split) if outfit.has_frames(split) else (), f"{outfit.name}, {split}")
    check_copies(outfit)
    return split_frames(train, config or SplitConfig())


def split_frames(names: Sequence[str], config: SplitConfig) -> Split:
    """Holds back validation frames, then thins the rest evenly; depends on the names alone.

    Whole sequences are held back where there are four or more, because neighbouring frames are nearly copies, otherwise
    the last frames. Raises `AvatarError` when there are too few frames to share.
    """
    names = sorted(names)
    count = max(round(len(names) * config.validation_share), 1) if config.validation_share > 0 else 0
    if count >= len(names):
        problem = f"expected frames left to train on, {len(names)} frames give none. Set it to 0."
        raise AvatarError(f"validation_share: {problem}")
    held = set((_held_sequences(names, count) or names[-count:]) if count else ())
    train = [name for name in names if name not in held]
    kept = np.floor(np.arange(np.ceil(len(train) * config.train_fraction - 1e-9)) / config.train_fraction + 1e-9)
    return Split(tuple(train[int(i)] for i in kept), tuple(name for name in names if name in held))


def sequence_of(name: str) -> str:
    """The sequence of a frame: ``walk`` of ``walk.00012``; a name without a number is its own sequence."""
    return name.rpartition(".")[0] or name


def _held_sequences(names: Sequence[str], count: int) -> list[str]:
    """Frames of whole sequences, last ones first, that come near to a count; none where sequences are few."""
    sequences: dict[str, list[str]] = {}
    for name in names:
        sequences.setdefault(sequence_of(name), []).append(name)
    if len(sequences) < SEVERAL_SEQUENCES:
        return []
    held: list[str] = []
    candidates = list(sequences.values())[1:]
    for frames in reversed(candidates):
        if abs(len(held) + len(frames) - count) < abs(len(held) - count):
            held += frames
    return held or min(candidates, key=len)


def check_leakage(train: Sequence[str], test: Sequence[str], outfit: str) -> None:
    """Refuses a frame that is both trained and tested on. Raises `AvatarError` naming the first such frames."""
    if shared := sorted(set(train) & set(test)):
        problem = f"expected different frames in train and test, {len(shared)} are in both ({', '.join(shared[:3])})"
        raise AvatarError(f"{outfit}: {problem}. Remove them from one.")


def spaced_frames(names: Sequence[Name], count: int | None) -> list[Name]:
    """``count`` of the frames' names, evenly spaced; all of them if None or fewer."""
    if count is None or count >= len(names):
        return list(names)
    return [names[round(i * (len(names) - 1) / max(count - 1, 1))] for i in range(count)]


def check_copies(outfit: Outfit) -> None:
    """Refuses scans that are in train and in another split, under whatever names; copies within train are logged.

    Scans are compared by the checksums in their files' directories. Raises `AvatarError` naming the first such frames.
    """
    seen: dict[object, str] = {}
    copies: dict[str, list[str]] = {}
    for split in SPLITS:
        for name in outfit.frames(split) if outfit.has_frames(split) else ():
            arrays = member_checksums(outfit.path / split / f"{name}.npz")
            content = arrays.get("scan_pc") or frozenset(item for item in arrays.items() if item[0] not in NO_CONTENT)
            if not content:
                continue
            first = seen.setdefault(content, f"{split}/{name}") if split == "train" else seen.get(content)
            if first not in (None, f"{split}/{name}"):
                copies.setdefault(split, []).append(f"{split}/{name} = {first}")
    for split, pairs in copies.items():
        problem = f"{outfit.path}: {len(pairs)} {split} frames have the scan of another frame of train"
        shown = f"{problem} ({', '.join(pairs[:3])})"
        if split != "train":
            raise AvatarError(f"{shown}. Remove them from one.")
        log.warning("%s, which counts once more in training; remove them.", shown)
