"""Checkpoints that are never half-written and never silently damaged: written whole, known by their sha256."""

from __future__ import annotations

import hashlib
import io
import json
import math
import re
import shutil
import warnings
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import NoneType
from typing import Any

import safetensors.torch
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from avatar.checks import AvatarError, DataError, check_finite, check_trained
from avatar.io.documents import read_json
from avatar.io.ledger import digest_of
from avatar.io.npz import write_whole

MANIFEST = "manifest.json"
KEPT = 2
FACTOR = 4  # times the numbers in a weights file: initialisation makes temporaries of a layer's size
SPARE = 1 << 22  # numbers beside them, 16 MiB: what a network draws, sorts and caches of its template
FACTORIES = {torch.empty, torch.zeros, torch.ones, torch.full, torch.rand, torch.randn, torch.eye}
NAME = re.compile(r"step-(\d{8,})\.([0-9a-f]{16})\.pt")  # the step, and the first digits of the file's sha256


def save_checkpoint(folder: Path, state: dict[str, Any], step: int, best: float | None = None) -> Path:
    """Writes the resume state of a step, keeps the last two and the best (lowest score), and forgets older ones.

    A file is on disk before the manifest names it, no file is ever written over, and the manifest is replaced whole: a
    crash or a full disk at any moment leaves earlier checkpoints valid. Raises `AvatarError` for a number that is not
    finite (nothing is written then), `DataError` when the disk refuses, saying how much room was needed.
    """
    _check_weights(named_tensors(state), f" at step {step}; this checkpoint")
    best = best if best is not None and math.isfinite(best) else None
    buffer = io.BytesIO()
    torch.save({**state, "score": best}, buffer)
    data = buffer.getbuffer()
    digest = hashlib.sha256(data).hexdigest()
    entry = {"file": f"step-{step:08d}.{digest[:16]}.pt", "step": step, "score": best, "sha256": digest}
    before = read_manifest(folder)
    older = [past for past in before.get("last", []) if past["step"] < step]  # later ones were damaged
    entries = {"last": older[-(KEPT - 1) :] + [entry]}
    record = before.get("best")
    improved = best is not None and best <= (record["score"] if record else math.inf)
    if improved or record:
        entries["best"] = entry if improved else record
    try:
        write_whole(folder / entry["file"], data)
        write_whole(folder / MANIFEST, json.dumps({**entries, "sha256": digest_of(entries)}, indent=1).encode())
    except DataError as error:
        free = shutil.disk_usage(folder if folder.is_dir() else ".").free
        kept = f"step {before['last'][-1]['step']}" if before.get("last") else "none"
        reason = getattr(error.__cause__, "strerror", error.__cause__)
        needed = f"{reason}; {len(data):,} bytes needed, {free:,} free"
        problem = f"could not write a checkpoint ({needed}). The last one written: {kept}."
        raise DataError(folder, problem, "Free disk space and give the same command again.") from error
    listed = {kept["file"] for kept in (*entries["last"], entries.get("best", entry))}
    for path in (*folder.glob("step-*.pt"), *folder.glob(".*.tmp-*")):
        if path.name not in listed:
            path.unlink()
    return folder / entry["file"]


def named_tensors(value: Any, name: str = "") -> Iterator[tuple[str, Tensor]]:
    """Every tensor in nested dicts and lists, with its name."""
    if isinstance(value, Tensor):
        yield name, value
    elif isinstance(value, (dict, list, tuple)):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from named_tensors(item, f"{name}.{key}" if name else str(key))


def _is_finite(value: Tensor) -> bool:
    return not value.is_floating_point() or bool(torch.isfinite(value).all())


def _check_weights(weights: Iterable[tuple[str, Tensor]], what: str) -> None:
    for name, value in weights:
        if not _is_finite(value):
            raise AvatarError(f"{name}: expected finite weights{what} was not written.")


def read_manifest(folder: Path) -> dict[str, Any]:
    """The checkpoints a folder lists, ``last`` (oldest first) and ``best``; made again from their names if damaged."""
    path = folder / MANIFEST
    if path.is_file():
        try:
            entries = read_json(path)
            if entries.pop("sha256", None) == digest_of(entries) and _is_listing(entries):
                return entries
        except DataError:
            pass  # not JSON: as damaged as a wrong hash
        warnings.warn(f"{path}: damaged; made again from the checkpoints beside it.", stacklevel=2)
    found = []
    for match in filter(None, (NAME.fullmatch(file.name) for file in sorted(folder.glob("step-*.pt")))):
        entry = {"file": match[0], "step": int(match[1]), "sha256": match[2]}
        if (state := _read_valid(folder, entry)) is not None:
            found.append(entry | {"score": state["score"]})
    scored = [entry for entry in found if entry["score"] is not None]
    best = {"best": min(scored, key=lambda entry: (entry["score"], -entry["step"]))} if scored else {}
    return {"last": found, **best} if found else {}


