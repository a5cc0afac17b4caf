"""Checkpoints that are never half-written and never silently damaged: written whole, listed with their sha256."""

from __future__ import annotations

import hashlib
import io
import json
import warnings
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor

from avatar.checks import AvatarError, DataError
from avatar.io.npz import write_whole

MANIFEST = "manifest.json"
KEPT = 2


def save_checkpoint(folder: Path, state: dict[str, Any], step: int, best: float | None = None) -> Path:
    """Writes the resume state of a step, keeps the last two and forgets older ones.

    The file is on disk before the manifest names it, and the manifest is replaced whole, so a crash at any moment
    leaves the previous checkpoint valid.

    Args:
        folder: the run's ``checkpoints`` folder.
        state: tensors and plain values only (it is read back with ``weights_only``).
        step: optimiser steps done.
        best: validation score; when it is the lowest so far the weights are also kept as ``best``.

    Raises:
        AvatarError: when the state holds a non-finite weight; nothing is written then.
    """
    for name, value in state["model"].items():
        if value.is_floating_point() and not torch.isfinite(value).all():
            raise AvatarError(f"{name}: expected finite weights at step {step}; this checkpoint was not written.")
    folder.mkdir(parents=True, exist_ok=True)
    buffer = io.BytesIO()
    torch.save(state, buffer)
    entries = read_manifest(folder)
    newest = _write_entry(folder, f"step-{step:08d}.pt", buffer, step)
    older = [entry for entry in entries.get("last", []) if entry["file"] != newest["file"]]
    entries["last"] = older[-(KEPT - 1) :] + [newest]
    if best is not None and best <= entries.get("best", {}).get("score", float("inf")):
        entries["best"] = _write_entry(folder, "best.pt", buffer, step) | {"score": best}
    write_whole(folder / MANIFEST, json.dumps(entries, indent=1).encode())
    listed = {entry["file"] for entry in entries["last"]}
    for path in folder.glob("step-*.pt"):
        if path.name not in listed:
            path.unlink()
    return folder / entries["last"][-1]["file"]


def _write_entry(folder: Path, name: str, buffer: io.BytesIO, step: int) -> dict[str, Any]:
    data = buffer.getvalue()
    write_whole(folder / name, data)
    return {"file": name, "step": step, "sha256": hashlib.sha256(data).hexdigest()}


def read_manifest(folder: Path) -> dict[str, Any]:
    """The checkpoints a folder lists: ``last`` (oldest first) and ``best``; empty when there are none."""
    path = folder / MANIFEST
    if not path.is_file():
        return {}
    try:
        return json.loads(path.read_bytes())
    except ValueError as error:
        raise DataError(path, f"expected JSON ({error}).", "Delete the run to start anew.") from error


def load_checkpoint(folder: Path, which: str = "last") -> dict[str, Any] | None:
    """The resume state of the newest sound checkpoint (``last``) or of the best (``best``); None without any.

    A checkpoint whose bytes do not match its hash is passed over with a warning that names both files.

    Raises:
        DataError: when checkpoints are listed and none of them is sound.
    """
    entries = read_manifest(folder)
    listed = [entries["best"]] if which == "best" and "best" in entries else list(reversed(entries.get("last", [])))
    for position, entry in enumerate(listed):
        path = folder / entry["file"]
        data = path.read_bytes() if path.is_file() else b""
        if hashlib.sha256(data).hexdigest() == entry["sha256"]:
            return torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
        following = listed[position + 1]["file"] if position + 1 < len(listed) else "nothing"
        warnings.warn(f"{path}: damaged or missing checkpoint; falling back to {following}.", stacklevel=2)
    if listed:
        raise DataError(folder, "no checkpoint listed here is sound.", "Restore one of them or delete the run.")
    return None


def write_weights(path: Path, weights: dict[str, Tensor], description: dict[str, Any]) -> None:
    """Writes weights to share: ``<path>.safetensors`` and ``<path>.json`` (description and sha256)."""
    data = save_tensors({name: value.contiguous().cpu() for name, value in weights.items()})
    write_whole(path.with_suffix(".safetensors"), data)
    described = description | {"sha256": hashlib.sha256(data).hexdigest()}
    write_whole(path.with_suffix(".json"), json.dumps(described, indent=1).encode())


def read_weights(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Weights and description as `write_weights` left them.

    Raises:
        DataError: when a file is missing, or the weights do not match the hash in their description.
    """
    weights, described = path.with_suffix(".safetensors"), path.with_suffix(".json")
    for needed in (weights, described):
        if not needed.is_file():
            raise DataError(needed, "no such file.", "Train the run first (tools/train.py).")
    try:
        description = json.loads(described.read_bytes())
        expected = description["sha256"]
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(described, f"expected a description with a sha256 ({error!r}).") from error
    data = weights.read_bytes()
    if hashlib.sha256(data).hexdigest() != expected:
        raise DataError(weights, "damaged: its sha256 is not the one in its description.", "Export it again.")
    return load_tensors(data), description
