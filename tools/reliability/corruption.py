"""`flips`: single bits and cut ends of checkpoints, each of which must be noticed and the one before it used."""

from __future__ import annotations

import hashlib
import random
import warnings
from pathlib import Path
from typing import Any

from avatar.checks import DataError
from avatar.training.checkpoints import load_checkpoint, read_manifest, read_weights
from reliability.findings import Finding, all_of, none_of
from reliability.small_jobs import folder_of, prepare, train_job
from reliability.validators import bits
from reliability.workers import work_alone


def flip_trial(root: Path, flips: int, truncations: int, seed: int) -> list[Finding]:
    """Damages the newest checkpoint of a real run, and its weights to share, one bit or one cut at a time."""
    work_alone(prepare, root)
    work_alone(train_job, "closet", root, "damaged")
    folder, rng = folder_of("closet", root, "damaged"), random.Random(seed)
    checkpoints = folder / "checkpoints"
    newest, before = (checkpoints / entry["file"] for entry in reversed(read_manifest(checkpoints)["last"]))
    sound = newest.read_bytes()
    newest.unlink()
    expected = digest(load_quietly(checkpoints))
    noticed = silent = 0
    for trial in range(flips + truncations):
        newest.write_bytes(flip(sound, rng) if trial < flips else sound[: rng.randrange(len(sound))])
        loaded = digest(load_quietly(checkpoints))
        noticed += loaded == expected
        silent += loaded not in (expected, None)
    newest.write_bytes(sound)
    weights, refused = folder / "avatar.safetensors", 0
    sound = weights.read_bytes()
    for trial in range(flips):
        weights.write_bytes(flip(sound, rng) if trial % 2 else sound[: rng.randrange(len(sound))])
        try:
            read_weights(folder / "avatar")
        except DataError:
            refused += 1
    weights.write_bytes(sound)
    return [
        all_of("flips", f"noticed, and {before.name.split('.')[0]} used instead", noticed, flips + truncations),
        none_of("flips", "damaged checkpoints that were loaded", silent, flips + truncations),
        all_of("flips", "damaged weights files refused", refused, flips),
    ]


def load_quietly(folder: Path) -> dict[str, Any] | None:
    """The checkpoint a folder gives, without its warnings; None where it gives none."""
    with warnings.catch_warnings(action="ignore"):
        try:
            return load_checkpoint(folder)
        except DataError:
            return None


def digest(state: dict[str, Any] | None) -> str | None:
    """A hash of all that a state holds, tensors and plain values, but for the time that training took."""
    if state is None:
        return None
    held = {name: value for name, value in state.items() if name != "seconds"}
    return hashlib.sha256(repr(sorted(bits(held).items())).encode()).hexdigest()


def flip(data: bytes, rng: random.Random) -> bytes:
    """The same bytes but for one bit."""
    flipped = bytearray(data)
    flipped[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return bytes(flipped)