def _is_listing(entries: dict[str, Any]) -> bool:
    """Whether a manifest lists checkpoints of its own folder: a seal can be forged, a name could lead elsewhere."""
    last, best = entries.get("last", []), [entries[key] for key in ("best",) if key in entries]
    valid = isinstance(last, list) and all(
        isinstance(entry, dict)
        and NAME.fullmatch(str(entry.get("file")))
        and type(entry.get("step")) is int
        and isinstance(entry.get("score"), (int, float, NoneType))
        and re.fullmatch("[0-9a-f]{16,64}", str(entry.get("sha256")))
        for entry in (*last, *best)
    )
    return valid and all(entry["score"] is not None for entry in best)


def _read_valid(folder: Path, entry: dict[str, Any]) -> dict[str, Any] | None:
    """The state of a listed checkpoint; None when its bytes are not those that were written, or no state of ours."""
    path = folder / entry["file"]
    data = path.read_bytes() if path.is_file() else b""
    if not hashlib.sha256(data).hexdigest().startswith(entry["sha256"]):
        return None
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:  # torch packs nothing, so nothing may swell on unpacking
            if any(info.file_size != info.compress_size for info in archive.infolist()):
                return None
        state = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception:  # the hash of a hostile file can be right: what it makes torch raise may be anything
        return None
    valid = isinstance(state, dict) and "score" in state and all(_is_finite(value) for _, value in named_tensors(state))
    return state if valid else None


@contextmanager
def restoring(folder: Path) -> Iterator[None]:
    """Turns whatever goes wrong while a state is taken over into a `DataError`: another network's, or a forgery."""
    try:
        yield
    except AvatarError:
        raise
    except (RuntimeError, KeyError, ValueError, TypeError, IndexError, AttributeError) as error:
        reason = " ".join(str(error).split())
        raise DataError(folder, f"its weights or state do not fit this run ({reason:.300}).") from error


class Budget(TorchFunctionMode):
    """Refuses to allocate a tensor larger than a number of elements, for as long as it is entered."""

    def __init__(self, elements: int):
        super().__init__()
        self.left = elements

    def __torch_function__(self, function: Any, types: Any, arguments: tuple = (), options: dict | None = None) -> Any:
        options = options or {}
        if function in FACTORIES:
            given = options.get("size", arguments[:1] if function is torch.full else arguments)
            sizes = [size for part in given for size in (part if isinstance(part, (tuple, list)) else [part])]
            asked = math.prod(int(size) for size in sizes if isinstance(size, int))
            self.left -= asked
            if self.left < 0:
                problem = f"they ask for a network of {asked} numbers, the weights beside it have less."
                raise AvatarError(f"settings: {problem}")
        return function(*arguments, **options)


@contextmanager
def building(path: Path, weights: Mapping[str, Tensor]) -> Iterator[None]:
    """Builds and fills a network within a ``with`` block; `DataError` for sizes beyond those of its weights."""
    with restoring(path), Budget(FACTOR * sum(value.numel() for value in weights.values()) + SPARE):
        yield


def load_checkpoint(folder: Path, which: str = "last") -> dict[str, Any] | None:
    """The newest valid resume state (``last``) or the best (``best``); None without any.

    A damaged one is passed over with a warning. Raises `DataError` when those listed are all damaged.
    """
    entries = read_manifest(folder)
    listed = entries.get("last", [])[::-1] if which == "last" else [entries[key] for key in (which,) if key in entries]
    for entry, following in zip(listed, [*(entry["file"] for entry in listed[1:]), "nothing"]):
        if (state := _read_valid(folder, entry)) is not None:
            return state
        damaged = folder / entry["file"]
        warnings.warn(f"{damaged}: damaged or missing checkpoint; falling back to {following}.", stacklevel=2)
    if listed or (which == "last" and any(folder.glob("step-*.pt"))):
        raise DataError(folder, "no checkpoint listed here is valid.", "Restore one of them or delete the run.")
    return None


def write_weights(path: Path, weights: dict[str, Tensor], description: dict[str, Any]) -> None:
    """Writes ``<path>.safetensors`` and ``<path>.json`` (description, sha256); `AvatarError` if not finite."""
    _check_weights(weights.items(), f"; {path}.safetensors")
    data = safetensors.torch.save({name: value.contiguous().cpu() for name, value in weights.items()})
    described = description | {"sha256": hashlib.sha256(data).hexdigest()}
    write_whole(path.with_suffix(".safetensors"), data)
    write_whole(path.with_suffix(".json"), json.dumps(described, indent=1).encode())


def read_weights(path: Path, facts: Iterable[str] = ()) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Weights and description as `write_weights` left them; ``facts`` are the keys the description must have.

    Raises `DataError` for a missing file or fact, and weights that are not finite or not those of the hash.
    """
    weights, described = check_trained(path)
    description = read_json(described)
    missing = [fact for fact in ("sha256", *facts) if fact not in description]
    if missing:
        raise DataError(described, f"expected a description with a sha256 and its facts; {missing[0]} is missing.")
    data = weights.read_bytes()
    if hashlib.sha256(data).hexdigest() != description["sha256"]:
        hint = "Give the command that made it again."
        raise DataError(weights, "damaged: its sha256 is not the one in its description.", hint)
    try:
        tensors = safetensors.torch.load(data)
        for name, value in tensors.items():
            check_finite(name, value)
    except (safetensors.SafetensorError, AvatarError) as error:
        raise DataError(weights, f"expected finite weights ({error}).") from error
    return tensors, description
