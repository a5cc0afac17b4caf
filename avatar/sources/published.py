"""Outfit lists and splits of published papers, by name (``avatar/assets/published.yaml``)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import groupby
from pathlib import Path

import numpy as np

from avatar.checks import AvatarError, unknown_name
from avatar.io.documents import read_yaml
from avatar.io.ledger import digest_of
from avatar.settings import settings_from_dict
from avatar.sources.base import SourceFrame

TABLE = Path(__file__).parents[1] / "assets" / "published.yaml"


@dataclass
class PublishedSplit:
    """Which frames of an outfit's sequences are trained on, and which are tested on; the rest is left out."""

    test: list[str] = field(default_factory=list)  # motions: sequences whose names hold one of them
    takes: dict[str, str] = field(default_factory=dict)  # the one sequence of each outfit
    share: float = 0.0  # of the sequences, drawn by their names
    first: int = 0  # frame of each sequence
    step: int = 1  # every which frame is trained on
    between: int = 0  # those so many frames behind a training frame are the split interpolation; none if 0


@cache
def published_outfits() -> dict[str, tuple[str, ...]]:
    """Names of outfits by the name of their list."""
    return {name: tuple(outfits) for name, outfits in read_yaml(TABLE)["outfits"].items()}


@cache
def published_splits() -> dict[str, PublishedSplit]:
    """Splits by name."""
    found = read_yaml(TABLE)["splits"]
    return {name: settings_from_dict(PublishedSplit, values, f"{name}.") for name, values in found.items()}


def named_outfits(names: Iterable[str]) -> list[str]:
    """Names of outfits, in which the name of a published list stands for the outfits of the list; each once."""
    lists = published_outfits()
    return list(dict.fromkeys(outfit for name in names for outfit in lists.get(name, (name,))))


def split_frames(frames: Iterable[SourceFrame], outfit: str, name: str) -> list[SourceFrame]:
    """The frames of an outfit that a published split has, each with its split.

    Raises `AvatarError` for an unknown split, an outfit that the split does not name, or sequences of which the split
    tests on none or on all.
    """
    if name not in published_splits():
        raise unknown_name("split", name, published_splits())
    split, found = published_splits()[name], []
    if split.takes and outfit not in split.takes:
        raise AvatarError(f"split: expected an outfit of {name} ({', '.join(split.takes)}), got {outfit}.")
    sequences = [(key, list(group)) for key, group in groupby(frames, key=lambda frame: frame.sequence)]
    tested = {key for key, _ in sequences if any(motion in key for motion in split.test)}
    tested |= {key for key, _ in sequences if key == split.takes.get(outfit)}
    order = sorted((key for key, _ in sequences), key=digest_of)
    tested |= set(order[: int(np.ceil(split.share * len(order)))])
    if not 0 < len(tested) < len(sequences):
        there = ", ".join(key or "single scans" for key, _ in sequences)
        raise AvatarError(
            f"split: expected sequences to train on and to test on, {name} tests on all or none of {there}."
        )
    for key, group in sequences:
        for place, frame in enumerate(group[split.first :]):
            if key in tested or place % split.step == 0:
                found.append(replace(frame, split="test" if key in tested else "train"))
            elif split.between and place % split.step == split.between:
                found.append(replace(frame, split="interpolation"))
    return sorted(found, key=lambda frame: (frame.split, frame.sequence, frame.number, frame.name))
