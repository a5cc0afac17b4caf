"""`flips`: bit flips and truncations of checkpoints; each must be detected, and the checkpoint before it used."""

from __future__ import annotations

import hashlib
import random
import warnings
from pathlib import Path
from typing import Any

from avatar.checks import DataError
from avatar.io.checkpoints import load_checkpoint, read_manifest, read_weights
from reliability.findings import Finding, all_of, none_of
from reliability.small_jobs import folder_of, prepare, train_job
from reliability.validators import bits
from reliability.workers import call_in_process


def flip_trial(root: Path, flips: int, truncations: int, seed: int) -> list[Finding]:
    """Corrupts the newest checkpoint of a real run, and its exported weights, one bit flip or truncation at a time."""
    call_in_process(prepare, root)
    call_in_process(train_job, "closet", root, "corrupted")
    folder, rng = folder_of("closet", root, "corrupted"), random.Random(seed)
    checkpoints = folder / "checkpoints"
    newest, before = (checkpoints / entry["file"] for entry in reversed(read_manifest(checkpoints)["last"]))
    valid = newest.read_bytes()
    newest.unlink()
    expected = digest(load_quietly(checkpoints))
    detected = loaded_anyway = 0
    for trial in range(flips + truncations):
        newest.write_bytes(flip(valid, rng) if trial < flips else valid[: rng.randrange(len(valid))])
        loaded = digest(load_quietly(checkpoints))
        detected += loaded == expected
        loaded_anyway += loaded not in (expected, None)
    newest.write_bytes(valid)
    weights, refused = folder / "avatar.safetensors", 0
    valid = weights.read_bytes()
    for trial in range(flips):
        weights.write_bytes(flip(valid, rng) if trial % 2 else valid[: rng.randrange(len(valid))])
        try:
            read_weights(folder / "avatar")
        except DataError:
            refused += 1
    weights.write_bytes(valid)
    return [
        all_of("flips", f"detected, and {before.name.split('.')[0]} used instead", detected, flips + truncations),
        none_of("flips", "corrupted checkpoints that were loaded", loaded_anyway, flips + truncations),
        all_of("flips", "corrupted weights files refused", refused, flips),
    ]


def load_quietly(folder: Path) -> dict[str, Any] | None:
    """Checkpoint that a folder loads, without warnings; None where none can be loaded."""
    with warnings.catch_warnings(action="ignore"):
        try:
            return load_checkpoint(folder)
        except DataError:
            return None


def digest(state: dict[str, Any] | None) -> str | None:
    """SHA-256 of a state's tensors and plain values, except for the time that training took."""
    if state is None:
        return None
    held = {name: value for name, value in state.items() if name != "seconds"}
    return hashlib.sha256(repr(sorted(bits(held).items())).encode()).hexdigest()


def flip(data: bytes, rng: random.Random) -> bytes:
    """Bytes with one bit flipped."""
    flipped = bytearray(data)
    flipped[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return bytes(flipped)
