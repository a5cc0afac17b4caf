"""`stream`: training on a data set far larger than memory, streamed frame by frame from disk."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

from avatar.body.packed import write_body
from avatar.data.batches import bytes_of
from avatar.data.layouts import OpenOutfit
from avatar.data.packed_layout import PackedOutfit, write_packed_frame
from avatar.data.scanner import ScanConfig
from avatar.io.npz import write_whole
from avatar.runs.training import train
from reliability.findings import Finding
from reliability.small_jobs import run_config, write_data
from reliability.workers import call_in_process, peak_memory

SCAN_POINTS = 400_000
LIMIT = 2 << 30  # bytes resident
BATCH = 4


def stream_trial(root: Path, gigabytes: float, visited: int) -> list[Finding]:
    """Trains on an outfit of so many gigabytes for as many frames as are to be ``visited``, and measures peak memory.

    Every frame is a file of its own name with 400,000 scan points. On the disk they are hard links to one file, which
    makes no difference to the reader and needs no large disk.
    """
    folder = root / "data" / "packed" / "large"
    size = call_in_process(write_large_outfit, root, folder, gigabytes)
    seen, frames = call_in_process(train_on_stream, root, visited, timeout=3600), size["frames"]
    return [
        Finding("stream", "size of the outfit's frames as arrays", size["gigabytes"], "GB", frames, gigabytes),
        Finding("stream", "frames read while training", seen["frames"], f"of {frames}", frames, visited),
        Finding("stream", "peak resident memory", round(seen["peak"] / 2**20), "MiB", frames, None, LIMIT / 2**20),
    ]


def write_large_outfit(root: Path, folder: Path, gigabytes: float) -> dict[str, Any]:
    """Writes one packed frame with many scan points, and hard links to it until their arrays have the given size."""
    shutil.rmtree(folder, ignore_errors=True)
    outfit = OpenOutfit(write_data(root), "open", ScanConfig(points=SCAN_POINTS))
    frame = outfit.load("train", outfit.frames("train")[0])
    write_body(folder / "template.npz", outfit.body)
    write_whole(folder / "outfit.yaml", b"format: outfit/1\nlayout: packed\n")
    first = folder / "train" / "walk.00000.npz"
    write_packed_frame(first, frame)
    each = bytes_of(PackedOutfit(folder, "packed").load("train", first.stem))
    count = int(-(-gigabytes * 1e9 // each))
    for number in range(1, count):
        os.link(first, first.with_name(f"walk.{number:05d}.npz"))
    return {"frames": count, "gigabytes": round(count * each / 1e9, 2)}


def train_on_stream(root: Path, visited: int) -> dict[str, int]:
    """Trains for as many steps as so many frames take; returns the files read and the peak resident memory, bytes."""
    load, read = PackedOutfit.load, set()

    def counted(outfit: PackedOutfit, split: str, name: str) -> Any:
        read.add((split, name))
        return load(outfit, split, name)

    PackedOutfit.load = counted
    config = run_config("closet", root, "stream", steps=-(-visited // BATCH), batch=BATCH, scan_points=20_000)
    shutil.rmtree(config.runs_root / "closet" / "packed", ignore_errors=True)
    training = replace(config.train, points=5000, validate_every=10**6, save_every=10**6)
    split = replace(config.split, validation_share=0.0)
    train(replace(config, dataset="packed", outfit=("large",), train=training, split=split))
    return {"frames": len(read), "peak": peak_memory()}
